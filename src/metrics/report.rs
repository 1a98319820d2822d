//! Self-contained HTML report on a trained scene, without external resources.

use std::fmt::Write as _;

use image::{ImageError, RgbImage, codecs::jpeg::JpegEncoder, imageops};

use super::markup::escaped;
use super::{
    Evaluation, Scores,
    plot::{self, Plot},
};
use crate::base64;

/// Content of a report page.
#[derive(Clone, Debug)]
pub struct Report<'a> {
    /// Heading: the name of the scene or capture.
    pub title: &'a str,
    /// Evaluation to show.
    pub evaluation: &'a Evaluation,
    /// Settings as (name, value), in display order.
    pub settings: &'a [(String, String)],
    /// Training curves, drawn side by side.
    pub plots: &'a [Plot],
    /// Pictures, shown one below the other.
    pub pictures: &'a [Picture],
}

/// Captioned picture, kept as a JPEG of at most [`MOST_SIDE`] pixels a side.
#[derive(Clone, Debug)]
pub struct Picture {
    caption: String,
    width: u32,
    height: u32,
    /// Original width and height, if the picture was scaled down.
    shrunk_from: Option<(u32, u32)>,
    jpeg: Vec<u8>,
}

impl Picture {
    /// Encodes `image`, see [`super::side_by_side`], scaled down to at most [`MOST_SIDE`] pixels a side.
    ///
    /// # Errors
    /// If the image is empty.
    pub fn new(caption: impl Into<String>, image: &RgbImage) -> Result<Self, ImageError> {
        let mut jpeg = Vec::new();
        let shrunk = shrunk(image);
        let embedded = shrunk.as_ref().unwrap_or(image);
        JpegEncoder::new_with_quality(&mut jpeg, QUALITY).encode_image(embedded)?;
        let (width, height) = embedded.dimensions();
        Ok(Self { caption: caption.into(), width, height, shrunk_from: shrunk.map(|_| image.dimensions()), jpeg })
    }
}

/// Most pixels a side of embedded pictures: three photographs of 2048 pixels side by side, more than four times the
/// width of the page. JPEG is limited to 65,535, which three of 21,843 or more would exceed.
pub const MOST_SIDE: u32 = 6144;

/// Scaled-down copy of an image that is larger than [`MOST_SIDE`]. Averages in integers, because resampling in floats
/// takes gigabytes for the largest images.
fn shrunk(image: &RgbImage) -> Option<RgbImage> {
    let (width, height) = image.dimensions();
    let longer = u64::from(width.max(height));
    let scaled = |side: u32| (u64::from(side) * u64::from(MOST_SIDE)).div_ceil(longer) as u32;
    (longer > u64::from(MOST_SIDE)).then(|| imageops::thumbnail(image, scaled(width), scaled(height)))
}

/// JPEG quality of embedded pictures: no visible loss at a tenth of the size of PNG. The lossless pictures are separate
/// files.
const QUALITY: u8 = 92;

/// Renders the page as HTML.
#[must_use]
pub fn html(report: &Report<'_>) -> String {
    let mut out = String::new();
    let title = escaped(report.title);
    let e = report.evaluation;
    out += &format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\n\
         <title>{title} · Centaur</title>\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n<h1>{title}</h1>\n"
    );
    let headline = |value: Option<f64>, decimals: usize| value.map_or("n/a".into(), |v| format!("{v:.decimals$}"));
    out += &format!(
        "<p class=\"headline\"><b>{}</b> dB PSNR <b>{}</b> SSIM (INRIA) <b>{}</b> held-out views</p>\n",
        headline(e.mean.map(|m| m.psnr), 2),
        headline(e.mean.map(|m| m.ssim_inria), 4),
        e.views.len()
    );
    out += "<section class=\"columns\">\n<div><h2>Views</h2>\n";
    write_views(&mut out, e);
    out += "</div>\n<div><h2>Scene and machine</h2>\n";
    write_pairs(&mut out, e.figures().iter().map(|(k, v)| (*k, v.as_str())));
    out += "</div>\n</section>\n";
    if !report.settings.is_empty() {
        out += "<details><summary>Settings</summary>\n";
        write_pairs(&mut out, report.settings.iter().map(|(k, v)| (k.as_str(), v.as_str())));
        out += "</details>\n";
    }
    if !report.plots.is_empty() {
        out += "<h2>Training</h2>\n<section class=\"plots\">\n";
        report.plots.iter().for_each(|p| out += &plot::svg(p));
        out += "</section>\n";
    }
    if !report.pictures.is_empty() {
        out += "<h2>Photograph, render, absolute error × 4</h2>\n";
    }
    for picture in report.pictures {
        let whole = picture.shrunk_from.map(|(w, h)| format!("; here smaller than its file of {w}×{h} pixels"));
        let _ = writeln!(
            out,
            "<figure><img alt=\"{caption}\" loading=\"lazy\" width=\"{}\" height=\"{}\" \
             src=\"data:image/jpeg;base64,{}\"><figcaption>{caption}{}</figcaption></figure>",
            picture.width,
            picture.height,
            base64::encode(&picture.jpeg),
            whole.unwrap_or_default(),
            caption = escaped(&picture.caption),
        );
    }
    out += &format!("<footer>centaur {}</footer>\n</main>\n</body>\n</html>\n", env!("CARGO_PKG_VERSION"));
    out
}

