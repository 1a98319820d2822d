//! **Centaur**: hybrid scenes of textured, semi-transparent meshes and 3D Gaussian splats, blended in one stable
//! depth order.
//!
//! Data flows `capture` → `geometry` → `scene` → `optimize` (over `render`, `metrics`) → `scene` → `format`; [`evaluate`] tells how good it is.
//! ARCHITECTURE.md has the map and the invariants.
//!
//! A scene from a file, rendered from one of the cameras that are in it:
//!
//! ```no_run
//! use centaur::{format::{ReadOptions, read_file}, render::gpu::{Gpu, Renderer}};
//!
//! let file = read_file("garden.glb".as_ref(), &ReadOptions::default())?;
//! let (_, camera) = file.cameras.first().ok_or("no camera in it")?;
//! let gpu = Gpu::open(None)?;
//! let picture = Renderer::new(&gpu, &file.scene, &[*camera])?.render(camera)?;
//! println!("{}×{}, first pixel {:?}", picture.width, picture.height, picture.rgb[0]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! From photographs to a file:
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
//!     progress: &mut |report| println!("{report:?}"),
//! };
//! let trained = optimize::train(&capture, MeshSource::suited_to(&capture), &options, session)?;
//! let names = capture.views.iter().map(|view| view.name.clone());
//! let cameras: Vec<_> = names.zip(trained.cameras).collect();
//! write_scene("garden.glb".as_ref(), &trained.scene, &WriteOptions { cameras: &cameras, ..WriteOptions::default() })?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![cfg_attr(test, allow(clippy::unwrap_used, clippy::print_stderr, reason = "a failed unwrap is a failed test"))]

pub mod atomic;
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
mod base64;
