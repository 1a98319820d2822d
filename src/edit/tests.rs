//! Transformed scenes are compared by renderings of the f64 reference, which does not know about transforms.

use glam::{DMat3, DQuat, DVec3, EulerRot, Quat, Vec2, Vec3};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;

use super::*;
use crate::render::reference::{Image, Margin, render, render_with_margins};
use crate::render::testing::{largest, random_scene, smooth_scene};
use crate::scene::{
    Atlas, Camera, ColorSpace, Composition, HybridScene, Mesh, OrderMode, PixelFilter, Splats, Texture, gather,
    in_morton_order, sh,
};

const MODES: [OrderMode; 3] = [OrderMode::Stable, OrderMode::SurfaceConsistent, OrderMode::Direct];

fn mirrored(image: &Image) -> Image {
    let mut flipped = image.clone();
    flipped.rgb.chunks_exact_mut(image.width).for_each(<[_]>::reverse);
    flipped.transmittance.chunks_exact_mut(image.width).for_each(<[_]>::reverse);
    flipped
}

/// Largest difference over the pixels for which `counts` is true.
fn difference(a: &Image, b: &Image, counts: impl Fn(usize) -> bool) -> f64 {
    let pixels = (0..a.rgb.len()).filter(|&i| counts(i));
    let of_pixel = |i: usize| {
        let rgb = (0..3).map(move |c| (a.rgb[i][c] - b.rgb[i][c]).abs());
        rgb.chain([(a.transmittance[i] - b.transmittance[i]).abs()])
    };
    largest(pixels.flat_map(of_pixel))
}

/// Rendering of the transformed scene by the transformed camera, flipped back if it is mirrored.
fn picture_after(similarity: &Similarity, scene: &HybridScene, camera: &Camera, mirrors: bool) -> Image {
    let moved = similarity.scene(scene.clone()).unwrap();
    let image = render(&moved, &similarity.camera(camera).unwrap());
    if mirrors { mirrored(&image) } else { image }
}

fn mirror(axis: DVec3) -> DMat3 {
    DMat3::from_diagonal(DVec3::ONE - 2.0 * axis)
}

#[test]
fn a_moved_scene_looks_the_same_to_a_moved_camera() {
    let mut rng = Pcg64Mcg::seed_from_u64(5);
    let mut differences = vec![];
    for (seed, mode) in (0..6).zip(MODES.into_iter().cycle()) {
        let (scene, camera) = smooth_scene(seed, [1, 2, 4][seed as usize % 3], mode);
        assert!(scene.splats.sh_degree() == 3 && scene.meshes.iter().any(|m| m.atlas().sh_degree() == 3));
        let before = render(&scene, &camera);
        let turn = DMat3::from_quat(DQuat::from_array([0; 4].map(|_| rng.random_range(-1.0..1.0))).normalize());
        let shift = DVec3::from_array([0; 3].map(|_| rng.random_range(-2.0..2.0)));
        for (orthogonal, mirrors) in [(turn, false), (turn * mirror(DVec3::Y), true), (-turn, true)] {
            let similarity = Similarity::new(rng.random_range(0.3..3.0), orthogonal, shift).unwrap();
            let after = picture_after(&similarity, &scene, &camera, mirrors);
            differences.push(difference(&before, &after, |_| true));
        }
    }
    // Every parameter is rounded to f32 once more: 6e-8 relative, times gradients of a few tens.
    let most = largest(differences);
    assert!(most < 1e-5, "{most}");
    assert!(most > 0.0, "nothing has been moved");
}

/// In random scenes, rounding can change edges, cut-offs and orders: such pixels are left out, as reported by the
/// reference itself.
#[test]
fn random_scenes_look_the_same_where_no_decision_is_close() {
    let close = Margin { alpha: 1e-4, order: 1e-5, edge: 1e-4, stop: 1e-3 };
    let turn = DMat3::from_euler(EulerRot::XYZ, 0.4, -1.2, 2.5);
    for (seed, mode) in (0..6).zip(MODES.into_iter().cycle()) {
        let (scene, camera) = random_scene(seed, 120, 2, 3, [1, 2, 4][seed as usize % 3], mode);
        let (before, margins) = render_with_margins(&scene, &camera);
        let clear = |i: usize| !margins[i].is_within(&close);
        let share = (0..margins.len()).filter(|&i| clear(i)).count() as f64 / margins.len() as f64;
        assert!(share > 0.7, "only {share} of the pixels are compared");
        for (orthogonal, mirrors) in [(turn, false), (turn * mirror(DVec3::X), true)] {
            let similarity = Similarity::new(1.7, orthogonal, DVec3::new(0.3, -2.0, 1.0)).unwrap();
            let after = picture_after(&similarity, &scene, &camera, mirrors);
            let largest = difference(&before, &after, clear);
            // Splats here are as narrow as 0.01: rounding positions to 2e-7 is 2e-5 of that.
            assert!(largest < 5e-5, "seed {seed}, mirrored {mirrors}: {largest}");
        }
    }
}

