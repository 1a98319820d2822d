//! Scores a scene against photographs, as `centaur eval` does.
//!
//! [`evaluate`] performs the whole evaluation; [`Evaluator`] and [`Comparison`] are its steps, for callers who also
//! need the images.

use image::{Rgb, Rgb32FImage};
use rayon::prelude::*;

use crate::{
    capture::{self, Capture, CaptureError, Photo, Split, View},
    metrics::{self, Evaluation, Lpips, Measured, ViewScore},
    render::gpu::{Gpu, GpuError, Picture, Renderer},
    scene::{Camera, Composition, HybridScene, SceneError},
};

/// Number of views over which frames per second are averaged; each is rendered `TIMED_FRAMES` times.
const TIMED_VIEWS: usize = 4;
const TIMED_FRAMES: u32 = 5;

/// Reasons for which a scene cannot be scored.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvaluateError {
    /// No view is held out.
    #[error("{capture}: expected at least one held-out view, found none")]
    NoneHeldOut {
        /// Name of the capture.
        capture: String,
    },
    /// A photograph could not be read.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// The adapter failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// An image cannot be scored.
    #[error("{view}: {source}")]
    Metric {
        /// Name of the view.
        view: String,
        /// Reason.
        source: SceneError,
    },
}

/// Scores a scene on the held-out views of its capture, with LPIPS if its weights are given.
///
/// Give the capture as it was opened for training: scores at other sizes do not compare. The scene has to be in its
/// world, in which [`read_scene`](crate::format::read_scene) has whatever was trained on it. Of [`Measured`] what only
/// the caller knows is left empty: the scene's file and its training.
///
/// ```no_run
/// use centaur::{capture::{self, LoadOptions}, evaluate::evaluate, format::read_scene, render::gpu::Gpu};
///
/// let capture = capture::open("captures/garden".as_ref(), &LoadOptions::default())?;
/// let evaluation = evaluate(&Gpu::open(None)?, &read_scene("garden.glb".as_ref())?, &capture, None)?;
/// println!("{evaluation}");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// If no view is held out, a photograph cannot be read, the adapter fails, or images are too small for the network of
/// `lpips`.
pub fn evaluate(
    gpu: &Gpu,
    scene: &HybridScene,
    capture: &Capture,
    lpips: Option<&Lpips>,
) -> Result<Evaluation, EvaluateError> {
    let views = held_out(capture)?;
    let mut evaluator = Evaluator::new(gpu, scene, &views)?;
    let (mut scores, mut left_out) = (vec![], vec![]);
    for view in views {
        let comparison = evaluator.compare(view)?;
        if comparison.is_empty {
            left_out.push(view.name.clone());
        } else {
            scores.push(comparison.score(&view.name, lpips)?);
        }
    }
    Ok(Evaluation { left_out, ..evaluator.finish(scores)? })
}

/// Held-out views, on which scores are taken and which training leaves out, see [`Split::Every8th`].
///
/// # Errors
/// If no view is held out.
pub fn held_out(capture: &Capture) -> Result<Vec<&View>, EvaluateError> {
    let (_, held_out) = Split::Every8th.split(&capture.views);
    if held_out.is_empty() {
        return Err(EvaluateError::NoneHeldOut { capture: capture.name.clone() });
    }
    Ok(held_out.into_iter().map(|i| &capture.views[i]).collect())
}

/// Checks that the photographs of the held-out views can be read and, if weights are given, scored by LPIPS, so that
/// failures show before hours of training. Reads as many at a time as there are cores, and keeps none.
///
/// # Errors
/// If no view is held out, or a photograph cannot be read or is too small for the network of `lpips`.
pub fn check_photographs(capture: &Capture, lpips: Option<&Lpips>) -> Result<(), EvaluateError> {
    let views = held_out(capture)?;
    for (lpips, view) in lpips.into_iter().flat_map(|lpips| views.iter().map(move |view| (lpips, view))) {
        let k = view.camera.intrinsics();
        let has_room = lpips.check_size((k.width, k.height));
        has_room.map_err(|source| EvaluateError::Metric { view: view.name.clone(), source })?;
    }
    let unread = views.into_par_iter().find_map_first(|view| capture::decode(view).err());
    unread.map_or(Ok(()), |error| Err(error.into()))
}

