//! Visibility of a given mesh from the training views.

use glam::{DVec2, Vec2};

use super::*;
use crate::{
    geometry::{self, MeshBvh, TexelSight},
    render::gpu::training::Show,
    scene::Texture,
};

/// Parts of a given mesh that no training view shows would stay grey and half transparent.
#[test]
fn what_no_view_sees_of_a_given_mesh_is_transparent() {
    let MeshSource::Given { mut surface, .. } = square() else { unreachable!() };
    // A copy of the mesh far above, where no camera looks.
    let above = surface.positions.iter().map(|p| *p + Vec3::new(0.0, 0.0, 1e4)).collect::<Vec<_>>();
    surface.positions.extend(above);
    surface.triangles.extend([[4, 5, 6], [4, 6, 7]]);
    let (gpu, capture, stop) = (Gpu::open(None).unwrap(), demo(), AtomicBool::new(false));
    // On the larger map, rays are cast to every other texel.
    for size in [64, 2048] {
        let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
        let source = MeshSource::Given { surface: surface.clone(), corner_uvs: None };
        // Although training has used few of the 42 views.
        let options = TrainOptions { texture_size: Some(size), ..options() };
        let trained = train(&capture, source, &options, session).unwrap();
        let mesh = &trained.scene.meshes[0];
        let logits: Vec<f32> = mesh.atlas().base().texels().iter().skip(3).step_by(4).copied().collect();
        let one = Texture::new(1, 1, 1, vec![1.0]).unwrap();
        let texels_of = |faces: std::ops::Range<usize>, rim: u32| {
            let uvs = &mesh.corner_uvs()[faces];
            let drawn = geometry::transfer(&one, uvs, uvs, size, rim).unwrap();
            let logits = logits.iter().zip(drawn.texels()).filter(|(_, drawn)| **drawn > 0.0);
            logits.map(|(logit, _)| *logit).collect::<Vec<f32>>()
        };
        let (seen, hidden) = (texels_of(0..2, 0), texels_of(2..4, 0));
        // All of the unseen chart is transparent, and a texel around it, except where coarser levels mix it with the
        // neighbouring chart.
        let is_grey = |logit: &&f32| **logit != unseen::TRANSPARENT;
        let rim = texels_of(2..4, 1);
        assert!(hidden.len() * 8 > logits.len() && hidden.iter().filter(is_grey).count() * 15 < hidden.len());
        assert!(rim.len() > hidden.len() && rim.iter().filter(is_grey).count() * 15 < rim.len());
        // The square's corners are beyond the table, and become transparent in training.
        let opaque = seen.iter().filter(|logit| **logit > -1.0).count();
        assert!(opaque * 2 > seen.len(), "{size}: {opaque} of {}", seen.len());
        // Texels between charts are not changed.
        assert!(logits.iter().filter(|logit| **logit == unseen::TRANSPARENT).count() < 2 * hidden.len());
    }
}

/// Pictures of 64 pixels begin at half their size, since 32 is the minimum.
#[test]
fn growing_pictures_read_coarser_levels_at_first() {
    for (coarse_to_fine, levels) in [(false, 0), (true, 1)] {
        let options = TrainOptions { coarse_to_fine, ..options() };
        with_run(&options, |run, _, _| assert_eq!(unseen::coarser(&run.setup), levels));
    }
}

/// A floor, above it a ball with another ball inside, and a third ball that half occludes it.
fn balls() -> Surface {
    let mut all = Surface {
        positions: [[-0.8, -0.8, 0.0], [0.8, -0.8, 0.0], [0.8, 0.8, 0.0], [-0.8, 0.8, 0.0]].map(Vec3::from).to_vec(),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    };
    for (center, radius) in [([-0.3, 0.0, 0.4], 0.35), ([-0.3, 0.0, 0.4], 0.25), ([0.35, 0.2, 0.3], 0.28)] {
        let first = all.positions.len() as u32;
        for i in 0..=10_u32 {
            for j in 0..20_u32 {
                let [a, b] = [i, j].map(|k| std::f32::consts::PI * k as f32 / 10.0);
                let direction = Vec3::new(a.sin() * b.cos(), a.sin() * b.sin(), a.cos());
                all.positions.push(Vec3::from(center) + radius * direction);
            }
        }
        let cells = (0..10).flat_map(|i| (0..20).map(move |j| [i * 20 + j, i * 20 + (j + 1) % 20]));
        let cells = cells.map(|cell| cell.map(|v| v + first));
        all.triangles.extend(cells.flat_map(|[a, b]| [[a, a + 20, b], [b, a + 20, b + 20]]));
    }
    all
}

