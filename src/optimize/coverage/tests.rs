//! Where splats are put, and where not.

use glam::{DMat3, Vec3};

use super::*;
use crate::{
    capture::{Capture, LoadOptions, open},
    scene::{Intrinsics, testing::ahead},
};

fn demo() -> Capture {
    open(&std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("demo"), &LoadOptions::default()).unwrap()
}

fn grey(camera: &Camera) -> Photo {
    let k = camera.intrinsics();
    let rgba = [51, 102, 204, 255].repeat(k.pixels());
    Photo { width: k.width, height: k.height, rgba, has_alpha: false, masked: false }
}

fn cover(capture: &Capture, points: &[DVec3], most: usize) -> Splats {
    let views: Vec<&View> = capture.views.iter().collect();
    between_points(&views, &known(points, &bare()), 1, most, |view| Ok(grey(&view.camera).into())).unwrap()
}

fn bare() -> MeshBvh {
    MeshBvh::new([])
}

fn known<'a>(points: &'a [DVec3], meshes: &'a MeshBvh) -> Known<'a> {
    Known { points, meshes, near: 0.2, background: None }
}

fn shown(camera: &Camera, points: &[DVec3], photo: &Photo) -> Shown {
    Shown::new(camera, &known(points, &bare()), photo)
}

/// A triangle at depth `z` that fills the view of [`facing`] cameras.
fn wall(z: f32) -> MeshBvh {
    let corners = [[-9.0, -9.0, z], [9.0, -9.0, z], [0.0, 9.0, z]].map(Vec3::from);
    MeshBvh::new([(&corners[..], &[[0, 1, 2]][..])])
}

/// Number of cells in all views that contain neither a point nor a splat.
fn empty_cells(capture: &Capture, points: &[DVec3]) -> usize {
    let of_view = |view: &View| {
        let cells = Cells::new(&view.camera);
        let mut taken = vec![false; cells.len()];
        points.iter().filter_map(|p| cells.of(view.camera.to_camera(*p))).for_each(|cell| taken[cell] = true);
        taken.iter().filter(|taken| !**taken).count()
    };
    capture.views.iter().map(of_view).sum()
}

#[test]
fn what_has_no_points_is_covered_once_at_their_depth() {
    let capture = demo();
    // In half of the demo the points are removed.
    let points: Vec<DVec3> = capture.points.iter().map(|p| p.position).filter(|p| p.x > 0.0).collect();
    let splats = cover(&capture, &points, 100_000);
    let all: Vec<DVec3> = points.iter().copied().chain(splats.means().iter().map(|m| m.as_dvec3())).collect();
    let (before, after) = (empty_cells(&capture, &points), empty_cells(&capture, &all));
    // In the remaining 13 %, splats would float in front of points of other views.
    assert!(before > 5000 && after < before / 5, "{before} {after}");
    // Views share splats.
    assert!(splats.len() < before / 2, "{} for {before}", splats.len());
    // The scene is a few units large; extrapolated depths stay in the range of point depths.
    assert!(splats.means().iter().all(|m| m.length() < 20.0));
    let color = splats.sh()[0].map(|c| 0.5 + 0.282_094_8 * c);
    assert!([0.2, 0.4, 0.8].iter().zip(color).all(|(a, b)| (a - b).abs() < 1e-5), "{color:?}");
    assert_eq!(splats, cover(&capture, &points, 100_000));
}

/// The demo's table stands in front of an empty background.
#[test]
fn what_shows_the_background_stays_bare() {
    let capture = demo();
    let views: Vec<&View> = capture.views.iter().collect();
    let points: Vec<DVec3> = capture.points.iter().map(|p| p.position).filter(|p| p.x > 0.0).collect();
    let nothing = bare();
    let cover = |background| {
        let known = Known { background, ..known(&points, &nothing) };
        between_points(&views, &known, 0, 100_000, |view| Ok(crate::capture::decode(view)?.into())).unwrap()
    };
    // No colour in the demo is close to this green.
    let [all, over_black, over_green] = [None, Some([0.0; 3]), Some([0.0, 1.0, 0.0])].map(cover);
    let is_black = |sh: &[f32; 3]| sh.iter().all(|c| 0.5 + 0.282_094_8 * c < 1.9 / 255.0);
    let black = all.sh().iter().filter(|sh| is_black(sh)).count();
    assert!(black > 100 && over_green == all, "{black} of {}", all.len());
    assert!(over_black.len() > 100 && !over_black.sh().iter().any(is_black), "{}", over_black.len());
}

