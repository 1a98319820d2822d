//! Benchmarks: what an adapter can do at best, and what each stage of a frame takes.

use std::time::Instant;

use super::{
    adam::{AdamStep, SplatRates},
    device::{Frame, Gpu, GpuError, Kernel, Timer},
    loss::TruthAlpha,
    mesh::BIN,
    pipeline::PAIRS_PER_SPLAT,
    renderer::Renderer,
    texels::TexelStep,
    training::{HEADROOM, Step, Training},
    view::TILE,
};
use crate::scene::{Camera, HybridScene, sh};

/// Upper bounds of an adapter.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Ceilings {
    /// Splat·pixel evaluations per second (conic, exp, blend) without memory traffic.
    pub evaluations: f64,
    /// f32 atomic additions per second, spread over 65,536 slots.
    pub atomic_adds: f64,
    /// Bytes per second, read plus written.
    pub copy_bytes: f64,
    /// Seconds that a dispatch of one thread takes.
    pub dispatch_seconds: f64,
}

/// Measures [`Ceilings`], best of five runs each; None where the adapter has no timestamps.
///
/// # Errors
/// If the driver fails.
pub fn ceilings(gpu: &Gpu) -> Result<Option<Ceilings>, GpuError> {
    const WORDS: usize = 1 << 23;
    let Some(mut timer) = Timer::new(gpu) else { return Ok(None) };
    let source = gpu.storage("ceilings", WORDS)?;
    let sums = gpu.storage("ceilings", 1 << 16)?;
    let destination = gpu.storage("ceilings", WORDS)?;
    let loops: u32 = if gpu.profile().is_cpu { 256 } else { 4096 };
    let groups = if gpu.profile().is_cpu { 256 } else { 4096 };
    let defines = gpu.defines().with("LOOPS", loops).with("COPY", 0);
    let mut best = |entry: &str, groups: usize| -> Result<f64, GpuError> {
        let copies = entry == "copy";
        let defines = defines.clone().with("COPY", u32::from(copies));
        let kernel = Kernel::new(gpu, "ceilings.wgsl", entry, &defines);
        let bindings = if copies {
            kernel.bind(gpu, &[&source, &sums, &destination])
        } else {
            kernel.bind(gpu, &[&source, &sums])
        };
        let mut best = f64::INFINITY;
        for _ in 0..6 {
            let mut frame = Frame::timed(gpu, &mut timer);
            frame.dispatch(&kernel, &bindings, groups);
            frame.submit();
            best = best.min(timer.seconds(gpu)?[0].1.max(1e-9));
        }
        Ok(best)
    };
    let threads = (groups * 256) as f64;
    Ok(Some(Ceilings {
        evaluations: threads * f64::from(loops) / best("evaluate", groups)?,
        atomic_adds: threads * f64::from(loops) / best("atomics", groups)?,
        copy_bytes: (8 * WORDS) as f64 / best("copy", WORDS / 256)?,
        dispatch_seconds: best("nothing", 1)?,
    }))
}

/// One kernel of a training step.
#[derive(Clone, Debug, serde::Serialize)]
pub struct StageTime {
    /// Shader file and entry point.
    pub kernel: String,
    /// Seconds per step, summed over its dispatches; median over the steps measured.
    pub seconds: f64,
}

/// What a training step of a scene does and takes.
#[derive(Clone, Debug, serde::Serialize)]
pub struct StepTimes {
    /// Every kernel, in the order of the first dispatch.
    pub stages: Vec<StageTime>,
    /// Seconds of a whole step by the host's clock, median.
    pub step_seconds: f64,
    /// Seconds of a forward frame by the host's clock, median.
    pub frame_seconds: f64,
    /// (tile, splat) pairs; each is 256 splat·pixel evaluations at most.
    pub pairs: usize,
    /// Splat·pixel evaluations of the blend's backward pass: in every tile, 256 per pair up to the last one that a pixel
    /// used. The forward pass does at least these and at most 256 per pair: it ends once every pixel is opaque, and
    /// finds out once per batch of pairs.
    pub evaluations: usize,
    /// Splats in view.
    pub visible: usize,
}

