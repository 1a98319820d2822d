//! Photographs with masks or alpha: no surface is made of what these leave out.

use crate::capture::Photo;

/// Takes out the depths `[h·w]` of what a photograph's mask or alpha leaves out.
pub(super) fn clear_unseen(depth: &mut [f32], photo: &Photo) {
    let left_out = depth.iter_mut().enumerate().filter(|(pixel, _)| photo.is_cut_out(*pixel));
    left_out.for_each(|(_, depth)| *depth = 0.0);
}
