//! Mesh and splats, each alone, beside the photographs.

use super::{Run, photographs::squared_error};
use crate::{
    optimize::TrainError,
    render::gpu::training::Training,
    scene::{Camera, HybridScene},
};

impl<'a> Run<'a> {
    /// Renders mesh and splats each alone from `views` and hands on, per view, the two trainings, the camera and at every
    /// pixel the squared errors of mesh and splats (and a zero, for `Training::gather`).
    pub(super) fn compare(
        &self,
        training: &mut Training<'a>,
        views: &[usize],
        mut use_view: impl FnMut(&mut Training<'a>, &mut Training<'a>, &Camera, &[[f32; 3]]) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        let splats = training.read_splats()?.to_splats()?;
        let scene = HybridScene { splats, meshes: vec![], composition: self.composition() };
        let background = scene.composition.background;
        let mut splats_only = self.training(&scene)?;
        for &i in views {
            let camera = &self.cameras[i];
            let photo = self.photos.whole(&self.capture.views[i])?;
            let behind = self.exposed(i, background);
            let mesh = training.render(camera, background, false)?.rgb;
            let splats = splats_only.render(camera, background, true)?.rgb;
            let errors: Vec<[f32; 3]> = (mesh.iter().zip(&splats).enumerate())
                .map(|(p, (mesh, splats))| {
                    let [mesh, splats] = [mesh, splats].map(|rgb| self.exposed(i, *rgb));
                    let (mesh, splats) = (&mesh, &splats);
                    [squared_error(&photo, p, mesh, behind), squared_error(&photo, p, splats, behind), 0.0]
                })
                .collect();
            use_view(training, &mut splats_only, camera, &errors)?;
        }
        Ok(())
    }

    /// What a view's photograph shows of a rendered colour.
    fn exposed(&self, view: usize, rgb: [f32; 3]) -> [f32; 3] {
        self.exposures.as_ref().map_or(rgb, |exposures| exposures.apply(view, rgb))
    }
}