/// Times full training steps (forward, loss, backward, Adam) of `scene` seen by `camera`, against a grey photograph.
/// Kernel times are 0 where the adapter has no timestamps.
///
/// # Errors
/// If the adapter fails.
pub fn training_step(gpu: &Gpu, scene: &HybridScene, camera: &Camera, repeats: usize) -> Result<StepTimes, GpuError> {
    let truth = vec![128; camera.intrinsics().width as usize * camera.intrinsics().height as usize * 4];
    let mut training = Training::new(gpu, scene, &[*camera], 0.2, TruthAlpha::Ignore)?;
    let rates = SplatRates { mean: 0.0, opacity: 0.0, rotation: 0.0, log_scale: 0.0, sh_dc: 0.0, sh_rest: 0.0 };
    let step = Step {
        camera,
        truth: &truth,
        background: scene.composition.background,
        sh_degree: scene.splats.sh_degree(),
        band_degree: sh::MAX_DEGREE,
        splats: Some(AdamStep {
            number: 1,
            n_splats: scene.splats.len() as u32,
            sh_degree: scene.splats.sh_degree(),
            rates,
            opacity_weight: 0.0,
            scale_weight: 0.0,
            noise: 0.0,
            seed: 0,
            visible_only: false,
        }),
        texels: (!scene.meshes.is_empty()).then_some(TexelStep {
            number: 1,
            base_rate: 0.0,
            band_rate: 0.0,
            visited_only: false,
        }),
    };
    // Compiled kernels, long enough lists.
    training.step(&step)?;
    while training.grow_if_short()? {
        training.step(&step)?;
    }
    gpu.wait()?;
    let mut walls = vec![];
    for _ in 0..repeats.max(1) {
        let start = Instant::now();
        training.step(&step)?;
        gpu.wait()?;
        walls.push(start.elapsed().as_secs_f64());
    }
    training.profile();
    let mut kernels: Vec<(String, Vec<f64>)> = vec![];
    for _ in 0..repeats.max(1) {
        training.step(&step)?;
        let mut sums: Vec<(String, f64)> = vec![];
        for (kernel, seconds) in training.seconds()? {
            match sums.iter_mut().find(|s| s.0 == kernel) {
                Some(sum) => sum.1 += seconds,
                None => sums.push((kernel, seconds)),
            }
        }
        for (kernel, seconds) in sums {
            match kernels.iter_mut().find(|k| k.0 == kernel) {
                Some(k) => k.1.push(seconds),
                None => kernels.push((kernel, vec![seconds])),
            }
        }
    }
    let (visible, pairs) = training.pipeline.lists.read_counts(gpu)?;
    let evaluations = evaluations(gpu, &training, camera)?;
    drop(training);
    let frame_seconds = Renderer::new(gpu, scene, &[*camera])?.seconds_per_frame(camera, repeats.max(1) as u32)?;
    Ok(StepTimes {
        stages: kernels.into_iter().map(|(kernel, t)| StageTime { kernel, seconds: median(t) }).collect(),
        step_seconds: median(walls),
        frame_seconds,
        pairs,
        evaluations,
        visible,
    })
}

/// See [`StepTimes::evaluations`].
fn evaluations(gpu: &Gpu, training: &Training, camera: &Camera) -> Result<usize, GpuError> {
    let (width, height) = (camera.intrinsics().width as usize, camera.intrinsics().height as usize);
    let lists = &training.pipeline.lists;
    let tile = TILE as usize;
    let across = width.div_ceil(tile);
    let ranges: Vec<[u32; 2]> = gpu.read(&lists.ranges, across * height.div_ceil(tile))?;
    let ends: Vec<u32> = match training.pipeline.blend.ends() {
        Some(ends) => gpu.read(ends, (lists.layers() as usize + 1) * width * height)?,
        None => vec![],
    };
    let mut last: Vec<u32> = ranges.iter().map(|r| r[0]).collect();
    for (i, &end) in ends.iter().enumerate() {
        let (x, y) = (i % width, i / width % height);
        let of_tile = &mut last[y / tile * across + x / tile];
        *of_tile = end.max(*of_tile);
    }
    Ok(last.iter().zip(&ranges).map(|(end, range)| (end - range[0]) as usize * tile * tile).sum())
}

/// What the memory of a training run depends on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TrainingSize {
    /// Splats.
    pub splats: usize,
    /// Of the splats.
    pub sh_degree: u32,
    /// Triangles of all meshes.
    pub triangles: usize,
    /// Floats of all maps, without mips: 4 per base texel, 3·((d+1)²−1) per texel of bands.
    pub map_floats: usize,
    /// Mesh layers, 0 without a mesh.
    pub layers: usize,
    /// Of the largest image.
    pub width: usize,
    /// Of the largest image.
    pub height: usize,
}

/// Bytes of GPU buffers that training takes, as long as no view has more (tile, splat) pairs than there is room for at
/// first. While buffers make place for larger ones both exist, so that a run's peak is below twice what it ends with.
#[must_use]
pub fn training_bytes(size: &TrainingSize) -> u64 {
    let s = size;
    let (pixels, layers) = (s.width * s.height, s.layers);
    let splats = s.splats + (s.splats as f64 * HEADROOM) as usize;
    let sh_floats = 3 * sh::coefficients(s.sh_degree);
    let tiles = s.width.div_ceil(TILE as usize) * s.height.div_ceil(TILE as usize);
    // Parameters, gradients and two moments; projection, blend moments, statistics, five counters, the depth sort.
    let per_splat = 4 * (12 + sh_floats) + 12 + 10 + 4 + 5 + 4 + layers.max(1);
    let pairs = PAIRS_PER_SPLAT * splats + tiles;
    // Image, its gradient, photograph, slopes of SSIM; colour, transmittance and end of every bucket.
    let per_pixel = 4 + 4 + 1 + 12 + 5 * (layers + 1);
    let mut floats = per_splat * splats + 4 * pairs + 2 * tiles + per_pixel * pixels;
    if layers > 0 {
        // A closed mesh has half as many vertices as triangles. Triangles, UVs, corners, boxes, four pairs.
        let bins = s.width.div_ceil(BIN as usize) * s.height.div_ceil(BIN as usize);
        floats += s.triangles * 3 / 2 + (4 + 8 + 12 + 2 + 4) * s.triangles + (2 + 16) * bins;
        floats += (1 + 1 + 4 + 4) * layers * pixels;
        // Texels and gradients have mips of up to five levels, the two moments none.
        floats += 2 * s.map_floats + 2 * (s.map_floats * 341 / 256);
    }
    // The counters of two sorts.
    floats += 2 * 256 * 256;
    4 * floats as u64
}

/// Peak bytes of GPU buffers in a training step, on an adapter opened for it.
///
/// # Errors
/// If the adapter fails.
pub fn training_peak(adapter: Option<&str>, scene: &HybridScene, camera: &Camera) -> Result<u64, GpuError> {
    let gpu = Gpu::open(adapter)?;
    training_step(&gpu, scene, camera, 1)?;
    Ok(gpu.peak_bytes())
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}
