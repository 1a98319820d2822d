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
    whole: PhotoCache,
    /// Cache of reduced photographs, and the scale of both sides, while these are trained on.
    small: Option<(PhotoCache, f64)>,
    /// Meaning of each photograph's alpha; of training views only.
    alphas: Vec<TruthAlpha>,
    /// Whether photographs have masks or alpha: then nothing is behind what they show.
    pub(super) are_cut_out: bool,
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

    /// As [`Self::open`], with this budget, bytes.
    pub(super) fn within(
        budget: usize,
        capture: &'a Capture,
        train: &[usize],
        mut test: impl Iterator<Item = usize>,
    ) -> Result<Self, CaptureError> {
        let (views, whole) = (capture.views.as_slice(), PhotoCache::new(budget));
        let mut are_cut_out = capture.has_masks();
        let mut alphas = vec![TruthAlpha::default(); views.len()];
        let look_at = |&i: &usize| whole.get(&views[i]).map(|photo| (i, truth_alpha(&photo), photo.has_alpha));
        for part in train.chunks(DECODED_AT_ONCE) {
            let found: Result<Vec<_>, CaptureError> = part.par_iter().map(look_at).collect();
            for (i, alpha, has_alpha) in found? {
                alphas[i] = alpha;
                are_cut_out |= has_alpha;
            }
        }
        test.try_for_each(|i| whole.get(&views[i]).map(drop))?;
        Ok(Self { views, budget, whole, small: None, alphas, are_cut_out })
    }

    /// Photograph of a view by its index in the capture, at its full size.
    pub(super) fn whole_of(&self, view: usize) -> Result<Arc<Photo>, CaptureError> {
        self.whole(&self.views[view])
    }

    /// Photograph of a view of the capture, at its full size.
    pub(super) fn whole(&self, view: &View) -> Result<Arc<Photo>, CaptureError> {
        self.whole.get(view)
    }

    /// Sets the scale of both sides of the pictures of steps from now on.
    pub(super) fn resize(&mut self, scale: f64) {
        let scale = scale.min(1.0);
        if self.small.as_ref().map_or(1.0, |(_, scale)| *scale) == scale {
            return;
        }
        // Threads that were to fill it would hold it for a while.
        if let Some((small, _)) = self.small.take() {
            small.set_budget(0);
        }
        if scale == 1.0 {
            self.whole.set_budget(self.budget);
            return;
        }
        // Steps have priority; full-size photographs, needed for the next size and at the ends of phases, are kept as
        // far as there is room beside theirs.
        let wanted = PhotoCache::budget_for(self.views, scale).min(self.budget - self.budget / 8);
        self.whole.set_budget(self.budget - wanted);
        self.small = Some((self.whole.reduced(scale, wanted), scale));
    }

    /// Cache of the pictures of steps.
    pub(super) fn of_steps(&self) -> &PhotoCache {
        self.small.as_ref().map_or(&self.whole, |(small, _)| small)
    }

    /// Photograph of a view for a step.
    pub(super) fn of_step(&self, view: usize) -> Result<Arc<Photo>, CaptureError> {
        self.of_steps().get(&self.views[view])
    }

    /// Width and height of the photograph of a view in steps.
    pub(super) fn size_in_steps(&self, view: usize) -> (u32, u32) {
        self.of_steps().size_of(&self.views[view])
    }

    /// Starts decoding photographs of the views of steps to come, the next first, on other threads, as far as there is
    /// room. Each should then be asked for.
    pub(super) fn prefetch(&self, next: impl Iterator<Item = usize>) {
        self.of_steps().prefetch(next.map(|view| &self.views[view]));
    }

    /// Meaning of the alpha of a training view's photograph, of any size, as in its evaluation.
    pub(super) fn alpha(&self, view: usize) -> TruthAlpha {
        self.alphas[view]
    }
}

fn truth_alpha(photo: &Photo) -> TruthAlpha {
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
    /// again. Pictures are the same with any budget.
    #[test]
    fn what_steps_want_is_kept() {
        let demo = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("demo");
        let options = LoadOptions { downscale: Downscale::MaxSide(64), ..LoadOptions::default() };
        let capture = capture::open(&demo, &options).unwrap();
        let all: Vec<usize> = (0..capture.views.len()).collect();
        let whole = PhotoCache::budget_for(&capture.views, 1.0);
        let bytes = |cache: &PhotoCache| {
            let photos = capture.views.iter().map(|view| cache.get(view).unwrap());
            photos.map(|photo| photo.rgba.len()).sum::<usize>()
        };
        let cache = PhotoCache::new(whole);
        let expected = [0.25, 0.5].map(|scale| {
            let of = |view| cache.reduced(scale, 0).get(view).unwrap();
            (scale, capture.views.iter().map(of).collect::<Vec<_>>())
        });
        // A budget for all pictures of both sizes, for all of one size, and for a part.
        for budget in [2 * whole, whole, whole / 2] {
            let mut photos = Photographs::within(budget, &capture, &all, std::iter::empty()).unwrap();
            let is_full = photos.whole.bytes();
            for (scale, expected) in &expected {
                photos.resize(*scale);
                let mut total = 0;
                for &i in &all {
                    let photo = photos.of_step(i).unwrap();
                    photos.prefetch(all[i + 1..].iter().copied());
                    assert!(photo == expected[i] && photos.size_in_steps(i) == (photo.width, photo.height));
                    total += photo.rgba.len();
                }
                assert_eq!(photos.of_steps().bytes(), total, "{budget} {scale}");
                assert!(total + photos.whole.bytes() <= budget, "{budget} {scale}: {}", photos.whole.bytes());
            }
            photos.resize(1.0);
            let whole_bytes = bytes(&photos.whole);
            assert_eq!(whole, whole_bytes.div_ceil(7) + whole_bytes);
            assert!(photos.small.is_none() && photos.whole.bytes() >= is_full, "{budget}");
        }
    }
}
