//! Refinement of the training views' poses, along with splats as long as there is no mesh.

use super::{Phase, Run, plan::Plan};
use crate::{
    optimize::schedule,
    render::gpu::pose::{PoseState, PoseStep},
    scene::Camera,
};

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

impl Run<'_> {
    /// Whether poses are refined in this phase: only without a mesh, whose gradients with respect to the pose are not
    /// computed.
    pub(super) fn refines_poses(&self, phase: Phase) -> bool {
        self.options.refine_poses && (phase == Phase::Surface || !self.finds_surface())
    }

    /// Poses before refinement.
    pub(super) fn given_poses(&self) -> PoseState {
        PoseState::new(self.cameras.len())
    }

    /// Pose step of iteration `t` for its view.
    pub(super) fn pose_step(&self, plan: &Plan, view: usize, t: u32) -> Option<PoseStep> {
        let rate = schedule::pose_rate(t, plan.iterations, self.train.len(), self.options.pose_reach.to_radians());
        self.refines_poses(plan.phase).then_some(PoseStep { view, turn_rate: rate, shift_rate: rate * self.extent })
    }

    /// Makes the refined poses those of the run's cameras.
    pub(super) fn fix_poses(&mut self, poses: PoseState) {
        for &i in &self.train {
            self.cameras[i] = poses.apply(i, &self.capture.views[i].camera);
        }
        self.train_cameras = self.train.iter().map(|&i| self.cameras[i]).collect();
        self.poses = Some(poses);
    }

    /// Refinements by name of training view; empty if none were made.
    pub(super) fn refined_poses(&self) -> Vec<(String, RefinedPose)> {
        let of_view = |&i: &usize| {
            let view = &self.capture.views[i];
            (view.name.clone(), RefinedPose::new(&view.camera, &self.cameras[i]))
        };
        if self.poses.is_some() { self.train.iter().map(of_view).collect() } else { vec![] }
    }
}
