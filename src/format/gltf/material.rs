//! Conversion of materials to maps: exact maps from `EXT_gaussian_splatting_hybrid`, else the base colour.

use std::collections::HashMap;

use gltf::accessor::DataType;
use gltf::material::AlphaMode;
use gltf::texture::MagFilter;
use rayon::prelude::*;

use super::extension::{
    EMISSIVE_STRENGTH, HYBRID, Radiance, SPECULAR_GLOSSINESS, ShField, SpecularGlossiness, TEXTURE_TRANSFORM,
    TexelSource, UNLIT, parse_color_space,
};
use super::image::{Texels, texels};
use super::lift::Asset;
use super::uv::UvMap;
use crate::format::activation;
use crate::format::error::{Fault, from_value, shown};
use crate::format::map_budget::{Identity, MapBudget, identity};
use crate::scene::{Atlas, ColorSpace, Texture, color, sh};

/// Maps of a material.
pub(super) struct Maps {
    pub(super) atlas: Atlas,
    pub(super) uv: UvMap,
    /// How vertex colours are applied; `None` if the maps are complete without them.
    pub(super) base: Option<BaseColour>,
}

/// Computation of colour and opacity from a core material.
#[derive(Clone, Copy)]
pub(super) struct BaseColour {
    factor: [f32; 4],
    /// Alpha mode: `None` is opaque; 0 is blended; otherwise the cut-off of a mask.
    cutoff: Option<f32>,
    space: ColorSpace,
    pub(super) is_textured: bool,
}

impl BaseColour {
    /// Texel of a map for `rgba` in linear light, before the material's factor.
    pub(super) fn texel(&self, rgba: [f32; 4]) -> [f32; 4] {
        let linear = [0, 1, 2].map(|c| rgba[c] * self.factor[c]);
        let alpha = rgba[3] * self.factor[3];
        let alpha = match self.cutoff {
            None => 1.0,
            Some(0.0) => alpha,
            Some(cutoff) => f32::from(alpha >= cutoff),
        };
        let [r, g, b] = sh::dc_from_rgb(self.space.from_linear(linear));
        [r, g, b, activation::map_logit(alpha)]
    }

    /// Texels of a map for those of an image. `is_whole`: whether all its channels come from one file.
    fn texels(&self, picture: &Texels, is_whole: bool) -> Vec<f32> {
        let rgba = &picture.rgba;
        let of = |[r, g, b, a]: [f32; 4]| {
            let [r, g, b] = [r, g, b].map(color::srgb_to_linear);
            self.texel([r, g, b, a])
        };
        // An 8-bit channel has few values, and channels are independent, so a table suffices.
        let texels: Vec<[f32; 4]> = if picture.is_srgb_by_custom && is_whole && rgba.len() > 256 {
            let table: Vec<[f32; 4]> = (0..=255u8).map(|v| of([f32::from(v) / 255.0; 4])).collect();
            let at = |v: f32| (v * 255.0).round() as usize;
            rgba.par_iter().map(|t| std::array::from_fn(|c| table[at(t[c])][c])).collect()
        } else {
            rgba.par_iter().map(|t| of(*t)).collect()
        };
        texels.into_flattened()
    }
}

/// Reads the maps of `material` for blending in `space`; counts their memory before allocation.
pub(super) fn maps(
    asset: &Asset,
    material: &gltf::Material<'_>,
    space: ColorSpace,
    (budget, made): (&mut MapBudget, &mut Made),
    notes: &mut Vec<String>,
) -> Result<Maps, Fault> {
    let at = place_of(material);
    if let Some(value) = material.extension_value(HYBRID) {
        let at = format!("{at}/extensions/{HYBRID}");
        let radiance: Radiance = from_value(value, &at, &format!("a material of {HYBRID}"))?;
        if parse_color_space(&radiance.color_space, &at)? != space {
            let at = format!("{at}/colorSpace");
            return Err(Fault::pointer(at, "the colour space of the scene", format!("`{}`", radiance.color_space)));
        }
        if let Some(harmonics) = &radiance.spherical_harmonics {
            let Some((key, token)) = unknown_choice(&radiance, harmonics) else {
                return exact(asset, &radiance, harmonics, &at, budget, notes);
            };
            let token = shown(token.as_bytes());
            notes.push(format!("{at}/{key}: {token} is unknown, the colour of the core material is used"));
        } else if radiance.opacity.is_some() {
            notes.push(format!(
                "{at}/opacity: not read without sphericalHarmonics, the opacity of the core material is used"
            ));
        }
    }
    base_colour(asset, material, (space, [1.0; 4]), (budget, made), notes)
}