/// Rays find every texel under a pixel and every texel with a gradient, and few others.
#[test]
fn rays_reach_what_the_renderer_shows() {
    for layers in [1, 2] {
        let options = TrainOptions { warmup: 84, texture_size: Some(256), layers, ..options() };
        with_mesh(balls(), &options, |run, training, scene| {
            let mesh = &scene.meshes[0];
            let sights = unseen::texel_visibility(&run.setup, &run.views, mesh, [256; 2]).unwrap();
            let reached = sights.reached(0, u8::MAX);
            let bvh = MeshBvh::new([(mesh.positions(), mesh.triangles())]);
            let (mut pixels, mut off_center, mut missed) = (0, 0, 0);
            for camera in run.views.train_cameras.clone() {
                training.render(&camera, [0.0; 3], Show::MeshesAlone).unwrap();
                let width = camera.intrinsics().width;
                for (pixel, front) in (0u32..).zip(training.front_triangles(&camera).unwrap()) {
                    let at = DVec2::new(f64::from(pixel % width), f64::from(pixel / width)) + 0.5;
                    let towards = camera.rotation().transpose() * camera.ray(at);
                    let hits = bvh.all_hits(camera.center(), towards);
                    let Some(hit) = hits.iter().find(|hit| hit.triangle + 1 == front) else { continue };
                    let uvs = mesh.corner_uvs()[hit.triangle as usize].map(Vec2::as_dvec2);
                    let [a, b, c] = hit.barycentrics.to_array();
                    let uv = 256.0 * (a * uvs[0] + b * uvs[1] + c * uvs[2]);
                    let texel = (uv.y as usize).min(255) * 256 + (uv.x as usize).min(255);
                    pixels += 1;
                    off_center += usize::from(sights.texels[texel] < TexelSight::Seen(0));
                    missed += usize::from(!reached[texel]);
                }
            }
            run.run_phase(training, scene, Phase::Warmup, None).unwrap();
            let second = training.read_texel_moments().unwrap().1;
            // By the result of the ray to a texel's centre, if that is in a triangle: with or without a gradient,
            // reached or not.
            let (one, uvs) = (Texture::new(1, 1, 1, vec![1.0]).unwrap(), mesh.corner_uvs());
            let drawn = geometry::transfer(&one, uvs, uvs, 256, 0).unwrap();
            let mut counts = [[[0; 2]; 2]; 3];
            for (i, moments) in second.chunks_exact(4).take(256 * 256).enumerate() {
                let sight = match sights.texels[i] {
                    _ if drawn.texels()[i] == 0.0 => 0,
                    TexelSight::Outside => unreachable!("{i} is in a triangle"),
                    TexelSight::Hidden => 1,
                    TexelSight::Seen(_) => 2,
                };
                let is_touched = moments.iter().any(|&v| v != 0.0);
                counts[sight][usize::from(is_touched)][usize::from(reached[i])] += 1;
            }
            eprintln!(
                "{layers} layers: {pixels} pixels, {off_center} on texels whose centre is not seen, {missed} missed"
            );
            eprintln!("outside, hidden, seen × untouched, touched × not reached, reached: {counts:?}");
            assert!(pixels > 20_000 && missed == 0 && off_center * 50 < pixels);
            assert_eq!(counts.map(|of_sight| of_sight[1][0]), [0; 3]);
            // Apart from slivers at the poles, with which texels are filtered together where a pixel falls on one.
            let too_many = counts[1][0][1] + counts[2][0][1];
            assert!(too_many * 80 < counts[1..].as_flattened().as_flattened().iter().sum::<usize>());
            assert!(layers == 2 || counts[1][0][0] > 2000);
        });
    }
}
