//! Splat primitives: attributes of `KHR_gaussian_splatting`, quantised as it allows, or an SPZ stream in their place.

use std::collections::BTreeMap;

use glam::{DMat4, DVec4, Quat, Vec3};
use serde_json::Value;

use super::extension::{
    DRAFT_ROTATION, DRAFT_SCALE, HYBRID, KHR_SPLATS, Khr, OPACITY, ROTATION, SCALE, SPZ, Spz, parse_color_space,
    sh_attributes,
};
use super::lift::Asset;
use crate::format::error::{Fault, from_value, shown};
use crate::format::placed::place;
use crate::format::{SplatFile, activation, spz};
use crate::scene::{ColorSpace, SplatArrays, sh};

/// Splats of a primitive, before a node's transform.
#[derive(Clone)]
pub(super) struct Stored {
    splats: SplatArrays,
    /// Transform from the splats' axes to those of glTF.
    frame: DMat4,
}

impl Stored {
    /// Applies the transform of a node, which is not flat.
    pub(super) fn placed(self, transform: DMat4) -> SplatArrays {
        let Self { mut splats, frame } = self;
        place(&mut splats, transform * frame);
        splats
    }
}

/// Reads primitive `id` (mesh, index in the mesh), whose `KHR_gaussian_splatting` is `khr`, for blending in the space
/// that the scene states, or else in the first that its splats state.
pub(super) fn read(
    asset: &Asset,
    id: (usize, usize),
    primitive: &gltf::Primitive<'_>,
    khr: &Value,
    (space, is_stated): (ColorSpace, bool),
    notes: &mut Vec<String>,
) -> Result<Stored, Fault> {
    let at = format!("/meshes/{}/primitives/{}", id.0, id.1);
    let at_khr = format!("{at}/extensions/{KHR_SPLATS}");
    let khr = from_value::<Khr>(khr, &at_khr, KHR_SPLATS)?;
    for (key, token, known) in [("kernel", &khr.kernel, "ellipse"), ("projection", &khr.projection, "perspective")] {
        if let Some(token) = token.as_ref().filter(|token| *token != known) {
            return Err(Fault::pointer(format!("{at_khr}/{key}"), known, format!("`{token}`")));
        }
    }
    if let Some(token) = &khr.color_space
        && parse_color_space(token, &at_khr)? != space
    {
        if is_stated {
            let expected = format!("{} throughout", space.name());
            return Err(Fault::pointer(format!("{at_khr}/colorSpace"), expected, format!("`{token}`")));
        }
        notes.push(format!("{at_khr}: blended in the colour space of the first splats"));
    }
    let is_draft = khr.kernel.is_none() && khr.color_space.is_none();
    if khr.kernel.is_none() != khr.color_space.is_none() {
        return Err(Fault::pointer(at_khr, "a kernel and a colorSpace", "one of them"));
    }
    if is_draft {
        notes.push(format!(
            "{at_khr}: written for a draft of the extension: read as ellipses in the scene's colour space"
        ));
    }
    if primitive.mode() != gltf::mesh::Mode::Points {
        return Err(Fault::pointer(format!("{at}/mode"), "0 (POINTS)", format!("{:?}", primitive.mode())));
    }
    if primitive.indices().is_some() {
        notes.push(format!("{at}/indices: ignored: every splat of the attributes is shown once"));
    }
    let is_empty = asset.positions(id, primitive).is_some_and(|positions| !asset.is_stored(&positions));
    for name in khr.extensions.keys().filter(|name| ![HYBRID, SPZ].contains(&name.as_str())) {
        if is_empty && !khr.extensions.contains_key(SPZ) {
            let expected = format!("splats in accessors or of {SPZ}");
            return Err(Fault::pointer(
                at_khr,
                expected,
                format!("accessors without data beside {}", shown(name.as_bytes())),
            ));
        }
        notes.push(format!("{at_khr}: `{name}` is unknown, the attributes are read"));
    }
    match khr.extensions.get(SPZ) {
        Some(value) => {
            let at = format!("{at_khr}/extensions/{SPZ}");
            let splats = decompress(asset, id, primitive, value, &at, notes)?;
            // Converts from the frame of captures (right, down, front), in which the codec delivers: half a turn about
            // z to (left, up, front), as Khronos' draft requires; early files store (right, up, back) as they are.
            let [x, y, z] = if is_draft { [1.0, -1.0, -1.0] } else { [-1.0, -1.0, 1.0] };
            Ok(Stored { splats, frame: DMat4::from_diagonal(DVec4::new(x, y, z, 1.0)) })
        }
        None => {
            let splats = attributes(asset, id, primitive, is_draft, &at, notes)?;
            Ok(Stored { splats, frame: DMat4::IDENTITY })
        }
    }
}

