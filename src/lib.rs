//! **Centaur**: hybrid scenes of textured, semi-transparent meshes and 3D Gaussian splats, blended in one
//! depth order.
//!
//! Data flows `capture` → `geometry` → `scene` → `optimize` (over `render`, `evaluate`) → `scene` → `format`;
//! [`evaluate`] scores a scene. ARCHITECTURE.md has the map and the invariants. Types of [`glam`], [`image`] and
//! [`serde_json`] are part of the API and therefore re-exported, so that versions agree.
//!
//! A scene from a file, rendered as a PNG and written in another format. Scenes are in the frame of captures, y down,
//! as [`format::read_scene`] and [`format::write_scene`] turn glTF and USD, which are y up:
//!
//! ```no_run
//! use centaur::{
//!     format::{WriteOptions, read_scene, write_scene},
//!     glam::DVec3,
//!     render::gpu::{Gpu, Renderer},
//!     scene::{Camera, Intrinsics},
//! };
//!
//! let scene = read_scene("garden.glb".as_ref())?;
//! // From four units before the origin and one above it.
//! let lens = Intrinsics::from_fov_y(1280, 720, 50_f64.to_radians());
//! let camera = Camera::look_at(lens, DVec3::new(0.0, -1.0, -4.0), DVec3::ZERO, DVec3::NEG_Y)?;
//! let gpu = Gpu::open(None)?;
//! let picture = Renderer::new(&gpu, &scene, &[camera])?.render(&camera)?;
//! picture.to_image(scene.composition.color_space).save("garden.png")?;
//! let report = write_scene("garden.usdz".as_ref(), &scene, &WriteOptions::default())?;
//! println!("{} bytes; lost: {}", report.bytes, report.loss);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Depths (camera-space z, world units) from one of the cameras that are in the file:
//!
//! ```no_run
//! use centaur::{
//!     format::{ReadOptions, read_file},
//!     render::{contract::ImageModel, gpu::{Gpu, LayeredRenderer}},
//! };
//!
//! let file = read_file("garden.glb".as_ref(), &ReadOptions::default())?;
//! let (_, camera) = file.cameras.first().ok_or("no camera in it")?;
//! let gpu = Gpu::open(None)?;
//! let parts = LayeredRenderer::new(&gpu, &file.scene, &[*camera], ImageModel::default())?.render(camera)?;
//! println!("farthest: {}", parts.median_depth.iter().copied().fold(0.0, f32::max));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Reading splats from a file, modifying them and writing them as glTF. A scene's content is always valid; therefore
//! its arrays are extracted for modification, and checked when they become splats again. [`edit`] provides common
//! edits:
//!
//! ```no_run
//! use centaur::{edit, format::{WriteOptions, read_scene, write_scene}, glam::{DMat3, DVec3}, scene::{Splats, gather}};
//!
//! let mut scene = read_scene("scan.ply".as_ref())?;
//! let splats = std::mem::replace(&mut scene.splats, Splats::empty(0));
//! let kept = edit::not_below_opacity(&splats, 0.02);
//! let mut arrays = gather(splats, &kept).into_arrays();
//! arrays.log_scales.iter_mut().for_each(|log_scale| *log_scale += 1.1_f32.ln());
//! scene.splats = arrays.check()?;
//! let scene = edit::Similarity::new(1.0, DMat3::from_rotation_y(0.5), DVec3::ZERO)?.scene(scene)?;
//! let report = write_scene("scan.glb".as_ref(), &scene, &WriteOptions::default())?;
//! println!("{} bytes; lost: {}", report.bytes, report.loss);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Evaluating the frames of an animated glTF ([`format::gltf::Source`]; `examples/write_hybrid.rs` builds a scene from
//! scratch):
//!
//! ```no_run
//! use centaur::format::{DEFAULT_FPS, ReadOptions, frame_count, read_file};
//!
//! let file = read_file("head.glb".as_ref(), &ReadOptions::default())?;
//! let source = file.source.as_ref().ok_or("not a glTF")?;
//! let ([start, end], fps) = (source.range(), source.fps().unwrap_or(DEFAULT_FPS));
//! for frame in 0..frame_count(start, end, fps).ok_or("too many frames")? {
//!     let posed = source.at(&file.scene, start + frame as f64 / fps)?;
//!     println!("{frame}: {} meshes, {} splats", posed.meshes.len(), posed.splats.len());
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Training from photographs and writing the result:
//!
//! ```no_run
//! use std::sync::atomic::AtomicBool;
//!
//! use centaur::{
//!     capture::{self, LoadOptions},
//!     format::{WriteOptions, write_scene},
//!     optimize::{self, Checkpoints, MeshSource, Session, TrainOptions},
//!     render::gpu::Gpu,
//! };
//!
//! let capture = capture::open("captures/garden".as_ref(), &LoadOptions::default())?;
//! let options = TrainOptions { iterations: 7_000, warmup: TrainOptions::warmup_of(7_000), ..TrainOptions::default() };
//! let session = Session {
//!     gpu: &Gpu::open(None)?,
//!     checkpoints: Checkpoints::Save("garden.checkpoint".into()),
//!     stop: &AtomicBool::new(false),
//!     progress: &mut |event| println!("{event:?}"),
//! };
//! let trained = optimize::train(&capture, MeshSource::suited_to(&capture), &options, session)?;
//! let names = capture.views.iter().map(|view| view.name.clone());
//! let cameras: Vec<_> = names.zip(trained.cameras).collect();
//! write_scene("garden.glb".as_ref(), &trained.scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() })?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used, clippy::print_stderr, reason = "a failed unwrap is a failed test"))]

pub mod atomic;
mod base64;
pub mod capture;
pub mod edit;
pub mod evaluate;
pub mod format;
pub mod geometry;
pub mod metrics;
pub mod optimize;
pub mod path;
pub mod render;
pub mod scene;
mod stats;

pub use {glam, image, serde_json};
