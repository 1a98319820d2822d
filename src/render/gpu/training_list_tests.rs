//! Steps whose lists are too short, longer than needed, replaced, or summed in parts.

use glam::Vec3;

use super::{
    Gpu,
    exposure::ExposureState,
    geometry::GEOMETRY_FLOATS,
    pose::PoseState,
    rows::{Rows, Source},
    training::{Training, TrainingOptions},
    training_tests::{SIDE, camera, learnt, scene, step, step_with_long_lists},
    vertices::VertexState,
};
use crate::{
    render::testing,
    scene::{Atlas, OrderMode, Texture},
};

/// An image that lacks entries beyond its lists' capacity trains nothing: four splats in 256 tiles each, with a
/// capacity of six pairs per splat and one per tile; 40 triangles in 1024 bins each, with a capacity of 16 per bin.
#[test]
fn a_step_with_lists_too_short_changes_nothing() {
    let open = || Gpu::open(None).unwrap();
    for (gpu, n, triangles) in [(open(), 4, 1), (open(), 1, 40), (open().posing_as_gpu(), 4, 1)] {
        let mut scene = scene(n, triangles);
        // Vertices have gradients if colours vary along the map.
        let texels = (0..4 * 16 * 16).map(|i| 0.3 * (i as f32).sin()).collect();
        let atlas = Atlas::new(Texture::new(16, 16, 4, texels).unwrap(), None).unwrap();
        scene.meshes[0] = scene.meshes[0].clone().with_atlas(atlas);
        // From far away everything is small and fits.
        let (near, far) = (camera(3.0), camera(1e5));
        let mut training = Training::new(&gpu, &scene, &[near], 0.2).unwrap();
        training.refine_poses(&PoseState::new(1)).unwrap();
        training.expose(&ExposureState::new(1)).unwrap();
        training.free_vertices(&scene.meshes, &VertexState::new(&scene.meshes, 1e-3)).unwrap();
        let before = learnt(&training, &scene.meshes);
        step(&mut training, &near);
        step(&mut training, &near);
        assert!(learnt(&training, &scene.meshes) == before, "{n} splats, {triangles} triangles");
        assert_eq!(training.status().unwrap().skipped, 2);
        // The host may look only after a step that would fit, but such a step must not be taken before those that did
        // not fit.
        step(&mut training, &far);
        assert!(learnt(&training, &scene.meshes) == before, "{n} splats, {triangles} triangles");
        assert_eq!(training.grow_if_short().unwrap(), 3);
        assert_eq!(training.grow_if_short().unwrap(), 0);
        step(&mut training, &near);
        let after = learnt(&training, &scene.meshes);
        assert!(after.0.geometry != before.0.geometry && after.1 != before.1 && after.2 != before.2);
        assert!(after.4 != before.4 && after.5 != before.5 && after.6 != before.6);
        assert_eq!(training.read_poses().unwrap().unwrap().steps, [1], "what was not learnt from does not count");
        assert_eq!(training.read_exposures().unwrap().unwrap().steps, [1]);
        assert_eq!(training.status().unwrap().skipped, 0);
    }
}

/// Rendering depths of splats alone enlarges lists as a picture does: a step after it equals one with lists that were
/// long from the beginning.
#[test]
fn a_step_after_depths_that_were_long_learns() {
    let (gpu, scene, near) = (Gpu::open(None).unwrap(), scene(4, 1), camera(3.0));
    let made = || {
        let mut training = Training::new(&gpu, &scene, &[near], 0.2).unwrap();
        training.refine_poses(&PoseState::new(1)).unwrap();
        training
    };
    let [mut short, mut long] = [made(), made()];
    let lengths = short.pipeline.front.list_lengths();
    let depths = short.median_depth(&near).unwrap();
    assert!(depths[(SIDE * SIDE / 2 + SIDE / 2) as usize] > 0.0);
    assert!(short.pipeline.front.list_lengths()[0] > lengths[0], "nothing was too short");
    long.lengthen_lists(short.pipeline.front.list_lengths()).unwrap();
    let losses = [&mut short, &mut long].map(|training| {
        step(training, &near);
        assert_eq!(training.status().unwrap().skipped, 0);
        training.loss().unwrap()
    });
    assert_eq!((losses[0].l1, losses[0].ssim), (losses[1].l1, losses[1].ssim));
}

/// A checkpoint stores the list lengths of the adapter that it was written on.
#[test]
fn lists_of_another_adapter_are_as_long_as_this_one_binds() {
    let gpu = Gpu::open(None).unwrap().binding_at_most(256 << 10);
    let near = camera(3.0).resized(64, 64);
    let mut training = Training::new(&gpu, &scene(4, 1), &[near], 0.2).unwrap();
    let longest = (256 << 10) / 8;
    assert_eq!(training.bindable([usize::MAX, 7]), [longest, 7]);
    training.lengthen_lists(training.bindable([usize::MAX; 2])).unwrap();
    assert_eq!(training.list_lengths(), [longest; 2]);
    step(&mut training, &near);
    assert_eq!(training.grow_if_short().unwrap(), 0);
}

