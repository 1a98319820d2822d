use std::f64::consts::{PI, TAU};

use glam::{DMat3, DQuat, DVec3, Vec3};

use super::rig::{Rig, symmetric_eigen};
use super::*;
use crate::render::testing::largest;
use crate::scene::{Composition, HybridScene, SplatArrays, Splats, testing::alike};

const K: Intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 50.0, cx: 30.0, cy: 25.0 };

fn view(center: DVec3, target: DVec3, up: DVec3) -> Camera {
    Camera::look_at(K, center, target, up).unwrap()
}

fn frames(frames: usize) -> Shot {
    Shot { frames, size: None, fov_y: None }
}

fn forward(camera: &Camera) -> DVec3 {
    camera.rotation().row(2)
}

/// Eight upright views on a circle of radius 3, 1 above `FOCUS`.
const FOCUS: DVec3 = DVec3::new(5.0, -1.0, 2.0);
const UP: DVec3 = DVec3::new(0.0, -1.0, 0.0);

fn ring() -> Vec<Camera> {
    let at = |i: u32| {
        let a = TAU * f64::from(i) / 8.0;
        view(FOCUS + DVec3::new(3.0 * a.cos(), -1.0, 3.0 * a.sin()), FOCUS, UP)
    };
    (0..8).map(at).collect()
}

fn all_finite(cameras: &[Camera]) -> bool {
    cameras.iter().all(|c| c.rotation().is_finite() && c.translation().is_finite())
}

#[test]
fn an_orbit_through_a_ring_is_the_ring() {
    let ring = ring();
    let rig = Rig::of(&ring).unwrap();
    assert!(rig.focus().unwrap().abs_diff_eq(FOCUS, 1e-9) && rig.orbit_axis().abs_diff_eq(UP, 1e-9));
    let found = orbit(&ring, &Around::default(), &frames(8)).unwrap();
    for (i, camera) in found.iter().enumerate() {
        let expected = &ring[i];
        assert!(camera.center().abs_diff_eq(expected.center(), 1e-9), "{i}: {}", camera.center());
        assert!(camera.rotation().abs_diff_eq(expected.rotation(), 1e-9), "{i}");
    }
    let k = found[0].intrinsics();
    assert_eq!((k.width, k.height, k.cx, k.cy), (64, 48, 32.0, 24.0));
    assert!((k.fx - 60.0).abs() < 1e-9 && (k.fy - 50.0).abs() < 1e-9);
}

#[test]
fn options_change_an_orbit_as_they_say() {
    let around = Around { radius_scale: 2.0, height: Some(-4.0), height_scale: 0.5, ..Around::default() };
    let shot = Shot { frames: 5, size: Some([200, 100]), fov_y: Some(PI / 2.0) };
    for camera in orbit(&ring(), &around, &shot).unwrap() {
        let offset = camera.center() - FOCUS;
        assert!((offset.dot(UP) + 2.0).abs() < 1e-9 && ((offset - UP * offset.dot(UP)).length() - 6.0).abs() < 1e-9);
        assert!(forward(&camera).abs_diff_eq(-offset.normalize(), 1e-9));
        let k = camera.intrinsics();
        assert!(k.width == 200 && k.height == 100 && (k.fy - 50.0).abs() < 1e-9 && (k.fx - 60.0).abs() < 1e-9);
    }
    let aside = Around { focus: Some(DVec3::ZERO), radius: Some(1.0), ..Around::default() };
    for camera in orbit(&ring(), &aside, &frames(3)).unwrap() {
        assert!(forward(&camera).cross(camera.center().normalize()).length() < 1e-9);
    }
}