#[test]
fn similarities_compose_and_exchanging_axes_is_exact() {
    let (scene, camera) = random_scene(4, 200, 2, 3, 2, OrderMode::Stable);
    assert_eq!(Similarity::IDENTITY.scene(scene.clone()).unwrap(), scene);
    assert_eq!(Similarity::IDENTITY.camera(&camera).unwrap(), camera);

    // A half turn and a power of two, and their inverse, are exact: bit-identical.
    let half_turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let there = Similarity::new(2.0, half_turn, DVec3::ZERO).unwrap();
    let back = Similarity::new(0.5, half_turn, DVec3::ZERO).unwrap();
    let (moved, again) =
        (there.scene(scene.clone()).unwrap(), back.scene(there.scene(scene.clone()).unwrap()).unwrap());
    assert_eq!(moved.splats.means()[7], scene.splats.means()[7] * Vec3::new(2.0, -2.0, -2.0));
    assert_eq!((moved.composition.near, moved.composition.lambda), (0.4, 2.0 * scene.composition.lambda));
    assert_eq!(again.meshes, scene.meshes);
    assert_eq!((again.splats.means(), again.splats.sh()), (scene.splats.means(), scene.splats.sh()));
    assert_eq!(there.then(&back), Similarity::IDENTITY);

    let a = Similarity::new(1.5, DMat3::from_rotation_x(0.7), DVec3::X).unwrap();
    let b = Similarity::new(0.4, mirror(DVec3::Z) * DMat3::from_rotation_y(2.0), DVec3::NEG_Y).unwrap();
    let p = DVec3::new(0.1, -4.0, 2.0);
    assert!(a.then(&b).point(p).abs_diff_eq(b.point(a.point(p)), 1e-12));
    let (one, two) = (a.then(&b).camera(&camera).unwrap(), b.camera(&a.camera(&camera).unwrap()).unwrap());
    assert!(one.rotation().abs_diff_eq(two.rotation(), 1e-12) && one.center().abs_diff_eq(two.center(), 1e-12));

    for (scale, orthogonal) in [(0.0, DMat3::IDENTITY), (f64::NAN, DMat3::IDENTITY), (1.0, 1.1 * DMat3::IDENTITY)] {
        assert!(Similarity::new(scale, orthogonal, DVec3::ZERO).is_err());
    }
    let far = Similarity::new(1.0, DMat3::IDENTITY, DVec3::splat(1e300)).unwrap();
    assert!(far.splats(scene.splats).unwrap_err().to_string().starts_with("means[0]: expected finite"));
}

#[test]
fn mirrored_meshes_keep_their_front() {
    let (scene, _) = random_scene(1, 0, 2, 1, 1, OrderMode::Stable);
    let similarity = Similarity::new(1.0, mirror(DVec3::X), DVec3::ZERO).unwrap();
    for mesh in &scene.meshes {
        let moved = similarity.mesh(mesh).unwrap();
        let normal = |mesh: &Mesh, t: usize| {
            let [a, b, c] = mesh.triangles()[t].map(|v| mesh.positions()[v as usize]);
            (b - a).cross(c - a)
        };
        for t in 0..mesh.triangles().len() {
            assert!((normal(&moved, t) - normal(mesh, t) * Vec3::new(-1.0, 1.0, 1.0)).length() < 1e-6);
            let uv_of = |mesh: &Mesh| {
                let mut corners: Vec<(u32, Vec2)> = mesh.triangles()[t].into_iter().zip(mesh.corner_uvs()[t]).collect();
                corners.sort_by_key(|(v, _)| *v);
                corners
            };
            assert_eq!(uv_of(&moved), uv_of(mesh));
        }
    }
}

