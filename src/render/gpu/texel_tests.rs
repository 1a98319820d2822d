//! Gradients of texels compared with finite differences of the oracle in `mesh_tests`, and Adam steps of texels.

use std::collections::BTreeMap;

use glam::{DMat3, DVec4, Vec2, Vec3};

use super::{
    device::{Frame, Gpu},
    mesh::MeshStage,
    mesh_tests::{Hit, Random, Rig, atlas, hits, mip_level, shade, soup, sphere, view},
    status::{Status, status_buffer},
    texels::TexelStep,
    view::{VIEW_WORDS, View},
};
use crate::{
    render::testing,
    scene::{Atlas, Mesh, Texture},
};

/// Numbers of floats compared per class and mesh: ones with large gradients, evenly spread over the map, and arbitrary
/// ones.
const STRONG: usize = 45;
const ANY: usize = 15;
/// Minimum number of compared floats with a gradient, in each class of each mesh.
const VISIBLE: usize = 40;

/// Gradients of every class of texel, also with fewer bands than are stored, against central differences of the oracle.
/// The loss is Σ w·(r, g, b, alpha) with random weights over all fragments; it is linear in the texels except where a
/// channel is clamped or through σ, so a small step keeps all thresholds where they are.
#[test]
fn texel_gradients_match_finite_differences() {
    let mut random = Random(5);
    let maps = [atlas(&mut random, 3, 32), atlas(&mut random, 1, 16)];
    let mut meshes = vec![soup(&mut random, 160, 2)];
    for (maps, x) in maps.into_iter().zip([-0.6, 0.7]) {
        meshes.push(sphere(24, 12, Vec3::new(x, 0.1, 3.0), 1.0, maps));
    }
    let view = view(61, 45, DMat3::IDENTITY, 2, &meshes);
    let weights: Vec<[f32; 4]> = (0..2 * view.pixels()).map(|_| [(); 4].map(|()| random.signed())).collect();
    let hits = hits(&view, &meshes);
    let levels = hits.iter().flatten().map(|h| mip_level(meshes[h.mesh].atlas().base(), h));
    let coarse = levels.filter(|&l| l > 1.5).count();
    assert!(coarse > 100, "only {coarse} fragments see the third mip level or beyond");
    let fragments = hits.iter().enumerate().flat_map(|(p, h)| h.iter().enumerate().map(move |(l, h)| (p, l, h)));
    let weighed = |(p, l, h): (usize, usize, _)| (DVec4::from_array(weights[l * view.pixels() + p].map(f64::from)), h);
    let fragments: Vec<(DVec4, &Hit)> = fragments.map(weighed).collect();
    // For one mesh: the fragments of others do not depend on its maps.
    let loss = |meshes: &[Mesh], mesh: usize, band_degree: u32| {
        let of_mesh = fragments.iter().filter(|(_, h)| h.mesh == mesh);
        of_mesh.map(|(weight, h)| weight.dot(shade(h, meshes, band_degree))).sum::<f64>()
    };
    // Finite difference for a float of a mesh's base map or bands.
    let difference = |band_degree: u32, m: usize, class: usize, i: usize| {
        let atlas = meshes[m].atlas();
        let moved = |step: f32| {
            let change = |t: &Texture, class_of: usize| {
                let mut texels = t.texels().to_vec();
                if class_of == class {
                    texels[i] += step;
                }
                Texture::new(t.width(), t.height(), t.channels(), texels).unwrap()
            };
            let atlas = Atlas::new(change(atlas.base(), 0), atlas.bands().map(|t| change(t, 1))).unwrap();
            let mut meshes = meshes.clone();
            meshes[m] = meshes[m].clone().with_atlas(atlas);
            loss(&meshes, m, band_degree)
        };
        let texel = if class == 0 { atlas.base() } else { atlas.bands().unwrap() };
        // The difference after rounding to f32.
        let h = 1.0 / 1024.0;
        let taken = f64::from(texel.texels()[i] + h) - f64::from(texel.texels()[i] - h);
        (moved(h) - moved(-h)) / taken
    };
    let open = || Gpu::open(None).unwrap();
    for band_degree in [3, 2] {
        // By mesh and class: the compared floats and their finite differences. They are chosen by the gradients of the
        // first kernels, and used for all kernels.
        let mut wanted = BTreeMap::new();
        for gpu in [open(), open().posing_as_gpu(), Gpu::with_subgroups(false).posing_as_gpu()] {
            let view = View { band_degree, ..view };
            let case = format!("bands of degree {band_degree}, {:?}", gpu.profile());
            let rig = Rig::new(gpu, &view, &meshes, true);
            rig.gpu.write(rig.stage.layer_gradient(), 0, &weights);
            let mut frame = Frame::new(&rig.gpu);
            // Twice: gradients of an earlier frame must not remain.
            rig.stage.record_backward(&mut frame);
            rig.stage.record_backward(&mut frame);
            frame.submit();
            let gradients = rig.stage.read_gradients(&rig.gpu).unwrap();
            let classes = gradients.iter().enumerate().flat_map(|(m, (base, bands))| [(m, 0, base), (m, 1, bands)]);
            for (m, class, found) in classes {
                let case = format!("{case}, mesh {m}, class {class}");
                let scale = testing::largest(found.iter().map(|g| f64::from(g.abs())));
                assert!(scale > 0.0, "{case}: {scale}");
                let wanted = &*wanted.entry((m, class)).or_insert_with(|| {
                    let is_strong = |i: &usize| f64::from(found[*i].abs()) > 0.02 * scale;
                    let strong: Vec<usize> = (0..found.len()).filter(is_strong).collect();
                    let n = STRONG.min(strong.len());
                    let any = (0..ANY).map(|_| (random.unit() * found.len() as f32) as usize);
                    let picked = (0..n).map(|k| strong[k * strong.len() / n]).chain(any);
                    picked.map(|i| (i, difference(band_degree, m, class, i))).collect::<Vec<_>>()
                });
                for &(i, wanted) in wanted {
                    let error = (f64::from(found[i]) - wanted).abs();
                    assert!(
                        error < 1e-3 * wanted.abs() + 1e-4 * scale,
                        "{case}, float {i}: {} instead of {wanted}",
                        found[i]
                    );
                }
                let visible = wanted.iter().filter(|(_, wanted)| wanted.abs() > 0.01 * scale).count();
                assert!(visible >= VISIBLE, "{case}: {visible} floats with a gradient");
            }

            // Adam also gets gradients from coarser levels: its first moment is a tenth of the gradient.
            rig.stage.set_step(&rig.gpu, &TexelStep { number: 1, ..TexelStep::default() });
            let mut frame = Frame::new(&rig.gpu);
            rig.stage.record_adam(&mut frame);
            frame.submit();
            let (first, _) = rig.stage.read_moments(&rig.gpu).unwrap();
            let (base, bands): (Vec<_>, Vec<_>) = gradients.into_iter().unzip();
            let all = [base.concat(), bands.concat()].concat();
            assert_eq!(first.len(), all.len());
            for (i, (m, g)) in first.iter().zip(&all).enumerate() {
                assert!((m - 0.1 * g).abs() <= 2e-6 * g.abs(), "{case}: float {i}: {m}, a tenth of {g}");
            }
        }
    }
}