#[test]
fn an_orbit_follows_a_tilted_ring_but_not_a_wall() {
    let tilt = DMat3::from_rotation_x(0.3);
    let tilted: Vec<Camera> = ring().iter().map(|c| view(tilt * c.center(), tilt * FOCUS, UP)).collect();
    let axis = Rig::of(&tilted).unwrap().orbit_axis();
    assert!(axis.abs_diff_eq(tilt * UP, 1e-9), "{axis}");
    // Views in a grid of rows and columns: the plane of the path is vertical.
    let wall: Vec<Camera> = (0..9)
        .map(|i| view(DVec3::new(f64::from(i % 3), f64::from(i / 3), 0.0), DVec3::new(1.0, 1.0, 5.0), UP))
        .collect();
    let rig = Rig::of(&wall).unwrap();
    assert_eq!(rig.orbit_axis(), rig.up);
    let found = orbit(&wall, &Around::default(), &frames(12)).unwrap();
    assert!(found.iter().all(|c| (c.center() - found[0].center()).dot(rig.up).abs() < 1e-9));
}

#[test]
fn a_figure_of_eight_crosses_itself_in_the_mean_view() {
    let views: Vec<Camera> = [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)]
        .iter()
        .map(|&(x, y)| view(DVec3::new(x, y, -10.0), DVec3::ZERO, UP))
        .collect();
    let found =
        lemniscate(&views, &Around { radius: Some(2.0), height: Some(0.5), ..Around::default() }, &frames(8)).unwrap();
    let distance = 101.0_f64.sqrt();
    // Right is x, up is −y: x = 2 sin t, y = −0.5 sin 2t.
    for (i, (x, y)) in
        [(0.0, 0.0), (2.0, -0.5), (2.0, 0.0), (2.0, 0.5), (0.0, 0.0), (-2.0, -0.5), (-2.0, 0.0), (-2.0, 0.5)]
            .into_iter()
            .enumerate()
    {
        let x = if i % 2 == 1 { x * 0.5_f64.sqrt() } else { x };
        let expected = DVec3::new(x, y, -distance);
        assert!(found[i].center().abs_diff_eq(expected, 1e-9), "{i}: {}", found[i].center());
        assert!(forward(&found[i]).abs_diff_eq(-expected.normalize(), 1e-9));
    }
    // Without options, the path is as wide as the spread of the views, at their mean distance.
    let own = lemniscate(&views, &Around::default(), &frames(4)).unwrap();
    assert!((own[1].center().x - 1.0).abs() < 1e-9, "{}", own[1].center());
    // For views all around, the mean view is undefined, and the first is used.
    let around = lemniscate(&ring(), &Around::default(), &frames(4)).unwrap();
    assert!(around[0].center().abs_diff_eq(ring()[0].center(), 1e-9));
}

#[test]
fn a_spline_through_a_line_is_the_line_at_one_speed() {
    let along = DVec3::new(1.0, 2.0, -2.0);
    let views: Vec<Camera> = [0.0, 1.0, 1.5, 4.0, 5.0].map(|s| view(along * s, along * s + DVec3::Z, UP)).to_vec();
    let found = spline(&views, &Spline::default(), &frames(11)).unwrap();
    for (i, camera) in found.iter().enumerate() {
        let expected = along * (0.5 * i as f64);
        assert!(camera.center().abs_diff_eq(expected, 1e-4), "{i}: {}", camera.center());
        assert!(camera.rotation().abs_diff_eq(views[0].rotation(), 1e-12));
    }
    let ends = spline(&views, &Spline { keys: Some(2), closed: false }, &frames(3)).unwrap();
    assert!(ends[1].center().abs_diff_eq(along * 2.5, 1e-9) && ends[2].center().abs_diff_eq(along * 5.0, 1e-9));
}

