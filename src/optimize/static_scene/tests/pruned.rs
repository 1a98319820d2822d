//! Pruning after training.

use super::*;
use crate::{
    geometry::{self, MeshBvh, Viewers},
    scene::{Atlas, Texture},
};

/// Invisible parts of an extracted surface are dropped after training, but not in an interrupted run, and not from the
/// user's mesh.
#[test]
fn what_ended_faint_is_dropped_after_training() {
    let MeshSource::Given { mut surface, .. } = square() else { unreachable!() };
    // A second square below, with nothing behind it.
    surface.positions.extend(surface.positions.clone().iter().map(|p| *p - Vec3::Z));
    surface.triangles.extend([[4, 5, 6], [4, 6, 7]]);
    with_mesh(surface, &options(), |run, _, scene| {
        let mesh = &scene.meshes[0];
        let one = Texture::new(1, 1, 1, vec![1.0]).unwrap();
        let upper = &mesh.corner_uvs()[..2];
        let drawn = geometry::transfer(&one, upper, upper, 64, 1).unwrap();
        let texels = drawn.texels().iter().flat_map(|drawn| [0.0, 0.0, 0.0, if *drawn > 0.0 { 2.0 } else { -5.0 }]);
        let base = Texture::new(64, 64, 4, texels.collect()).unwrap();
        let mesh = mesh.clone().with_atlas(Atlas::new(base, mesh.atlas().bands().cloned()).unwrap());
        let scene = HybridScene { meshes: vec![mesh.clone()], ..scene.clone() };
        let mut training = run.training(&scene).unwrap();
        for (hands_over, outcome, left) in
            [(true, Outcome::Finished, 2), (true, Outcome::Interrupted, 4), (false, Outcome::Finished, 4)]
        {
            run.setup.identity.finds_surface = hands_over;
            let trained = run.finish(&mut training, &scene, outcome).unwrap();
            assert_eq!(trained.faint_triangles, 4 - left);
            let [found] = trained.scene.meshes.try_into().unwrap();
            assert_eq!(
                (found.triangles(), found.corner_uvs()),
                (&mesh.triangles()[..left], &mesh.corner_uvs()[..left])
            );
            assert_eq!(found.positions(), &mesh.positions()[..2 * left]);
            assert_eq!(found.atlas(), mesh.atlas());
        }
    });
}

/// A splat is dropped after training if the mesh hides all of it from all views. A splat that protrudes between the
/// points tested by rays stays, and so do all splats of an interrupted run.
#[test]
fn what_ended_behind_what_is_opaque_is_dropped_after_training() {
    let MeshSource::Given { mut surface, .. } = square() else { unreachable!() };
    // A box around the centre of the demo, with lid and floor.
    surface.positions = [-0.5, 0.5].iter().flat_map(|&z| surface.positions.iter().map(move |p| p.with_z(z))).collect();
    let sides = (0..4).flat_map(|i| [[i, (i + 1) % 4, 4 + i], [(i + 1) % 4, 4 + (i + 1) % 4, 4 + i]]);
    surface.triangles.extend(sides.chain([[4, 5, 6], [4, 6, 7]]));
    with_mesh(surface, &options(), |run, _, scene| {
        let mesh = &scene.meshes[0];
        let base = Texture::new(64, 64, 4, [0.0, 0.0, 0.0, 5.0].repeat(64 * 64)).unwrap();
        let mesh = mesh.clone().with_atlas(Atlas::new(base, mesh.atlas().bands().cloned()).unwrap());
        let mut arrays = scene.splats.clone().into_arrays();
        for (i, (mean, scale)) in arrays.means.iter_mut().zip(&mut arrays.log_scales).enumerate() {
            // The first is small and inside the box. The second is inside up to two standard deviations.
            *mean = if i < 2 { Vec3::ZERO } else { Vec3::new(0.0, 0.0, 1.0 + 0.01 * (i % 10) as f32) };
            *scale = if i == 1 { Vec3::new(0.48, 0.48, 0.24) } else { Vec3::splat(0.05) }.map(f32::ln);
        }
        arrays.opacity_logits.fill(2.0);
        let scene = HybridScene { splats: arrays.check().unwrap(), meshes: vec![mesh], ..scene.clone() };
        let viewers = Viewers { cameras: &run.views.train_cameras, near: 0.1, layers: 1, shows: &|_, _| true };
        let by_rays =
            geometry::occluded_splats(&scene.splats, (&scene.meshes, &MeshBvh::of(&scene.meshes)), 0.02, &viewers);
        assert!(by_rays[..2] == [true; 2] && !by_rays[2..].contains(&true));
        let mut training = run.training(&scene).unwrap();
        for (outcome, dropped) in [(Outcome::Finished, 1), (Outcome::Interrupted, 0)] {
            let trained = run.finish(&mut training, &scene, outcome).unwrap();
            assert_eq!(trained.occluded_splats, dropped);
            assert_eq!(trained.scene.splats.means(), &scene.splats.means()[dropped..]);
        }
    });
}
