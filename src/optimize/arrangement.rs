//! The working set of a density step: splats while they are added, moved and removed.

use glam::Vec3;

use crate::{
    render::gpu::{
        rows::Source,
        state::{GEOMETRY_FLOATS, Geometry, geometry_not_finite, logit, sigmoid},
    },
    scene::{keep_rows, smoothed},
};

/// Geometry of the splats, on which density control decides, and for each the splat that it takes the rest from: SH
/// coefficients and moments of Adam, 14 of 15 floats at degree 3, which stay on the GPU.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Arrangement {
    geometry: Vec<f32>,
    sources: Vec<Source>,
}

impl Arrangement {
    /// An arrangement of all splats in their present order, from geometry laid out as
    /// [`SplatState::geometry`](crate::render::gpu::state::SplatState::geometry).
    pub(super) fn new(geometry: Vec<f32>) -> Self {
        let sources = (0..geometry.len() / GEOMETRY_FLOATS).map(Source::new).collect();
        Self { geometry, sources }
    }

    /// Number of splats.
    pub(super) fn len(&self) -> usize {
        self.sources.len()
    }

    /// Geometry of all splats, `[N·12]`.
    pub(super) fn geometry(&self) -> &[f32] {
        &self.geometry
    }

    /// Source of each splat, `[N]`: the splat before the step that its SH coefficients and moments come from.
    pub(super) fn sources(&self) -> &[Source] {
        &self.sources
    }

    /// Drops the splats for which `keep` `[N]` is false; the others keep their order and moments.
    ///
    /// # Panics
    /// If `keep` has not one entry per splat.
    pub(super) fn retain(&mut self, keep: &[bool]) {
        assert_eq!(keep.len(), self.len(), "one entry per splat");
        let kept: Vec<usize> = (0..keep.len()).filter(|&i| keep[i]).collect();
        keep_rows(&mut self.geometry, GEOMETRY_FLOATS, kept.iter().copied());
        keep_rows(&mut self.sources, 1, kept.into_iter());
    }