#[test]
fn a_spline_is_smooth_evenly_paced_and_goes_through_its_keys() {
    let ring = ring();
    let closed = Spline { keys: None, closed: true };
    let found = spline(&ring, &closed, &frames(800)).unwrap();
    for (i, camera) in found.iter().enumerate() {
        // Eight keys on a circle: between keys, a Catmull–Rom spline deviates by (9 cos 22.5° − cos 67.5°) / 8 of the
        // radius.
        let offset = camera.center() - FOCUS;
        assert!(((offset - UP * offset.dot(UP)).length() - 3.0).abs() < 0.026 && (offset.dot(UP) - 1.0).abs() < 1e-9);
        assert!((forward(camera) + offset.normalize()).length() < 0.01, "{i}");
        let [a, b, c] = [0, 1, 2].map(|j| &found[(i + j) % 800]);
        let step = b.center() - a.center();
        let first = found[1].center().distance(found[0].center());
        assert!((step.length() / first - 1.0).abs() < 1e-3, "{i}: {}", step.length());
        // Velocity is continuous, at keys as well as between them.
        let bend = (c.center() - b.center() - step).length() / step.length();
        assert!(bend < 0.02, "{i}: {bend}");
        let turn =
            |a: &Camera, b: &Camera| DQuat::from_mat3(&(b.rotation() * a.rotation().transpose())).to_scaled_axis();
        let change = (turn(b, c) - turn(a, b)).length() / turn(a, b).length();
        assert!(change < 0.03, "{i}: {change}");
    }
    for (i, key) in ring.iter().enumerate() {
        assert!(
            found[i * 100].center().abs_diff_eq(key.center(), 1e-3)
                && found[i * 100].rotation().abs_diff_eq(key.rotation(), 1e-3)
        );
    }
    // Four keys out of eight are every other one.
    let some = spline(&ring, &Spline { keys: Some(4), closed: true }, &frames(4)).unwrap();
    assert!((0..4).all(|i| some[i].center().abs_diff_eq(ring[2 * i].center(), 1e-6)));
}

/// A closed path stays smooth if its last key repeats the first up to rounding, or if another key is repeated.
#[test]
fn keys_that_are_nearly_one_make_no_corner() {
    let closed = Spline { keys: None, closed: true };
    let largest = |found: &[Camera]| {
        let steps: Vec<DVec3> = found.windows(2).map(|w| (w[1].center() - w[0].center()).normalize()).collect();
        steps.windows(2).map(|w| w[0].angle_between(w[1])).fold(0.0, f64::max)
    };
    let clean = ring();
    let near = |of: &Camera, by: f64| {
        let center = of.center() + DVec3::new(by, 0.0, by);
        view(center, FOCUS, UP)
    };
    for by in [1e-15, 1e-9, 1e-5] {
        let (mut seam, mut rest) = (clean.clone(), clean.clone());
        seam.push(near(&clean[0], by));
        rest.insert(4, near(&clean[3], by));
        for views in [&clean, &seam, &rest] {
            let found = spline(views, &closed, &frames(240)).unwrap();
            assert!(largest(&found) < 2.5_f64.to_radians(), "{by:e}: {}°", largest(&found).to_degrees());
        }
    }
}

#[test]
fn a_turn_in_place_takes_its_time() {
    let look = |angle: f64| view(DVec3::ONE, DVec3::ONE + DVec3::new(angle.sin(), 0.0, angle.cos()), UP);
    let still: Vec<Camera> = [0.0, 0.4, 0.8].map(look).to_vec();
    let found = spline(&still, &Spline::default(), &frames(9)).unwrap();
    for (i, camera) in found.iter().enumerate() {
        let angle = 0.1 * i as f64;
        assert!(
            camera.center().abs_diff_eq(DVec3::ONE, 1e-12)
                && (forward(camera) - DVec3::new(angle.sin(), 0.0, angle.cos())).length() < 2e-3
        );
    }
    let far = |x: f64, angle: f64| {
        let c = DVec3::new(x, 0.0, 0.0);
        view(c, c + DVec3::new(angle.sin(), 0.0, angle.cos()), UP)
    };
    let stop = [far(0.0, 0.0), far(5.0, 0.0), far(5.0, 1.0), far(10.0, 1.0)];
    let found = spline(&stop, &Spline::default(), &frames(201)).unwrap();
    let most = largest(found.windows(2).map(|w| forward(&w[0]).angle_between(forward(&w[1]))));
    assert!(most < 0.05, "{most}");
}