/// Map of a core material multiplied by a colour common to all vertices, as described by [`Maps::base`].
pub(super) fn tinted(
    asset: &Asset,
    material: &gltf::Material<'_>,
    shown: (ColorSpace, [f32; 4]),
    counted: (&mut MapBudget, &mut Made),
) -> Result<Atlas, Fault> {
    // Notes have already been given for the maps without the colour.
    base_colour(asset, material, shown, counted, &mut vec![]).map(|maps| maps.atlas)
}

/// Place of a material, for messages.
fn place_of(material: &gltf::Material<'_>) -> String {
    material.index().map_or("the default material".to_owned(), |i| format!("/materials/{i}"))
}

/// Unknown choice of a material, and the property that makes it: the maps would then have another meaning.
fn unknown_choice<'a>(radiance: &'a Radiance, harmonics: &'a ShField) -> Option<(&'static str, &'a str)> {
    let opacity = radiance.opacity.as_ref().map(|field| ("opacity/activation", &*field.activation));
    let choices = opacity.into_iter().chain([("sphericalHarmonics/frame", &*harmonics.frame)]);
    let is_known = |key: &str, token: &str| match key {
        "opacity/activation" => ["none", "logistic"].contains(&token),
        _ => ["node", TRIANGLE].contains(&token),
    };
    choices.into_iter().find(|(key, token)| !is_known(key, token))
}

/// Name of the frame in which view dependence rotates with triangles.
const TRIANGLE: &str = "triangle";

/// Common texture coordinates of all texel sources of a material: those of the first one.
struct Coordinates<'a> {
    document: &'a gltf::Document,
    uv: UvMap,
    like: &'static str,
}

impl Coordinates<'_> {
    /// Rejects a source with other coordinates; true if its wrapping beyond the borders differs.
    fn check(&self, source: &TexelSource, at: &str) -> Result<bool, Fault> {
        let own = UvMap::of_source(self.document, source, at)?;
        if own.set != self.uv.set {
            let expected = format!("texCoord {}, as of {}", self.uv.set, self.like);
            return Err(Fault::pointer(at, expected, own.set.to_string()));
        }
        if own.transform != self.uv.transform {
            return Err(Fault::pointer(at, format!("the {TEXTURE_TRANSFORM} of {}", self.like), "another or none"));
        }
        Ok(own != self.uv)
    }
}

/// Reserves floats of maps at `at`.
fn spend(budget: &mut MapBudget, floats: usize, at: &str) -> Result<(), Fault> {
    budget.spend(floats as u64).map_err(|(expected, found)| Fault::pointer(at, expected, found))
}

