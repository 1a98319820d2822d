//! Measures the peak rates of the adapter and the time of a training step, stage by stage: `make bench`.
//!
//! `cargo bench -- --quick` takes a minute, `--yardstick` runs one small scene only.

#![allow(clippy::print_stdout, reason = "a benchmark reports on the terminal")]

mod scene;
mod tables;

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use centaur::{
    format::{ReadOptions, atomic_write, read_file},
    metrics::plot::{self, Plot},
    render::gpu::{
        Gpu,
        measure::{self, Ceilings, StepTimes},
        memory::{self, TrainingSize},
    },
};
use clap::Parser as _;
use scene::Sheet;

/// Mesh of the hybrid scenes: 20,000 triangles, 1024² base texels, 256² texels of SH bands of degree 2.
const SHEET: Sheet = Sheet { cells: 100, side: 1024 };
/// Splats, width and height of the yardstick: a capture of 43 views that other trainers were timed on.
const YARDSTICK: (usize, u32, u32) = (12_000, 265, 473);

/// Ceilings of the adapter, and every stage of a training step as a fraction of them.
#[derive(clap::Parser)]
struct Options {
    /// Small scenes only: finds mistakes, does not measure speed.
    #[arg(long)]
    quick: bool,
    /// Only the yardstick: 12,000 splats at 265×473.
    #[arg(long)]
    yardstick: bool,
    /// Only GPU memory in bytes, up to a scene of 1 M splats at 1920×1080.
    #[arg(long, conflicts_with = "yardstick")]
    memory: bool,
    /// Only a training step of this scene, as written by `centaur train`, with the camera in the middle of its list.
    #[arg(long, value_name = "SCENE.glb", conflicts_with_all = ["yardstick", "memory", "json"])]
    scene: Option<PathBuf>,
    /// Also write the figures to this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Name of the adapter, as for `centaur train --adapter`, instead of the best one.
    #[arg(long, value_name = "NAME")]
    adapter: Option<String>,
    /// Flag that cargo passes to benchmarks.
    #[arg(long, hide = true)]
    bench: bool,
}

/// A scene and the measured times of one of its training steps.
#[derive(serde::Serialize)]
struct Run {
    splats: usize,
    width: u32,
    height: u32,
    mesh: bool,
    #[serde(flatten)]
    times: StepTimes,
}

/// Step times as a function of one quantity.
#[derive(serde::Serialize)]
struct Curve {
    over: &'static str,
    /// (quantity, seconds per step).
    points: Vec<(f64, f64)>,
    /// Exponent of the power law that fits best.
    exponent: f64,
    /// Intercept in seconds, and seconds per unit, of the straight line that fits best.
    line: (f64, f64),
    /// Largest deviation from that line, as a fraction of the time.
    off_line: f64,
}

/// Bytes used by training: measured as the difference between two sizes, and as computed by the library.
#[derive(serde::Serialize)]
struct Memory {
    per_splat: f64,
    per_map_float: f64,
    per_pixel: f64,
    /// Measured bytes divided by computed bytes.
    agreement: f64,
    large: Large,
}

/// Bytes for many splats, a 2048² atlas with 512² SH bands of degree 2, 200,000 triangles, one layer, 1920×1080.
#[derive(serde::Serialize)]
struct Large {
    /// As computed by the library for 1 M splats.
    accounted: u64,
    /// Largest such scene that could be trained; quick runs train none.
    trained: Option<Trained>,
    /// Why that scene has fewer than 1 M splats.
    refused: Option<String>,
}

#[derive(serde::Serialize)]
struct Trained {
    splats: usize,
    /// Peak over some steps.
    bytes: u64,
    accounted: u64,
}

#[derive(serde::Serialize)]
struct Results {
    adapter: String,
    ceilings: Option<Ceilings>,
    yardstick: Option<Run>,
    runs: Vec<Run>,
    curves: Vec<Curve>,
    memory: Option<Memory>,
}