fn decompress(
    asset: &Asset,
    id: (usize, usize),
    primitive: &gltf::Primitive<'_>,
    value: &Value,
    at: &str,
    notes: &mut Vec<String>,
) -> Result<SplatArrays, Fault> {
    let stream: Spz = from_value(value, at, &format!("an object of {SPZ}"))?;
    let view = asset.document.views().nth(stream.buffer_view).filter(|view| asset.has_view(view));
    let view = view.ok_or_else(|| {
        let views = asset.root.get("bufferViews").and_then(Value::as_array).map_or(0, Vec::len);
        let at = format!("{at}/bufferView");
        Fault::pointer(at, format!("a bufferView below {views}"), stream.buffer_view.to_string())
    })?;
    let SplatFile { splats, pixel_filter, notes: found, .. } =
        spz::parse(&asset.view_bytes(&view)?).map_err(|Fault { location, expected, found }| {
            Fault::pointer(at, expected, format!("{found} ({location}in the stream)"))
        })?;
    let antialiased =
        "trained with anti-aliasing, which glTF can state for whole scenes only: small splats look too strong"
            .to_owned();
    let found = found.into_iter().chain(pixel_filter.normalized.then_some(antialiased));
    notes.extend(found.map(|note| format!("{at}: {note}")));
    let declared = asset.positions(id, primitive).map_or(splats.len(), |a| a.count());
    if declared != splats.len() {
        return Err(Fault::pointer(at, format!("{declared} splats, as in POSITION"), splats.len().to_string()));
    }
    Ok(splats.into_arrays())
}

fn attributes(
    asset: &Asset,
    id: (usize, usize),
    primitive: &gltf::Primitive<'_>,
    is_draft: bool,
    at: &str,
    notes: &mut Vec<String>,
) -> Result<SplatArrays, Fault> {
    let none = BTreeMap::new();
    let attributes = asset.attributes.get(&id).unwrap_or(&none);
    let find = |name: &str, of_draft: &str| {
        let found = attributes.get(name).or(attributes.get(of_draft).filter(|_| is_draft));
        found.copied().ok_or_else(|| {
            Fault::pointer(format!("{at}/attributes"), format!("the attribute `{name}`"), "none of this name")
        })
    };
    let position = asset.positions(id, primitive);
    let position = position.ok_or_else(|| Fault::pointer(format!("{at}/attributes"), "POSITION", "none"))?;
    let means: Vec<Vec3> = asset.floats::<3>(position.index())?.into_iter().map(Vec3::from).collect();
    let same = |found: usize, name: &str| {
        let fault = || {
            let expected = format!("{} elements, as in POSITION", means.len());
            Fault::pointer(format!("{at}/attributes/{name}"), expected, found.to_string())
        };
        if found == means.len() { Ok(()) } else { Err(fault()) }
    };
    let rotations = asset.floats::<4>(find(ROTATION, DRAFT_ROTATION)?)?;
    same(rotations.len(), ROTATION)?;
    let scales = asset.floats::<3>(find(SCALE, DRAFT_SCALE)?)?;
    same(scales.len(), SCALE)?;
    // Drafts store the zeroth coefficient and the opacity as a colour.
    let dc_name = format!("{KHR_SPLATS}:SH_DEGREE_0_COEF_0");
    let of_color = is_draft && !attributes.contains_key(&dc_name) && !attributes.contains_key(OPACITY);
    let colors = if of_color { asset.floats::<4>(find("COLOR_0", "")?)? } else { vec![] };
    let opacities: Vec<f32> = if of_color {
        colors.iter().map(|c| c[3]).collect()
    } else {
        asset.floats::<1>(find(OPACITY, "")?)?.into_iter().map(|[o]| o).collect()
    };
    same(opacities.len(), if of_color { "COLOR_0" } else { OPACITY })?;

    let prefix = format!("{KHR_SPLATS}:SH_DEGREE_");
    let harmonics = attributes.keys().filter(|name| name.starts_with(&prefix)).count() + usize::from(of_color);
    let degree = (0..=sh::MAX_DEGREE).find(|&d| sh::coefficients(d) == harmonics).ok_or_else(|| {
        let found = format!("{harmonics} SH attributes");
        Fault::pointer(format!("{at}/attributes"), "complete SH degrees from 0 to at most 3", found)
    })?;
    let k = sh::coefficients(degree);
    let mut interleaved = vec![[0.0; 3]; means.len() * k];
    for (c, name) in sh_attributes(degree).enumerate() {
        let coefficients = if of_color && c == 0 {
            colors.iter().map(|c| sh::dc_from_rgb([c[0], c[1], c[2]])).collect()
        } else {
            asset.floats::<3>(find(&name, "")?)?
        };
        same(coefficients.len(), &name)?;
        interleaved.iter_mut().skip(c).step_by(k).zip(coefficients).for_each(|(slot, value)| *slot = value);
    }

    let (opacity_logits, log_scales) = activation::parameters(opacities, scales, at, notes);
    let rotations = rotations.into_iter().map(Quat::from_array).collect();
    Ok(SplatArrays { means, rotations, log_scales, opacity_logits, sh_degree: degree, sh: interleaved })
}
