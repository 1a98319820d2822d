use std::fmt;

use image::Rgb32FImage;
use serde::Serialize;

use super::{Lpips, LpipsScore, flip, psnr, quantised, ssim_inria, ssim_reflect, ssim_valid};
use crate::scene::{HybridScene, SceneError};

/// Image-quality scores of one render, or their mean over several. Each score names its convention; scores of different
/// conventions are not comparable.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// PSNR in dB on 8-bit-quantised images. Infinite (null in JSON) for equal images.
    pub psnr: f64,
    /// PSNR in dB on unquantised images.
    pub psnr_float: f64,
    /// SSIM by INRIA's convention (zero padding), on 8-bit-quantised images.
    pub ssim_inria: f64,
    /// SSIM over windows inside the image only, on 8-bit-quantised images; none if an image is smaller than a window.
    pub ssim_valid: Option<f64>,
    /// SSIM with reflected borders, on 8-bit-quantised images; none if an image is too small.
    pub ssim_reflect: Option<f64>,
    /// [`flip`](fn@flip) error on 8-bit-quantised images; lower is better.
    pub flip: f64,
    /// LPIPS on 8-bit-quantised images; none without the network's weights.
    pub lpips: Option<LpipsScore>,
}

impl Scores {
    /// Computes all scores of a pair of images.
    ///
    /// # Errors
    /// If the sizes differ, the images are empty, or too small for the network of `lpips`.
    pub fn new(truth: &Rgb32FImage, render: &Rgb32FImage, lpips: Option<&Lpips>) -> Result<Self, SceneError> {
        let psnr_float = psnr(truth, render)?;
        let (truth, render) = (quantised(truth), quantised(render));
        Ok(Self {
            psnr: psnr(&truth, &render)?,
            psnr_float,
            ssim_inria: ssim_inria(&truth, &render)?,
            ssim_valid: ssim_valid(&truth, &render).ok(),
            ssim_reflect: ssim_reflect(&truth, &render).ok(),
            flip: flip(&truth, &render)?,
            lpips: lpips.map(|lpips| lpips.score(&truth, &render)).transpose()?,
        })
    }

    /// Mean of each score; `None` for an empty slice. An optional score has no mean if it is missing in any element.
    fn mean(all: &[Self]) -> Option<Self> {
        let first = all.first()?;
        let mean = |score: &dyn Fn(&Self) -> f64| all.iter().map(score).sum::<f64>() / all.len() as f64;
        let optional = |score: &dyn Fn(&Self) -> Option<f64>| {
            all.iter().map(score).sum::<Option<f64>>().map(|sum| sum / all.len() as f64)
        };
        let lpips = optional(&|s| s.lpips.map(|l| l.normalized)).zip(optional(&|s| s.lpips.map(|l| l.unnormalized)));
        Some(Self {
            psnr: mean(&|s| s.psnr),
            psnr_float: mean(&|s| s.psnr_float),
            ssim_inria: mean(&|s| s.ssim_inria),
            ssim_valid: optional(&|s| s.ssim_valid),
            ssim_reflect: optional(&|s| s.ssim_reflect),
            flip: mean(&|s| s.flip),
            lpips: lpips.zip(first.lpips).map(|((normalized, unnormalized), first)| LpipsScore {
                normalized,
                unnormalized,
                ..first
            }),
        })
    }

    /// Names and values of the scores shown in tables: 8-bit PSNR, INRIA's SSIM, FLIP, and LPIPS, if present, under
    /// both conventions.
    #[must_use]
    pub fn columns(&self) -> Vec<(String, String)> {
        let mut columns = vec![
            ("PSNR".to_owned(), format!("{:.3}", self.psnr)),
            ("SSIM".to_owned(), format!("{:.4}", self.ssim_inria)),
            ("FLIP".to_owned(), format!("{:.4}", self.flip)),
        ];
        if let Some(l) = &self.lpips {
            columns.push((format!("LPIPS {} −1…1", l.net.name()), format!("{:.4}", l.normalized)));
            columns.push((format!("LPIPS {} 0…1", l.net.name()), format!("{:.4}", l.unnormalized)));
        }
        columns
    }

