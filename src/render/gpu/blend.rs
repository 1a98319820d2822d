//! The blend of splats and mesh layers and its gradients: `blend_forward.wgsl`, `blend_backward.wgsl`.

use super::{
    device::{Buffer, Frame, Gpu, GpuError, Stage},
    scan::DispatchSizes,
    shader::Defines,
    splats::{ImageCapacity, Purpose, SplatLists},
    tile_pairs::{COUNT_STORED_PAIRS, COUNT_VISIBLE},
};

/// Threads per workgroup of `sum_pairs.wgsl`.
const SUM_THREADS: usize = 256;

/// Number of sums per splat that `blend_backward.wgsl` computes.
pub(crate) fn sums_each(absolute: bool) -> usize {
    if absolute { 12 } else { 10 }
}

/// Depth, colour and gradient of the mesh layers.
#[derive(Clone, Copy)]
pub(crate) struct LayerBuffers<'a> {
    pub(crate) depth: &'a Buffer,
    pub(crate) color: &'a Buffer,
    pub(crate) gradient: &'a Buffer,
}

/// Forward blend into an image.
pub(crate) struct Blend {
    /// Image, `[h·w]` vec4: rgb, final transmittance.
    pub(crate) image: Buffer,
    /// Colour and transmittance of each bucket, `[BUCKETS][pixel]` vec4. Empty unless lists are for training.
    buckets: Buffer,
    /// Per bucket `[BUCKETS][pixel]` two words: the pair after the last that it used, and the bits of the disparity,
    /// 1/z, blended as its colour. Empty unless for training.
    pub(crate) ends: Buffer,
    forward: Stage,
}

/// Backward blend: from the gradient of the image to sums per splat and the gradient of mesh layers.
pub(crate) struct BlendBackward {
    /// Stages from tiles to rows and from rows to sums per splat, once for each window of pairs whose rows can be bound.
    windows: Vec<[Stage; 2]>,
    sizes: DispatchSizes,
    splats_a_group: usize,
    /// Sums per splat, `[n]` rows; those of splats that the last view does not see are stale.
    pub(crate) sums: Buffer,
}

/// Threads per tile, and pixels per thread. A splat's record is read, and its gradient reduced over lanes, once per
/// thread, so more pixels per thread are faster until their state no longer fits in registers, or too few threads are
/// left to hide latency. A software adapter reads workgroup memory lane by lane and has no latency to hide, so there a
/// tile is one or two subgroups.
fn shape(gpu: &Gpu, layers: u32) -> (u32, u32) {
    match (gpu.profile().is_cpu, layers) {
        (true, 0..=1) => (16, 16),
        (true, _) => (32, 8),
        (false, _) if gpu.profile().subgroups => (128, 2),
        // Without subgroups the sums of every thread are in workgroup memory, which is limited to 16 KiB.
        (false, _) => (64, 4),
    }
}

/// Number of splats that a thread of the forward blend evaluates at once: hardware hides the latency of one behind the
/// others.
fn splats_at_once(gpu: &Gpu) -> u32 {
    if gpu.profile().is_cpu { 1 } else { 4 }
}

/// Adds the paths of the loop over splats: one per bucket, for splats that are in it throughout the tile, and one that
/// decides per pixel. Without `runs` a tile takes that last path only.
fn with_paths(defines: &Defines, layers: u32, runs: bool) -> Defines {
    let deciding = layers + 1;
    let (runs, first, end) = match (layers, runs) {
        (0, _) => (0, 0, 1),
        (_, true) => (1, 0, deciding + 1),
        (_, false) => (0, deciding, deciding + 1),
    };
    defines.clone().with("RUNS", runs).with("FIRST_PATH", first).with("PATHS", end)
}

/// Largest number of (tile, splat) pairs whose sums can be bound.
fn rows_at_most(gpu: &Gpu, n_sums: usize) -> usize {
    (gpu.max_binding_bytes() as usize / (4 * n_sums)).max(1)
}

fn base_defines(gpu: &Gpu, layers: u32) -> Defines {
    let (threads, per_thread) = shape(gpu, layers);
    gpu.defines()
        .with("LAYERS", layers)
        .with("BUCKETS", layers + 1)
        .with("THREADS", threads)
        .with("PER_THREAD", per_thread)
}

