use std::fmt;

use image::Rgb32FImage;
use serde::Serialize;

use super::{MetricError, psnr, quantised, ssim_inria};
use crate::scene::HybridScene;

/// How [`ViewScore`]s are taken; belongs next to every table, as numbers of different protocols do not compare.
pub const PROTOCOL: &str = "held-out views: the capture's own, else every 8th by file name; 8-bit quantised; PSNR per \
     image, then mean; SSIM INRIA (zero-padded 11×11 Gaussian, mean over channels); LPIPS n/a (needs network weights)";

/// Scores of one held-out view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewScore {
    /// Name of the photograph.
    pub name: String,
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// dB, on 8-bit-quantised images. Infinite (null in JSON) where they are equal.
    pub psnr: f64,
    /// INRIA's convention, on 8-bit-quantised images.
    pub ssim_inria: f64,
    /// True if a mask multiplied photograph and render.
    pub masked: bool,
}

impl ViewScore {
    /// Quantises both images to 8 bits and scores them. Where the view has a mask, the caller has multiplied both
    /// images by it and says so in `masked`.
    ///
    /// # Errors
    /// If the sizes differ or the images are empty.
    pub fn new(name: &str, truth: &Rgb32FImage, render: &Rgb32FImage, masked: bool) -> Result<Self, MetricError> {
        let (truth, render) = (quantised(truth), quantised(render));
        Ok(Self {
            name: name.to_owned(),
            size: [truth.width(), truth.height()],
            psnr: psnr(&truth, &render)?,
            ssim_inria: ssim_inria(&truth, &render)?,
            masked,
        })
    }
}

/// What only the program that ran knows.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Measured {
    /// Size of the scene's file.
    pub file_bytes: u64,
    /// Mean wall time of a training iteration.
    pub seconds_per_iteration: Option<f64>,
    /// Rendered frames per second at the size of the views, reading pictures back excluded.
    pub fps: Option<f64>,
    /// Most GPU memory held at once, in bytes.
    pub peak_gpu_bytes: Option<u64>,
    /// Name of the adapter that rendered.
    pub adapter: String,
}

/// How good a scene is, what it costs, and how both were measured.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// Mean over views in dB; none without views.
    pub psnr: Option<f64>,
    /// Mean over views; none without views.
    pub ssim_inria: Option<f64>,
    /// Number of splats.
    pub splats: usize,
    /// Number of mesh triangles.
    pub triangles: usize,
    /// Number of atlas texels, of both resolutions.
    pub texels: usize,
    /// Optimised floats, see [`HybridScene::total_floats`].
    pub total_floats: usize,
    /// Times, bytes, adapter.
    #[serde(flatten)]
    pub measured: Measured,
    /// [`PROTOCOL`].
    pub protocol: &'static str,
    /// One score per held-out view.
    pub views: Vec<ViewScore>,
}

impl Evaluation {
    /// Counts `scene` and averages `views`.
    #[must_use]
    pub fn new(scene: &HybridScene, views: Vec<ViewScore>, measured: Measured) -> Self {
        let mean = |score: fn(&ViewScore) -> f64| {
            (!views.is_empty()).then(|| views.iter().map(score).sum::<f64>() / views.len() as f64)
        };
        let texels = |t: &crate::scene::Texture| t.width() as usize * t.height() as usize;
        let atlas = |a: &crate::scene::Atlas| texels(a.base()) + a.bands().map_or(0, texels);
        Self {
            psnr: mean(|v| v.psnr),
            ssim_inria: mean(|v| v.ssim_inria),
            splats: scene.splats.len(),
            triangles: scene.meshes.iter().map(|m| m.triangles().len()).sum(),
            texels: scene.meshes.iter().map(|m| atlas(m.atlas())).sum(),
            total_floats: scene.total_floats(),
            measured,
            protocol: PROTOCOL,
            views,
        }
    }