#[test]
fn degenerate_views_give_a_reason_or_a_path_but_no_nan() {
    let one = [view(DVec3::ZERO, DVec3::Z, UP)];
    let at_focus = Around { focus: Some(DVec3::Z * 2.0), ..Around::default() };
    let two = |a: (DVec3, DVec3), b: (DVec3, DVec3)| [view(a.0, a.0 + a.1, UP), view(b.0, b.0 + b.1, UP)];
    let parallel = two((DVec3::ZERO, DVec3::Z), (DVec3::X, DVec3::Z));
    let facing = two((DVec3::ZERO, DVec3::Z), (DVec3::Z * 4.0, -DVec3::Z));
    let outwards = two((DVec3::X, DVec3::new(1.0, 0.0, 1.0)), (-DVec3::X, DVec3::new(-1.0, 0.0, 1.0)));
    let same = [one[0], one[0], one[0]];
    for around in [orbit, lemniscate] {
        let reason = |views: &[Camera]| around(views, &Around::default(), &frames(3)).unwrap_err();
        assert_eq!(reason(&[]), PathError::TooFew { expected: 1, found: 0 });
        for views in [&one[..], &parallel, &facing, &same] {
            assert_eq!(reason(views), PathError::NoFocus);
            // With a given focus there is a path even for a single view.
            let found = around(views, &at_focus, &frames(5)).unwrap();
            assert!(all_finite(&found) && found.iter().all(|c| c.to_camera(DVec3::Z * 2.0).z > 0.0));
        }
        assert_eq!(reason(&outwards), PathError::Outwards);
        let inside = Around { focus: Some(DVec3::ZERO), ..Around::default() };
        assert_eq!(around(&one, &inside, &frames(3)).unwrap_err(), PathError::NoRadius);
    }
    let above = [view(DVec3::new(0.0, -5.0, 0.0), DVec3::ZERO, DVec3::Z)];
    let below = Around { focus: Some(DVec3::ZERO), radius: Some(1e-3), ..Around::default() };
    assert!(all_finite(&orbit(&above, &below, &frames(4)).unwrap()));

    let reason = |views: &[Camera]| spline(views, &Spline::default(), &frames(3)).unwrap_err();
    assert_eq!(reason(&[]), PathError::TooFew { expected: 1, found: 0 });
    assert_eq!(reason(&one), PathError::TooFew { expected: 2, found: 1 });
    assert_eq!(reason(&same), PathError::TooFew { expected: 2, found: 1 });
    for views in [&parallel, &facing, &outwards] {
        for closed in [false, true] {
            let found = spline(views, &Spline { keys: None, closed }, &frames(50)).unwrap();
            assert!(found.len() == 50 && all_finite(&found));
        }
    }
    let options = |fov_y| spline(&parallel, &Spline::default(), &Shot { fov_y: Some(fov_y), ..frames(3) });
    assert!(options(1.0).is_ok() && options(f64::NAN).is_err() && options(PI).is_err());
}

#[test]
fn eigenvectors_are_those_of_the_matrix() {
    let turn = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 0.7);
    let matrix = turn * DMat3::from_diagonal(DVec3::new(3.0, -1.0, 7.0)) * turn.transpose();
    let (values, vectors) = symmetric_eigen(matrix);
    for ((value, vector), expected) in values.into_iter().zip(vectors).zip([-1.0, 3.0, 7.0]) {
        assert!((value - expected).abs() < 1e-12 && (matrix * vector).abs_diff_eq(vector * value, 1e-12));
        assert!((vector.length() - 1.0).abs() < 1e-12);
    }
}

