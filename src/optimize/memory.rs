//! Check, before a run begins, that it fits the adapter's memory.

use super::{Density, MeshSource, TrainError, TrainOptions, maps::MapLayout};
use crate::{
    geometry::Shell,
    render::gpu::{
        Gpu,
        memory::{TrainingSize, training_bytes},
    },
    scene::Camera,
};

/// Most bytes of photographs to keep on the adapter.
const MOST_KEPT: u64 = 1 << 30;

/// Checks that the run will not exhaust memory once it has `max_splats`, as far as that can be predicted: growth of
/// lists for views with more pairs than their first size holds is not counted. Returns the bytes of photographs that
/// may stay on the adapter: those of all cameras, or [`MOST_KEPT`] of them, provided that half as much again as the run
/// asks for is free beside them; else 0.
///
/// # Errors
/// [`GpuError::NotEnoughMemory`](crate::render::gpu::GpuError), stating what takes how much.
pub(super) fn check(
    gpu: &Gpu,
    options: &TrainOptions,
    cameras: &[Camera],
    source: &MeshSource,
    max_splats: usize,
    texture_size: u32,
) -> Result<u64, TrainError> {
    let hybrid = size(options, cameras, source, max_splats, texture_size);
    // The longest buffers. Splats are limited to what can be bound.
    let [base, bands] = MapLayout::of(options, texture_size).floats().map(|floats| floats as u64 * 341 / 256);
    let area = |c: &Camera| c.intrinsics().pixels() as u64;
    let pixels = cameras.iter().map(area).max().unwrap_or(1);
    if hybrid.layers > 0 {
        gpu.ensure_bindable("the map of colour and opacity", 4 * base)?;
        gpu.ensure_bindable("the map of view dependence", 4 * bands)?;
        // Two floats for one of a map, but none for its coarser levels.
        let longest = MapLayout::of(options, texture_size).floats().into_iter().max().unwrap_or(0) as u64;
        gpu.ensure_bindable("the moments of a map", 8 * longest)?;
        gpu.ensure_bindable("the mesh layers of an image", 16 * (hybrid.layers as u64 + 1) * pixels)?;
    }
    gpu.ensure_bindable("the loss of an image", 48 * pixels)?;
    let (what, bytes) = needed(&hybrid, texture_size);
    gpu.ensure_free(&what, bytes)?;
    let photographs = cameras.iter().map(area).fold(0_u64, |sum, pixels| sum.saturating_add(4 * pixels)).min(MOST_KEPT);
    let with_room = bytes.saturating_add(bytes / 2).saturating_add(photographs);
    Ok(if gpu.ensure_free("photographs", with_room).is_ok() { photographs } else { 0 })
}

/// Sizes of the run at its largest.
fn size(
    options: &TrainOptions,
    cameras: &[Camera],
    source: &MeshSource,
    splats: usize,
    texture_size: u32,
) -> TrainingSize {
    let triangles = match source {
        MeshSource::None => 0,
        MeshSource::Splats | MeshSource::Points => {
            options.triangles.saturating_add(if options.shell { Shell::MOST_TRIANGLES } else { 0 })
        }
        MeshSource::Given { surface, .. } => surface.triangles.len(),
    };
    let size = |c: &Camera| (c.intrinsics().width as usize, c.intrinsics().height as usize);
    let (width, height) = cameras.iter().map(size).max_by_key(|(w, h)| w * h).unwrap_or((1, 1));
    let has_mesh = *source != MeshSource::None;
    TrainingSize {
        splats,
        sh_degree: options.sh_degree,
        absolute_gradients: options.density == Density::Absgs,
        poses_move: options.refine_poses,
        triangles,
        vertices_move: source.is_found(),
        map_floats: if has_mesh { MapLayout::of(options, texture_size).floats().iter().sum() } else { 0 },
        layers: if has_mesh { options.layers as usize } else { 0 },
        width,
        height,
    }
}