/// Scene on the GPU, to be compared with photographs one at a time.
pub struct Evaluator<'a> {
    gpu: &'a Gpu,
    scene: &'a HybridScene,
    renderer: Renderer<'a>,
    /// Cameras of the timed views.
    cameras: Vec<Camera>,
}

impl<'a> Evaluator<'a> {
    /// Uploads the scene and allocates images of the views' sizes. Resets the adapter's peak of memory, which then
    /// measures scoring only.
    ///
    /// # Errors
    /// If the adapter cannot hold the scene, or its composition is not valid.
    pub fn new(gpu: &'a Gpu, scene: &'a HybridScene, views: &[&View]) -> Result<Self, EvaluateError> {
        let mut cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
        gpu.reset_peak();
        let renderer = Renderer::new(gpu, scene, &cameras)?;
        cameras.truncate(TIMED_VIEWS);
        Ok(Self { gpu, scene, renderer, cameras })
    }

    /// Renders a view for comparison with its photograph.
    ///
    /// # Errors
    /// If the photograph cannot be read, the image is larger than those of the views announced, or the adapter fails.
    pub fn compare(&mut self, view: &View) -> Result<Comparison, EvaluateError> {
        let picture = self.renderer.render(&view.camera)?;
        Ok(Comparison::new(&capture::decode(view)?, &picture, &self.scene.composition))
    }

    /// Evaluation with the mean of these scores and the costs of the scene: counts, frames per second, memory.
    ///
    /// # Errors
    /// If the adapter fails.
    pub fn finish(mut self, views: Vec<ViewScore>) -> Result<Evaluation, EvaluateError> {
        let mut seconds = 0.0;
        for camera in &self.cameras {
            seconds += self.renderer.seconds_per_frame(camera, TIMED_FRAMES)?;
        }
        let measured = Measured {
            fps: (!self.cameras.is_empty()).then(|| self.cameras.len() as f64 / seconds.max(1e-9)),
            peak_gpu_bytes: Some(self.gpu.peak_bytes()),
            adapter: self.gpu.adapter().to_owned(),
            ..Measured::default()
        };
        Ok(Evaluation::new(self.scene, views, measured))
    }
}

/// Photograph and render in the form in which they are scored: sRGB-encoded; transparent parts of a photograph show the
/// background of the scene, and a mask multiplies both (as in HERA).
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// Photograph, in \[0, 1\].
    pub truth: Rgb32FImage,
    /// Render as displayed, clamped to \[0, 1\] before a mask multiplies it.
    pub render: Rgb32FImage,
    /// Whether a mask multiplied both images.
    pub masked: bool,
    /// Whether the mask is zero everywhere: both images are black, and scores are meaningless.
    pub is_empty: bool,
}

impl Comparison {
    /// Prepares a photograph and a render of a scene with this composition for comparison.
    ///
    /// # Panics
    /// If the photograph states more pixels than it has.
    #[must_use]
    pub fn new(photo: &Photo, picture: &Picture, composition: &Composition) -> Self {
        let space = composition.color_space;
        let background = space.to_srgb(composition.background);
        let mut truth = Rgb32FImage::new(photo.width, photo.height);
        let mut render = Rgb32FImage::new(picture.width, picture.height);
        for (p, truth) in truth.pixels_mut().enumerate() {
            let (rgb, mask) = expected(photo, p, background);
            *truth = Rgb(rgb.map(|c| c * mask));
        }
        let are_alike = render.dimensions() == truth.dimensions();
        for (p, (render, rgb)) in render.pixels_mut().zip(&picture.rgb).enumerate() {
            // Images of different sizes have no score.
            let mask = if are_alike { expected(photo, p, background).1 } else { 1.0 };
            *render = Rgb(space.to_srgb(*rgb).map(|c| c.clamp(0.0, 1.0) * mask));
        }
        let is_empty = photo.masked && photo.rgba.chunks_exact(4).all(|rgba| rgba[3] == 0);
        Self { truth, render, masked: photo.masked, is_empty }
    }

    /// Scores of the view `name`.
    ///
    /// # Errors
    /// If the sizes differ, or are too small for the network of `lpips`.
    pub fn score(&self, name: &str, lpips: Option<&Lpips>) -> Result<ViewScore, EvaluateError> {
        ViewScore::new(name, &self.truth, &self.render, self.masked, lpips)
            .map_err(|source| EvaluateError::Metric { view: name.to_owned(), source })
    }