    /// Description of how the scores of `views` were taken, to accompany every table.
    fn protocol(&self, views: &[ViewScore]) -> String {
        let lpips = self.lpips.map_or("n/a (--lpips-weights)".to_owned(), |l| {
            format!("v0.1 {}, colours −1…1 (0…1: INRIA's script)", l.net.name())
        });
        let masked = match views.iter().filter(|v| v.masked).count() {
            0 => "",
            n if n == views.len() => " photographs and renders multiplied by masks;",
            _ => " photographs and renders multiplied by masks where views have them;",
        };
        format!(
            "held-out views: the capture's own, else every 8th by file name;{masked} 8-bit quantised; PSNR per image, then mean; \
             SSIM INRIA (zero-padded 11×11 Gaussian, mean over channels); FLIP at 67 pixels per degree; LPIPS {lpips}"
        )
    }
}

/// Scores of one held-out view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewScore {
    /// Name of the photograph.
    pub name: String,
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Scores of the render.
    #[serde(flatten)]
    pub scores: Scores,
    /// Whether a mask multiplied photograph and render.
    pub masked: bool,
}

impl ViewScore {
    /// Scores two images. If the view has a mask, the caller has multiplied both images by it and sets `masked`.
    ///
    /// # Errors
    /// Same as [`Scores::new`].
    pub fn new(
        name: &str,
        truth: &Rgb32FImage,
        render: &Rgb32FImage,
        masked: bool,
        lpips: Option<&Lpips>,
    ) -> Result<Self, SceneError> {
        let scores = Scores::new(truth, render, lpips)?;
        Ok(Self { name: name.to_owned(), size: [truth.width(), truth.height()], scores, masked })
    }
}

/// Measurements that only the running program can supply.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Measured {
    /// Size of the scene's file in bytes, if there is a file.
    pub file_bytes: Option<u64>,
    /// Mean wall time of a training iteration of the joint phase, in which splats and mesh are trained together, or of
    /// any iteration if there is no mesh.
    pub seconds_per_iteration: Option<f64>,
    /// Wall time of the whole training: all phases and the steps between them.
    pub training_seconds: Option<f64>,
    /// Peak GPU memory of training, in bytes.
    pub training_peak_gpu_bytes: Option<u64>,
    /// Name of the adapter used for training, if it differs from [`Self::adapter`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trained_on: Option<String>,
    /// Rendered frames per second at the size of the views, excluding readback.
    pub fps: Option<f64>,
    /// Peak GPU memory of the renders scored here, in bytes.
    pub peak_gpu_bytes: Option<u64>,
    /// Name of the adapter used for rendering.
    pub adapter: String,
}

/// Evaluation of a scene: its quality, its cost, and how both were measured.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// Mean scores over the views; none without views.
    #[serde(flatten)]
    pub mean: Option<Scores>,
    /// Number of splats.
    pub splats: usize,
    /// Number of mesh triangles.
    pub triangles: usize,
    /// Number of atlas texels, summed over base and band textures.
    pub texels: usize,
    /// Number of optimised floats, see [`HybridScene::total_floats`].
    pub total_floats: usize,
    /// Measured times, byte counts and adapters.
    #[serde(flatten)]
    pub measured: Measured,
    /// Background colour behind the scene, and behind photographs with alpha; RGB, sRGB-encoded.
    pub background: [f32; 3],
    /// How scores were taken; empty without views.
    pub protocol: String,
    /// One score per held-out view.
    pub views: Vec<ViewScore>,
    /// Names of held-out views whose masks cover the whole image and which therefore have no score.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub left_out: Vec<String>,
}

impl Evaluation {
    /// Evaluates `scene`: counts its elements and averages the scores of `views`.
    #[must_use]
    pub fn new(scene: &HybridScene, views: Vec<ViewScore>, measured: Measured) -> Self {
        let mean = Scores::mean(&views.iter().map(|v| v.scores).collect::<Vec<_>>());
        let texels = |t: &crate::scene::Texture| t.width() as usize * t.height() as usize;
        let atlas = |a: &crate::scene::Atlas| texels(a.base()) + a.bands().map_or(0, texels);
        Self {
            mean,
            splats: scene.splats.len(),
            triangles: scene.meshes.iter().map(|m| m.triangles().len()).sum(),
            texels: scene.meshes.iter().map(|m| atlas(m.atlas())).sum(),
            total_floats: scene.total_floats(),
            measured,
            background: scene.composition.color_space.to_srgb(scene.composition.background),
            protocol: mean.map_or_else(String::new, |mean| mean.protocol(&views)),
            views,
            left_out: vec![],
        }
    }