/// Description of what the memory is for, and its bytes.
fn needed(hybrid: &TrainingSize, texture_size: u32) -> (String, u64) {
    let bytes = training_bytes(hybrid);
    let mib = |bytes: u64| bytes >> 20;
    let TrainingSize { splats, sh_degree, layers, width, height, .. } = *hybrid;
    let mesh = match layers {
        0 => String::new(),
        _ => format!(", the mesh with maps of {texture_size}² texels {} MiB", mib(bytes.meshes)),
    };
    let what = format!(
        "training ({splats} splats of SH degree {sh_degree}: {} MiB{mesh}, images of {width}×{height}: {} MiB)",
        mib(bytes.splats),
        mib(bytes.images),
    );
    (what, bytes.total())
}

/// Largest side of maps with no more than this many floats: `wanted`, else a multiple of 32, which gives mip levels as
/// deep as gutters separate charts, else the least possible, 16.
pub(super) fn texture_size_within(options: &TrainOptions, wanted: u32, floats: usize) -> u32 {
    let smaller = (1..=wanted / 32).rev().map(|n| 32 * n);
    let mut sizes = std::iter::once(wanted).chain(smaller);
    sizes.find(|&size| MapLayout::of(options, size).floats().iter().sum::<usize>() <= floats).unwrap_or(16)
}

#[cfg(test)]
mod tests {
    use glam::{DVec3, Vec3};

    use super::*;
    use crate::{geometry::Surface, optimize::maps, scene::testing::ahead};

    fn camera(width: u32, height: u32) -> Camera {
        ahead([width, height], f64::from(width), DVec3::ZERO)
    }

    #[test]
    fn the_maps_are_those_that_are_made() {
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y];
        let surface = Surface { positions, triangles: vec![[0, 1, 2]] };
        for (band_degree, side) in [(0, 64), (2, 32), (3, 128)] {
            let options = TrainOptions { band_degree, ..TrainOptions::default() };
            let mesh =
                maps::textured_as(crate::geometry::unwrap(&surface, None, side, 0).unwrap(), &options, side).unwrap();
            assert_eq!(MapLayout::of(&options, side).floats().iter().sum::<usize>(), mesh.atlas().floats());
        }
    }

    #[test]
    fn the_message_names_every_part() {
        let (options, cameras) = (TrainOptions::default(), [camera(1920, 1080), camera(80, 1200)]);
        let of = |source: &MeshSource| needed(&size(&options, &cameras, source, 1_000_000, 2048), 2048);
        let (what, hybrid) = of(&MeshSource::Splats);
        let expected = "training (1000000 splats of SH degree 3: 1450 MiB, the mesh with maps of 2048² texels 415 MiB, \
                        images of 1920×1080: 468 MiB)";
        assert_eq!(what, expected);
        let (what, alone) = of(&MeshSource::None);
        assert!(alone < hybrid && !what.contains("mesh"), "{what}");
    }

    #[test]
    fn any_number_of_triangles_has_a_size() {
        let options = TrainOptions { triangles: usize::MAX, ..TrainOptions::default() };
        let hybrid = size(&options, &[camera(64, 64)], &MeshSource::Splats, 1, 64);
        assert_eq!((hybrid.triangles, needed(&hybrid, 64).1), (usize::MAX, u64::MAX));
    }

    #[test]
    fn more_than_there_is_is_refused() {
        let gpu = Gpu::open(None).unwrap();
        let options = TrainOptions::default();
        let error = check(&gpu, &options, &[camera(64, 64)], &MeshSource::Splats, 1, 1 << 20).unwrap_err().to_string();
        assert!(error.starts_with("the map of colour and opacity needs a buffer of "), "{error}");
        let of = |n| check(&gpu, &options, &[camera(64, 64)], &MeshSource::None, n, 64);
        of(1000).unwrap();
        // A software adapter uses host memory; a test must not fill the memory of a GPU.
        if gpu.profile().is_cpu {
            assert!(matches!(of(1 << 50), Err(TrainError::Gpu(e)) if e.is_lack_of_memory()));
        }
    }
}