/// A wall with a coarse map, or with equal UVs everywhere: in a picture of 270,000 pixels with gradients of equal sign,
/// the mean over pixels makes the gradient as large as for 1,200 pixels.
#[test]
fn a_texel_as_large_as_the_picture_is_pulled_as_far_in_large_pictures() {
    let corners = [[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]].map(|[x, y]| Vec3::new(x, y, 2.0));
    for (side, spread) in [(16, 1.0), (16, 0.0), (1, 1.0)] {
        let uv = |v: u32| 0.5 + spread * corners[v as usize].truncate() / 18.0;
        let triangles = vec![[0, 1, 2], [0, 2, 3]];
        let uvs = triangles.iter().map(|t: &[u32; 3]| t.map(uv)).collect();
        let maps = Atlas::new(Texture::zeros(side, side, 4), Some(Texture::zeros(side, side, 9))).unwrap();
        let meshes = [Mesh::new(corners.to_vec(), triangles, uvs, maps).unwrap()];
        for poses in [false, true] {
            let pulled = |width: u32, height: u32| {
                let view = view(width, height, DMat3::IDENTITY, 1, &meshes);
                let gpu = Gpu::open(None).unwrap();
                let rig = Rig::new(if poses { gpu.posing_as_gpu() } else { gpu }, &view, &meshes, true);
                let weights = vec![1.0 / view.pixels() as f32; 4 * view.pixels()];
                rig.gpu.write(rig.stage.layer_gradient(), 0, &weights);
                let mut frame = Frame::new(&rig.gpu);
                rig.stage.record_backward(&mut frame);
                frame.submit();
                rig.stage.read_gradients(&rig.gpu).unwrap().remove(0)
            };
            let (few, many) = (pulled(40, 30), pulled(600, 450));
            for (few, many) in [(few.0, many.0), (few.1, many.1)] {
                let largest = testing::largest(few.iter().map(|g| f64::from(g.abs())));
                assert!(largest > 0.01, "{largest}");
                let apart = testing::largest(few.iter().zip(&many).map(|(few, many)| f64::from((few - many).abs())));
                assert!(apart < 0.02 * largest, "{side}² texels, UVs spread by {spread}: {apart} of {largest} apart");
            }
        }
    }
}

