//! Comparison of mesh and splats, each rendered alone, with the photographs.

use super::{Run, photographs::squared_error};
use crate::{
    optimize::TrainError,
    render::gpu::training::{Show, Training},
    scene::Camera,
};

impl<'a> Run<'a> {
    /// Renders splats and mesh each alone from `views`. `use_view` gets, per view, the training, which has rendered the
    /// mesh last, the camera, and for every pixel the squared errors of mesh and splats (and a zero, for
    /// `Training::gather`); all three are zero in masked-out pixels.
    pub(super) fn compare(
        &self,
        training: &mut Training<'a>,
        views: &[usize],
        mut use_view: impl FnMut(&mut Training<'a>, &Camera, &[[f32; 3]]) -> Result<(), TrainError>,
    ) -> Result<(), TrainError> {
        let background = self.composition().background;
        for &i in views {
            let camera = &self.cameras[i];
            let photo = self.photos.whole(&self.capture.views[i])?;
            let behind = self.exposed(i, background);
            let splats = training.render(camera, background, Show::SplatsAlone)?.rgb;
            let mesh = training.render(camera, background, Show::MeshesAlone)?.rgb;
            let errors: Vec<[f32; 3]> = (mesh.iter().zip(&splats).enumerate())
                .map(|(p, (mesh, splats))| {
                    if !photo.counts(p) {
                        return [0.0; 3];
                    }
                    let [mesh, splats] = [mesh, splats].map(|rgb| self.exposed(i, *rgb));
                    let (mesh, splats) = (&mesh, &splats);
                    [squared_error(&photo, p, mesh, behind), squared_error(&photo, p, splats, behind), 0.0]
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
}