    /// The figures that are not per view, as (what, figure) pairs for a table. Unmeasured ones are left out.
    #[must_use]
    pub fn figures(&self) -> Vec<(&'static str, String)> {
        let m = &self.measured;
        let mut rows = vec![
            ("splats", thousands(self.splats as u64)),
            ("triangles", thousands(self.triangles as u64)),
            ("texels", thousands(self.texels as u64)),
            ("total floats", thousands(self.total_floats as u64)),
            ("file", format!("{} bytes", thousands(m.file_bytes))),
        ];
        rows.extend(m.seconds_per_iteration.map(|s| ("time per iteration", format!("{s:.4} s"))));
        rows.extend(m.fps.map(|f| ("frames per second", format!("{f:.1}"))));
        let mib = |b: u64| format!("{} MiB", thousands(b.div_ceil(1 << 20)));
        rows.extend(m.peak_gpu_bytes.map(|b| ("peak GPU memory", mib(b))));
        rows.push(("adapter", m.adapter.clone()));
        rows.push(("protocol", self.protocol.to_owned()));
        rows
    }
}

/// A plain-text table: views, mean, then [`Evaluation::figures`].
impl fmt::Display for Evaluation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = self.views.iter().map(|v| v.name.chars().count()).max().unwrap_or(0).max(4);
        writeln!(f, "{:width$}  {:>11}  {:>7}  {:>6}", "view", "size", "PSNR", "SSIM")?;
        for v in &self.views {
            let (size, mask) = (format!("{}×{}", v.size[0], v.size[1]), if v.masked { "  masked" } else { "" });
            writeln!(f, "{:width$}  {size:>11}  {:7.3}  {:6.4}{mask}", v.name, v.psnr, v.ssim_inria)?;
        }
        if let (Some(psnr), Some(ssim)) = (self.psnr, self.ssim_inria) {
            writeln!(f, "{:width$}  {:>11}  {psnr:7.3}  {ssim:6.4}", "mean", "")?;
        }
        writeln!(f)?;
        for (what, figure) in self.figures() {
            writeln!(f, "{what:18}  {figure}")?;
        }
        Ok(())
    }
}

/// `1234567` as `1,234,567`.
fn thousands(n: u64) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (i, d) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(d);
    }
    out
}

#[cfg(test)]
pub(super) mod tests {
    use image::Rgb;

    use super::*;
    use crate::scene::{Composition, Splats};

    pub(in crate::metrics) fn example() -> Evaluation {
        let grey = |v| Rgb32FImage::from_pixel(12, 8, Rgb([v; 3]));
        let views = vec![
            ViewScore::new("a.jpg", &grey(0.5), &grey(0.6), false).unwrap(),
            ViewScore::new("b <b>.jpg", &grey(0.5), &grey(0.51), true).unwrap(),
        ];
        let scene = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
        let measured =
            Measured { file_bytes: 1_234_567, fps: Some(61.25), adapter: "test".into(), ..Measured::default() };
        Evaluation::new(&scene, views, measured)
    }

    #[test]
    fn scores_are_taken_on_8_bit_images() {
        let e = example();
        // 0.5 → 128, 0.6 → 153, 0.51 → 130: quantised differences of 25 and 2 levels.
        let db = |levels: f64| -20.0 * (levels / 255.0).log10();
        assert!((e.views[0].psnr - db(25.0)).abs() < 1e-5 && (e.views[1].psnr - db(2.0)).abs() < 1e-5);
        assert!((e.psnr.unwrap() - (db(25.0) + db(2.0)) / 2.0).abs() < 1e-5);
    }

    #[test]
    fn table_and_json_hold_the_figures() {
        let text = example().to_string();
        assert!(text.contains("1,234,567 bytes") && text.contains("masked") && text.contains("zero-padded"), "{text}");
        let json = serde_json::to_value(example()).unwrap();
        assert_eq!(json["file_bytes"], 1_234_567);
        assert_eq!(json["views"][1]["masked"], true);
        assert!(json["seconds_per_iteration"].is_null());
    }

    #[test]
    fn no_views_is_no_mean() {
        let e = Evaluation { views: vec![], ..example() };
        let scene = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
        assert_eq!(Evaluation::new(&scene, vec![], Measured::default()).psnr, None);
        assert!(!e.to_string().contains("a.jpg"));
    }
}