/// A face with equal UVs at its corners that covers a third of the picture: the gradients of its 100,000 pixels all go
/// to four texels, whose sums must not overflow, as for a wall that fills the picture.
#[test]
fn a_face_at_one_place_of_the_map_pulls_with_all_of_its_pixels() {
    let corners = [[-0.7, -0.7], [0.7, -0.7], [0.7, 0.7], [-0.7, 0.7]].map(|[x, y]| Vec3::new(x, y, 2.0));
    let uvs = vec![[Vec2::splat(0.5); 3]; 2];
    let maps = Atlas::new(Texture::zeros(16, 16, 4), Some(Texture::zeros(16, 16, 9))).unwrap();
    let meshes = [Mesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]], uvs, maps).unwrap()];
    let view = view(600, 450, DMat3::IDENTITY, 1, &meshes);
    for gpu in [Gpu::open(None).unwrap(), Gpu::open(None).unwrap().posing_as_gpu()] {
        let rig = Rig::new(gpu, &view, &meshes, true);
        rig.gpu.write(rig.stage.layer_gradient(), 0, &vec![1.0_f32; 4 * view.pixels()]);
        let mut frame = Frame::new(&rig.gpu);
        rig.stage.record_backward(&mut frame);
        frame.submit();
        let base = rig.stage.read_gradients(&rig.gpu).unwrap().remove(0).0;
        let shown = rig.stage.read_front_triangles(&rig.gpu, view.pixels()).unwrap();
        let covered = shown.iter().filter(|triangle| **triangle != 0).count() as f64;
        assert!((80_000.0..150_000.0).contains(&covered), "{covered} pixels");
        // Derivatives: Y₀ of a colour, and σ' = ¼ of a logit of 0.
        for (channel, of_pixel) in [(0, 0.282_095), (3, 0.25)] {
            let sum: f64 = base.iter().skip(channel).step_by(4).map(|g| f64::from(*g)).sum();
            assert!((sum / (of_pixel * covered) - 1.0).abs() < 2e-3, "channel {channel}: {sum} of {covered} pixels");
        }
    }
}