/// Maps of the extension, all of whose choices are known.
fn exact(
    asset: &Asset,
    radiance: &Radiance,
    harmonics: &ShField,
    at: &str,
    budget: &mut MapBudget,
    notes: &mut Vec<String>,
) -> Result<Maps, Fault> {
    let at_sh = format!("{at}/sphericalHarmonics");
    let (degree, found) = (harmonics.degree, harmonics.coefficients.len());
    if degree > sh::MAX_DEGREE || found != sh::coefficients(degree) {
        let expected = "(degree+1)² coefficients of degree 0 to 3";
        return Err(Fault::pointer(&at_sh, expected, format!("{found} of degree {degree}")));
    }
    if harmonics.frame == TRIANGLE {
        notes.push(format!(
            "{at_sh}/frame: {TRIANGLE} is read as node, which differs where the mesh is skinned, deformed, mirrored or stretched"
        ));
    }
    let (document, first) = (&asset.document, format!("{at_sh}/coefficients/0"));
    let uv = UvMap::of_source(document, &harmonics.coefficients[0], &first)?;
    let coordinates = Coordinates { document, uv, like: "coefficient 0" };
    let mut planes = vec![];
    let mut borders_differ = false;
    for (i, source) in harmonics.coefficients.iter().enumerate() {
        let at = format!("{at_sh}/coefficients/{i}");
        borders_differ |= coordinates.check(source, &at)?;
        planes.push(plane::<3>(asset, source, &at, budget)?);
    }
    let dc = &planes[0];
    let logits = if let Some(field) = &radiance.opacity {
        let at = format!("{at}/opacity");
        borders_differ |= coordinates.check(&field.source, &at)?;
        let mut logits = plane::<1>(asset, &field.source, &at, budget)?;
        if field.activation != "logistic" {
            logits.values.iter_mut().for_each(|v| v[0] = activation::map_logit(v[0]));
        }
        if (logits.width, logits.height) != (dc.width, dc.height) {
            let found = format!("{}×{}", logits.width, logits.height);
            return Err(Fault::pointer(at, format!("the size of coefficient 0, {}×{}", dc.width, dc.height), found));
        }
        logits
    } else {
        spend(budget, dc.values.len(), at)?;
        Plane { width: dc.width, height: dc.height, values: vec![[activation::logit(1.0).0]; dc.values.len()] }
    };
    let texels = dc.values.iter().zip(&logits.values).flat_map(|(c, l)| [c[0], c[1], c[2], l[0]]).collect();
    let refused = |e| Fault::from(e).under(&at_sh);
    let base = Texture::new(dc.width, dc.height, 4, texels).map_err(refused)?;
    let bands = match planes.get(1) {
        None => None,
        Some(first) => {
            let (width, height) = (first.width, first.height);
            if let Some(other) = planes[1..].iter().find(|p| (p.width, p.height) != (width, height)) {
                let found = format!("{}×{}", other.width, other.height);
                return Err(Fault::pointer(at_sh, format!("bands of one size, {width}×{height}"), found));
            }
            let texels = (0..first.values.len()).flat_map(|i| planes[1..].iter().flat_map(move |p| p.values[i]));
            Some(Texture::new(width, height, 3 * (planes.len() - 1) as u32, texels.collect()).map_err(refused)?)
        }
    };
    if borders_differ {
        notes.push(format!("{at}: all maps use the wrap mode of the map of coefficient 0"));
    }
    Ok(Maps { atlas: Atlas::new(base, bands).map_err(refused)?, uv, base: None })
}

struct Plane<const N: usize> {
    width: u32,
    height: u32,
    values: Vec<[f32; N]>,
}

/// Values of a texel source with `N` (1 or 3) components: `offset + scale·texel`.
fn plane<const N: usize>(
    asset: &Asset,
    source: &TexelSource,
    at: &str,
    budget: &mut MapBudget,
) -> Result<Plane<N>, Fault> {
    let mut plane = match (source.accessor, &source.texture, source.width, source.height) {
        (Some(accessor), None, Some(width), Some(height)) => {
            let values = asset.floats::<N>(accessor)?;
            if values.len() as u64 != u64::from(width) * u64::from(height) {
                let found = format!("an accessor of {} elements", values.len());
                return Err(Fault::pointer(at, format!("{width}×{height} texels"), found));
            }
            if let Some((kind, false)) = asset.component(accessor).filter(|(kind, _)| *kind != DataType::F32) {
                let expected = format!("{N} component(s), of Float or a normalised type");
                return Err(Fault::pointer(format!("{at}/accessor"), expected, format!("{N} of {kind:?}")));
            }
            spend(budget, N * values.len(), at)?;
            Plane { width, height, values }
        }
        (None, Some(texture), ..) => {
            let Texels { width, height, rgba, encoded, .. } = asset.texels(texture.index)?;
            let first = if N == 1 { source.channel as usize } else { 0 };
            if first > 3 {
                return Err(Fault::pointer(format!("{at}/channel"), "0 to 3", first.to_string()));
            }
            budget.include(encoded);
            spend(budget, N * rgba.len(), at)?;
            let values = rgba.iter().map(|t| std::array::from_fn(|c| t[first + c])).collect();
            Plane { width, height, values }
        }
        _ => return Err(Fault::pointer(at, "an accessor with width and height, or a texture", "neither or both")),
    };
    let per_channel = |values: &Option<Vec<f32>>, default: f32, name: &str| match values.as_deref() {
        None => Ok([default; N]),
        Some([one]) => Ok([*one; N]),
        Some(all) => <[f32; N]>::try_from(all)
            .map_err(|_| Fault::pointer(format!("{at}/{name}"), format!("1 or {N} numbers"), all.len().to_string())),
    };
    if source.offset.is_some() || source.scale.is_some() {
        let (offset, scale) = (per_channel(&source.offset, 0.0, "offset")?, per_channel(&source.scale, 1.0, "scale")?);
        for v in &mut plane.values {
            *v = std::array::from_fn(|c| offset[c] + scale[c] * v[c]);
        }
    }
    Ok(plane)
}

