//! Conversion of `ParticleField3DGaussianSplat` to splats.

use glam::{Quat, Vec3};

use super::names;
use super::stage::Stage;
use crate::format::activation;
use crate::format::error::{Fault, shown};
use crate::scene::{ColorSpace, SplatArrays, sh};

/// Colour space that a prim states by `ColorSpaceAPI`; on failure, the unknown name.
pub(super) fn color_space<'a>(stage: &Stage<'a>, prim: usize) -> Result<Option<ColorSpace>, &'a str> {
    match stage.text(prim, "colorSpace:name") {
        None => Ok(None),
        Some(names::SRGB) => Ok(Some(ColorSpace::SrgbDisplay)),
        Some(names::LINEAR) => Ok(Some(ColorSpace::LinearDisplay)),
        Some(other) => Err(other),
    }
}

/// SH degree that a prim states; on failure, the invalid value.
fn degree_stated(stage: &Stage<'_>, prim: usize) -> Result<u32, f64> {
    let stated = stage.number(prim, "radiance:sphericalHarmonicsDegree").unwrap_or(3.0);
    if (0.0..=16.0).contains(&stated) { Ok(stated as u32) } else { Err(stated) }
}

/// SH coefficients per splat for the degree that a prim states; `None` if it is invalid.
pub(super) fn coefficients_stated(stage: &Stage<'_>, prim: usize) -> Option<usize> {
    degree_stated(stage, prim).ok().map(sh::coefficients)
}

/// Reads splats in the frame of the prim. Arrays that are too short count as missing, as the schema demands; missing
/// arrays get the schema's defaults.
pub(super) fn read(stage: &Stage<'_>, prim: usize, notes: &mut Vec<String>) -> Result<SplatArrays, Fault> {
    let at = stage.path(prim);
    if let Some(hint) = stage.text(prim, "projectionModeHint").filter(|hint| *hint != "perspective") {
        notes.push(format!("{at}.projectionModeHint: {}, read as perspective", shown(hint.as_bytes())));
    }
    let means = either::<3>(stage, prim, "positions")?.unwrap_or_default();
    let n = means.len();
    let mut fitted = |name: &str, found: usize, expected: usize| {
        if found != expected {
            let what = if found > expected { "cut" } else { "not used" };
            notes.push(format!("{at}.{name}: {found} values for {expected}, {what}"));
        }
        found >= expected
    };
    let mut rotations = either::<4>(stage, prim, "orientations")?.unwrap_or_default();
    if !fitted("orientations", rotations.len(), n) {
        rotations = vec![[1.0, 0.0, 0.0, 0.0]; n];
    }
    let mut scales = either::<3>(stage, prim, "scales")?.unwrap_or_default();
    if !fitted("scales", scales.len(), n) {
        scales = vec![[1.0; 3]; n];
    }
    let mut opacities = either::<1>(stage, prim, "opacities")?.unwrap_or_default();
    if !fitted("opacities", opacities.len(), n) {
        opacities = vec![[1.0]; n];
    }
    let stated = degree_stated(stage, prim).map_err(|found| {
        let at = format!("{at}.radiance:sphericalHarmonicsDegree");
        Fault::pointer(at, "a degree of 0 to 3", found.to_string())
    })?;
    let (mut degree, stated_k) = (stated.min(sh::MAX_DEGREE), sh::coefficients(stated));
    let mut harmonics = either::<3>(stage, prim, "radiance:sphericalHarmonicsCoefficients")?.unwrap_or_default();
    if !fitted("radiance:sphericalHarmonicsCoefficients", harmonics.len(), n * stated_k) {
        (degree, harmonics) = (0, vec![[0.0; 3]; n]);
    } else if stated_k > sh::coefficients(degree) {
        notes.push(format!("{at}: SH bands above degree {degree} are left out"));
        harmonics = harmonics.chunks_exact(stated_k).flat_map(|c| c[..sh::coefficients(degree)].to_vec()).collect();
    }
    harmonics.truncate(n * sh::coefficients(degree));

    let opacities = opacities.into_iter().take(n).map(|[o]| o);
    let (opacity_logits, log_scales) = activation::parameters(opacities, scales.into_iter().take(n), &at, notes);
    Ok(SplatArrays {
        means: means.into_iter().map(Vec3::from).collect(),
        rotations: rotations.into_iter().take(n).map(|[w, x, y, z]| Quat::from_xyzw(x, y, z, w)).collect(),
        log_scales,
        opacity_logits,
        sh_degree: degree,
        sh: harmonics,
    })
}

/// Attribute in single precision, else in half precision.
fn either<const N: usize>(stage: &Stage<'_>, prim: usize, name: &str) -> Result<Option<Vec<[f32; N]>>, Fault> {
    match stage.rows(prim, name)? {
        Some(rows) => Ok(Some(rows)),
        None => stage.rows(prim, &format!("{name}h")),
    }
}