#[test]
fn fewer_are_larger() {
    let capture = demo();
    let points: Vec<DVec3> = capture.points.iter().map(|p| p.position).take(50).collect();
    let (all, some) = (cover(&capture, &points, 100_000), cover(&capture, &points, 100));
    assert_eq!(some.len(), 100);
    let wider = (all.len() as f32 / 100.0).sqrt().ln();
    assert!((some.log_scales()[0].x - all.log_scales()[0].x - wider).abs() < 1e-5);
    assert!(cover(&capture, &points, 0).is_empty() && cover(&capture, &[], 100).is_empty());
}

/// A floor of two triangles below the whole demo.
#[test]
fn what_a_mesh_covers_stays_bare() {
    let capture = demo();
    let points: Vec<DVec3> = capture.points.iter().map(|p| p.position).take(50).collect();
    let floor = [[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]].map(|[x, y]| Vec3::new(x, y, -1.0));
    let floor = MeshBvh::new([(&floor[..], &[[0, 1, 2], [0, 2, 3]][..])]);
    let views: Vec<&View> = capture.views.iter().collect();
    let photo = |view: &View| Ok(grey(&view.camera).into());
    let splats = between_points(&views, &known(&points, &floor), 1, 100_000, photo).unwrap();
    // Each splat is above the floor's horizon in some view. There, splats are moved farther away rather than left out,
    // so that many remain.
    let is_above = |eye: DVec3, p: DVec3| !floor.any_hit(eye, p - eye, 0.0, f64::INFINITY);
    let above = |p: DVec3| views.iter().any(|view| is_above(view.camera.center(), p));
    assert!(splats.means().iter().all(|p| above(p.as_dvec3())));
    let (some, all) = (splats.len(), cover(&capture, &points, 100_000).len());
    assert!(some > 100 && some < all / 2, "{some} of {all}");
}

fn facing(x: f64) -> Camera {
    ahead([100, 100], 100.0, x * DVec3::X)
}

#[test]
fn splats_are_as_deep_as_what_is_beside_them_and_as_wide_as_their_cell() {
    let map = shown(&facing(0.0), &[DVec3::new(0.0, 0.0, 4.0)], &grey(&facing(0.0)));
    let corner = map.cover(0).unwrap();
    // The border is ten pixels wide and a cell four: the centre of the first is eight pixels outside of the picture.
    let p = facing(0.0).to_camera(corner.mean);
    assert!((p.z - 4.0).abs() < 1e-9 && (facing(0.0).project(p) + DVec2::splat(8.0)).length() < 1e-9, "{p}");
    // Half of a cell of 3.6 pixels of size 1/100 at a depth of 4.
    assert!((corner.scale - 0.072).abs() < 1e-9, "{}", corner.scale);
    // Between two depths, inverse depth is averaged.
    let two = [DVec3::new(-2.0, 0.0, 4.0), DVec3::new(6.0, 0.0, 12.0)];
    let map = shown(&facing(0.0), &two, &grey(&facing(0.0)));
    let row = map.cells.of(DVec3::new(0.0, 0.0, 1.0)).unwrap() / map.cells.columns * map.cells.columns;
    let depths: Vec<f64> = (row..row + map.cells.columns).map(|cell| map.nearness[cell].unwrap().recip()).collect();
    assert!(depths.is_sorted() && depths[0] == 4.0 && (depths[33] - 12.0).abs() < 1e-9, "{depths:?}");
}