/// Base colour of a core material.
struct Base {
    /// Name of the property, for messages.
    name: &'static str,
    factor: [f32; 4],
    picture: Option<Picture>,
}

/// Reference to an image: its place in the document, the index of its texture, and its UV mapping.
struct Picture {
    at: String,
    texture: usize,
    uv: UvMap,
}

impl Picture {
    /// Image of a core material.
    fn of(info: Option<gltf::texture::Info<'_>>, at: String) -> Result<Option<Self>, Fault> {
        let Some(info) = info else { return Ok(None) };
        Ok(Some(Self { texture: info.texture().index(), uv: UvMap::of(&info, &at)?, at }))
    }
}

impl Base {
    /// Diffuse colour of `KHR_materials_pbrSpecularGlossiness`, or the core's base colour.
    fn of(document: &gltf::Document, material: &gltf::Material<'_>) -> Result<Self, Fault> {
        let at = place_of(material);
        let Some(value) = material.extension_value(SPECULAR_GLOSSINESS) else {
            let pbr = material.pbr_metallic_roughness();
            let picture = Picture::of(pbr.base_color_texture(), format!("{at}/pbrMetallicRoughness/baseColorTexture"))?;
            return Ok(Self { name: "base colour", factor: pbr.base_color_factor(), picture });
        };
        let at = format!("{at}/extensions/{SPECULAR_GLOSSINESS}");
        let extension: SpecularGlossiness = from_value(value, &at, &format!("an object of {SPECULAR_GLOSSINESS}"))?;
        let picture = extension.diffuse_texture.map(|texture| -> Result<Picture, Fault> {
            let at = format!("{at}/diffuseTexture");
            let uv = UvMap::of_texture(document, &texture, &at)?;
            Ok(Picture { at, texture: texture.index, uv })
        });
        Ok(Self { name: "diffuse colour", factor: extension.diffuse_factor, picture: picture.transpose()? })
    }
}

/// Emission of a core material in linear light, if that is what it shows: its base colour is black, or has no image
/// while emission has one. `None`: the base colour is shown.
fn emission(material: &gltf::Material<'_>, colour: [f32; 3], has_picture: bool) -> Option<[f32; 3]> {
    let strength = material.extension_value(EMISSIVE_STRENGTH).and_then(|e| e.get("emissiveStrength")?.as_f64());
    let light = material.emissive_factor().map(|v| v * strength.unwrap_or(1.0) as f32);
    let is_black = colour == [0.0; 3];
    let is_only_picture = material.emissive_texture().is_some() && !has_picture;
    let is_lit = material.extension_value(UNLIT).is_none() && light.iter().any(|&v| v > 0.0);
    (is_lit && (is_black || is_only_picture)).then_some(light)
}

/// Maps made so far, keyed by image, factor and cut-off: materials of one file often share images.
pub(super) type Made = HashMap<(Identity, [u32; 4], Option<u32>), Atlas>;

/// Decoded image and its UV mapping.
type Placed = (Texels, UvMap);

/// Adds a note if the sampler of a texture of `texels` texels asks for NEAREST filtering, which is read as linear.
fn note_nearest(asset: &Asset, texture: usize, texels: usize, notes: &mut Vec<String>) {
    let sampler = asset.document.textures().nth(texture).map(|t| t.sampler());
    let is_nearest = sampler.and_then(|s| s.mag_filter()) == Some(MagFilter::Nearest);
    let note = format!("/textures/{texture}: its sampler's NEAREST is read as linear filtering");
    if is_nearest && texels > 1 && !notes.contains(&note) {
        notes.push(note);
    }
}

/// Image of a core material; `None`, with a note, if it is unavailable: the rest can be shown without it.
fn placed(asset: &Asset, picture: Option<Picture>, notes: &mut Vec<String>) -> Option<Placed> {
    let file = asset.encoded(picture.as_ref()?.texture);
    placed_from(asset, picture?, file, notes)
}

/// Image of a core material, from a file that has been looked up.
fn placed_from(
    asset: &Asset,
    Picture { at, texture, uv }: Picture,
    file: Result<(String, Vec<u8>), Fault>,
    notes: &mut Vec<String>,
) -> Option<Placed> {
    match file.and_then(texels) {
        Ok(texels) => {
            note_nearest(asset, texture, texels.rgba.len(), notes);
            Some((texels, uv))
        }
        Err(fault) => {
            notes.push(format!("{at}: left out: {fault}"));
            None
        }
    }
}

