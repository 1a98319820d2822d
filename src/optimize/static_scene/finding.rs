//! Making of a surface, from the capture's points or from splats, and of a mesh from it.

use super::Run;
use crate::{
    capture::View,
    geometry::{GeometryError, Surface, Viewers},
    optimize::{SurfaceOrigin, TrainError, cut_out, fused, seen_points},
    render::gpu::training::Training,
    scene::Mesh,
};

impl Run<'_> {
    /// Makes a mesh by fusing triangles between the points that the training views see, or the median depths of the
    /// present splats.
    pub(super) fn find_surface(&mut self, training: &mut Training, of_points: bool) -> Result<Mesh, TrainError> {
        let planar = self.options.planar;
        if of_points {
            let photos = &self.photos;
            let photo_of = |view: &View| photos.are_cut_out.then(|| photos.whole(view)).transpose();
            let views = seen_points::point_views(self.capture, &self.cameras, &self.train, photo_of)?;
            // With few points left the surface would be a guess, where splats know better.
            if !seen_points::are_few_left(self.capture, &self.train, &views) {
                match fused::from_points(self.capture, &views, self.options.triangles, planar) {
                    Ok((surface, _, origin)) => {
                        self.found.surface = Some(origin);
                        return self.textured(training, surface);
                    }
                    Err(GeometryError::EmptySurface { .. }) => {}
                    Err(error) => return Err(error.into()),
                }
            }
        }
        let points = self.whereabouts(training)?;
        let (surface, _) = fused::from_depths(&self.train_cameras, &points, self.options.triangles, planar, |i| {
            let mut depth = training.median_depth(&self.train_cameras[i])?;
            cut_out::clear_unseen(&mut depth, &*self.photos.whole(&self.capture.views[self.train[i]])?);
            Ok(depth)
        })?;
        self.found.surface = Some(SurfaceOrigin::Splats);
        self.textured(training, surface)
    }

    /// Turns a surface into a mesh with empty maps; if there is a shell, what training views see past the surface is
    /// added on it and painted.
    fn textured(&self, training: &Training, surface: Surface) -> Result<Mesh, TrainError> {
        let surface = match &self.shell {
            // Past the surface is where nothing of it is, whatever may show through.
            Some(shell) => match shell.around_surface(surface.clone(), &Viewers { layers: 1, ..self.viewers() }) {
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
}