fn main() -> anyhow::Result<()> {
    let options = Options::parse();
    let gpu = Gpu::open(options.adapter.as_deref())?;
    let ceilings = measure::ceilings(&gpu)?;
    tables::print_adapter(&gpu, ceilings.as_ref());

    if let Some(file) = &options.scene {
        let read = read_file(file, &ReadOptions::default())?;
        let (name, camera) = (read.cameras.get(read.cameras.len() / 2))
            .with_context(|| format!("{}: has no cameras", file.display()))?;
        println!("\n{} from {name}\n", file.display());
        tables::print_stages(&[timed(&gpu, &read.scene, camera)?], ceilings.as_ref());
        return Ok(());
    }

    let mut results = Results {
        adapter: gpu.adapter().into(),
        ceilings,
        yardstick: None,
        runs: vec![],
        curves: vec![],
        memory: None,
    };
    if !options.memory {
        let (n, width, height) = YARDSTICK;
        let yardstick = run(&gpu, n, (width, height), None)?;
        println!("\nyardstick\n");
        tables::print_stages(std::slice::from_ref(&yardstick), ceilings.as_ref());
        results.yardstick = Some(yardstick);
    }
    if !options.yardstick && !options.memory {
        results.runs = stages(&gpu, options.quick, ceilings.as_ref())?;
        results.curves = curves(&gpu, options.quick)?;
    }
    if !options.yardstick {
        results.memory = Some(memory(options.adapter.as_deref(), options.quick)?);
    }
    if let Some(memory) = &results.memory {
        tables::print_memory(memory);
    }
    if let Some(file) = &options.json {
        let text = serde_json::to_string_pretty(&results)?;
        atomic_write(file, text.as_bytes())?;
    }
    Ok(())
}

/// Times a step with `n` splats. A software adapter is so slow that few repetitions suffice.
fn run(gpu: &Gpu, n: usize, (width, height): (u32, u32), sheet: Option<Sheet>) -> anyhow::Result<Run> {
    let camera = scene::camera(width, height);
    timed(gpu, &scene::scene(n, &camera, sheet), &camera)
}

fn timed(gpu: &Gpu, scene: &centaur::scene::HybridScene, camera: &centaur::scene::Camera) -> anyhow::Result<Run> {
    let (k, splats, mesh) = (camera.intrinsics(), scene.splats.len(), !scene.meshes.is_empty());
    let repeats = if gpu.profile().is_cpu { 3 } else { 30 };
    let times = measure::training_step(gpu, scene, camera, repeats)
        .with_context(|| format!("{splats} splats at {}×{}", k.width, k.height))?;
    Ok(Run { splats, width: k.width, height: k.height, mesh, times })
}

/// Times every splat count at every image size, with and without mesh.
fn stages(gpu: &Gpu, quick: bool, ceilings: Option<&Ceilings>) -> anyhow::Result<Vec<Run>> {
    let (counts, sizes): (&[usize], &[(u32, u32)]) =
        if quick { (&[20_000], &[(480, 270)]) } else { (&[100_000, 500_000], &[(960, 540), (1920, 1080)]) };
    let mut runs = vec![];
    for &n in counts {
        println!();
        let first = runs.len();
        for &size in sizes {
            for sheet in [None, Some(SHEET)] {
                runs.push(run(gpu, n, size, sheet)?);
            }
        }
        tables::print_stages(&runs[first..], ceilings);
    }
    Ok(runs)
}