impl Blend {
    /// Buffers and kernel. With lists for training it also saves the data that [`BlendBackward`] reads.
    pub(crate) fn new(
        gpu: &Gpu,
        lists: &SplatLists,
        image: ImageCapacity,
        view: &Buffer,
        layers: Option<LayerBuffers>,
    ) -> Result<Self, GpuError> {
        let buckets_a_pixel = lists.layers() as usize + 1;
        let saved = if lists.purpose() == Purpose::Train { image.pixels * buckets_a_pixel } else { 0 };
        let image = gpu.storage("image", image.pixels * 4)?;
        let buckets = gpu.storage("blend buckets", saved * 4)?;
        let ends = gpu.storage("blend ends", saved * 2)?;
        let forward = forward(gpu, lists, [&image, &buckets, &ends], view, layers);
        Ok(Self { image, buckets, ends, forward })
    }

    /// Blends other lists of the same purpose into the same image.
    pub(crate) fn rebind(&mut self, gpu: &Gpu, lists: &SplatLists, view: &Buffer, layers: Option<LayerBuffers>) {
        self.forward = forward(gpu, lists, [&self.image, &self.buckets, &self.ends], view, layers);
    }

    /// Appends the blend of `tiles` tiles.
    pub(crate) fn record(&self, frame: &mut Frame, tiles: usize) {
        frame.dispatch(&self.forward, tiles);
    }
}

fn forward(
    gpu: &Gpu,
    lists: &SplatLists,
    [image, buckets, ends]: [&Buffer; 3],
    view: &Buffer,
    layers: Option<LayerBuffers>,
) -> Stage {
    let saves = lists.purpose() == Purpose::Train;
    let n_layers = lists.layers();
    let defines = with_paths(&base_defines(gpu, n_layers), n_layers, true)
        .with("SAVE", u32::from(saves))
        .with("AT_ONCE", splats_at_once(gpu));
    let mut buffers = vec![view, &lists.pairs.ranges, lists.pairs.splats(), &lists.projected, image];
    if saves {
        buffers.extend([buckets, ends]);
    }
    if let Some(l) = layers {
        buffers.extend([&lists.thresholds, l.depth, l.color]);
    }
    Stage::new(gpu, "blend_forward.wgsl", "main", &defines, &buffers)
}

impl BlendBackward {
    /// Stages for `capacity` splats in these lists, which must be for training. `image_gradient` is `[h·w]` vec4, by
    /// rgb and by the disparity; with `absolute` the sums include absolute values of each pixel's gradient by the
    /// means.
    pub(crate) fn new(
        gpu: &Gpu,
        lists: &SplatLists,
        blend: &Blend,
        view: &Buffer,
        layers: Option<LayerBuffers>,
        image_gradient: &Buffer,
        (capacity, absolute): (usize, bool),
    ) -> Result<Self, GpuError> {
        let n_layers = lists.layers();
        let n_sums = sums_each(absolute);
        // Without subgroups there are barriers where the paths would diverge.
        let defines = with_paths(&base_defines(gpu, n_layers), n_layers, gpu.profile().subgroups)
            .with("SUMS", n_sums as u32)
            .with("ABSOLUTE", u32::from(absolute))
            .with("PAIRWISE", u32::from(gpu.profile().subgroups && !gpu.profile().is_cpu))
            .with("HALF", n_sums as u32 / 2);
        let lanes = if gpu.profile().is_cpu && n_sums.is_multiple_of(2) { 2 } else { 1 };
        let values = n_sums / lanes;
        let together = if gpu.profile().is_cpu { values } else { 1 };
        let splats_a_group = SUM_THREADS / (values / together);
        let sum_defines = gpu
            .defines()
            .with("BY_EIGHT", u32::from(together == 1))
            .with("PAIRED", u32::from(lanes == 2))
            .with("VALUES", values as u32)
            .with("TOGETHER", together as u32)
            .with("SPLATS", splats_a_group as u32)
            .with("COUNT_VISIBLE", COUNT_VISIBLE)
            .with("COUNT_STORED_PAIRS", COUNT_STORED_PAIRS);
        let (pairs, window) = (lists.pairs.capacity(), rows_at_most(gpu, n_sums));
        let sums = gpu.storage("sums of splats", capacity.max(1) * n_sums)?;
        let rows = gpu.storage("sums of pairs", pairs.min(window) * n_sums)?;
        let numbers = lists.numbers();
        let mut tiles = vec![
            view,
            &lists.pairs.ranges,
            numbers.pairs,
            &lists.projected,
            image_gradient,
            &blend.buckets,
            &blend.ends,
            &rows,
        ];
        if let Some(l) = layers {
            tiles.extend([&lists.thresholds, l.depth, l.color, l.gradient]);
        }
        let of_splats = [numbers.counts, numbers.splats, numbers.first, numbers.count, &rows, &sums];
        let bound = |file: &str, defines: &Defines, start: usize, buffers: &[&Buffer]| {
            let defines =
                defines.clone().with("WINDOW_START", start as u32).with("WINDOW_END", (start + window) as u32);
            Stage::new(gpu, file, "main", &defines, buffers)
        };
        let of_window = |start: usize| {
            let of_tiles = bound("blend_backward.wgsl", &defines, start, &tiles);
            [of_tiles, bound("sum_pairs.wgsl", &sum_defines, start, &of_splats)]
        };
        let windows = (0..pairs.max(1)).step_by(window).map(of_window).collect();
        let sizes = DispatchSizes::new(gpu, capacity, &[splats_a_group], numbers.counts, COUNT_VISIBLE)?;
        Ok(Self { windows, sizes, splats_a_group, sums })
    }