    /// Rows (name, value) of a table of all figures that are not per view. Unmeasured figures are left out.
    #[must_use]
    pub fn figures(&self) -> Vec<(&'static str, String)> {
        let m = &self.measured;
        let mut rows = vec![
            ("splats", thousands(self.splats as u64)),
            ("triangles", thousands(self.triangles as u64)),
            ("texels", thousands(self.texels as u64)),
            ("total floats", thousands(self.total_floats as u64)),
        ];
        rows.extend(m.file_bytes.map(|bytes| ("file", format!("{} bytes", thousands(bytes)))));
        let on = m.trained_on.as_ref().map_or_else(String::new, |name| format!(" on {name}"));
        rows.extend(m.training_seconds.map(|s| ("training time", format!("{s:.1} s{on}"))));
        // Splats alone have no other.
        let phase = if self.triangles > 0 { " in the joint phase" } else { "" };
        rows.extend(m.seconds_per_iteration.map(|s| ("time per iteration", format!("{s:.4} s{phase}{on}"))));
        rows.extend(m.fps.map(|f| ("frames per second", format!("{f:.1}"))));
        let peak = |bytes: Option<u64>, by: &str| bytes.map(|b| format!("{} MiB {by}", thousands(b.div_ceil(1 << 20))));
        let peaks = [peak(m.peak_gpu_bytes, "rendering"), peak(m.training_peak_gpu_bytes, &format!("training{on}"))];
        let peaks: Vec<String> = peaks.into_iter().flatten().collect();
        if !peaks.is_empty() {
            rows.push(("peak GPU memory", peaks.join(", ")));
        }
        rows.push(("adapter", m.adapter.clone()));
        if !self.left_out.is_empty() {
            let (count, all) = (self.left_out.len(), self.left_out.len() + self.views.len());
            let names = self.left_out.join(", ");
            rows.push(("not scored", format!("{count} of {all} held-out views: masks leave no pixel of {names}")));
        }
        if let Some(mean) = &self.mean {
            rows.push(("PSNR before 8 bits", format!("{:.3} dB", mean.psnr_float)));
            rows.extend(mean.ssim_valid.map(|s| ("SSIM, valid windows", format!("{s:.4}"))));
            rows.extend(mean.ssim_reflect.map(|s| ("SSIM, mirrored border", format!("{s:.4}"))));
            rows.push(("background", self.background.map(|c| c.to_string()).join(" ")));
            rows.push(("protocol", self.protocol.clone()));
        }
        rows
    }
}

/// Formats a plain-text table: views, mean, then [`Evaluation::figures`].
impl fmt::Display for Evaluation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = self.views.iter().map(|v| v.name.chars().count()).max().unwrap_or(0).max(4);
        let row = |scores: &Scores, cell: fn((String, String)) -> (String, usize)| {
            scores.columns().into_iter().map(cell).map(|(text, width)| format!("  {text:>width$}")).collect::<String>()
        };
        if let Some(mean) = &self.mean {
            let name = |(name, _): (String, String)| (name.clone(), name.chars().count().max(7));
            let value = |(name, value): (String, String)| (value, name.chars().count().max(7));
            writeln!(f, "{:width$}  {:>11}{}", "view", "size", row(mean, name))?;
            for v in &self.views {
                let (size, mask) = (format!("{}×{}", v.size[0], v.size[1]), if v.masked { "  masked" } else { "" });
                writeln!(f, "{:width$}  {size:>11}{}{mask}", v.name, row(&v.scores, value))?;
            }
            writeln!(f, "{:width$}  {:>11}{}\n", "mean", "", row(mean, value))?;
        }
        for (what, figure) in self.figures() {
            writeln!(f, "{what:18}  {figure}")?;
        }
        Ok(())
    }
}