/// A texel seen for the first time late in a run, with and without mips: with sparse Adam it moves by the learning
/// rate, with dense Adam by more, since its moments are younger than the step count.
#[test]
fn a_late_texel_moves_by_the_rate() {
    let mut random = Random(7);
    let dense = 0.1 / (0.001_f32 / (1.0 - 0.999_f32.powi(500))).sqrt();
    for (side, visited_only, expected) in [(16, true, 1.0), (16, false, dense), (1, true, 1.0), (1, false, dense)] {
        let meshes = [sphere(24, 12, Vec3::new(0.0, 0.0, 2.0), 1.0, atlas(&mut random, 0, side))];
        let view = view(40, 40, DMat3::IDENTITY, 1, &meshes);
        let rig = Rig::new(Gpu::open(None).unwrap(), &view, &meshes, true);
        let weights: Vec<f32> = (0..4 * view.pixels()).map(|_| random.signed()).collect();
        rig.gpu.write(rig.stage.layer_gradient(), 0, &weights);
        let step = TexelStep { number: 500, base_rate: 1e-3, band_rate: 1e-3, visited_only, holds_opacity: false };
        rig.stage.set_step(&rig.gpu, &step);
        let mut frame = Frame::new(&rig.gpu);
        rig.stage.record_backward(&mut frame);
        rig.stage.record_adam(&mut frame);
        frame.submit();
        let gradient = rig.stage.read_gradients(&rig.gpu).unwrap().remove(0).0;
        let after = rig.stage.read_atlases(&rig.gpu).unwrap().remove(0);
        let pairs = meshes[0].atlas().base().texels().iter().zip(after.base().texels());
        for (i, ((a, b), g)) in pairs.zip(&gradient).enumerate().filter(|(_, (_, g))| **g != 0.0) {
            let moved = (a - b) * g.signum() / 1e-3;
            assert!(
                (moved - expected).abs() < 2e-3 * expected,
                "{side}: float {i} moved {moved} rates, not {expected}"
            );
        }
    }
}

/// One Adam step from zero moments moves a float by the learning rate against the sign of its gradient; logits stay
/// within ±6; mips are updated; moments survive a round trip.
#[test]
fn adam_steps_and_moments_are_restored() {
    let mut random = Random(6);
    let maps = atlas(&mut random, 1, 16);
    let base = maps.base();
    let near_limit = base.texels().chunks(4).flat_map(|t| [t[0], t[1], t[2], 5.9995_f32.copysign(t[3])]).collect();
    let base = Texture::new(base.width(), base.height(), 4, near_limit).unwrap();
    let maps = Atlas::new(base, maps.bands().cloned()).unwrap();
    let meshes = [sphere(24, 12, Vec3::new(0.0, 0.0, 2.0), 1.0, maps.clone())];
    let mut view = view(40, 40, DMat3::IDENTITY, 1, &meshes);
    let mut rig = Rig::new(Gpu::open(None).unwrap(), &view, &meshes, true);
    let weights: Vec<f32> = (0..4 * view.pixels()).map(|_| random.signed()).collect();
    rig.gpu.write(rig.stage.layer_gradient(), 0, &weights);
    let step = TexelStep { number: 1, base_rate: 1e-3, band_rate: 2e-3, visited_only: false, holds_opacity: false };
    rig.stage.set_step(&rig.gpu, &step);
    let mut frame = Frame::new(&rig.gpu);
    rig.stage.record_backward(&mut frame);
    rig.stage.record_adam(&mut frame);
    frame.submit();
    let gradients = rig.stage.read_gradients(&rig.gpu).unwrap().remove(0);
    let after = rig.stage.read_atlases(&rig.gpu).unwrap().remove(0);
    let mut moved = 0;
    let pairs = [
        (maps.base(), after.base(), &gradients.0, 1e-3),
        (maps.bands().unwrap(), after.bands().unwrap(), &gradients.1, 2e-3),
    ];
    for (is_base, (before, after, gradient, rate)) in [true, false].into_iter().zip(pairs) {
        for (i, (&g, (&a, &b))) in gradient.iter().zip(before.texels().iter().zip(after.texels())).enumerate() {
            let mut wanted = if g == 0.0 { a } else { a - rate * g.signum() };
            if is_base && i % 4 == 3 {
                wanted = wanted.clamp(-6.0, 6.0);
            }
            moved += usize::from(g != 0.0);
            assert!((b - wanted).abs() < 1e-5, "float {i}: {a} became {b} instead of {wanted} (gradient {g})");
        }
    }
    assert!(moved > 500, "only {moved} floats have a gradient");
    view.band_degree = 1;
    rig.forward(&view);
    rig.check(&view, &[meshes[0].clone().with_atlas(after.clone())], "after a step");

    // With another camera, dense Adam moves texels visited before by their momentum, and the visited-only variant does
    // not.
    let (first, second) = rig.stage.read_moments(&rig.gpu).unwrap();
    assert!(first.iter().zip(&second).all(|(m, v)| (*m == 0.0) == (*v == 0.0)));
    let status = status_buffer(&rig.gpu).unwrap();
    for visited_only in [false, true] {
        let other = MeshStage::new(&rig.gpu, &[meshes[0].clone().with_atlas(after.clone())], 1, Some(&status)).unwrap();
        assert!(other.write_moments(&rig.gpu, &first, &second));
        assert!(!other.write_moments(&rig.gpu, &first[1..], &second[1..]));
        assert_eq!(other.read_moments(&rig.gpu).unwrap(), (first.clone(), second.clone()));
        other.set_step(&rig.gpu, &TexelStep { number: 2, visited_only, ..step });
        let mut frame = Frame::new(&rig.gpu);
        other.record_adam(&mut frame);
        frame.submit();
        let changed = other.read_atlases(&rig.gpu).unwrap().remove(0) != after;
        assert_eq!(changed, !visited_only, "gradients are zero, moments are not");
    }

    // While opacity is frozen, colours are still trained.
    let other = MeshStage::new(&rig.gpu, &[meshes[0].clone().with_atlas(after.clone())], 1, Some(&status)).unwrap();
    assert!(other.write_moments(&rig.gpu, &first, &second));
    other.set_step(&rig.gpu, &TexelStep { number: 2, holds_opacity: true, ..step });
    let mut frame = Frame::new(&rig.gpu);
    other.record_adam(&mut frame);
    frame.submit();
    let held = other.read_atlases(&rig.gpu).unwrap().remove(0);
    let (m, v) = other.read_moments(&rig.gpu).unwrap();
    for (i, (a, b)) in after.base().texels().iter().zip(held.base().texels()).enumerate() {
        let stays = i % 4 == 3 || first[i] == 0.0;
        assert!((a == b) == stays && ((m[i], v[i]) == (first[i], second[i])) == stays, "float {i}: {a} became {b}");
    }
    assert_ne!(after.bands(), held.bands());
}