    /// Appends the gradients of `tiles` tiles with this many splats.
    pub(crate) fn record(&self, frame: &mut Frame, tiles: usize, splats: usize) {
        if splats > 0 {
            self.sizes.record(frame);
        }
        for [of_tiles, of_splats] in &self.windows {
            frame.dispatch(of_tiles, tiles);
            if splats > 0 {
                self.sizes.dispatch(frame, of_splats, self.splats_a_group);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg32;

    use super::*;

    /// Also for subgroup sizes that no adapter here has: every sum is computed by exactly one lane, and equals the
    /// sequential sum.
    #[test]
    fn sums_are_spread_over_any_number_of_lanes() {
        let gpu = Gpu::open(None).unwrap();
        let mut rng = Pcg32::seed_from_u64(1);
        for (lanes, absolute) in [8_usize, 16, 32, 64].into_iter().flat_map(|lanes| [(lanes, false), (lanes, true)]) {
            let n_sums = sums_each(absolute);
            // Sums of both splats.
            let row = 2 * n_sums;
            let addends: Vec<f32> = (0..lanes * row).map(|_| rng.random_range(-1.0..1.0)).collect();
            let defines = (gpu.defines().with("LANES", lanes as u32).with("SUMS", n_sums as u32))
                .with("HALF", n_sums as u32 / 2)
                .with("ABSOLUTE", u32::from(absolute));
            let buffers = [
                gpu.storage_with("addends", &addends).unwrap(),
                gpu.storage("totals", 4 * lanes).unwrap(),
                gpu.storage("places", 4 * lanes).unwrap(),
            ];
            let stage = Stage::new(&gpu, "tests/spread.wgsl", "main", &defines, &buffers.each_ref());
            let mut frame = Frame::new(&gpu);
            frame.dispatch(&stage, 1);
            frame.submit();
            let [_, totals, places] = &buffers;
            let (totals, places) = gpu.read_both::<[f32; 4], [u32; 4]>((totals, lanes), (places, lanes)).unwrap();

            let mut found: Vec<Vec<f64>> = vec![vec![]; row];
            for (totals, places) in totals.iter().zip(&places) {
                for (total, place) in totals.iter().zip(places).take(3) {
                    assert!(*place as usize <= row, "{lanes} lanes: {place} of {row}");
                    if let Some(found) = found.get_mut(*place as usize) {
                        found.push(f64::from(*total));
                    }
                }
            }
            for (place, found) in found.iter().enumerate() {
                let expected: f64 = addends.iter().skip(place).step_by(row).map(|a| f64::from(*a)).sum();
                let is_it = matches!(found[..], [total] if (total - expected).abs() < 1e-6 * lanes as f64);
                assert!(is_it, "{lanes} lanes, sum {place} of {row}: {found:?}, not {expected}");
            }
        }
    }
}
