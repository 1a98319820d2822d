//! Photographs of a run, at the size at which they are trained on.

use std::sync::Arc;

use rayon::prelude::*;

use crate::{
    capture::{Capture, CaptureError, DECODED_AT_ONCE, Photo, PhotoCache, View},
    render::gpu::loss::TruthAlpha,
};

/// Most bytes of decoded photographs to keep in memory, of all sizes together.
const BUDGET: usize = 2 << 30;

/// Photographs, decoded on demand and cached.
pub(super) struct Photographs<'a> {
    views: &'a [View],
    /// Most bytes of all caches together.
    budget: usize,
    cache: PhotoCache,
    small: Option<Small>,
    /// Whether photographs have masks or alpha: then nothing is behind what they show.
    pub(super) are_cut_out: bool,
}

/// Views while they are trained on at a reduced size.
struct Small {
    /// Scale of both sides.
    scale: f64,
    views: Vec<View>,
    cache: PhotoCache,
}

impl<'a> Photographs<'a> {
    /// Decodes the training views and some held-out ones (`test`): any may have alpha, and one that cannot be read is
    /// better reported now than in an hour.
    pub(super) fn open(
        capture: &'a Capture,
        train: &[usize],
        test: impl Iterator<Item = usize>,
    ) -> Result<Self, CaptureError> {
        Self::within(BUDGET, capture, train, test)
    }

    fn within(
        budget: usize,
        capture: &'a Capture,
        train: &[usize],
        mut test: impl Iterator<Item = usize>,
    ) -> Result<Self, CaptureError> {
        let (views, cache) = (capture.views.as_slice(), PhotoCache::new(budget));
        let has_alpha = |&i: &usize| cache.get(&views[i]).map(|photo| photo.has_alpha);
        let any = |a: bool, b: bool| Ok::<_, CaptureError>(a || b);
        let mut are_cut_out = capture.has_masks();
        for part in train.chunks(DECODED_AT_ONCE) {
            are_cut_out |= part.par_iter().map(has_alpha).try_reduce(|| false, any)?;
        }
        test.try_for_each(|i| has_alpha(&i).map(drop))?;
        Ok(Self { views, budget, cache, small: None, are_cut_out })
    }

    /// Photograph of a view by its index in the capture, at its full size.
    pub(super) fn whole_of(&self, view: usize) -> Result<Arc<Photo>, CaptureError> {
        self.whole(&self.views[view])
    }

    /// Photograph of a view of the capture, at its full size.
    pub(super) fn whole(&self, view: &View) -> Result<Arc<Photo>, CaptureError> {
        self.cache.get(view)
    }

    /// Sets the scale of the sides of pictures that [`Self::of_step`] returns from now on.
    pub(super) fn resize(&mut self, scale: f64) {
        if self.small.as_ref().map_or(1.0, |small| small.scale) == scale {
            return;
        }
        self.small = None;
        if scale >= 1.0 {
            if self.cache.budget() < self.budget {
                self.cache = PhotoCache::new(self.budget);
            }
            return;
        }
        let views: Vec<View> = self.views.iter().map(|view| view.scaled(scale)).collect();
        // Steps have priority; full-size photographs, needed at the ends of phases, are kept as far as there is room
        // beside them.
        let wanted = PhotoCache::budget_for(&views).min(self.budget - self.budget / 8);
        if self.cache.bytes() + wanted > self.budget {
            self.cache = PhotoCache::new(self.budget - wanted);
        }
        self.small = Some(Small { scale, views, cache: PhotoCache::new(wanted) });
    }

    /// Photograph for a step on view `view`; that of view `next` is decoded while this one is on the GPU.
    pub(super) fn of_step(&self, view: usize, next: usize) -> Result<Arc<Photo>, CaptureError> {
        let (views, cache) = match &self.small {
            Some(small) => (small.views.as_slice(), &small.cache),
            None => (self.views, &self.cache),
        };
        cache.prefetch(&views[next]);
        cache.get(&views[view])
    }
}

/// Meaning of a photograph's alpha, as in its evaluation.
pub(super) fn truth_alpha(photo: &Photo) -> TruthAlpha {
    match (photo.masked, photo.has_alpha) {
        (true, _) => TruthAlpha::Mask,
        (false, true) => TruthAlpha::Composite,
        (false, false) => TruthAlpha::Ignore,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{self, Downscale, LoadOptions};

    /// While steps use smaller pictures, all of these are cached; once steps use whole pictures, these are cached
    /// again.
    #[test]
    fn what_steps_want_is_kept() {
        let demo = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
        let options = LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() };
        let capture = capture::open(&demo, &options).unwrap();
        let all: Vec<usize> = (0..capture.views.len()).collect();
        let whole = PhotoCache::budget_for(&capture.views);
        let bytes = |cache: &PhotoCache| {
            let photos = capture.views.iter().map(|view| cache.get(view).unwrap());
            photos.map(|photo| photo.rgba.len()).sum::<usize>()
        };
        // A budget for all pictures of both sizes, for all of one size, and for a part.
        for budget in [2 * whole, whole, whole / 2] {
            let mut photos = Photographs::within(budget, &capture, &all, std::iter::empty()).unwrap();
            let is_full = photos.cache.bytes();
            for scale in [0.25, 0.5] {
                photos.resize(scale);
                let small = photos.small.as_ref().unwrap();
                let total: usize = all.iter().map(|&i| photos.of_step(i, i).unwrap().rgba.len()).sum();
                assert_eq!(small.cache.bytes(), total, "{budget} {scale}");
                assert!(total + photos.cache.bytes() <= budget, "{budget} {scale}: {}", photos.cache.bytes());
            }
            photos.resize(1.0);
            assert_eq!(PhotoCache::budget_for(&capture.views), bytes(&photos.cache).div_ceil(7) + bytes(&photos.cache));
            assert!(photos.small.is_none() && photos.cache.bytes() >= is_full, "{budget}");
        }
    }
}
