//! Free memory of the host.

use std::path::Path;

/// Bytes of the host's memory that programs may still allocate, if the system reports them.
pub(super) fn host_memory() -> Option<u64> {
    memory_of(Path::new("/"))
}

/// Free memory according to Linux's files below `root`.
fn memory_of(root: &Path) -> Option<u64> {
    let read = |file: &Path| std::fs::read_to_string(root.join(file)).ok();
    let free = available_bytes(&read(Path::new("proc/meminfo"))?)?;
    // Limited by all control groups of the process, including those of containers and jobs.
    let groups = read(Path::new("proc/self/cgroup")).unwrap_or_default();
    let limits = groups.lines().filter_map(|line| {
        let (files, group) = files_of(line)?;
        let left_of = |group: &Path| {
            let folder = Path::new(files.folder).join(group);
            let text = |name: &str| read(&folder.join(name)).unwrap_or_default();
            left_of_group(&text(files.limit), &text(files.used), &text("memory.stat"), files.cached)
        };
        Path::new(group).ancestors().filter_map(left_of).min()
    });
    Some(limits.fold(free, u64::min))
}

/// Names of the memory files of a version of Linux's control groups.
struct Files {
    folder: &'static str,
    limit: &'static str,
    used: &'static str,
    /// Lines of `memory.stat` that count cached pages of files, which are part of what is used.
    cached: [&'static str; 2],
}

const V1: Files = Files {
    folder: "sys/fs/cgroup/memory",
    limit: "memory.limit_in_bytes",
    used: "memory.usage_in_bytes",
    cached: ["total_inactive_file", "total_active_file"],
};

const V2: Files = Files {
    folder: "sys/fs/cgroup",
    limit: "memory.max",
    used: "memory.current",
    cached: ["inactive_file", "active_file"],
};

/// Memory files and group, as a relative path, of a line of `/proc/self/cgroup`, `ID:CONTROLLERS:/GROUP`; version 2 has
/// one group for all controllers.
fn files_of(line: &str) -> Option<(Files, &str)> {
    let (_, rest) = line.split_once(':')?;
    let (controllers, group) = rest.split_once(":/")?;
    match controllers {
        "" => Some((V2, group)),
        _ => controllers.split(',').any(|name| name == "memory").then_some((V1, group)),
    }
}

/// Bytes that a group may still allocate; cached pages of files count as free, as the kernel reclaims them. `None`
/// without a limit.
fn left_of_group(limit: &str, used: &str, stat: &str, cached: [&str; 2]) -> Option<u64> {
    let [limit, used] = [limit, used].map(|text| text.trim().parse::<u64>().ok());
    let kept = |name: &str| {
        let line = stat.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.and_then(|n| n.trim().parse::<u64>().ok()).unwrap_or(0)
    };
    let of_files = cached.into_iter().map(kept).fold(0, u64::saturating_add);
    Some(limit?.saturating_sub(used?.saturating_sub(of_files)))
}

/// Bytes of `MemAvailable` in Linux's `/proc/meminfo`.
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
        let left = |limit: &str, used: &str, stat: &str| left_of_group(limit, used, stat, V2.cached);
        assert_eq!(left("1000\n", "700\n", stat), Some(700));
        assert_eq!(left("1000", "700", ""), Some(300));
        assert_eq!(left("100", "700", stat), Some(0));
        for (max, current) in [("max\n", "700"), ("", ""), ("1000", "")] {
            assert_eq!(left(max, current, stat), None);
        }
    }

    /// A system with 8 GiB free memory, and nested control groups of version 1, of version 2, and of both.
    #[test]
    fn the_tightest_group_of_either_version_counts() {
        let root = tempfile::tempdir().unwrap();
        let write = |file: &str, text: &str| {
            let file = root.path().join(file);
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, text).unwrap();
        };
        let memory = |groups: &str| {
            write("proc/self/cgroup", groups);
            memory_of(root.path())
        };
        assert_eq!(memory_of(root.path()), None);
        write("proc/meminfo", "MemAvailable: 8388608 kB\n");
        assert_eq!(memory_of(root.path()), Some(8 << 30));
        write("sys/fs/cgroup/memory/slurm/job_7/memory.limit_in_bytes", "3221225472\n");
        write("sys/fs/cgroup/memory/slurm/job_7/memory.usage_in_bytes", "2147483648\n");
        write("sys/fs/cgroup/memory/slurm/job_7/memory.stat", "inactive_file 1\ntotal_inactive_file 1073741824\n");
        write("sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712\n");
        write("sys/fs/cgroup/memory/memory.usage_in_bytes", "4294967296\n");
        assert_eq!(memory("5:cpu,cpuacct:/slurm\n4:memory:/slurm/job_7/step_0\n0::/\n"), Some(2 << 30));
        assert_eq!(memory("4:hugetlb,memory:/\n"), Some(8 << 30));
        write("sys/fs/cgroup/pod/memory.max", "1073741824\n");
        write("sys/fs/cgroup/pod/memory.current", "0\n");
        write("sys/fs/cgroup/pod/box/memory.max", "max\n");
        write("sys/fs/cgroup/pod/box/memory.current", "0\n");
        assert_eq!(memory("0::/pod/box\n"), Some(1 << 30));
        assert_eq!(memory("5:cpu:/pod\n0::/\n"), Some(8 << 30));
    }
}
