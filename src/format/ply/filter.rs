//! Pixel filter of the splats of a file: stated by comments of the header, or implied by Mip-Splatting's property.

use super::layout::FILTER_3D;
use super::table::{Element, Header};
use crate::format::error::shown;
use crate::format::splat_record::SEEN_IN_3D;
use crate::scene::PixelFilter;

/// Start of the comment that states the variance of a pixel filter.
pub(super) const VARIANCE: &str = "Centaur filter variance:";

/// Header comments of splats whose pixel filter preserves the integral of projections.
pub(super) fn filter_comments(filter: PixelFilter) -> String {
    if !filter.normalized {
        return String::new();
    }
    format!("comment SplatRenderMode: mip\ncomment {VARIANCE} {}\n", filter.variance)
}

/// Render mode requested by the comments of a header.
#[derive(Clone, Copy)]
enum Mode {
    Usual,
    /// `SplatRenderMode: mip`, by which Brush and splat-transform mean different filters.
    Mip,
    /// Postshot's `antialiased 1`.
    Antialiased,
    /// `SplatRenderMode: 2dgs`.
    Flat,
}

/// Pixel filter stated by a header: implied by Mip-Splatting's property, otherwise by the last comment on it.
pub(super) fn pixel_filter_of(header: &Header, is_compressed: bool, notes: &mut Vec<String>) -> PixelFilter {
    if !is_compressed && header.element("vertex").is_some_and(|vertex| vertex.scalar(FILTER_3D).is_some()) {
        return PixelFilter::MIP;
    }
    match mode_of(header.comments(), notes) {
        Mode::Usual => PixelFilter::DILATION,
        Mode::Antialiased => PixelFilter::NORMALIZED_DILATION,
        Mode::Flat => {
            notes.push(format!("SplatRenderMode 2dgs: {SEEN_IN_3D}"));
            PixelFilter::DILATION
        }
        Mode::Mip => mip_filter_of(header, is_compressed).unwrap_or_else(|| {
            notes.push(
                "SplatRenderMode mip, written by neither Brush nor Centaur: read as antialiased with 0.3 px², as in SPZ and SOG, not with Mip-Splatting's 0.1"
                    .to_owned(),
            );
            PixelFilter::NORMALIZED_DILATION
        }),
    }
}

/// Render mode of the last comment that states one. The last unknown one is noted.
fn mode_of(comments: &[String], notes: &mut Vec<String>) -> Mode {
    let (mut mode, mut unknown) = (Mode::Usual, None);
    for comment in comments {
        let comment = comment.to_lowercase();
        mode = match (comment.strip_prefix("splatrendermode:").map(str::trim), comment.as_str()) {
            (Some("mip"), _) => Mode::Mip,
            (Some("2dgs"), _) => Mode::Flat,
            (Some("default"), _) | (None, "antialiased 0") => Mode::Usual,
            (None, "antialiased 1") => Mode::Antialiased,
            (None, _) => mode,
            (Some(other), _) => {
                unknown = Some(shown(other.as_bytes()));
                mode
            }
        };
    }
    notes.extend(unknown.map(|name| format!("SplatRenderMode {name}: not known, left out")));
    mode
}

/// Pixel filter meant by *mip*, if it can be determined: splat-transform writes the word for any antialiased splats.
fn mip_filter_of(header: &Header, is_compressed: bool) -> Option<PixelFilter> {
    let stated =
        header.comments().iter().find_map(|comment| comment.strip_prefix(VARIANCE)?.trim().parse::<f32>().ok());
    if let Some(variance) = stated.filter(|variance| variance.is_finite() && *variance >= 0.0) {
        return Some(PixelFilter { variance, normalized: true });
    }
    let is_of_brush = header.comments().iter().any(|comment| comment.eq_ignore_ascii_case("exported from brush"));
    (is_of_brush || is_of_former_centaur(header, is_compressed)).then_some(PixelFilter::MIP)
}

/// Whether the header is one that Centaur wrote before it stated the variance: that comment alone; splat-transform
/// writes it above a table with properties in another order, or, in compressed files, below its own name.
fn is_of_former_centaur(header: &Header, is_compressed: bool) -> bool {
    let first = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0"];
    let is_inrias = |vertex: &Element| vertex.scalar_properties().map(|(_, name, _)| name).take(first.len()).eq(first);
    header.comments() == ["SplatRenderMode: mip"] && (is_compressed || header.element("vertex").is_some_and(is_inrias))
}
