//! Poses of photographs during training (`shaders/pose.wgsl`).

use glam::{DMat3, DQuat, DVec3};

use super::{
    adam,
    backward::Backward,
    device::{Buffer, Frame, Gpu, GpuError, Kernel, Stage},
    per_view::{PerView, PerViewBuffers},
    pipeline::Pipeline,
};
use crate::scene::{Camera, center_and_spread};

/// Workgroups of `pull`, equal to the threads of `update`.
const PARTS: usize = 256;
/// Floats per view.
pub(crate) const FLOATS: usize = 8;

/// Corrections of each view's known camera: a rotation after its rotation W, W' = exp(ω)·W, about a shifted centre, C'
/// = C + c. Per view: ω in camera axes (radians), 0, c in the world's unit, 0.
pub(crate) type PoseState = PerView<FLOATS>;

impl PoseState {
    /// Zero corrections.
    pub(crate) fn new(views: usize) -> Self {
        Self::beginning_at([0.0; FLOATS], views)
    }

    /// ω and c of a view.
    pub(crate) fn of(&self, view: usize) -> [DVec3; 2] {
        [0, 4].map(|at| glam::Vec3::from_slice(&self.values[FLOATS * view + at..]).as_dvec3())
    }

    fn set(&mut self, view: usize, change: [DVec3; 2]) {
        let words = change.map(|v| [v.x as f32, v.y as f32, v.z as f32, 0.0]);
        self.values[FLOATS * view..FLOATS * (view + 1)].copy_from_slice(words.as_flattened());
    }

    /// The corrected camera of a view whose known camera is `camera`.
    pub(crate) fn apply(&self, view: usize, camera: &Camera) -> Camera {
        let [turn, shift] = self.of(view);
        if (turn, shift) == (DVec3::ZERO, DVec3::ZERO) {
            return *camera;
        }
        let rotation = DMat3::from_quat(DQuat::from_scaled_axis(turn)) * camera.rotation();
        // A non-finite correction was detected by the step that made it.
        Camera::new(*camera.intrinsics(), rotation, -(rotation * (camera.center() + shift))).unwrap_or(*camera)
    }

    /// Removes the similarity that the corrections of `views` have in common: scene and cameras could be moved, rotated
    /// and scaled together without any photograph telling. It is the similarity x + s + θ×d + σd, d = x − mean of
    /// centres, nearest to the corrections, with rotations (radians) weighted like centres (relative to the root mean
    /// square distance of `cameras` from their mean).
    pub(crate) fn center(&mut self, cameras: &[Camera], views: &[usize]) {
        let n = views.len().max(1) as f64;
        let (mean, _) = center_and_spread(views.iter().map(|&i| &cameras[i]));
        let found: Vec<_> = (views.iter())
            .map(|&i| {
                let ([turn, shift], d) = (self.of(i), cameras[i].center() - mean);
                (d, shift, cameras[i].rotation().transpose() * turn)
            })
            .collect();
        let of_all = |f: fn(&(DVec3, DVec3, DVec3)) -> DVec3| found.iter().map(f).sum::<DVec3>();
        let shift = of_all(|f| f.1) / n;
        // Coincident cameras, up to rounding, have no scale.
        let square: f64 = found.iter().map(|f| f.0.length_squared()).sum();
        let weight = if square > 1e-18 * n * mean.length_squared() { n / square } else { 0.0 };
        let growth = weight / n * found.iter().map(|f| f.0.dot(f.1)).sum::<f64>();
        let outer = found.iter().map(|&(d, ..)| DMat3::from_cols(d.x * d, d.y * d, d.z * d)).sum::<DMat3>();
        let normal = n * DMat3::IDENTITY + weight * (square * DMat3::IDENTITY - outer);
        let turn = normal.inverse() * (weight * of_all(|f| f.0.cross(f.1)) - of_all(|f| f.2));
        for (&i, (d, moved, turned)) in views.iter().zip(&found) {
            self.set(i, [cameras[i].rotation() * (*turned + turn), *moved - shift - turn.cross(*d) - growth * *d]);
        }
    }
}

/// Pose step of a training step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct PoseStep {
    /// View of the photograph.
    pub(crate) view: usize,
    /// Learning rates, radians and world units; 0 leaves the pose as it is.
    pub(crate) turn_rate: f32,
    pub(crate) shift_rate: f32,
}

/// Poses of all views, and their stages before and after the frame.
pub(crate) struct Poses {
    /// Kernels `correct`, `pull` and `update`.
    kernels: [Kernel; 3],
    step: Buffer,
    pub(super) views: PerViewBuffers<FLOATS>,
    partial: Buffer,
    stages: Option<[Stage; 3]>,
}

impl Poses {
    /// # Errors
    /// If the adapter has no memory left.
    pub(crate) fn new(gpu: &Gpu, state: &PoseState) -> Result<Self, GpuError> {
        let defines = adam::defines(gpu).with("PARTS", PARTS as u32);
        Ok(Self {
            kernels: ["correct", "pull", "update"].map(|entry| Kernel::new(gpu, "pose.wgsl", entry, &defines)),
            step: gpu.uniform("pose step", 8)?,
            views: PerViewBuffers::new(gpu, "poses", state)?,
            partial: gpu.storage("pose gradients", 8 * PARTS)?,
            stages: None,
        })
    }