/// A light ball with points in a room, seen from twelve sides, and beside it a plate without points.
#[test]
fn dim_air_is_far_away_but_not_what_other_views_tell() {
    const PLATE: DVec3 = DVec3::new(0.0, 1.1, 0.0);
    let k = Intrinsics { width: 100, height: 100, fx: 150.0, fy: 150.0, cx: 50.0, cy: 50.0 };
    let turn = |i: u32| DMat3::from_rotation_y(std::f64::consts::TAU * f64::from(i) / 12.0);
    let cameras: Vec<Camera> = (0..12).map(|i| Camera::new(k, turn(i), DVec3::new(0.0, 0.0, 5.0)).unwrap()).collect();
    let ball: Vec<DVec3> = (0..2000)
        .map(|i| (f64::from(i) * 2.4, f64::from(i).mul_add(1e-3, -0.9995)))
        .map(|(turn, z)| 0.5 * DVec3::new((1.0 - z * z).sqrt() * turn.cos(), (1.0 - z * z).sqrt() * turn.sin(), z))
        .collect();
    let nothing = bare();
    let known = Known { background: Some([0.0; 3]), ..known(&ball, &nothing) };
    let covers_of = |room: u8, plate: u8| {
        let maps = cameras.iter().map(|camera| {
            let plate_at = camera.project(camera.to_camera(PLATE));
            let mut photo = grey(camera);
            for (i, p) in photo.rgba.chunks_exact_mut(4).enumerate() {
                let at = DVec2::new((i % 100) as f64, (i / 100) as f64) + 0.5;
                let is_ball = at.distance(DVec2::splat(50.0)) < 15.5;
                let is_plate = at.distance(plate_at) < 12.0;
                p[..3].fill(if is_ball {
                    200
                } else if is_plate {
                    plate
                } else {
                    room
                });
            }
            Shown::new(camera, &known, &photo)
        });
        covers(&maps.collect::<Vec<_>>(), &known)
    };
    let (air, things): (Vec<Cover>, Vec<Cover>) = covers_of(30, 60).into_iter().partition(|c| c.color[0] < 0.2);
    let nearest = air.iter().map(|c| c.mean.length()).fold(f64::INFINITY, f64::min);
    assert!(air.len() > 100 && nearest > 20.0, "{}, {nearest}", air.len());
    assert!(things.len() > 5 && things.iter().all(|c| c.mean.distance(PLATE) < 1.0), "{}", things.len());
    let light = covers_of(150, 200);
    let near = light.iter().filter(|c| c.mean.length() < 6.0).count();
    // Splats that would float in front of the ball are moved farther away here too.
    assert!(near > light.len() / 3, "{near} of {}", light.len());
}

/// Points to the left and right of the middle, at equal or different depths.
#[test]
fn what_is_between_points_of_one_depth_is_told() {
    for (depths, expected) in [([4.0, 4.0], true), ([4.0, 5.9], true), ([4.0, 6.1], false), ([4.0, f64::NAN], false)] {
        for side in [DVec3::X, DVec3::Y, DVec3::new(1.0, 1.0, 0.0), DVec3::new(1.0, -1.0, 0.0)] {
            // The centre of the middle cell, and the centres five cells away.
            let middle = DVec3::new(-0.006, -0.006, 1.0);
            let points: Vec<DVec3> = (depths.iter().zip([-0.18, 0.18]))
                .filter(|(z, _)| z.is_finite())
                .map(|(z, shift)| *z * (middle + shift * side))
                .collect();
            let map = shown(&facing(0.0), &points, &grey(&facing(0.0)));
            let middle = map.cells.of(DVec3::Z).unwrap();
            assert_eq!(map.is_between(middle), expected, "{depths:?} {side}");
        }
    }
}

#[test]
fn nothing_is_put_before_what_others_see_nor_where_a_mask_is() {
    // The first view sees only a point at depth 2 and would extrapolate it over the whole picture, where other views
    // see points at depth 10.
    let near = DVec3::new(-0.9, -0.9, 2.0);
    let far: Vec<DVec3> = (0..3600)
        .map(|i| DVec3::new(f64::from(i % 60), f64::from(i / 60), 0.0) / 5.0 - DVec3::new(5.9, 5.9, -10.0))
        .collect();
    let photo = grey(&facing(0.0));
    let first = shown(&facing(0.0), &[near], &photo);
    let middle = first.cells.of(DVec3::Z).unwrap();
    let cover = first.cover(middle).unwrap();
    let at = |z: f64| Cover { mean: DVec3::new(0.0, 0.0, z), ..cover };
    let hides = |cover: &Cover, meshes: &MeshBvh| {
        let known = known(&far, meshes);
        hides(cover, &[0.1, -0.1].map(|x| Shown::new(&facing(x), &known, &photo)), &known)
    };
    let [nothing, wall, lens] = [bare(), wall(5.0), wall(0.1)];
    assert!(hides(&cover, &nothing) && !super::hides(&cover, &[], &known(&[], &nothing)));
    assert!(hides(&at(9.4), &nothing) && !hides(&at(9.6), &nothing));
    // A mesh hides the points behind it, except for parts in front of the near plane.
    assert!(hides(&at(4.7), &wall) && !hides(&at(4.8), &wall));
    assert!(hides(&at(4.5), &nothing) && hides(&at(4.5), &lens));
    let camera = &first.cells.camera;
    let has_mesh = |meshes| known(&[], meshes).has_mesh(camera, DVec3::new(0.0, 0.0, 9.0), 0.0, f64::INFINITY);
    assert_eq!([has_mesh(&wall), has_mesh(&lens), has_mesh(&nothing)], [true, false, false]);
    let mut masked = photo;
    masked.rgba[4 * (50 * 100 + 50) + 3] = 0;
    let masked = shown(&facing(0.0), &[near], &masked);
    assert!(masked.cover(middle).is_none() && masked.cover(middle + 2).is_some());
}