/// Splats at these positions with these opacity logits; all other parameters differ from splat to splat.
fn splats_at(means: &[Vec3], logits: &[f32], degree: u32) -> Splats {
    let n = means.len();
    let number = |i: usize| i as f32 * 0.1;
    Splats::new(
        means.to_vec(),
        (0..n).map(|i| Quat::from_rotation_x(number(i))).collect(),
        (0..n).map(|i| Vec3::new(number(i), 0.0, -number(i))).collect(),
        logits.to_vec(),
        degree,
        (0..n * sh::coefficients(degree)).map(|i| [number(i), 1.0, 2.0]).collect(),
    )
    .unwrap()
}

#[test]
fn crops_keep_what_lies_inside_or_outside_borders_included() {
    let means = [Vec3::ZERO, Vec3::X, Vec3::new(0.0, 2.0, 0.0), Vec3::new(-3.0, 0.0, 0.5)];
    let splats = splats_at(&means, &[0.0; 4], 1);
    let unit = Volume::Box { low: DVec3::ZERO, high: DVec3::ONE };
    let ball = Volume::Sphere { center: DVec3::Y, radius: 1.0 };
    let half_space = Volume::Box { low: DVec3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, 0.5), high: DVec3::INFINITY };
    assert_eq!(in_crops(&splats, &[]), [0, 1, 2, 3]);
    assert_eq!(in_crops(&splats, &[Crop::Inside(unit)]), [0, 1]);
    assert_eq!(in_crops(&splats, &[Crop::Outside(unit)]), [2, 3]);
    assert_eq!(in_crops(&splats, &[Crop::Inside(ball)]), [0, 2]);
    assert_eq!(in_crops(&splats, &[Crop::Inside(unit), Crop::Outside(ball)]), [1]);
    assert_eq!(in_crops(&splats, &[Crop::Inside(half_space)]), [3]);

    let kept = gather(splats.clone(), &[3, 1]);
    assert_eq!(kept.means(), [means[3], means[1]]);
    assert_eq!(kept.sh_of(1), splats.sh_of(1));
    assert_eq!((kept.rotations()[0], kept.log_scales()[0]), (splats.rotations()[3], splats.log_scales()[3]));
    assert_eq!(gather(splats.clone(), &[]), Splats::empty(1));
}

#[test]
fn any_choice_of_splats_keeps_what_belongs_together() {
    let (scene, _) = random_scene(3, 5, 0, 2, 1, OrderMode::Stable);
    let splats = scene.splats;
    // Ascending indices, permutations (with two cycles and a fixed point), and repeated indices.
    for indices in [&[0, 2, 4][..], &[0, 1, 2, 3, 4], &[3, 2, 1, 0, 4], &[1, 2, 0, 4, 3], &[4, 4, 0], &[2, 0, 1]] {
        let taken = gather(splats.clone(), indices);
        assert_eq!(taken.len(), indices.len());
        for (to, &from) in indices.iter().enumerate() {
            assert_eq!((taken.means()[to], taken.rotations()[to]), (splats.means()[from], splats.rotations()[from]));
            assert_eq!(taken.log_scales()[to], splats.log_scales()[from]);
            assert_eq!(taken.opacity_logits()[to], splats.opacity_logits()[from]);
            assert_eq!(taken.sh_of(to), splats.sh_of(from), "{indices:?}");
        }
    }
}

#[test]
fn meshes_are_cropped_by_the_centroids_of_triangles() {
    let positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::new(9.0, 0.0, 0.0), Vec3::new(9.0, 1.0, 0.0)];
    let uvs = [[Vec2::ZERO, Vec2::X, Vec2::Y], [Vec2::ONE, Vec2::X, Vec2::Y]];
    let atlas = Atlas::new(Texture::zeros(2, 2, 4), None).unwrap();
    let mesh = Mesh::new(positions, vec![[0, 1, 2], [1, 4, 3]], uvs.to_vec(), atlas).unwrap();
    let far = Crop::Outside(Volume::Sphere { center: DVec3::ZERO, radius: 3.0 });
    let kept = crop_mesh(&mesh, &[far]).unwrap();
    assert_eq!(kept.positions(), [Vec3::X, Vec3::new(9.0, 0.0, 0.0), Vec3::new(9.0, 1.0, 0.0)]);
    assert_eq!((kept.triangles(), kept.corner_uvs()), (&[[0, 2, 1]][..], &uvs[1..]));
    assert_eq!(crop_mesh(&mesh, &[]).unwrap().triangles(), mesh.triangles());
    assert!(crop_mesh(&mesh, &[far, Crop::Inside(Volume::Sphere { center: DVec3::ZERO, radius: 3.0 })]).is_none());
}

