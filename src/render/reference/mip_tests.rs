//! Gradients of vertices with mipmapped maps, compared with differences at constant mip levels, since the choice of
//! levels has no derivative.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::*;
use crate::{
    render::testing::{largest, smooth_scene},
    scene::OrderMode,
};

const STEP: f64 = 1e-6;

/// Mip levels of base and bands for every hit of every pixel.
type Levels = Vec<Vec<[f64; 2]>>;

/// Renders with these parameters, sampling all hits at these levels; also returns the triangles hit and the texels
/// between which each hit lies.
fn at_levels(
    scene: &HybridScene,
    camera: &Camera,
    parameters: &Parameters,
    (maps, levels): (&[mesh::Maps], &Levels),
) -> (Image, Vec<usize>) {
    let mut view = View::new(scene, camera, parameters);
    for ((hits, layers), levels) in view.hits.iter_mut().zip(&mut view.layers).zip(levels) {
        for ((hit, layer), levels) in hits.iter_mut().zip(layers).zip(levels) {
            let atlas = scene.meshes[hit.mesh].atlas();
            hit.sample_at(camera, atlas, *levels);
            *layer = mesh::shade(hit, &maps[hit.mesh]);
        }
    }
    let mut places = vec![];
    for hit in view.hits.iter().flatten() {
        places.extend([hit.mesh, hit.triangle]);
        places.extend(hit.base.iter().chain(&hit.bands).flat_map(|tap| [tap.level, tap.texel]));
    }
    (view.composite(scene.composition.background), places)
}

#[test]
fn vertex_gradients_are_differences_at_held_mip_levels() {
    let modes = [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct];
    for (mode, layers) in modes.into_iter().zip([1, 2, 4]) {
        let (scene, camera) = smooth_scene(12, layers, mode);
        assert!(scene.meshes.iter().all(|mesh| mesh.atlas().base().mip_levels() > 3));
        let parameters = Parameters::of(&scene);
        let maps = mesh::maps(&scene, &parameters);
        let of_hit = |hit: &mesh::Hit| hit.levels(&camera, scene.meshes[hit.mesh].atlas());
        let hits = View::new(&scene, &camera, &parameters).hits;
        let levels: Levels = hits.iter().map(|hits| hits.iter().map(of_hit).collect()).collect();
        let coarse = levels.iter().flatten().filter(|[base, _]| *base > 1.0).count();
        assert!(layers == 1 || coarse > 50, "{coarse} hits are beyond the first coarser level");
        let held = (&maps[..], &levels);
        assert!(at_levels(&scene, &camera, &parameters, held).0 == render(&scene, &camera), "levels are others");

        let (k, mut rng) = (camera.intrinsics(), Pcg64Mcg::seed_from_u64(18));
        let cotangent = Image {
            width: k.width as usize,
            height: k.height as usize,
            rgb: (0..k.pixels()).map(|_| [0; 3].map(|_| rng.random_range(-1.0..1.0))).collect(),
            transmittance: (0..k.pixels()).map(|_| rng.random_range(-1.0..1.0)).collect(),
        };
        let mut gradient = backward(&scene, &camera, &cotangent);
        let (mut pairs, mut all) = (vec![], 0);
        for (m, mesh) in scene.meshes.iter().enumerate() {
            // One axis per vertex: all of them would take seconds.
            for parameter in (0..mesh.positions().len()).map(|v| Parameter::Position(m, v, v % 3)) {
                let [(ahead, places), (back, others)] = [STEP, -STEP].map(|step| {
                    let mut moved = parameters.clone();
                    *moved.at(parameter) += step;
                    at_levels(&scene, &camera, &moved, held)
                });
                all += 1;
                // Crossing an edge causes a step, and crossing the centre of a texel a kink.
                if places == others {
                    let difference = (ahead.dot(&cotangent) - back.dot(&cotangent)) / (2.0 * STEP);
                    pairs.push((*gradient.at(parameter), difference));
                }
            }
        }
        let scale = largest(pairs.iter().map(|(_, b)| b.abs()));
        let worst = largest(pairs.iter().map(|(a, b)| (a - b).abs()));
        eprintln!(
            "{mode:?}: {} of {all} vertices, {coarse} coarse hits, relative error {:.1e}",
            pairs.len(),
            worst / scale
        );
        assert!(2 * pairs.len() > all, "{} of {all} vertices cross no texel", pairs.len());
        // The same accuracy as without mips.
        assert!(worst < 1e-5 * scale && scale > 1e-3, "{mode:?}: {worst:e} of {scale:e}");
    }
}