fn write_views(out: &mut String, e: &Evaluation) {
    let cells = |scores: &Scores| -> String {
        scores.columns().iter().map(|(_, value)| format!("<td class=\"n\">{value}")).collect()
    };
    let names = e.mean.map_or_else(Vec::new, |mean| mean.columns());
    let names: String = names.iter().map(|(name, _)| format!("<th>{name}")).collect();
    let _ = writeln!(out, "<table><thead><tr><th>view<th>size{names}</tr></thead>\n<tbody>");
    for v in &e.views {
        let mask = if v.masked { " <small>masked</small>" } else { "" };
        let name = escaped(&v.name);
        let [w, h] = v.size;
        let _ = writeln!(out, "<tr><td>{name}{mask}<td class=\"n\">{w}×{h}{}</tr>", cells(&v.scores));
    }
    *out += "</tbody>\n";
    if let Some(mean) = &e.mean {
        let _ = writeln!(out, "<tfoot><tr><td>mean<td>{}</tr></tfoot>", cells(mean));
    }
    *out += "</table>\n";
}

fn write_pairs<'a>(out: &mut String, pairs: impl Iterator<Item = (&'a str, &'a str)>) {
    *out += "<table class=\"pairs\"><tbody>\n";
    for (key, value) in pairs {
        let _ = writeln!(out, "<tr><th>{}<td>{}</tr>", escaped(key), escaped(value));
    }
    *out += "</tbody></table>\n";
}

const CSS: &str = "
:root{color-scheme:light dark;--paper:#fff;--ink:#24292f;--soft:#68707a;--rule:#d8dde3;--accent:#0b6bcb}
@media(prefers-color-scheme:dark){:root{--paper:#14171a;--ink:#dde2e7;--soft:#8d969f;--rule:#343a41;--accent:#62b0ff}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:15px/1.5 system-ui,sans-serif}
main{max-width:84rem;margin:0 auto;padding:2rem 1.5rem}
h1{font-size:1.7rem;margin:0}h2,summary{font-size:1.05rem;font-weight:700;margin:2rem 0 .6rem}
summary{cursor:pointer}details table{max-width:40rem}
.headline{color:var(--soft);margin:.3rem 0 0}.headline b{color:var(--ink);font-size:1.25rem;margin-left:.9rem}
.headline b:first-child{margin-left:0}
.columns{display:grid;grid-template-columns:repeat(auto-fit,minmax(21rem,1fr));gap:0 2.5rem}
.plots{display:grid;grid-template-columns:repeat(auto-fit,minmax(21rem,1fr));gap:1rem}.plots svg{width:100%;height:auto}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{text-align:left;padding:.25rem .6rem .25rem 0;border-bottom:1px solid var(--rule);vertical-align:top;overflow-wrap:anywhere}
thead th,.pairs th,small{color:var(--soft);font-weight:400}.pairs th{white-space:nowrap}
.n,thead th+th{text-align:right;white-space:nowrap}tfoot td{font-weight:600;border:0}
figure{margin:0 0 1.2rem}img{max-width:100%;height:auto;display:block}
figcaption,footer{color:var(--soft);font-size:.85rem}footer{margin-top:2rem}
";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::evaluation::tests::example;

    #[test]
    fn page_is_self_contained_and_escaped() {
        let evaluation = example();
        let settings = [("lambda".to_owned(), "0.01 <extent>".to_owned())];
        let plots = [Plot {
            title: "loss".into(),
            x_label: "iteration".into(),
            log_y: true,
            points: vec![(0.0, 1.0), (10.0, 0.1)],
            parts: vec![],
        }];
        let pictures = [Picture::new("b <b>.jpg", &RgbImage::new(8, 8)).unwrap()];
        let page = html(&Report {
            title: "a&b",
            evaluation: &evaluation,
            settings: &settings,
            plots: &plots,
            pictures: &pictures,
        });
        assert!(
            page.contains("<h1>a&amp;b</h1>")
                && page.contains("b &lt;b&gt;.jpg")
                && page.contains("0.01 &lt;extent&gt;")
        );
        assert!(page.contains("src=\"data:image/jpeg;base64,/9j/") && page.contains("<polyline"));
        // The SVG namespace is a name, not a link.
        let links = page.replace("http://www.w3.org/2000/svg", "");
        assert!(!links.contains("http") && !links.contains("<link") && !links.contains("<script"));
    }

    #[test]
    fn an_empty_picture_is_an_error() {
        for (width, height) in [(0, 0), (0, 70_000)] {
            assert!(Picture::new("", &RgbImage::new(width, height)).is_err());
        }
    }

    /// A sheet of photographs 22,000 pixels wide is wider than a JPEG can be.
    #[test]
    fn pictures_that_are_too_large_for_a_page_are_shrunk() {
        let sheet = RgbImage::from_fn(66_008, 20, |x, _| image::Rgb([if x < 33_004 { 200 } else { 40 }; 3]));
        let picture = Picture::new("wide.jpg", &sheet).unwrap();
        assert_eq!((picture.width, picture.height), (MOST_SIDE, 2));
        let seen = image::load_from_memory(&picture.jpeg).unwrap().to_rgb8();
        assert_eq!(seen.dimensions(), (MOST_SIDE, 2));
        let level = |x: u32| i32::from(seen.get_pixel(x, 1).0[0]);
        assert!((level(1000) - 200).abs() < 4 && (level(5000) - 40).abs() < 4, "{} {}", level(1000), level(5000));
        let narrow = Picture::new("", &RgbImage::new(1, 70_000)).unwrap();
        assert_eq!((narrow.width, narrow.height), (1, MOST_SIDE));
        let same = Picture::new("small.jpg", &RgbImage::new(MOST_SIDE, 1)).unwrap();
        assert_eq!((same.width, same.height), (MOST_SIDE, 1));
        let evaluation = example();
        let page =
            html(&Report { title: "", evaluation: &evaluation, settings: &[], plots: &[], pictures: &[picture, same] });
        assert!(page.contains("wide.jpg; here smaller than its file of 66008×20 pixels</figcaption>"));
        assert!(page.contains("small.jpg</figcaption>"));
    }
}
