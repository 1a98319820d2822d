//! How much of the host's memory there is.

/// Bytes of the host's memory that programs may still take, where the system says so.
pub(super) fn host_memory() -> Option<u64> {
    let read = |file: &str| std::fs::read_to_string(file).ok();
    let free = available_bytes(&read("/proc/meminfo")?)?;
    // Within the limits of all groups, those of containers and jobs among them, that the process is in.
    let group =
        read("/proc/self/cgroup").and_then(|text| Some(text.lines().find_map(|l| l.strip_prefix("0::/"))?.to_owned()));
    let left_of = |group: &std::path::Path| {
        let [max, current, stat] = ["max", "current", "stat"]
            .map(|what| read(&format!("/sys/fs/cgroup/{}/memory.{what}", group.display())).unwrap_or_default());
        left_of_group(&max, &current, &stat)
    };
    let groups = group.iter().flat_map(|group| std::path::Path::new(group).ancestors());
    Some(groups.filter_map(left_of).fold(free, u64::min))
}

/// What a control group may still take by the files of Linux's second version of them, of which the kernel takes back what it keeps of files.
/// `None` without a limit.
fn left_of_group(max: &str, current: &str, stat: &str) -> Option<u64> {
    let [max, current] = [max, current].map(|text| text.trim().parse::<u64>().ok());
    let kept = |name: &str| {
        let line = stat.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.and_then(|n| n.trim().parse::<u64>().ok()).unwrap_or(0)
    };
    let of_files = kept("inactive_file").saturating_add(kept("active_file"));
    Some(max?.saturating_sub(current?.saturating_sub(of_files)))
}

/// `MemAvailable` of Linux's `/proc/meminfo`.
fn available_bytes(meminfo: &str) -> Option<u64> {
    let kib = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    kib.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_memory_is_read_from_linux() {
        let text = "MemTotal:       24684000 kB\nMemFree:  100 kB\nMemAvailable:   23256352 kB\nBuffers: 1 kB\n";
        assert_eq!(available_bytes(text), Some(23_256_352 * 1024));
        assert_eq!(available_bytes("MemTotal: 5 kB\n"), None);
        assert_eq!(available_bytes("MemAvailable: some\n"), None);
    }

    #[test]
    fn a_container_has_what_is_left_of_its_limit() {
        let stat = "anon 50\ninactive_file 300\nactive_file 100\ninactive_file_other 7\n";
        assert_eq!(left_of_group("1000\n", "700\n", stat), Some(700));
        assert_eq!(left_of_group("1000", "700", ""), Some(300));
        assert_eq!(left_of_group("100", "700", stat), Some(0));
        for (max, current) in [("max\n", "700"), ("", ""), ("1000", "")] {
            assert_eq!(left_of_group(max, current, stat), None);
        }
    }
}