/// Pictures do not depend on list lengths: the last step's picture is kept, and not rendered again.
#[test]
fn longer_lists_leave_pictures_alone() {
    let (gpu, scene, near) = (Gpu::open(None).unwrap(), scene(4, 1), camera(3.0));
    let mut training = Training::new(&gpu, &scene, &[near], 0.2).unwrap();
    // The first step may find its lists too short.
    for _ in 0..2 {
        step(&mut training, &near);
        training.grow_if_short().unwrap();
    }
    let image = |training: &Training| training.pipeline.read_picture(&gpu, &near).unwrap().rgb;
    let (loss, seen) = (training.loss().unwrap(), image(&training));
    assert!(loss.l1 > 0.0);
    assert_eq!(training.look().unwrap().loss, loss, "as it is read with the status");
    let lengths = training.pipeline.front.list_lengths();
    training.lengthen_lists(lengths.map(|n| 4 * n)).unwrap();
    assert!(training.pipeline.front.list_lengths()[0] > lengths[0]);
    assert_eq!((training.loss().unwrap(), image(&training)), (loss, seen));
}

/// Whoever replaced buffers: the next step binds the present ones by itself.
#[test]
fn a_step_is_of_the_present_lists() {
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = testing::smooth_scene(1, 2, OrderMode::Stable);
    let [expected, found] = [false, true].map(|replaces| {
        let mut training = Training::new(&gpu, &scene, &[camera], 0.2).unwrap();
        training.refine_poses(&PoseState::new(1)).unwrap();
        if replaces {
            let longer = training.list_lengths().map(|n| 2 * n);
            training.pipeline.front.lengthen_lists(&gpu, longer).unwrap();
        }
        step(&mut training, &camera);
        assert_eq!(training.status().unwrap().skipped, 0);
        learnt(&training, &scene.meshes)
    });
    assert!(found == expected && found.0.geometry_m.iter().any(|m| *m != 0.0));
}

/// As after a handover to a mesh that leaves room for fewer splats than there were.
#[test]
fn a_step_in_buffers_that_shrank_is_the_same() {
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = testing::random_scene(7, 300, 0, 2, 1, OrderMode::Stable);
    let sources: Vec<Source> = (0..300).step_by(2).map(Source::new).collect();
    let [expected, found] = [(usize::MAX, 450), (200, 200)].map(|(most_splats, capacity)| {
        let options = TrainingOptions { most_splats, absolute_gradients: true, ..TrainingOptions::default() };
        let mut training = Training::with_options(&gpu, &scene, &[camera], &options).unwrap();
        training.refine_poses(&PoseState::new(1)).unwrap();
        step_with_long_lists(&mut training, &camera);
        let geometry = training.read_geometry().unwrap();
        let geometry = Source::gather(&sources, &geometry, GEOMETRY_FLOATS, Rows::Parameters);
        training.rearrange(&geometry, &sources).unwrap();
        assert_eq!(training.pipeline.front.splats.capacity, capacity);
        step_with_long_lists(&mut training, &camera);
        learnt(&training, &scene.meshes)
    });
    assert!(found == expected && found.0.geometry_m.iter().any(|m| *m != 0.0));
}

/// Lists that had to grow stay as long for each splat.
#[test]
fn lists_shrink_with_the_room_for_splats() {
    let gpu = Gpu::open(None).unwrap();
    let (scene, camera) = testing::random_scene(7, 400, 0, 0, 1, OrderMode::Stable);
    let options = TrainingOptions { most_splats: 200, ..TrainingOptions::default() };
    let mut training = Training::with_options(&gpu, &scene, &[camera], &options).unwrap();
    training.lengthen_lists([9000, 0]).unwrap();
    let sources: Vec<Source> = (0..150).map(Source::new).collect();
    training.rearrange(&vec![0.0; 150 * GEOMETRY_FLOATS], &sources).unwrap();
    assert_eq!((training.pipeline.front.splats.capacity, training.list_lengths()[0]), (200, 4500));
}

/// A thousand splats that cover all tiles, which use a few of them: more rows of sums than are bound at a time.
#[test]
fn sums_of_pairs_in_parts_are_those_of_all() {
    let mut scene = scene(1000, 1);
    let splats = scene.splats.into_arrays();
    scene.splats = crate::scene::SplatArrays { log_scales: vec![Vec3::splat(3.0); 1000], ..splats }.check().unwrap();
    let near = camera(3.0).resized(64, 64);
    let ways = [(true, false), (false, false), (true, true), (false, true)];
    for ((subgroups, absolute), poses) in ways.into_iter().flat_map(|way| [(way, false), (way, true)]) {
        let open = || {
            let gpu = Gpu::with_subgroups(subgroups);
            if poses { gpu.posing_as_gpu() } else { gpu }
        };
        let [all, parts] = [open(), open().binding_at_most(256 << 10)].map(|gpu| {
            let options = TrainingOptions { absolute_gradients: absolute, ..TrainingOptions::default() };
            let mut training = Training::with_options(&gpu, &scene, &[near], &options).unwrap();
            training.refine_poses(&PoseState::new(1)).unwrap();
            step_with_long_lists(&mut training, &near);
            assert!(training.pipeline.front.lists.read_counts(&gpu).unwrap().1 > 12_000);
            learnt(&training, &scene.meshes)
        });
        assert!(all.0.geometry_m.iter().filter(|m| **m != 0.0).count() > 50);
        assert!(all == parts, "subgroups {subgroups}, absolute {absolute}, as a GPU {poses}");
    }
}
