//! Benchmarks: ceilings of an adapter, and the time of each stage of a frame.

use std::time::Instant;

use super::{
    adam::AdamStep,
    device::{Frame, Gpu, GpuError, Stage, Timer},
    photographs::Truth,
    renderer::Renderer,
    texels::TexelStep,
    training::{Step, Training, TrainingOptions},
    view::TILE,
};
use crate::scene::{Camera, HybridScene, sh};
use crate::stats::median;

/// Steps between waits of the host for a GPU, as `optimize::static_scene` waits for losses.
const STEPS_A_WAIT: u32 = 10;

/// Measured upper bounds of an adapter's throughput.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub struct Ceilings {
    /// Evaluations of a splat at a pixel per second (conic, exp, blend) without memory traffic.
    pub evaluations: f64,
    /// Atomic additions of integers per second, spread over 65,536 slots.
    pub atomic_adds: f64,
    /// Bytes per second, read plus written.
    pub copy_bytes: f64,
    /// Seconds of a dispatch of one thread.
    pub dispatch_seconds: f64,
}

/// How much is done at a time.
struct Work {
    /// Evaluations of a thread.
    loops: u32,
    /// Atomic additions of a thread.
    adds: u32,
    /// Workgroups of 256 threads that do either.
    groups: usize,
    /// Words to copy, a multiple of 256.
    words: usize,
}

impl Work {
    /// So much that starting it takes no time beside it.
    fn of(gpu: &Gpu) -> Self {
        let words = 1 << 23;
        if gpu.profile().is_cpu {
            return Self { loops: 256, adds: 256, groups: 256, words };
        }
        // Where adds are slow, as many as evaluations would take seconds, which drivers of displays do not grant.
        Self { loops: 4096, adds: 64, groups: 4096, words }
    }
}

/// Measures [`Ceilings`], best of five runs each; None where the adapter has no timestamps.
///
/// # Errors
/// If the driver fails.
pub fn ceilings(gpu: &Gpu) -> Result<Option<Ceilings>, GpuError> {
    ceilings_by(gpu, &Work::of(gpu))
}

fn ceilings_by(gpu: &Gpu, work: &Work) -> Result<Option<Ceilings>, GpuError> {
    let &Work { loops, adds, groups, words } = work;
    let Some(mut timer) = Timer::new(gpu) else { return Ok(None) };
    let source = gpu.storage("ceilings", words)?;
    let sums = gpu.storage("ceilings", 1 << 16)?;
    let destination = gpu.storage("ceilings", words)?;
    let mut best = |entry: &str, groups: usize| -> Result<f64, GpuError> {
        let copies = entry == "copy";
        let loops = if entry == "atomics" { adds } else { loops };
        let defines = gpu.defines().with("LOOPS", loops).with("COPY", u32::from(copies));
        let buffers = [&source, &sums, &destination];
        let stage = Stage::new(gpu, "ceilings.wgsl", entry, &defines, if copies { &buffers } else { &buffers[..2] });
        let mut best = f64::INFINITY;
        for _ in 0..6 {
            let mut frame = Frame::timed(gpu, &mut timer);
            frame.dispatch(&stage, groups);
            frame.submit();
            best = best.min(timer.seconds(gpu)?[0].1.max(1e-9));
        }
        Ok(best)
    };
    let threads = (groups * 256) as f64;
    Ok(Some(Ceilings {
        evaluations: threads * f64::from(loops) / best("evaluate", groups)?,
        atomic_adds: threads * f64::from(adds) / best("atomics", groups)?,
        copy_bytes: (8 * words) as f64 / best("copy", words / 256)?,
        dispatch_seconds: best("nothing", 1)?,
    }))
}

/// Time of one kernel of a training step.
#[derive(Clone, Debug, serde::Serialize)]
pub struct StageTime {
    /// Shader file and entry point.
    pub kernel: String,
    /// Seconds per step, summed over its dispatches; median over the steps measured.
    pub seconds: f64,
}

/// Times and counts of a training step.
#[derive(Clone, Debug, serde::Serialize)]
pub struct StepTimes {
    /// Every kernel, in the order of the first dispatch.
    pub stages: Vec<StageTime>,
    /// Seconds of a whole step by the host's clock, median; on GPUs averaged over ten consecutive steps, as in
    /// training.
    pub step_seconds: f64,
    /// Seconds of a forward frame by the host's clock, median.
    pub frame_seconds: f64,
    /// (tile, splat) pairs; each is at most 256 evaluations of a splat at a pixel.
    pub pairs: usize,
    /// Evaluations of splats at pixels in the blend's backward pass: in every tile, 256 per pair up to the last one
    /// that a pixel used. The forward pass does at least these and at most 256 per pair: it ends once every pixel is
    /// opaque, which is checked once per batch of pairs.
    pub evaluations: usize,
    /// Splats in view.
    pub visible: usize,
}