    /// Appends a copy of splat `i` with moments of zero: the copy will share the gradients of its source, whose moments
    /// describe all of them.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn push_copy(&mut self, i: usize) {
        self.geometry.extend_from_within(i * GEOMETRY_FLOATS..(i + 1) * GEOMETRY_FLOATS);
        self.sources.push(self.sources[i].without_moments());
    }

    /// Overwrites splat `to` with splat `from`, moments set to zero.
    ///
    /// # Panics
    /// If one is out of range.
    pub(super) fn copy_over(&mut self, from: usize, to: usize) {
        self.geometry.copy_within(from * GEOMETRY_FLOATS..(from + 1) * GEOMETRY_FLOATS, to * GEOMETRY_FLOATS);
        self.sources[to] = self.sources[from].without_moments();
    }

    /// Sets the moments of splat `i` to zero.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn clear_moments(&mut self, i: usize) {
        self.sources[i] = self.sources[i].without_moments();
    }

    /// Sets the moments of all opacities to zero.
    pub(super) fn clear_opacity_moments(&mut self) {
        self.sources.iter_mut().for_each(|source| *source = source.without_opacity_moments());
    }

    /// Geometry of splat `i`.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn row(&self, i: usize) -> Geometry {
        Geometry::at(&self.geometry, i)
    }

    /// Applies `change` to the geometry of splat `i`.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn edit(&mut self, i: usize, change: impl FnOnce(&mut Geometry)) {
        Geometry::edit(&mut self.geometry, i, change);
    }

    /// Opacity of splat `i`, 0 to 1.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn opacity(&self, i: usize) -> f32 {
        sigmoid(self.row(i).opacity_logit)
    }

    /// Sets the opacity of splat `i`, 0 to 1.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn set_opacity(&mut self, i: usize, opacity: f32) {
        self.edit(i, |g| g.opacity_logit = logit(opacity));
    }

    /// Factor, 0 to 1, by which smoothing reduces the opacity of splat `i`.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn smoothing_factor(&self, i: usize) -> f32 {
        let row = self.row(i);
        smoothed(row.log_scale.as_dvec3(), row.smoothing.into()).1 as f32
    }

    /// Opacity of splat `i` as rendered: its own times [`Self::smoothing_factor`].
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn seen_opacity(&self, i: usize) -> f32 {
        self.opacity(i) * self.smoothing_factor(i)
    }

    /// Standard deviations of splat `i` along its axes, world units.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn scales(&self, i: usize) -> Vec3 {
        self.row(i).log_scale.exp()
    }

    /// Multiplies the standard deviations of splat `i` by e to the power of `log_factor`.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn scale_by(&mut self, i: usize, log_factor: f32) {
        self.edit(i, |g| g.log_scale += log_factor);
    }

    /// Moves splat `i` by `offset`, in world units along the splat's own axes.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn move_by(&mut self, i: usize, offset: Vec3) {
        // In f64 like `Splats::new`: an unnormalised quaternion may be long or short. A zero one turns nothing.
        let rotation = self.row(i).rotation.as_dquat().normalize();
        let offset = if rotation.is_finite() { rotation * offset.as_dvec3() } else { offset.as_dvec3() };
        self.edit(i, |g| g.mean += offset.as_vec3());
    }

    /// Group of parameters and index of the first splat whose geometry is not finite.
    pub(super) fn first_non_finite(&self) -> Option<(&'static str, usize)> {
        geometry_not_finite(&self.geometry)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optimize::density::tests::{arrangement, rearranged, state};

    #[test]
    fn what_is_kept_keeps_its_coefficients_and_moments() {
        let (all, mut s) = (state(4, 1), arrangement(4));
        s.retain(&[false, true, false, true]);
        let after = rearranged(&all, &s);
        assert_eq!((s.len(), after.len()), (2, 2));
        for (now, then) in [(0, 1), (1, 3)] {
            let (g, h) = (GEOMETRY_FLOATS, all.sh_floats());
            assert_eq!(after.geometry[now * g..][..g], all.geometry[then * g..][..g]);
            assert_eq!(after.geometry_v[now * g..][..g], all.geometry_v[then * g..][..g]);
            assert_eq!(after.sh[now * h..][..h], all.sh[then * h..][..h]);
            assert_eq!(after.sh_m[now * h..][..h], all.sh_m[then * h..][..h]);
        }
        s.retain(&[false, false]);
        let after = rearranged(&all, &s);
        assert!(s.len() == 0 && after.is_empty() && after.sh.is_empty() && after.sh_v.is_empty());
    }

    #[test]
    fn copies_start_without_moments() {
        let mut s = arrangement(3);
        s.push_copy(1);
        s.copy_over(2, 0);
        assert_eq!((s.len(), s.row(3), s.row(0)), (4, s.row(1), s.row(2)));
        let after = rearranged(&state(3, 1), &s);
        assert_eq!((&after.sh[..12], &after.sh[36..]), (&after.sh[24..36], &after.sh[12..24]));
        assert!(after.geometry_m[36..].iter().chain(&after.geometry_m[..12]).all(|&v| v == 0.0));
        assert!(after.sh_v[12..36].iter().all(|&v| v != 0.0), "the others keep theirs");
        assert!(after.sh_v[36..].iter().chain(&after.sh_v[..12]).all(|&v| v == 0.0));
    }

    #[test]
    fn smoothing_takes_as_much_of_an_opacity_as_a_scene_shows() {
        let mut smooth = state(1, 0);
        Geometry::edit(&mut smooth.geometry, 0, |g| {
            *g = Geometry { log_scale: Vec3::new(-4.0, -5.0, -6.0), smoothing: 0.02, ..*g };
        });
        let shown = sigmoid(smooth.to_splats().unwrap().opacity_logits()[0]);
        let factor = Arrangement::new(smooth.geometry).smoothing_factor(0);
        assert!((f64::from(factor) * 0.5 / f64::from(shown) - 1.0).abs() < 1e-5);
    }
}