/// Ignoring outlying splats and invisible ones.
#[test]
fn a_scene_without_views_is_seen_from_around_it() {
    let middle = DVec3::new(10.0, -3.0, 5.0);
    let mut means: Vec<DVec3> = (0..125)
        .map(|i| middle + DVec3::new(f64::from(i % 5), f64::from(i / 5 % 5), f64::from(i / 25)) - DVec3::splat(2.0))
        .collect();
    let solid = means.clone();
    means.extend([DVec3::splat(1e4), DVec3::splat(-1e6)]);
    means.extend((0..100).map(|i| DVec3::new(500.0, f64::from(i), 0.0)));
    let opacity_logits = (0..means.len()).map(|i| if i < 127 { 3.0 } else { -20.0 }).collect();
    let arrays = alike(means.iter().map(|mean| mean.as_vec3()).collect(), -3.0, 0.0, [0.0; 3]).into_arrays();
    let splats = SplatArrays { opacity_logits, ..arrays }.check().unwrap();
    let scene = HybridScene { splats, meshes: vec![], composition: Composition::default() };
    let Overview { views, focus, radius } = overview(&scene, UP, 8).unwrap();
    assert!(views.len() == 8 && (2.0..5.0).contains(&radius), "{radius}");
    assert!(solid.iter().all(|p| p.distance(focus) < radius), "{focus}");
    for view in &views {
        assert!(solid.iter().all(|&p| view.in_picture(view.to_camera(p)).is_some()));
        assert!((view.center() - middle).y < 0.0 && view.rotation().row(1).y > 0.9);
        assert!((forward(view).cross(middle - view.center())).length() < 0.2);
    }
    // Paths can be computed from these views as from any others.
    let again = orbit(&views, &Around::default(), &frames(8)).unwrap();
    assert!(again.iter().zip(&views).all(|(a, b)| a.center().abs_diff_eq(b.center(), 1e-6)));
    assert!(all_finite(&spline(&views, &Spline { keys: None, closed: true }, &frames(20)).unwrap()));
    let nothing = HybridScene { splats: Splats::empty(0), ..scene };
    assert_eq!(overview(&nothing, UP, 8).unwrap_err(), PathError::Empty);
}

/// Splats of a grid around the origin, 4 wide, and of this size and place besides.
fn grid_and(far: &[(DVec3, f64)]) -> HybridScene {
    let of_grid = (0..125).map(|i| (DVec3::new(f64::from(i % 5), f64::from(i / 5 % 5), f64::from(i / 25)) - 2.0, 0.1));
    let all: Vec<(DVec3, f64)> = of_grid.chain(far.iter().copied()).collect();
    let log_scales = all.iter().map(|(_, size)| Vec3::splat(size.ln() as f32)).collect();
    let arrays = alike(all.iter().map(|(mean, _)| mean.as_vec3()).collect(), 0.0, 3.0, [0.0; 3]).into_arrays();
    let splats = SplatArrays { log_scales, ..arrays }.check().unwrap();
    HybridScene { splats, meshes: vec![], composition: Composition::default() }
}

/// As trainings of few splats have it, in which a background is more than a tenth of them.
#[test]
fn a_background_is_not_what_a_scene_without_views_shows() {
    let alone = overview(&grid_and(&[]), UP, 1).unwrap();
    let far: Vec<(DVec3, f64)> = (0..40).map(|i| (DVec3::new(f64::from(i) - 20.0, 0.0, -60.0), 10.0)).collect();
    let found = overview(&grid_and(&far), UP, 1).unwrap();
    assert!(found.focus.distance(alone.focus) < 0.5 && found.radius < 1.2 * alone.radius, "{found:?}");
    // What is as large as the rest is shown.
    let near: Vec<(DVec3, f64)> = far.iter().map(|(mean, _)| (*mean, 0.1)).collect();
    assert!(overview(&grid_and(&near), UP, 1).unwrap().radius > 20.0);
}

#[test]
fn views_of_a_scene_without_any_stand_as_they_are_asked_to() {
    let scene = grid_and(&[]);
    for up in [DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y, DVec3::NEG_Z] {
        let Overview { views, focus, radius } = overview(&scene, up, 8).unwrap();
        assert!(focus.length() < 1e-6 && radius > 3.0, "{focus} {radius}");
        for view in &views {
            assert!(-view.rotation().row(1).dot(up) > 0.9 && view.center().dot(up) > 0.0, "{up}");
            assert!(forward(view).abs_diff_eq(-view.center().normalize(), 1e-6), "{up}");
        }
        let ahead = if up.z == 0.0 { DVec3::Z } else { DVec3::Y };
        assert!(forward(&views[0]).dot(ahead) > 0.9, "{up}");
    }
}