/// Fixed point has no NaN, but its scale can be one.
#[test]
fn what_is_not_finite_is_found_through_fixed_point() {
    let mut random = Random(8);
    let meshes = [sphere(24, 12, Vec3::new(0.0, 0.0, 2.0), 1.0, atlas(&mut random, 1, 16))];
    let view = view(40, 40, DMat3::IDENTITY, 1, &meshes);
    for (value, found) in [
        (1.0, None),
        (f32::NAN, Some("a map of colour and opacity")),
        (f32::INFINITY, Some("a map of colour and opacity")),
    ] {
        let gpu = Gpu::open(None).unwrap();
        let status = status_buffer(&gpu).unwrap();
        let uniform = gpu.uniform("view", VIEW_WORDS).unwrap();
        gpu.write(&uniform, 0, &view.words());
        let mut stage = MeshStage::new(&gpu, &meshes, 1, Some(&status)).unwrap();
        stage.resize(&gpu, &view, &uniform).unwrap();
        let mut weights: Vec<f32> = (0..4 * view.pixels()).map(|_| random.signed()).collect();
        weights[4 * (20 * 40 + 20)] = value;
        gpu.write(stage.layer_gradient(), 0, &weights);
        stage.set_step(
            &gpu,
            &TexelStep { number: 1, base_rate: 1e-3, band_rate: 1e-3, visited_only: true, holds_opacity: false },
        );
        let mut frame = Frame::new(&gpu);
        stage.record_forward(&mut frame);
        stage.record_backward(&mut frame);
        stage.record_adam(&mut frame);
        frame.submit();
        assert_eq!(Status::read(&gpu, &status).unwrap().not_finite, found, "{value}");
    }
}