/// Step time by the number of splats of constant size in pixels, and by the number of pixels for one scene.
fn curves(gpu: &Gpu, quick: bool) -> anyhow::Result<Vec<Curve>> {
    let (unit, fixed) = if quick { (2_500, (480, 270)) } else { (25_000, (960, 540)) };
    let over_splats = (0..4).map(|i| unit << i).map(|n| Ok((n as f64, run(gpu, n, fixed, None)?.times.step_seconds)));
    let over_splats = over_splats.collect::<anyhow::Result<_>>()?;

    // The same splats in world space, rendered at other resolutions: their size in pixels grows with the image.
    let full = scene::camera(2 * fixed.0, 2 * fixed.1);
    let scene = scene::scene(4 * unit, &full, None);
    let over_pixels = [0.5, 1.0, 1.5, 2.0].map(|s| {
        let camera = full.resized((f64::from(fixed.0) * s) as u32, (f64::from(fixed.1) * s) as u32);
        let run = timed(gpu, &scene, &camera)?;
        Ok((f64::from(run.width) * f64::from(run.height), run.times.step_seconds))
    });
    let over_pixels = over_pixels.into_iter().collect::<anyhow::Result<_>>()?;

    let folder = Path::new("out/bench");
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let mut curves = vec![];
    for (over, points) in [("splats", over_splats), ("pixels", over_pixels)] {
        let points: Vec<(f64, f64)> = points;
        let curve = Curve::of(over, points.clone());
        tables::print_curve(&curve);
        let plot =
            Plot { title: "training step (s)".into(), x_label: over.into(), log_y: false, points, parts: vec![] };
        atomic_write(&folder.join(format!("linearity-{over}.svg")), plot::svg(&plot).as_bytes())?;
        curves.push(curve);
    }
    Ok(curves)
}

impl Curve {
    fn of(over: &'static str, points: Vec<(f64, f64)>) -> Self {
        let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
        let line = fit(&points);
        let off_line = points.iter().map(|(x, y)| (line.0 + line.1 * x - y).abs() / y).fold(0.0, f64::max);
        Self { over, exponent: fit(&logs).1, line, off_line, points }
    }
}

/// Intercept and slope of the least-squares line.
fn fit(points: &[(f64, f64)]) -> (f64, f64) {
    let mean = |f: fn(&(f64, f64)) -> f64| points.iter().map(f).sum::<f64>() / points.len() as f64;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let covariance: f64 = points.iter().map(|(x, y)| (x - mx) * (y - my)).sum();
    let slope = covariance / points.iter().map(|(x, _)| (x - mx).powi(2)).sum::<f64>();
    (my - slope * mx, slope)
}

fn memory(adapter: Option<&str>, quick: bool) -> anyhow::Result<Memory> {
    let size = |splats, side: u32, (width, height): (u32, u32), cells: usize| {
        let (width, height) = (width as usize, height as usize);
        TrainingSize {
            splats,
            sh_degree: 3,
            absolute_gradients: false,
            poses_move: false,
            triangles: 2 * cells * cells,
            vertices_move: false,
            map_floats: Sheet { cells, side }.map_floats(),
            layers: 1,
            width,
            height,
        }
    };
    let peak = |splats, side, (width, height), cells| -> anyhow::Result<u64> {
        let camera = scene::camera(width, height);
        let scene = scene::scene(splats, &camera, Some(Sheet { cells, side }));
        Ok(measure::training_peak(adapter, &scene, &camera)?)
    };
    let (usual, wide) = ((256, 256), (512, 512));
    let base = peak(10_000, 256, usual, 20)?;
    let per = |peak: u64, count: usize| (peak as f64 - base as f64) / count as f64;
    let small = size(10_000, 256, usual, 20);
    let (side, full, cells) = (2048, (1920, 1080), 316);
    let accounted = |n: usize| memory::training_bytes(&size(n, side, full, cells)).total();
    let train = |splats: usize| -> anyhow::Result<Trained> {
        Ok(Trained { splats, bytes: peak(splats, side, full, cells)?, accounted: accounted(splats) })
    };
    let mut large = Large { accounted: accounted(1_000_000), trained: None, refused: None };
    if !quick {
        // Adapters that bind at most 128 MiB at a time cannot hold the SH coefficients of a million splats.
        large.trained = Some(train(1_000_000).or_else(|error| {
            large.refused = Some(error.to_string());
            train(400_000)
        })?);
    }
    Ok(Memory {
        per_splat: per(peak(30_000, 256, usual, 20)?, 20_000),
        per_map_float: per(peak(10_000, 512, usual, 20)?, size(0, 512, usual, 20).map_floats - small.map_floats),
        per_pixel: per(peak(10_000, 256, wide, 20)?, 512 * 512 - 256 * 256),
        agreement: base as f64 / memory::training_bytes(&small).total() as f64,
        large,
    })
}