    /// Binds to the buffers of a pipeline and its backward pass, if the latter differentiates by poses.
    pub(crate) fn bind(&mut self, gpu: &Gpu, pipeline: &Pipeline, backward: &Backward) {
        if let Some(by_turn) = &backward.splats.turn {
            let gradients = [by_turn, &backward.splats.geometry];
            let front = &pipeline.front;
            self.bind_gradients(gpu, gradients, [&front.view, &front.lists.visible, &backward.status]);
        }
    }

    /// Binds the gradients of splats by a rotation and by their geometry.
    fn bind_gradients(&mut self, gpu: &Gpu, gradients: [&Buffer; 2], [view, visible, status]: [&Buffer; 3]) {
        let [by_turn, by_geometry] = gradients;
        let Self { step, views, partial, .. } = &*self;
        let [first, second] = &views.moments;
        let buffers = [view, step, &views.values, first, second, by_turn, by_geometry, partial, status, visible];
        self.stages = Some(self.kernels.each_ref().map(|kernel| kernel.bind(gpu, &buffers)));
    }

    /// Appends, before anything else of a frame, the correction of its view, and sets the step for
    /// [`Self::record_update`].
    pub(crate) fn record_correction(&mut self, gpu: &Gpu, frame: &mut Frame, step: &PoseStep) {
        let Some([correct, ..]) = &self.stages else { return };
        let [first, second] = self.views.count(step.view, step.turn_rate != 0.0);
        let [turn, shift] = [step.turn_rate, step.shift_rate].map(f32::to_bits);
        let words = [step.view as u32, turn, shift, first, second, 0, 0, 0];
        gpu.write(&self.step, 0, &words);
        frame.dispatch(correct, 1);
    }

    /// Appends the step of the view's pose, after the gradients.
    pub(crate) fn record_update(&self, frame: &mut Frame) {
        if let Some([_, pull, update]) = &self.stages {
            frame.dispatch(pull, PARTS);
            frame.dispatch(update, 1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        render::{
            gpu::{
                status::status_buffer,
                view::{VIEW_WORDS, View},
            },
            testing,
        },
        scene::OrderMode,
    };

    /// More splats than threads; the view does not see a third of them, and gradients increase with the index.
    #[test]
    fn all_of_many_splats_pull() {
        const N: usize = 70_000;
        const { assert!(N > 256 * PARTS) };
        let (scene, camera) = testing::smooth_scene(1, 1, OrderMode::Stable);
        let view = View { n_splats: N as u32, ..View::of(&camera, scene.composition) };
        let is_seen = |i: usize| !i.is_multiple_of(3);
        let pull = |i: usize, axis: usize| (1 + axis) as f32 * (1.0 + (i % 7) as f32 + i as f32 / 1e4) * 1e-6;
        let by_turn: Vec<[f32; 4]> = (0..N).map(|i| [pull(i, 0), pull(i, 1), pull(i, 2), 0.0]).collect();
        let by_geometry: Vec<[[f32; 4]; 3]> =
            (0..N).map(|i| [[pull(i, 2), pull(i, 1), pull(i, 0), 9.0], [9.0; 4], [9.0; 4]]).collect();
        let visible: Vec<u32> = (0..N).map(|i| u32::from(is_seen(i))).collect();

        let gpu = Gpu::open(None).unwrap();
        let uniform = gpu.uniform("view", VIEW_WORDS).unwrap();
        gpu.write(&uniform, 0, &view.words());
        let gradients = [
            gpu.storage_with("rotation gradients", &by_turn).unwrap(),
            gpu.storage_with("geometry gradient", &by_geometry).unwrap(),
        ];
        let visible = gpu.storage_with("visible splats", &visible).unwrap();
        let mut poses = Poses::new(&gpu, &PoseState::new(1)).unwrap();
        poses.bind_gradients(&gpu, gradients.each_ref(), [&uniform, &visible, &status_buffer(&gpu).unwrap()]);
        let mut frame = Frame::new(&gpu);
        poses.record_correction(&gpu, &mut frame, &PoseStep { view: 0, turn_rate: 1e-3, shift_rate: 1e-3 });
        poses.record_update(&mut frame);
        frame.submit();

        let [first, _] = poses.views.read(&gpu).unwrap().moments;
        let seen = || (0..N).filter(|i| is_seen(*i));
        for axis in 0..3 {
            let turn: f64 = seen().map(|i| f64::from(by_turn[i][axis])).sum();
            // Equal to the gradient of the means with opposite sign.
            let shift: f64 = seen().map(|i| -f64::from(by_geometry[i][0][axis])).sum();
            for (i, expected) in [(axis, turn), (4 + axis, shift)] {
                // Adam's first moment after the first step is a tenth of the gradient.
                let found = 10.0 * f64::from(first[i]);
                assert!((found / expected - 1.0).abs() < 1e-5, "{i}: {found}, not {expected}");
            }
        }
    }
}