/// Times full training steps (forward, loss, backward, Adam) of `scene` seen by `camera`, against a grey photograph.
/// Kernel times are 0 where the adapter has no timestamps.
///
/// # Errors
/// If the adapter fails, or the scene's composition is not valid.
pub fn training_step(gpu: &Gpu, scene: &HybridScene, camera: &Camera, repeats: usize) -> Result<StepTimes, GpuError> {
    scene.composition.validate().map_err(GpuError::Scene)?;
    let truth = vec![128; camera.intrinsics().pixels() * 4];
    let options = TrainingOptions { most_splats: scene.splats.len(), ..TrainingOptions::default() };
    let mut training = Training::with_options(gpu, scene, &[*camera], &options)?;
    training.keep_photographs(truth.len() as u64);
    let step = unmoving(scene, camera, &truth);
    // Warm-up: compiles kernels and makes lists long enough.
    training.step(&step)?;
    while training.grow_if_short()? > 0 {
        training.step(&step)?;
    }
    gpu.wait()?;
    // On a software adapter a wait is negligible beside a step.
    let steps = if gpu.profile().is_cpu { 1 } else { STEPS_A_WAIT };
    let mut walls = vec![];
    for _ in 0..repeats.max(1) {
        let start = Instant::now();
        for _ in 0..steps {
            training.step(&step)?;
        }
        gpu.wait()?;
        walls.push(start.elapsed().as_secs_f64() / f64::from(steps));
    }
    let stages = kernels(&mut training, &step, repeats)?;
    let (visible, pairs) = training.pipeline.front.lists.read_counts(gpu)?;
    let evaluations = evaluations(gpu, &training, camera)?;
    drop(training);
    let frame_seconds = Renderer::new(gpu, scene, &[*camera])?.seconds_per_frame(camera, repeats.max(1) as u32)?;
    Ok(StepTimes { stages, step_seconds: median(walls).unwrap_or(0.0), frame_seconds, pairs, evaluations, visible })
}

/// A step with everything enabled, at learning rates of 0, so that steps can be repeated.
fn unmoving<'a>(scene: &HybridScene, camera: &'a Camera, truth: &'a [u8]) -> Step<'a> {
    let (n_splats, sh_degree) = (scene.splats.len() as u32, scene.splats.sh_degree());
    let texels = TexelStep { number: 1, ..TexelStep::default() };
    Step {
        truth: Truth::Sent { rgba: truth, number: Some(0) },
        background: scene.composition.background,
        sh_degree,
        band_degree: sh::MAX_DEGREE,
        splats: Some(AdamStep { number: 1, n_splats, sh_degree, ..AdamStep::default() }),
        texels: (!scene.meshes.is_empty()).then_some(texels),
        ..Step::still(camera, truth)
    }
}

/// Computes [`StepTimes::stages`].
fn kernels(training: &mut Training, step: &Step, repeats: usize) -> Result<Vec<StageTime>, GpuError> {
    training.profile();
    let mut kernels: Vec<(String, Vec<f64>)> = vec![];
    for _ in 0..repeats.max(1) {
        training.step(step)?;
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
    let stage = |(kernel, t)| StageTime { kernel, seconds: median(t).unwrap_or(0.0) };
    Ok(kernels.into_iter().map(stage).collect())
}

/// Computes [`StepTimes::evaluations`].
fn evaluations(gpu: &Gpu, training: &Training, camera: &Camera) -> Result<usize, GpuError> {
    let (width, height) = (camera.intrinsics().width as usize, camera.intrinsics().height as usize);
    let lists = &training.pipeline.front.lists;
    let tile = TILE as usize;
    let across = width.div_ceil(tile);
    let ranges: Vec<[u32; 2]> = gpu.read(&lists.pairs.ranges, across * height.div_ceil(tile))?;
    let ends: Vec<[u32; 2]> =
        gpu.read(&training.pipeline.blend.ends, (lists.layers() as usize + 1) * width * height)?;
    let mut last: Vec<u32> = ranges.iter().map(|r| r[0]).collect();
    for (i, &[end, _]) in ends.iter().enumerate() {
        let (x, y) = (i % width, i / width % height);
        let of_tile = &mut last[y / tile * across + x / tile];
        *of_tile = end.max(*of_tile);
    }
    Ok(last.iter().zip(&ranges).map(|(end, range)| (end - range[0]) as usize * tile * tile).sum())
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::testing::smooth_scene;
    use crate::scene::OrderMode;

    #[test]
    fn ceilings_are_measured_where_there_are_timestamps() {
        let gpu = Gpu::open(None).unwrap();
        let found = ceilings_by(&gpu, &Work { loops: 1, adds: 1, groups: 1, words: 256 }).unwrap();
        assert_eq!(found.is_some(), gpu.profile().timestamps);
        if let Some(Ceilings { evaluations, atomic_adds, copy_bytes, dispatch_seconds }) = found {
            let all = [evaluations, atomic_adds, copy_bytes, dispatch_seconds];
            assert!(all.iter().all(|v| v.is_finite() && *v > 0.0), "{found:?}");
        }
    }

    #[test]
    fn a_step_is_taken_apart_into_what_it_does() {
        let gpu = Gpu::open(None).unwrap();
        let (scene, camera) = smooth_scene(1, 2, OrderMode::Stable);
        let times = training_step(&gpu, &scene, &camera, 1).unwrap();
        // Splats that are visible in every pixel of 24 × 18, which are four tiles.
        assert_eq!((times.visible, times.pairs), (5, 20), "{times:?}");
        assert!((1..=256 * times.pairs).contains(&times.evaluations), "{times:?}");
        assert!(times.step_seconds > 0.0 && times.frame_seconds > 0.0, "{times:?}");
        let kernels: Vec<&str> = times.stages.iter().map(|stage| stage.kernel.as_str()).collect();
        for part in
            ["project_splats", "raster_layers", "blend_forward", "loss", "blend_backward", "adam_splats", "adam_texels"]
        {
            let of_part = kernels.iter().filter(|kernel| kernel.starts_with(part)).count();
            assert!(of_part > 0 || !gpu.profile().timestamps, "{part} is not among {kernels:?}");
        }
        let mut distinct = kernels.clone();
        distinct.sort_unstable();
        distinct.dedup();
        assert_eq!(distinct.len(), kernels.len(), "{kernels:?}");
        assert!(times.stages.iter().all(|stage| stage.seconds.is_finite() && stage.seconds >= 0.0), "{times:?}");
        // Measured on an adapter of its own, which has allocated nothing else.
        assert!(training_peak(None, &scene, &camera).unwrap() > 0);
    }
}
