//! The views of a capture as a run knows them: their photographs, how these were taken, and what they say of a scene.

use super::{photographs::Photographs, setup::Setup};
use crate::{
    capture::Photo,
    evaluate,
    optimize::TrainError,
    render::gpu::{
        exposure::ExposureState,
        pose::PoseState,
        training::{Show, Training},
    },
    scene::Camera,
};

/// Photographs, and what a run has learnt of how they were taken. Views have their indices in the capture; cameras are
/// world→camera, in world units and pixels.
pub(super) struct Views<'a> {
    pub(super) photos: Photographs<'a>,
    /// Cameras of all views; those of training views refined, after the phase that refines them.
    pub(super) cameras: Vec<Camera>,
    /// Those of the training views, in their order.
    pub(super) train_cameras: Vec<Camera>,
    /// Exposures of all views, after the last phase; `None` if they are not fitted.
    pub(super) exposures: Option<ExposureState>,
    /// Corrections of the poses of all views, after the phase that refines them.
    pub(super) poses: Option<PoseState>,
}

impl<'a> Views<'a> {
    /// What is known before the first phase. `cameras` are those of all views, `train` the indices of the training
    /// views.
    pub(super) fn new(
        photos: Photographs<'a>,
        cameras: Vec<Camera>,
        train: &[usize],
        exposures: Option<ExposureState>,
    ) -> Self {
        let train_cameras = of_views(&cameras, train);
        Self { photos, cameras, train_cameras, exposures, poses: None }
    }

    /// Renders splats and mesh each alone from `views`, over this background. `use_view` gets, per view, the training,
    /// which has rendered the mesh last, the camera, and for every pixel the squared errors of mesh and splats (and a
    /// zero, for `Training::gather`); all three are zero in masked-out pixels.
    pub(super) fn compare(
        &self,
        training: &mut Training,
        views: &[usize],
        background: [f32; 3],
        mut use_view: impl FnMut(&mut Training, &Camera, &[[f32; 3]]) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        for &i in views {
            let camera = &self.cameras[i];
            let photo = self.photos.whole_of(i)?;
            let behind = self.exposed(i, background);
            let splats = training.render(camera, background, Show::SplatsAlone)?.rgb;
            let mesh = training.render(camera, background, Show::MeshesAlone)?.rgb;
            let errors: Vec<[f32; 3]> = (mesh.iter().zip(&splats).enumerate())
                .map(|(p, (mesh, splats))| {
                    let error = |rgb: &[f32; 3]| squared_error(&photo, p, &self.exposed(i, *rgb), behind);
                    if photo.counts(p) { [error(mesh), error(splats), 0.0] } else { [0.0; 3] }
                })
                .collect();
            use_view(training, camera, &errors)?;
        }
        Ok(())
    }

    /// Rendered colour after the exposure of a view's photograph.
    fn exposed(&self, view: usize, rgb: [f32; 3]) -> [f32; 3] {
        self.exposures.as_ref().map_or(rgb, |exposures| exposures.apply(view, rgb))
    }

    /// Makes the refined poses those of the training views' cameras.
    pub(super) fn fix_poses(&mut self, setup: &Setup, poses: PoseState) {
        for &i in &setup.train {
            self.cameras[i] = poses.apply(i, &setup.capture.views[i].camera);
        }
        self.train_cameras = of_views(&self.cameras, &setup.train);
        self.poses = Some(poses);
    }

    /// Refinements by name of training view; empty if none were made.
    pub(super) fn refined_poses(&self, setup: &Setup) -> Vec<(String, RefinedPose)> {
        let of_view = |&i: &usize| {
            let view = &setup.capture.views[i];
            (view.name.clone(), RefinedPose::new(&view.camera, &self.cameras[i]))
        };
        if self.poses.is_some() { setup.train.iter().map(of_view).collect() } else { vec![] }
    }
}

/// The cameras of these views.
fn of_views(cameras: &[Camera], views: &[usize]) -> Vec<Camera> {
    views.iter().map(|&i| cameras[i]).collect()
}

/// Up to four of the held-out views, evaluated while training.
pub(super) fn sampled(test: &[usize]) -> impl Iterator<Item = usize> {
    test.iter().copied().step_by(test.len().div_ceil(4).max(1))
}

/// Squared difference of a render from pixel `p` of a photograph, as both are scored.
fn squared_error(photo: &Photo, p: usize, render: &[f32; 3], background: [f32; 3]) -> f32 {
    let (truth, mask) = evaluate::expected(photo, p, background);
    let error: f32 = truth.iter().zip(render).map(|(truth, render)| (truth - render).powi(2)).sum();
    error * mask * mask
}

/// Refinement of a training view's pose.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct RefinedPose {
    /// Angle of rotation, degrees.
    pub degrees: f64,
    /// Shift of the camera's centre, in the capture's unit.
    pub distance: f64,
    /// Rows of [R|t], OpenCV axes.
    pub world_to_camera: [[f64; 4]; 3],
}

impl RefinedPose {
    fn new(before: &Camera, after: &Camera) -> Self {
        let (r, t) = (after.rotation(), after.translation());
        let (sine, cosine) = {
            let q = glam::DQuat::from_mat3(&(r * before.rotation().transpose()));
            (q.xyz().length(), q.w.abs())
        };
        Self {
            degrees: (2.0 * sine.atan2(cosine)).to_degrees(),
            distance: after.center().distance(before.center()),
            world_to_camera: [0, 1, 2].map(|i| [r.row(i).x, r.row(i).y, r.row(i).z, t[i]]),
        }
    }

    /// Adapts the pose to a world shifted by `shift`.
    pub(super) fn follow(&mut self, shift: glam::DVec3) {
        for [x, y, z, t] in &mut self.world_to_camera {
            *t -= glam::DVec3::new(*x, *y, *z).dot(shift);
        }
    }
}
