//! How much memory training takes, and how much there is.

use super::{
    blend::moments, device::Gpu, mesh::BIN, pipeline::PAIRS_PER_SPLAT, state::GEOMETRY_FLOATS, training::HEADROOM,
    view::TILE,
};
use crate::scene::sh;

/// Most splats of a degree whose longest array fits one binding of the adapter.
#[must_use]
pub fn most_splats(gpu: &Gpu, sh_degree: u32) -> usize {
    let bytes_each = 4 * (3 * sh::coefficients(sh_degree)).max(GEOMETRY_FLOATS);
    gpu.max_binding_bytes() as usize / bytes_each
}

/// What the memory of a training run depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrainingSize {
    /// Splats.
    pub splats: usize,
    /// Of the splats.
    pub sh_degree: u32,
    /// Density control goes by absolute gradients.
    pub absolute_gradients: bool,
    /// Poses of photographs are refined.
    pub poses_move: bool,
    /// Triangles of all meshes.
    pub triangles: usize,
    /// Their vertices are free to move.
    pub vertices_move: bool,
    /// Floats of all maps, without mips: 4 per base texel, 3·((d+1)²−1) per texel of bands.
    pub map_floats: usize,
    /// Mesh layers, 0 without a mesh.
    pub layers: usize,
    /// Of the largest image.
    pub width: usize,
    /// Of the largest image.
    pub height: usize,
}

/// Bytes of GPU buffers that training takes, by what they grow with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrainingBytes {
    /// Parameters, gradients, moments and lists of the splats, with room for half as many again.
    pub splats: u64,
    /// Maps of the meshes, with mips, gradients and moments; triangles.
    pub meshes: u64,
    /// Images, layers and what the loss needs.
    pub images: u64,
}

impl TrainingBytes {
    /// All of it.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.splats.saturating_add(self.meshes).saturating_add(self.images)
    }
}

/// Bytes of GPU buffers that training takes, as long as no view has more (tile, splat) pairs than there is room for at
/// first. Lists exist twice while longer ones take their place. Saturates.
#[must_use]
pub fn training_bytes(size: &TrainingSize) -> TrainingBytes {
    let s = size;
    let wide = |n: usize| n as u64;
    let bytes = |parts: &[(u64, u64)]| {
        parts.iter().fold(0_u64, |sum, (count, floats)| sum.saturating_add(count.saturating_mul(4 * floats)))
    };
    let (pixels, layers) = (wide(s.width).saturating_mul(wide(s.height)), wide(s.layers));
    let splats = wide(s.splats).saturating_add((s.splats as f64 * HEADROOM) as u64);
    let sh_floats = 3 * wide(sh::coefficients(s.sh_degree));
    let per_side =
        |side: u32| wide(s.width.div_ceil(side as usize)).saturating_mul(wide(s.height.div_ceil(side as usize)));
    let tiles = per_side(TILE);
    // Parameters, gradients and two moments; projection, sums of the blend, statistics, five counters, the depth sort.
    let sums = wide(moments(s.absolute_gradients));
    let by_pose = if s.poses_move { 4 } else { 0 };
    let per_splat = 4 * (12 + sh_floats) + 12 + sums + 4 + 5 + 4 + layers.max(1) + by_pose;
    let pairs = wide(PAIRS_PER_SPLAT).saturating_mul(splats).saturating_add(tiles);
    // Image, its gradient, photograph, slopes of SSIM; colour, transmittance, disparity and end of every bucket.
    let mut per_pixel = 4 + 4 + 1 + 12 + 6 * (layers + 1);
    let (mut per_bin, mut meshes) = (0, 0);
    if layers > 0 {
        per_pixel += (1 + 1 + 4 + 4) * layers;
        per_bin = 2 + 16;
        // Texels and gradients have mips of up to five levels, the two moments none. Triangles, UVs, corners, boxes, four
        // pairs; a closed mesh has half as many vertices as triangles. To move, normals of corners; of vertices gradient, moments,
        // normals, steps, and neighbours with where they begin.
        let (map_floats, triangles) = (wide(s.map_floats), wide(s.triangles));
        let (by_triangle, by_vertex) = if s.vertices_move { (12, 2 + 2 + 4 + 4 + 6 + 1) } else { (0, 0) };
        meshes = bytes(&[
            (map_floats, 2),
            (map_floats.saturating_mul(341) / 256, 2),
            (triangles, 4 + 8 + 12 + 2 + 4 + by_triangle),
            (triangles / 2, 3 + by_vertex),
        ]);
    }
    TrainingBytes {
        // Pairs: keys and values, twice, splats, those with their numbers, sums. The counters of two sorts.
        splats: bytes(&[(splats, per_splat), (pairs, 4 + 1 + 2 + sums), (2 * 256 * 256, 1)]),
        meshes,
        images: bytes(&[(pixels, per_pixel), (tiles, 2), (per_side(BIN), per_bin)]),
    }
}

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

    #[test]
    fn absurd_sizes_saturate() {
        let n = usize::MAX;
        let size = TrainingSize {
            splats: n,
            sh_degree: 3,
            absolute_gradients: true,
            poses_move: true,
            triangles: n,
            vertices_move: false,
            map_floats: n,
            layers: 4,
            width: n,
            height: n,
        };
        assert_eq!(training_bytes(&size).total(), u64::MAX);
    }
}
