//! What photographs leave out, by a mask or by alpha: no surface is made of it.

use glam::DVec2;

use crate::capture::Photo;

/// Alpha of a photograph, which may be a mask, from which on surfaces are made of what it shows.
pub(super) const LEAST_ALPHA: u8 = 128;

/// Takes out the depths `[h·w]` of what a photograph's mask or alpha leaves out.
pub(super) fn clear_unseen(depth: &mut [f32], photo: &Photo) {
    if photo.masked || photo.has_alpha {
        let pixels = depth.iter_mut().zip(photo.rgba.chunks_exact(4));
        pixels.filter(|(_, rgba)| rgba[3] < LEAST_ALPHA).for_each(|(depth, _)| *depth = 0.0);
    }
}

/// Whether a photograph's mask or alpha leaves in what is there.
pub(super) fn shows(photo: &Photo, at: DVec2) -> bool {
    let pixel = at.y as usize * photo.width as usize + at.x as usize;
    !(photo.masked || photo.has_alpha) || photo.rgba.get(4 * pixel + 3).is_some_and(|alpha| *alpha >= LEAST_ALPHA)
}