/// Formats `1234567` as `1,234,567`.
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
    use crate::metrics::LpipsNet;
    use crate::scene::{Composition, Splats};

    pub(in crate::metrics) fn example() -> Evaluation {
        let grey = |v| Rgb32FImage::from_pixel(12, 8, Rgb([v; 3]));
        let views = vec![
            ViewScore::new("a.jpg", &grey(0.5), &grey(0.6), false, None).unwrap(),
            ViewScore::new("b <b>.jpg", &grey(0.5), &grey(0.51), true, None).unwrap(),
        ];
        let scene = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
        let measured =
            Measured { file_bytes: Some(1_234_567), fps: Some(61.25), adapter: "test".into(), ..Measured::default() };
        Evaluation::new(&scene, views, measured)
    }

    #[test]
    fn scores_are_taken_on_8_bit_images() {
        let e = example();
        // 0.5 → 128, 0.6 → 153, 0.51 → 130: differences of 25 and 2 levels after quantisation.
        let db = |levels: f64| -20.0 * (levels / 255.0).log10();
        let [a, b] = [0, 1].map(|i| e.views[i].scores);
        assert!((a.psnr - db(25.0)).abs() < 1e-5 && (b.psnr - db(2.0)).abs() < 1e-5);
        assert!((a.psnr_float - 20.0).abs() < 1e-4 && (b.psnr_float - 40.0).abs() < 1e-3);
        assert!((e.mean.unwrap().psnr - (db(25.0) + db(2.0)) / 2.0).abs() < 1e-5);
    }

    #[test]
    fn table_and_json_hold_the_figures() {
        let text = example().to_string();
        assert!(text.contains("1,234,567 bytes") && text.contains("masked") && text.contains("zero-padded"), "{text}");
        let json = serde_json::to_value(example()).unwrap();
        assert_eq!(json["file_bytes"], 1_234_567);
        assert_eq!(json["views"][1]["masked"], true);
        assert!(json["seconds_per_iteration"].is_null());
        let e = Evaluation { measured: Measured::default(), ..example() };
        assert!(!e.to_string().contains("bytes"), "what nobody has measured is no row: {e}");
        assert!(serde_json::to_value(e).unwrap()["file_bytes"].is_null());
        assert_eq!(json["background"], serde_json::json!([0.0, 0.0, 0.0]));
        assert!(text.lines().any(|line| line.split_whitespace().eq(["background", "0", "0", "0"])), "{text}");
        assert_eq!(json["psnr"].as_f64(), example().mean.map(|m| m.psnr));
        assert!(json["ssim_valid"].is_null() && json["ssim_reflect"].is_number(), "8 pixels high");
        let mut e = example();
        let lpips = Some(LpipsScore { net: LpipsNet::Vgg, normalized: 0.25, unnormalized: 0.125 });
        e.views.iter_mut().for_each(|v| v.scores.lpips = lpips);
        let scene = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
        let text = Evaluation::new(&scene, e.views, e.measured).to_string();
        for part in ["LPIPS VGG −1…1  LPIPS VGG 0…1", "0.2500         0.1250", "LPIPS v0.1 VGG"] {
            assert!(text.contains(part), "{text}");
        }
    }

    /// Rendering figures belong to this adapter, training figures to the adapter that trained.
    #[test]
    fn times_and_memory_say_what_they_are_of() {
        let measured = Measured {
            seconds_per_iteration: Some(0.25),
            training_seconds: Some(61.04),
            training_peak_gpu_bytes: Some(3 << 20),
            peak_gpu_bytes: Some(2 << 20),
            ..Measured::default()
        };
        let text = |triangles, measured| Evaluation { triangles, measured, ..example() }.to_string();
        let there = Measured { trained_on: Some("another".to_owned()), ..measured.clone() };
        for (text, phase, on) in [
            (text(2, measured.clone()), " in the joint phase", ""),
            (text(2, there), " in the joint phase", " on another"),
            (text(0, measured), "", ""),
        ] {
            for part in [
                format!("training time       61.0 s{on}\n"),
                format!("time per iteration  0.2500 s{phase}{on}\n"),
                format!("peak GPU memory     2 MiB rendering, 3 MiB training{on}\n"),
            ] {
                assert!(text.contains(&part), "{part}: {text}");
            }
        }
    }

    #[test]
    fn protocol_tells_of_masks() {
        let scene = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
        let protocol = |masked: [bool; 2]| {
            let mut views = example().views;
            views.iter_mut().zip(masked).for_each(|(view, masked)| view.masked = masked);
            Evaluation::new(&scene, views, Measured::default()).protocol
        };
        let said = "photographs and renders multiplied by masks";
        assert!(!protocol([false; 2]).contains(said));
        assert!(protocol([true; 2]).contains(&format!("; {said}; 8-bit")));
        assert!(protocol([true, false]).contains(&format!("; {said} where views have them; 8-bit")));
    }

    #[test]
    fn views_of_which_masks_leave_nothing_are_counted() {
        let e = Evaluation { left_out: vec!["c.jpg".to_owned()], ..example() };
        let row = "not scored          1 of 3 held-out views: masks leave no pixel of c.jpg\n";
        assert!(e.to_string().contains(row) && !example().to_string().contains("not scored"), "{e}");
        assert_eq!(serde_json::to_value(e).unwrap()["left_out"], serde_json::json!(["c.jpg"]));
    }

    #[test]
    fn no_views_is_no_mean() {
        let e = Evaluation { views: vec![], ..example() };
        let scene = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
        assert_eq!(Evaluation::new(&scene, vec![], Measured::default()).mean, None);
        assert!(!e.to_string().contains("a.jpg"));
    }
}
