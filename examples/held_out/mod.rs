//! Shared start of the programs that look at held-out views: reads the arguments `SCENE CAPTURE MAX_SIDE`.

use std::error::Error;
use std::path::Path;

use centaur::capture::{self, Downscale, LoadOptions, Split, View};
use centaur::format::read_scene;
use centaur::scene::HybridScene;
use glam::DVec3;

pub(crate) struct HeldOut {
    pub(crate) scene: HybridScene,
    pub(crate) views: Vec<View>,
    /// Points of structure from motion.
    #[allow(dead_code, reason = "of one program alone")]
    pub(crate) points: Vec<DVec3>,
}

/// # Errors
/// If the arguments are others, or one of them cannot be read.
pub(crate) fn open(program: &str) -> Result<HeldOut, Box<dyn Error>> {
    let [scene, folder, side] = std::env::args()
        .skip(1)
        .collect::<Vec<_>>()
        .try_into()
        .map_err(|_| format!("usage: {program} SCENE CAPTURE MAX_SIDE"))?;
    let scene = read_scene(Path::new(&scene))?;
    let options = LoadOptions { downscale: Downscale::MaxSide(side.parse()?), ..LoadOptions::default() };
    let capture = capture::open(Path::new(&folder), &options)?;
    let (_, held_out) = Split::Every8th.split(&capture.views);
    let views = held_out.iter().map(|&i| capture.views[i].clone()).collect();
    Ok(HeldOut { scene, views, points: capture.points.iter().map(|p| p.position).collect() })
}