#[test]
fn transparent_splats_go_and_important_ones_stay() {
    let splats = splats_at(&[Vec3::ZERO; 5], &[0.0, -2.0, 3.0, -1000.0, 0.0], 0);
    assert_eq!(not_below_opacity(&splats, 0.5), [0, 2, 4]);
    assert_eq!(not_below_opacity(&splats, 0.0), [0, 1, 2, 3, 4]);
    assert!(not_below_opacity(&splats, 1.0).is_empty());
    // Opacities ½, .12, .95, 0, ½ times areas e^0, e^.1, e^.2, e^.3, e^.4.
    for (count, kept) in
        [(0, &[][..]), (1, &[2]), (2, &[2, 4]), (3, &[0, 2, 4]), (4, &[0, 1, 2, 4]), (9, &[0, 1, 2, 3, 4])]
    {
        assert_eq!(most_important(&splats, count), kept, "{count}");
    }
    let equal = gather(splats.clone(), &[1; 6]);
    assert_eq!(most_important(&equal, 3), [0, 1, 2], "of equals the first");
}

#[test]
fn morton_order_brings_neighbours_together() {
    let corners: Vec<Vec3> = (0..8_u8).rev().map(|i| Vec3::from([0, 1, 2].map(|b| f32::from(i >> b & 1)))).collect();
    assert_eq!(in_morton_order(&splats_at(&corners, &[0.0; 8], 0)), [7, 6, 5, 4, 3, 2, 1, 0]);
    assert_eq!(in_morton_order(&splats_at(&[Vec3::ONE; 3], &[0.0; 3], 0)), [0, 1, 2]);
    assert!(in_morton_order(&Splats::empty(0)).is_empty());

    let mut rng = Pcg64Mcg::seed_from_u64(2);
    let means: Vec<Vec3> = (0..2000).map(|_| Vec3::from_array([0; 3].map(|_| rng.random_range(-5.0..5.0)))).collect();
    let splats = splats_at(&means, &[0.0; 2000], 0);
    let order = in_morton_order(&splats);
    let path = |order: &[usize]| order.windows(2).map(|w| means[w[0]].distance(means[w[1]])).sum::<f32>();
    let unsorted: Vec<usize> = (0..2000).collect();
    assert!(path(&order) < 0.3 * path(&unsorted));
    let mut sorted = order;
    sorted.sort_unstable();
    assert_eq!(sorted, unsorted, "a permutation");
}

#[test]
fn degrees_are_cut_and_raised() {
    let splats = splats_at(&[Vec3::ZERO, Vec3::X], &[0.0; 2], 2);
    let cut = with_sh_degree(splats.clone(), 1);
    assert_eq!((cut.sh_degree(), cut.sh_of(1)), (1, &splats.sh_of(1)[..4]));
    let raised = with_sh_degree(cut.clone(), 3);
    assert_eq!((&raised.sh_of(1)[..4], &raised.sh_of(1)[4..]), (cut.sh_of(1), &[[0.0; 3]; 12][..]));
    assert_eq!(with_sh_degree(Splats::empty(0), 7).sh_degree(), 3);
    assert_eq!(cut.into_arrays().with_sh_degree(u32::MAX).check().unwrap(), raised);

    let (scene, _) = random_scene(3, 0, 1, 3, 1, OrderMode::Stable);
    let mesh = &scene.meshes[0];
    let cut = with_mesh_sh_degree(mesh.clone(), 1);
    let (old, new) = (mesh.atlas().bands().unwrap(), cut.atlas().bands().unwrap());
    assert_eq!((new.channels(), cut.atlas().sh_degree()), (9, 1));
    assert_eq!(new.texels()[9..18], old.texels()[45..54]);
    assert!(with_mesh_sh_degree(mesh.clone(), 0).atlas().bands().is_none());
    assert_eq!(&with_mesh_sh_degree(mesh.clone(), 3), mesh);
}

