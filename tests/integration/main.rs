//! The library on files of other programs, and the program as its users call it. A single binary, since each is linked
//! separately; tests that count the memory of their process have their own, beside this folder.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a failed unwrap is a failed test; figures are printed"
)]

mod common;

mod architecture;
mod bad_input;
mod bad_meshes;
#[cfg(unix)]
mod bench_command;
mod cameras;
mod capture;
mod checkpoints;
mod cli;
mod convert;
mod convert_formats;
mod cut_out;
mod few_views;
mod films;
mod flags;
mod format;
mod gltf;
mod gsplat_oracle;
mod initial_splats;
#[cfg(unix)]
mod interrupted;
mod layouts;
mod layouts_of_documents;
mod lpips_oracle;
mod machines;
mod moving;
mod oracle_brush;
mod pictures;
mod reports;
mod scales;
mod sog;
mod spared;
mod splat_formats;
mod splat_transform_oracle;
mod ssim_oracles;
mod surfaces;
mod training;
mod units;
mod usd_oracle;
mod validate;
