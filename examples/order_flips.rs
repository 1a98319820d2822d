//! Measures, on held-out views, how often the order of splats and layers flips while a camera moves a little, in each
//! of the three order modes: `cargo run --release --example order_flips -- SCENE.glb CAPTURE MAX_SIDE`.
//!
//! Every view is compared with itself moved sideways by a hundredth of the median depth of the points in front of it,
//! about half a degree around what it looks at.

#![allow(clippy::print_stdout, reason = "a program that reports")]

mod held_out;

use std::error::Error;

use centaur::render::reference::{OrderFlips, order_flips};
use centaur::scene::{Camera, OrderMode};
use glam::DVec3;

fn main() -> Result<(), Box<dyn Error>> {
    let held_out::HeldOut { mut scene, views, points } = held_out::open("order_flips")?;
    for mode in [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct] {
        scene.composition.mode = mode;
        let mut flips = OrderFlips::default();
        for view in &views {
            let camera = &view.camera;
            let mut depths: Vec<f64> = points.iter().map(|p| camera.to_camera(*p).z).filter(|z| *z > 0.0).collect();
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
