//! Recentring: scenes far from the origin are trained in a frame centred on their cameras, where 32-bit floats resolve
//! a step of training.

use glam::{DMat3, DVec3};

use super::Trained;
use crate::{
    capture::{self, Capture},
    edit::Similarity,
    optimize::{MeshSource, TrainError, size},
    scene::{Camera, SceneError, center_and_spread},
};

/// Largest distance of the cameras' mean from the origin, in extents, at which a scene stays where it is. At the end of
/// training means move by some 1.6e-6 of an extent, and floats round coordinates ten extents away by up to 5e-7: a
/// scene thirty of its sizes away would stand still then, and farther away before.
const FAR: f64 = 8.0;

/// Frame in which a scene far from the origin is trained.
pub(super) struct Origin {
    /// Transform to the frame centred on the cameras.
    there: Similarity,
    /// Transform from that frame.
    back: Similarity,
}

impl Origin {
    /// The frame for a capture; `None` if it may stay where it is.
    pub(super) fn of(capture: &Capture) -> Result<Option<Self>, SceneError> {
        let cameras = capture.cameras();
        let (mean, _) = center_and_spread(&cameras);
        let all: Vec<usize> = (0..cameras.len()).collect();
        if mean.length() <= FAR * size::extent(&cameras, size::median_depth(capture, &all)) {
            return Ok(None);
        }
        let by = |shift| Similarity::new(1.0, DMat3::IDENTITY, shift);
        Ok(Some(Self { there: by(-mean)?, back: by(mean)? }))
    }

    pub(super) fn capture(&self, capture: &Capture) -> Result<Capture, SceneError> {
        let mut capture = capture.clone();
        let is_one_place = capture::extent(&capture.cameras()) == 0.0;
        for view in &mut capture.views {
            view.camera = self.there.camera(&view.camera)?;
            if is_one_place {
                // Rounding would otherwise leave an extent there.
                view.camera = Camera::new(*view.camera.intrinsics(), view.camera.rotation(), DVec3::ZERO)?;
            }
        }
        capture.points.iter_mut().for_each(|point| point.position = self.there.point(point.position));
        Ok(capture)
    }

    pub(super) fn mesh(&self, mut source: MeshSource) -> MeshSource {
        if let MeshSource::Given { surface, .. } = &mut source {
            surface.positions.iter_mut().for_each(|p| *p = self.there.point(p.as_dvec3()).as_vec3());
        }
        source
    }

    /// The trained result in the capture's own frame.
    pub(super) fn trained(&self, trained: Trained) -> Result<Trained, TrainError> {
        let mut poses = trained.poses;
        for (_, pose) in &mut poses {
            pose.follow(self.back.point(DVec3::ZERO));
        }
        let cameras = trained.cameras.iter().map(|camera| self.back.camera(camera)).collect::<Result<_, _>>()?;
        Ok(Trained { scene: self.back.scene(trained.scene)?, cameras, poses, ..trained })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use glam::Vec3;

    use super::super::{Checkpoints, Session, train};
    use super::*;
    use crate::{
        capture::{Downscale, LoadOptions},
        geometry::Surface,
        optimize::TrainOptions,
        render::gpu::Gpu,
    };

    /// Moving the capture by hand gives the same scene, to the last bit.
    #[test]
    fn runs_far_away_are_those_around_the_origin() {
        let demo = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
        let load = LoadOptions { downscale: Downscale::MaxSide(48), ..LoadOptions::default() };
        let near = capture::open(&demo, &load).unwrap();
        let shift = DVec3::new(600.0, -800.0, 100.0) * capture::extent(&near.cameras());
        let by = |shift| Similarity::new(1.0, DMat3::IDENTITY, shift).unwrap();
        let far = Origin { there: by(shift), back: by(-shift) }.capture(&near).unwrap();
        let origin = Origin::of(&far).unwrap().unwrap();
        let (gpu, stop) = (Gpu::open(None).unwrap(), AtomicBool::new(false));
        let options = TrainOptions { iterations: 30, max_splats: Some(500), ..TrainOptions::default() };
        let run = |capture: &Capture| {
            let session = Session { gpu: &gpu, checkpoints: Checkpoints::Off, stop: &stop, progress: &mut |_| {} };
            train(capture, MeshSource::None, &options, session).unwrap()
        };
        let by_hand = origin.trained(run(&origin.capture(&far).unwrap())).unwrap();
        assert_eq!(run(&far).scene.splats, by_hand.scene.splats);
    }

    /// For a panorama without points, its size could only come from the camera positions, which differ by rounding.
    #[test]
    fn a_tripod_far_away_is_in_one_place_still() {
        let demo = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
        let mut capture =
            capture::open(&demo, &LoadOptions { without_points: true, ..LoadOptions::default() }).unwrap();
        let center = DVec3::new(100.0, 200.0, 300.3);
        for view in &mut capture.views {
            let rotation = view.camera.rotation();
            view.camera = Camera::new(*view.camera.intrinsics(), rotation, -(rotation * center)).unwrap();
        }
        let moved = Origin::of(&capture).unwrap().unwrap().capture(&capture).unwrap();
        assert_eq!(size::extent(&moved.cameras(), None), 1.0);
    }

    #[test]
    fn what_is_far_is_trained_around_the_origin() {
        let demo = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
        let near = capture::open(&demo, &LoadOptions::default()).unwrap();
        assert!(Origin::of(&near).unwrap().is_none());
        let shift = DVec3::new(30.0, -40.0, 5.0) * capture::extent(&near.cameras());
        let by = |shift| Similarity::new(1.0, DMat3::IDENTITY, shift).unwrap();
        let far = Origin { there: by(shift), back: by(-shift) }.capture(&near).unwrap();
        let origin = Origin::of(&far).unwrap().unwrap();
        let moved = origin.capture(&far).unwrap();
        let mean = moved.cameras().iter().map(Camera::center).sum::<DVec3>() / moved.views.len() as f64;
        assert!(mean.length() < 1e-9 && Origin::of(&moved).unwrap().is_none());
        let apart = |capture: &Capture| capture.points[0].position.distance(capture.views[0].camera.center());
        assert!((apart(&moved) - apart(&near)).abs() < 1e-9);
        // Vertices that are far away along each axis and are not moved by training come back bit-identical.
        let positions: Vec<Vec3> = far.points.iter().map(|point| point.position.as_vec3()).collect();
        let surface = Surface { positions: positions.clone(), triangles: vec![[0, 1, 2]] };
        let MeshSource::Given { surface, .. } = origin.mesh(MeshSource::Given { surface, corner_uvs: None }) else {
            unreachable!()
        };
        assert!(surface.positions[0].length() < positions[0].length() / 10.0);
        let back = surface.positions.iter().map(|p| origin.back.point(p.as_dvec3()).as_vec3());
        assert!(back.eq(positions));
    }
}