/// Colours of `light`, which has no alpha, with the alpha of `cover`; `None` if neither is an image.
fn covered(light: Option<Placed>, cover: Option<Placed>, at: &str, notes: &mut Vec<String>) -> Option<Placed> {
    let Some((mut texels, uv)) = light else {
        let (mut texels, uv) = cover?;
        texels.rgba.iter_mut().for_each(|[r, g, b, _]| (*r, *g, *b) = (1.0, 1.0, 1.0));
        return Some((texels, uv));
    };
    texels.rgba.iter_mut().for_each(|texel| texel[3] = 1.0);
    match cover {
        Some((alpha, place)) if (place, alpha.width, alpha.height) == (uv, texels.width, texels.height) => {
            texels.rgba.iter_mut().zip(&alpha.rgba).for_each(|(texel, alpha)| texel[3] = alpha[3]);
        }
        Some(_) => notes.push(format!(
            "{at}: its opacity map has another size or other texture coordinates than its emission map and is left out"
        )),
        None => {}
    }
    Some((texels, uv))
}

/// Base colour or emission of a core material, as maps of degree 0 for blending in this space, multiplied by a vertex
/// colour in linear light.
fn base_colour(
    asset: &Asset,
    material: &gltf::Material<'_>,
    (space, tint): (ColorSpace, [f32; 4]),
    (budget, made): (&mut MapBudget, &mut Made),
    notes: &mut Vec<String>,
) -> Result<Maps, Fault> {
    let at = place_of(material);
    let Base { name, factor: [r, g, b, alpha], picture } = Base::of(&asset.document, material)?;
    let emission = emission(material, [r, g, b], picture.is_some());
    // Maps are unlit; they cannot represent lighting and specular reflection.
    if material.extension_value(UNLIT).is_none() {
        let what = if emission.is_some() { "emission" } else { name };
        notes.push(format!("{at}: only its {what} is shown, unlit"));
    }
    let [r, g, b] = emission.unwrap_or([r, g, b]);
    let factor = [r, g, b, alpha];
    let mut base = BaseColour {
        factor: std::array::from_fn(|c| factor[c] * tint[c]),
        cutoff: match material.alpha_mode() {
            AlphaMode::Opaque => None,
            AlphaMode::Blend => Some(0.0),
            // A cut-off of 0 keeps everything.
            AlphaMode::Mask => Some(material.alpha_cutoff().unwrap_or(0.5)).filter(|&c| c > 0.0),
        },
        space,
        is_textured: true,
    };
    let mut key = None;
    let picture = match (emission, picture) {
        (None, None) => None,
        (None, Some(picture)) => {
            let file = asset.encoded(picture.texture);
            let image = file.as_ref().ok().map(|(_, encoded)| identity(encoded));
            key = image.map(|image| (image, base.factor.map(f32::to_bits), base.cutoff.map(f32::to_bits)));
            if let Some(atlas) = key.and_then(|key| made.get(&key)) {
                note_nearest(asset, picture.texture, atlas.floats() / 4, notes);
                return Ok(Maps { atlas: atlas.clone(), uv: picture.uv, base: Some(base) });
            }
            placed_from(asset, picture, file, notes)
        }
        (Some(_), picture) => {
            let cover = picture.filter(|_| material.alpha_mode() != AlphaMode::Opaque);
            let cover = placed(asset, cover, notes);
            let light = Picture::of(material.emissive_texture(), format!("{at}/emissiveTexture"))?;
            covered(placed(asset, light, notes), cover, &at, notes)
        }
    };
    base.is_textured = picture.is_some();
    // Many maps may come from one image.
    picture.iter().for_each(|(texels, _)| budget.include(texels.encoded));
    let (texels, uv) = picture.unwrap_or_else(|| {
        let white = Texels { width: 1, height: 1, rgba: vec![[1.0; 4]], is_srgb_by_custom: true, encoded: (0, 0) };
        (white, UvMap::plain(0))
    });
    spend(budget, 4 * texels.rgba.len(), &at)?;
    let atlas = Texture::new(texels.width, texels.height, 4, base.texels(&texels, emission.is_none()))
        .and_then(|base| Atlas::new(base, None));
    let atlas = atlas.map_err(|e| Fault::from(e).under(at))?;
    made.extend(key.filter(|_| base.is_textured).map(|key| (key, atlas.clone())));
    // Vertex colours do not affect emission.
    let of_vertices = emission.is_none().then_some(base);
    Ok(Maps { atlas, uv, base: of_vertices })
}