#[test]
fn scenes_join_at_the_highest_degree_and_by_the_rule_of_the_first_mesh() {
    let (hybrid, _) = random_scene(1, 5, 2, 1, 4, OrderMode::Direct);
    let (other, _) = random_scene(2, 3, 1, 2, 2, OrderMode::Stable);
    let plain = HybridScene {
        splats: splats_at(&[Vec3::ONE; 2], &[0.0; 2], 3),
        meshes: vec![],
        composition: Composition::default(),
    };
    // All state their composition rule, as scenes written by this program do.
    let joined_of = |scenes: Vec<HybridScene>| join(scenes.into_iter().map(|scene| (scene, true)).collect());
    let joined = joined_of(vec![plain.clone(), hybrid.clone(), other.clone()]).unwrap();
    assert_eq!((joined.splats.len(), joined.splats.sh_degree(), joined.meshes.len()), (10, 3, 3));
    assert_eq!(joined.composition, hybrid.composition);
    // Of the layers, the largest number is kept, so that no scene loses surfaces.
    let most = Composition { layers: 4, ..other.composition };
    assert_eq!(
        (hybrid.composition.layers, joined_of(vec![other.clone(), hybrid.clone()]).unwrap().composition),
        (4, most)
    );
    let mut close = plain.clone();
    close.composition.near = 0.01;
    let from_there = Composition { near: 0.01, ..hybrid.composition };
    assert_eq!(joined_of(vec![plain.clone(), hybrid.clone(), close]).unwrap().composition, from_there);
    // A mesh without splats does not define the pixel filter.
    let mut mip = plain.clone();
    mip.composition.pixel_filter = PixelFilter::MIP;
    let mesh_alone = HybridScene { splats: Splats::empty(0), ..hybrid.clone() };
    for scenes in [[mip.clone(), mesh_alone.clone()], [mesh_alone, mip]] {
        assert_eq!(
            joined_of(scenes.to_vec()).unwrap().composition,
            Composition { pixel_filter: PixelFilter::MIP, ..hybrid.composition }
        );
    }
    assert_eq!(joined.splats.means()[2..7], *hybrid.splats.means());
    assert_eq!(joined.splats.sh_of(9)[..9], *other.splats.sh_of(2));
    assert_eq!(joined_of(vec![plain.clone()]).unwrap(), plain);
    assert!(joined_of(vec![]).unwrap().splats.is_empty());

    let mut linear = hybrid;
    linear.composition.color_space = ColorSpace::LinearDisplay;
    assert!(joined_of(vec![linear, other]).unwrap_err().to_string().contains("colours in LinearDisplay"));
}

#[test]
fn what_states_a_rule_comes_before_what_states_none() {
    let of = |composition| HybridScene { splats: splats_at(&[Vec3::ONE], &[0.0], 0), meshes: vec![], composition };
    let (with_mesh, _) = random_scene(1, 5, 1, 1, 1, OrderMode::Stable);
    let usual = Composition::default();
    let unstated = HybridScene { composition: usual, ..with_mesh.clone() };
    let own = Composition { mode: OrderMode::Direct, lambda: 0.5, background: [1.0; 3], near: 3.0, ..usual };
    let stated = HybridScene { composition: own, ..with_mesh };
    // A foreign mesh, whose file states no rule, on either side.
    for scenes in
        [[(unstated.clone(), false), (stated.clone(), true)], [(stated.clone(), true), (unstated.clone(), false)]]
    {
        assert_eq!(join(scenes.to_vec()).unwrap().composition, own);
    }
    // Splat-only scenes that state a rule have priority over meshes that do not, but not over meshes that do.
    let splats_alone = of(Composition { background: [0.5; 3], near: 5.0, ..usual });
    for scenes in [
        [(unstated.clone(), false), (splats_alone.clone(), true)],
        [(splats_alone.clone(), true), (unstated.clone(), false)],
    ] {
        assert_eq!(join(scenes.to_vec()).unwrap().composition, splats_alone.composition);
    }
    for scenes in [[(stated.clone(), true), (splats_alone.clone(), true)], [(splats_alone, true), (stated, true)]] {
        assert_eq!(join(scenes.to_vec()).unwrap().composition, own);
    }
    // If no scene states a rule, it is that of the first mesh, with the nearest near plane.
    let close = of(Composition { near: 0.1, background: [1.0; 3], ..usual });
    let joined = join(vec![(close, false), (unstated, false)]).unwrap().composition;
    assert_eq!(joined, Composition { near: 0.1, ..usual });
}
