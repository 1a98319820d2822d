//! How often the order of splats and layers flips while a camera moves a little, by the three modes, on held-out views:
//! `cargo run --release --example order_flips -- SCENE.glb CAPTURE MAX_SIDE`.
//!
//! Every view is compared with itself moved sideways by a hundredth of the median depth of the points before it, about half a degree around
//! what it looks at.

#![allow(clippy::print_stdout, reason = "a program that reports")]

use std::{error::Error, path::Path};

use centaur::capture::{self, Downscale, LoadOptions, Split};
use centaur::format::read_scene;
use centaur::render::reference::{OrderFlips, order_flips};
use centaur::scene::{Camera, OrderMode};
use glam::DVec3;

fn main() -> Result<(), Box<dyn Error>> {
    let [scene, folder, side] = std::env::args()
        .skip(1)
        .collect::<Vec<_>>()
        .try_into()
        .map_err(|_| "usage: order_flips SCENE CAPTURE MAX_SIDE")?;
    let mut scene = read_scene(Path::new(&scene))?;
    let options = LoadOptions { downscale: Downscale::MaxSide(side.parse()?), ..LoadOptions::default() };
    let capture = capture::open(Path::new(&folder), &options)?;
    let (_, held_out) = Split::Every8th.split(&capture.views);
    for mode in [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct] {
        scene.composition.mode = mode;
        let mut flips = OrderFlips::default();
        for &i in &held_out {
            let camera = &capture.views[i].camera;
            let mut depths: Vec<f64> =
                capture.points.iter().map(|p| camera.to_camera(p.position).z).filter(|z| *z > 0.0).collect();
            depths.sort_by(f64::total_cmp);
            let step = 0.01 * depths.get(depths.len() / 2).ok_or("a view has no points before it")?;
            let moved = camera.translation() - DVec3::X * step;
            let next = Camera::new(*camera.intrinsics(), camera.rotation(), moved)?;
            flips = flips + order_flips(&scene, [camera, &next]);
        }
        println!("{mode:?}: {:.3} % of {} points of splats near the mesh", 100.0 * flips.part(), flips.points);
    }
    Ok(())
}
