//! From splats to a mesh and back to the splats that the mesh does not make superfluous.

use super::{Run, arrangement, photographs::squared_error};
use crate::{
    geometry::{GeometryError, PlanarOptions, Surface},
    optimize::{SurfaceOrigin, TrainError, surface},
    render::gpu::training::Training,
    scene::{Camera, HybridScene, Mesh},
};

impl<'a> Run<'a> {
    /// Fuses triangles of the points that the training views see, or the median depths of the splats as they are.
    pub(super) fn find_surface(&mut self, training: &mut Training, of_points: bool) -> Result<Mesh, TrainError> {
        let planar = self.options.planar.then(PlanarOptions::default);
        if of_points {
            match surface::from_points(self.capture, &self.cameras, &self.train, self.options.triangles, planar) {
                Ok((surface, _, origin)) => {
                    self.found.surface = Some(origin);
                    return self.textured(training, surface);
                }
                Err(GeometryError::EmptySurface { .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
        let points = self.whereabouts(training)?;
        let (surface, _) = surface::from_depths(&self.train_cameras, &points, self.options.triangles, planar, |i| {
            let mut depth = training.median_depth(&self.train_cameras[i])?;
            surface::clear_unseen(&mut depth, &*self.photos.whole(&self.capture.views[self.train[i]])?);
            Ok(depth)
        })?;
        self.found.surface = Some(SurfaceOrigin::Splats);
        self.textured(training, surface)
    }

    /// With empty maps, and with what training views see past the surface on a shell around it, painted, if there is one.
    fn textured(&self, training: &Training, surface: Surface) -> Result<Mesh, TrainError> {
        let surface = match &self.shell {
            Some(shell) => match shell.around_surface(surface.clone(), &self.train_cameras) {
                // All of it is far away, and no two views see the same part of the shell.
                both if both.triangles.is_empty() => surface,
                both => both,
            },
            None => surface,
        };
        let charts_in = self.charts_in(training)?;
        let mesh = self.in_charts(&surface, charts_in.as_ref())?;
        if self.shell.is_some() { self.painted(mesh) } else { Ok(mesh) }
    }

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

    /// Keeps those splats of the surface phase that explain the photographs better than the mesh does, which has the smooth
    /// regions, as in HERA: a splat goes if the mesh alone has no larger squared error than the splats
    /// alone over its footprint in all views. What remains is mostly fine structure, at most `max_splats` of them.
    /// How far views tell what remains is measured anew.
    pub(super) fn hand_over(&self, training: &mut Training<'a>, max_splats: usize) -> Result<(), TrainError> {
        let mut splats = arrangement(training)?;
        let mut advantage = vec![0.0_f64; splats.len()];
        self.compare(training, &self.train, |_, splats_only, camera, errors| {
            for (sum, [mesh, splats, ..]) in advantage.iter_mut().zip(splats_only.gather(camera, errors)?) {
                *sum += f64::from(mesh) - f64::from(splats);
            }
            Ok(())
        })?;
        let mut ranked = advantage.clone();
        ranked.sort_by(|a, b| b.total_cmp(a));
        let least = ranked.get(max_splats).copied().unwrap_or(0.0).max(0.0);
        let keep: Vec<bool> = advantage.iter().map(|&a| a > least).collect();
        splats.retain(&keep);
        training.rearrange(splats.geometry(), splats.sources())?;
        training.smooth();
        Ok(())
    }
}
