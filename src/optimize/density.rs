//! Density control: where splats are added, moved and removed.
//!
//! Everything is a function of the splats, the statistics, the seed and the iteration, so a resumed run repeats it.

pub(super) mod inria;
pub(super) mod mcmc;

use super::arrangement::Arrangement;

/// Per-splat sums since the last density step, as `splat_backward.wgsl` accumulates them. `[N]` rows of Σ‖(½W·∂L/∂u,
/// ½H·∂L/∂v)‖, the number of views in which the splat was visible, Σ blend weight α·T over their pixels, and, with
/// AbsGS, the first sum again with absolute values of each pixel's contribution to ∂L/∂u and ∂L/∂v.
#[derive(Clone, Copy, Debug)]
pub(super) struct Statistics<'a>(pub(super) &'a [[f32; 4]]);

impl Statistics<'_> {
    /// Gradient of the projected mean in normalised device coordinates, averaged over the views that saw splat `i`.
    /// 0 if none did.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn mean_gradient(&self, i: usize) -> f32 {
        let [gradient, views, ..] = self.0[i];
        finite_or_zero(gradient / views.max(1.0))
    }

    /// Like [`Self::mean_gradient`], but from the absolute values of each pixel's contribution, which do not cancel
    /// where pixels pull in opposite directions; 0 unless measured.
    ///
    /// # Panics
    /// If `i` is out of range.
    pub(super) fn absolute_gradient(&self, i: usize) -> f32 {
        let [_, views, _, absolute] = self.0[i];
        finite_or_zero(absolute / views.max(1.0))
    }
}

/// Limits the rendered (smoothed) opacity of every splat to 0.01 and clears the Adam moments of all opacities. INRIA's
/// strategy does so every 3000 iterations: what is not needed does not become opaque again and is pruned.
pub(super) fn reset_opacity(splats: &mut Arrangement) {
    for i in 0..splats.len() {
        let most = 0.01 / splats.smoothing_factor(i);
        if splats.opacity(i) > most {
            splats.set_opacity(i, most);
        }
    }
    splats.clear_opacity_moments();
}

fn finite_or_zero(x: f32) -> f32 {
    if x.is_finite() { x } else { 0.0 }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::render::gpu::state::{Geometry, SplatState};

    pub(crate) use crate::render::gpu::state::tests::state;

    /// [`state`] as an arrangement.
    pub(crate) fn arrangement(n: usize) -> Arrangement {
        Arrangement::new(state(n, 0).geometry)
    }

    /// The state after a rearrangement.
    pub(crate) fn rearranged(before: &SplatState, splats: &Arrangement) -> SplatState {
        before.rearranged(splats.geometry(), splats.sources())
    }

    #[test]
    fn reset_limits_opacity_and_forgets_only_its_moments() {
        let mut s = arrangement(3);
        s.set_opacity(1, 0.004);
        s.edit(2, |g| g.smoothing = 0.01);
        let before = s.clone();
        reset_opacity(&mut s);
        assert!((s.opacity(0) - 0.01).abs() < 1e-6);
        assert_eq!(s.opacity(1), before.opacity(1));
        // As large as its smoothing: √2 times as wide along each axis.
        assert!((s.opacity(2) - 0.01 * 8.0_f32.sqrt()).abs() < 1e-6);
        let all = state(3, 1);
        let after = rearranged(&all, &s);
        let mut expected = all.geometry_m;
        (0..3).for_each(|i| Geometry::edit(&mut expected, i, |g| g.opacity_logit = 0.0));
        assert_eq!((&after.geometry_m, &after.geometry_v), (&expected, &expected));
        assert_eq!((after.sh, after.sh_m), (all.sh, all.sh_m));
    }

    #[test]
    fn statistics_are_averaged_over_the_views_that_saw_the_splat() {
        let rows = [[6.0, 3.0, 9.0, 1.0], [0.0; 4], [f32::NAN, 1.0, f32::INFINITY, 0.0]];
        let s = Statistics(&rows);
        assert_eq!(
            [0, 1, 2].map(|i| (s.mean_gradient(i), s.absolute_gradient(i))),
            [(2.0, 1.0 / 3.0), (0.0, 0.0), (0.0, 0.0)]
        );
    }
}