/// A cube with a size of a tenth of its distance, seen from four sides against an area without points.
#[test]
fn what_is_around_an_object_stands_before_it_from_no_side() {
    let source = demo().views[0].source.clone();
    let k = Intrinsics { width: 100, height: 100, fx: 200.0, fy: 200.0, cx: 50.0, cy: 50.0 };
    let turn = |i: u8| DMat3::from_rotation_y(f64::from(i) * std::f64::consts::FRAC_PI_2);
    let camera = |i| Camera::new(k, turn(i), DVec3::new(0.0, 0.0, 10.0)).unwrap();
    let view = |i: u8| View { name: i.to_string(), camera: camera(i), source: source.clone(), sees: vec![] };
    let views: Vec<View> = (0..4).map(view).collect();
    let side = || (-5..=5).map(|i| f64::from(i) / 10.0);
    let cube: Vec<DVec3> =
        side().flat_map(|x| side().flat_map(move |y| side().map(move |z| DVec3::new(x, y, z)))).collect();
    let photo = |view: &View| Ok(grey(&view.camera).into());
    let some: Vec<&View> = views.iter().collect();
    let splats = between_points(&some, &known(&cube, &bare()), 0, 100_000, photo).unwrap();
    // The front of the cube is at 9.5. A splat beside the cube, as deep as its centre, would be in front of it from the
    // next side.
    let is_before = |view: &View, p: DVec3| {
        let p = view.camera.to_camera(p);
        let from_middle = view.camera.project(p) - DVec2::splat(50.0);
        p.z > 0.0 && p.z < 9.0 && from_middle.abs().max_element() < 8.0
    };
    let before = splats.means().iter().filter(|p| views.iter().any(|view| is_before(view, p.as_dvec3())));
    assert_eq!((before.count(), splats.len() > 1000), (0, true), "{}", splats.len());
}

#[test]
fn nothing_is_put_right_before_a_camera() {
    // 1 % of the depths are outliers.
    let depths: Vec<f64> = (0..100).map(|i| if i == 7 { 0.3 } else { 4.0 + f64::from(i) / 100.0 }).collect();
    assert_eq!([depths, vec![5.0], vec![]].map(nearest_depth), [4.01, 5.0, 0.0]);
    let photo = grey(&facing(0.0));
    let is_hiding = |x: f64, z: f64, meshes: &MeshBvh| {
        let point = [DVec3::new(0.0, 0.0, 5.0)];
        let known = known(&point, meshes);
        let cover = Cover { mean: DVec3::new(x, 0.0, z), scale: 0.1, color: [0.5; 3] };
        hides(&cover, &[Shown::new(&facing(0.0), &known, &photo)], &known)
    };
    // Beside the pixel of the point, and outside the picture; and at a greater distance.
    for (at, far) in [([1.0, 3.5], [1.0, 4.1]), ([3.0, 1.0], [4.5, 1.0])] {
        assert_eq!([at, far].map(|[x, z]| is_hiding(x, z, &bare())), [true, false], "{at:?}");
    }
    assert!(!is_hiding(0.0, -1.0, &bare()));
    // A splat may be about as near to the camera as the nearest mesh.
    assert_eq!([2.3, 2.5].map(|x| is_hiding(x, 0.1, &wall(3.0))), [true, false]);
}

#[test]
fn pictures_without_points_and_points_at_infinity_are_left_alone() {
    let photo = grey(&facing(0.0));
    let nothing = shown(&facing(0.0), &[-DVec3::Z], &photo);
    assert!((0..nothing.cells.len()).all(|cell| nothing.cover(cell).is_none()));
    for z in [1e300, 1e19, 0.1] {
        let map = shown(&facing(0.0), &[DVec3::new(0.0, 0.0, z)], &photo);
        assert!((0..map.cells.len()).all(|cell| map.cover(cell).is_none()), "{z}");
    }
}