    /// [`Scores::psnr`](metrics::Scores::psnr) alone, in dB.
    ///
    /// # Errors
    /// If the sizes differ.
    pub fn psnr(&self) -> Result<f64, SceneError> {
        metrics::psnr(&metrics::quantised(&self.truth), &metrics::quantised(&self.render))
    }
}

/// Target colour, sRGB-encoded, of a render at pixel `p` (row-major from the top) of a photograph, and the mask factor
/// that multiplies both before comparison.
pub(crate) fn expected(photo: &Photo, p: usize, background: [f32; 3]) -> ([f32; 3], f32) {
    let [r, g, b, a] = photo.color(p);
    let rgb = [r, g, b];
    if photo.masked { (rgb, a) } else { ([0, 1, 2].map(|c| a * rgb[c] + (1.0 - a) * background[c]), 1.0) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{ColorSpace, color::linear_to_srgb};

    fn photo(masked: bool) -> Photo {
        Photo { width: 2, height: 1, rgba: vec![255, 0, 0, 0, 0, 255, 0, 255], has_alpha: !masked, masked }
    }

    fn grey(level: f32, width: u32) -> Picture {
        let pixels = width as usize;
        Picture { width, height: 1, rgb: vec![[level; 3]; pixels], transmittance: vec![0.0; pixels] }
    }

    #[test]
    fn masks_multiply_both_and_transparency_shows_the_background() {
        let white = Composition { background: [1.0; 3], ..Composition::default() };
        let masked = Comparison::new(&photo(true), &grey(0.5, 2), &white);
        assert_eq!(masked.truth.as_raw(), &[0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        assert_eq!(masked.render.as_raw(), &[0.0, 0.0, 0.0, 0.5, 0.5, 0.5]);
        let plain = Comparison::new(&photo(false), &grey(0.5, 2), &white);
        assert_eq!(plain.truth.as_raw(), &[1.0, 1.0, 1.0, 0.0, 1.0, 0.0]);
        assert_eq!(plain.render.as_raw(), &[0.5; 6]);
        assert!(masked.masked && !plain.masked && !masked.is_empty && !plain.is_empty);
        // A fully masked view has no score (it would be perfect); transparent pixels show the background.
        let nothing = |masked| Photo { rgba: vec![9, 9, 9, 0, 9, 9, 9, 0], ..photo(masked) };
        assert!(Comparison::new(&nothing(true), &grey(0.5, 2), &white).is_empty);
        assert!(!Comparison::new(&nothing(false), &grey(0.5, 2), &white).is_empty);
        // A half is level 128: 127 from white in four channels, 128 from black in two.
        let squares = (4.0 * 127.0_f64.powi(2) + 2.0 * 128.0_f64.powi(2)) / 255.0_f64.powi(2);
        assert!((plain.psnr().unwrap() - -10.0 * (squares / 6.0).log10()).abs() < 1e-5, "{}", plain.psnr().unwrap());
    }

    /// Half a mask on a value brighter than white gives half of white.
    #[test]
    fn renders_are_clamped_before_masks_multiply_them() {
        let white = Photo { rgba: vec![255, 255, 255, 255, 255, 255, 255, 128], ..photo(true) };
        let both = Comparison::new(&white, &grey(1.6, 2), &Composition::default());
        assert_eq!(both.truth, both.render);
        let score = both.score("a.jpg", None).unwrap().scores;
        assert!(score.psnr.is_infinite() && score.psnr_float.is_infinite() && score.flip == 0.0, "{score:?}");
    }

    #[test]
    fn linear_scenes_are_compared_as_they_are_shown() {
        let linear =
            Composition { background: [0.5; 3], color_space: ColorSpace::LinearDisplay, ..Composition::default() };
        let shown = linear_to_srgb(0.5);
        let both = Comparison::new(&photo(false), &grey(0.5, 2), &linear);
        assert_eq!((both.truth.as_raw()[0], both.render.as_raw()), (shown, &vec![shown; 6]));
    }

    #[test]
    fn pictures_of_another_size_have_no_score_but_a_name() {
        let both = Comparison::new(&photo(true), &grey(0.5, 3), &Composition::default());
        let error = both.score("a.jpg", None).unwrap_err().to_string();
        assert!(error.starts_with("a.jpg: ") && error.contains("2×1"), "{error}");
    }
}
