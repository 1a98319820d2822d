//! The photographs of a run, at the size at which they are trained on, and how renders are compared with them.

use std::sync::Arc;

use rayon::prelude::*;

use crate::{
    capture::{Capture, CaptureError, Photo, PhotoCache, View},
    evaluate,
    render::gpu::loss::TruthAlpha,
};

/// Decoded photographs are kept up to this many bytes, of whatever size.
const BUDGET: usize = 2 << 30;
/// Photographs that are decoded at once before training.
const DECODED_AT_ONCE: usize = 4;

/// Decoded as they are asked for, and kept.
pub(super) struct Photographs<'a> {
    views: &'a [View],
    cache: PhotoCache,
    small: Option<Small>,
    /// They have masks or alpha: nothing is behind what they show.
    pub(super) are_cut_out: bool,
}

/// The views while they are trained on at less than their size.
struct Small {
    /// Of both sides.
    scale: f64,
    views: Vec<View>,
    cache: PhotoCache,
}

impl<'a> Photographs<'a> {
    /// Looks at those of training (`train`) and some that are held out (`test`): any may have alpha, and one that cannot be read is better
    /// known now than in an hour.
    pub(super) fn open(
        capture: &'a Capture,
        train: &[usize],
        mut test: impl Iterator<Item = usize>,
    ) -> Result<Self, CaptureError> {
        let (views, cache) = (capture.views.as_slice(), PhotoCache::new(BUDGET));
        let has_alpha = |&i: &usize| cache.get(&views[i]).map(|photo| photo.has_alpha);
        let any = |a: bool, b: bool| Ok::<_, CaptureError>(a || b);
        let mut are_cut_out = views.iter().any(|view| view.source.mask().is_some());
        // Few at once: while they are decoded they have their full size.
        for part in train.chunks(DECODED_AT_ONCE) {
            are_cut_out |= part.par_iter().map(has_alpha).try_reduce(|| false, any)?;
        }
        test.try_for_each(|i| has_alpha(&i).map(drop))?;
        Ok(Self { views, cache, small: None, are_cut_out })
    }

    /// Of a view of the capture, at its full size.
    pub(super) fn whole(&self, view: &View) -> Result<Arc<Photo>, CaptureError> {
        self.cache.get(view)
    }

    /// From now on [`Self::of_step`] gives pictures with their sides scaled so.
    pub(super) fn resize(&mut self, scale: f64) {
        if self.small.as_ref().map_or(1.0, |small| small.scale) != scale {
            self.small = (scale < 1.0).then(|| Small {
                scale,
                views: self.views.iter().map(|view| view.scaled(scale)).collect(),
                cache: PhotoCache::new(BUDGET.saturating_sub(self.cache.bytes())),
            });
        }
    }

    /// What a step sees of a view, by its index; that of the `next` is decoded while this one is on the GPU.
    pub(super) fn of_step(&self, view: usize, next: usize) -> Result<Arc<Photo>, CaptureError> {
        let (views, cache) = match &self.small {
            Some(small) => (small.views.as_slice(), &small.cache),
            None => (self.views, &self.cache),
        };
        cache.prefetch(&views[next]);
        cache.get(&views[view])
    }
}

/// What a photograph's alpha means, as in its evaluation.
pub(super) fn truth_alpha(photo: &Photo) -> TruthAlpha {
    match (photo.masked, photo.has_alpha) {
        (true, _) => TruthAlpha::Mask,
        (false, true) => TruthAlpha::Composite,
        (false, false) => TruthAlpha::Ignore,
    }
}

/// Squared difference of a render from pixel `p` of a photograph, as both are scored.
pub(super) fn squared_error(photo: &Photo, p: usize, render: &[f32; 3], background: [f32; 3]) -> f32 {
    let (truth, mask) = evaluate::expected(photo, p, background);
    let error: f32 = truth.iter().zip(render).map(|(truth, render)| (truth - render).powi(2)).sum();
    error * mask * mask
}
