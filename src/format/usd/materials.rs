//! Conversion of materials to maps: exact ones from our own files, otherwise the colour and opacity of
//! `UsdPreviewSurface`.

use glam::{Mat2, Vec2};
use gltf::texture::WrappingMode;

use super::Breach;
use super::document::Value;
use super::inherited::{COLORS, OPACITIES};
use super::maps::{self, Mismatch};
use super::names;
use super::package::Place;
use super::primvar::Means;
use super::stage::{Placed, Source, Stage};
use crate::format::activation;
use crate::format::error::Fault;
use crate::format::gltf::{Texels, Unrolling, UvMap, decode};
use crate::format::map_budget::{Identity, MapBudget};
use crate::scene::{Atlas, ColorSpace, Texture, color, sh};

/// Context for reading maps of the meshes of one stage.
pub(super) struct Materials<'a> {
    /// Location of the files.
    pub(super) place: &'a mut Place,
    /// Colour space in which maps are blended.
    pub(super) space: ColorSpace,
    /// Unrolling of repeated images.
    pub(super) unrolling: Unrolling,
    /// Budget for the maps of all meshes.
    budget: MapBudget,
    /// Colours and opacities of meshes without a shader.
    colors: Means<3>,
    opacities: Means<1>,
}

/// Value over a surface: RGB, or one number three times.
struct Picture {
    width: u32,
    height: u32,
    texels: Vec<[f32; 3]>,
    /// Texture coordinates; `None` if the value is constant.
    coordinates: Option<Coordinates>,
    /// Identity of the encoded image.
    encoded: Option<Identity>,
}

/// Texture coordinates of an image on a surface.
#[derive(Clone)]
pub(super) struct Coordinates {
    /// Primvar with the texture coordinates.
    pub(super) primvar: String,
    /// Mapping of the coordinates, v downwards as everywhere in this crate.
    pub(super) map: UvMap,
    /// Whether the image is black beyond its borders, horizontally and vertically.
    is_black_beyond: [bool; 2],
}

impl Coordinates {
    /// Default texture coordinates.
    fn plain() -> Self {
        Self { primvar: ST.to_owned(), map: UvMap::plain(0), is_black_beyond: [false; 2] }
    }

    /// Whether these corners reach to where the image is black, beyond its borders.
    pub(super) fn leave_the_image(&self, corners: &[[Vec2; 3]]) -> bool {
        let is_beyond = |v: f32| !(-ROUNDING..=1.0 + ROUNDING).contains(&v);
        [0, 1]
            .into_iter()
            .filter(|&axis| self.is_black_beyond[axis])
            .any(|axis| corners.as_flattened().iter().any(|uv| is_beyond(uv[axis])))
    }

    /// Whether they are taken from the same place in the same way.
    fn agree(&self, other: &Self) -> bool {
        (&self.primvar, self.map) == (&other.primvar, other.map)
    }

    /// Texture coordinates of a `UsdUVTexture`: a primvar, via any number of `UsdTransform2d`.
    fn of(stage: &Stage<'_>, texture: usize) -> Self {
        // The image may state a mode, but those that are read here do not: without one, it is black.
        let modes = ["inputs:wrapS", "inputs:wrapT"].map(|name| stage.text(texture, name).unwrap_or("useMetadata"));
        let wrap = modes.map(|mode| match mode {
            "repeat" => WrappingMode::Repeat,
            "mirror" => WrappingMode::MirroredRepeat,
            _ => WrappingMode::ClampToEdge,
        });
        let (mut linear, mut offset) = (Mat2::IDENTITY, Vec2::ZERO);
        let mut source = stage.input(texture, "inputs:st");
        for _ in 0..MOST_TRANSFORMS {
            let Some(Source::Output { prim, .. }) = source else { break };
            if stage.text(prim, "info:id") != Some("UsdTransform2d") {
                break;
            }
            let [scale, translation] = [("inputs:scale", 1.0), ("inputs:translation", 0.0)].map(|(name, default)| {
                Vec2::from(stage.numbers::<2>(prim, name).unwrap_or([default; 2]).map(|v| v as f32))
            });
            let angle = stage.number(prim, "inputs:rotation").unwrap_or(0.0).to_radians() as f32;
            offset += linear * translation;
            linear *= Mat2::from_angle(angle) * Mat2::from_diagonal(scale);
            source = stage.input(prim, "inputs:in");
        }
        let varname = match source {
            Some(Source::Output { prim, .. }) => stage.input(prim, "inputs:varname"),
            _ => None,
        };
        let primvar = match varname {
            Some(Source::Value(name)) => name.as_text().unwrap_or(ST),
            _ => ST,
        };
        // USD has v upwards: flip, transform, flip back.
        let over = Mat2::from_diagonal(Vec2::new(1.0, -1.0));
        let transform = (over * linear * over, over * (linear * Vec2::Y + offset) + Vec2::Y);
        let is_black_beyond = modes.map(|mode| matches!(mode, "black" | "useMetadata"));
        Self { primvar: primvar.to_owned(), map: UvMap::new(transform, wrap), is_black_beyond }
    }
}

/// Tolerance, in images, by which coordinates may pass the border of one and still belong to it.
const ROUNDING: f32 = 1e-3;

/// Upper bound on chained transforms of texture coordinates.
const MOST_TRANSFORMS: usize = 16;

/// Default primvar of texture coordinates.
const ST: &str = "st";

impl Picture {
    fn constant(value: [f32; 3]) -> Self {
        Self { width: 1, height: 1, texels: vec![value], coordinates: None, encoded: None }
    }

    /// Texel at the place of texel (x, y) of an image of another size.
    fn at(&self, x: u32, y: u32, [width, height]: [u32; 2]) -> [f32; 3] {
        let scaled = |i: u32, from: u32, to: u32| (u64::from(i) * u64::from(to) / u64::from(from)) as usize;
        self.texels[scaled(y, height, self.height) * self.width as usize + scaled(x, width, self.width)]
    }
}

/// Names of the inputs of a `UsdPreviewSurface`.
const EMISSION: &str = "inputs:emissiveColor";
const DIFFUSE: &str = "inputs:diffuseColor";

impl<'a> Materials<'a> {
    pub(super) fn new(place: &'a mut Place, space: ColorSpace) -> Self {
        let (colors, opacities) = (Means::new(COLORS), Means::new(OPACITIES));
        Self { place, space, unrolling: Unrolling::default(), budget: MapBudget::new(0), colors, opacities }
    }

    /// Maps of the faces of a mesh with one material, and their mapping to it.
    pub(super) fn atlas(
        &mut self,
        stage: &Stage<'_>,
        mesh: &Placed,
        material: Option<usize>,
        notes: &mut Vec<String>,
    ) -> Result<(Atlas, Coordinates), Fault> {
        match self.exact(stage, mesh.prim) {
            None => {}
            Some(Ok(atlas)) => return Ok((atlas, Coordinates::plain())),
            Some(Err(Fault { location, expected, found })) => {
                notes.push(format!(
                    "{location}the maps cannot be read, those of the material are shown instead: expected {expected}, found {found}"
                ));
            }
        }
        let Some(shader) = material.and_then(|material| preview_surface(stage, material)) else {
            return Ok((self.displayed(stage, mesh, notes)?, Coordinates::plain()));
        };
        let path = stage.path(shader);
        let is_picture = |name: &'static str| matches!(stage.input(shader, name), Some(Source::Output { .. }));
        let emits = match stage.input(shader, EMISSION) {
            None => false,
            Some(Source::Output { .. }) => true,
            Some(Source::Value(value)) => value.as_numbers().unwrap_or_default().iter().any(|&v| v > 0.0),
        };
        // Surfaces that emit only in places, but have an image of their diffuse colour, are shown by that colour.
        let (input, what) = if emits && !is_picture(DIFFUSE) { (EMISSION, "emissive") } else { (DIFFUSE, "diffuse") };
        notes.push(format!("{path}: only its {what} colour is shown, unlit"));
        let color = self.picture(stage, shader, input, [0.18; 3], true, notes)?;
        let mut opacity = self.picture(stage, shader, "inputs:opacity", [1.0; 3], false, notes)?;
        let threshold = stage.number(shader, "inputs:opacityThreshold").unwrap_or(0.0) as f32;
        if threshold > 0.0 {
            opacity.texels.iter_mut().for_each(|t| *t = t.map(|a| f32::from(a >= threshold)));
        }
        let atlas = self.joined(&color, &opacity, &path)?;
        let coordinates = match (color.coordinates, opacity.coordinates) {
            (Some(of_color), Some(of_opacity)) => {
                if !of_color.agree(&of_opacity) {
                    notes.push(format!("{path}: its opacity uses the texture coordinates of its colour, not its own"));
                }
                let [s, t] = of_opacity.is_black_beyond;
                let is_black_beyond = [of_color.is_black_beyond[0] || s, of_color.is_black_beyond[1] || t];
                Coordinates { is_black_beyond, ..of_color }
            }
            (of_color, of_opacity) => of_color.or(of_opacity).unwrap_or_else(Coordinates::plain),
        };
        Ok((atlas, coordinates))
    }

    /// Exact maps, if the mesh refers to them.
    fn exact(&mut self, stage: &Stage<'_>, mesh: usize) -> Option<Result<Atlas, Fault>> {
        let base = stage.text(mesh, names::BASE_MAP)?;
        let bands = stage.text(mesh, names::BANDS_MAP);
        let fault = |name: &str, (expected, found): Mismatch| {
            Fault::pointer(format!("{}.{name}", stage.path(mesh)), expected, found)
        };
        let mut read = |name: &str, path: &str| {
            let content = self.place.read(path);
            let map = content.and_then(|exr| maps::from_exr(&exr, name == names::BASE_MAP, &mut self.budget));
            map.map_err(|e| fault(name, e))
        };
        let mut atlas = || {
            let base = read(names::BASE_MAP, base)?;
            let bands = bands.map(|path| read(names::BANDS_MAP, path)).transpose()?;
            Atlas::new(base, bands).map_err(|e| fault(names::BANDS_MAP, (e.expected, e.found)))
        };
        Some(atlas())
    }

    /// Maps of a mesh without a shader: one texel of the mean of its colours and opacities.
    fn displayed(&mut self, stage: &Stage<'_>, mesh: &Placed, notes: &mut Vec<String>) -> Result<Atlas, Fault> {
        let (colors, opacities) = (self.colors.of(stage, mesh)?, self.opacities.of(stage, mesh)?);
        let differ = colors.is_some_and(|(_, differ)| differ) || opacities.is_some_and(|(_, differ)| differ);
        let (at, which) = (stage.path(mesh.prim), if differ { ", the mean of several" } else { "" });
        notes.push(format!("{at}: has no UsdPreviewSurface and is shown in one colour{which}"));
        let color = Picture::constant(colors.map_or([0.5; 3], |(rgb, _)| self.space.from_linear(rgb)));
        let opacity = Picture::constant(opacities.map_or([1.0; 3], |([a], _)| [a; 3]));
        self.joined(&color, &opacity, &at)
    }

    /// Maps of degree 0 at the larger of both sizes, for a prim at `at`.
    fn joined(&mut self, color: &Picture, opacity: &Picture, at: &str) -> Result<Atlas, Fault> {
        let size @ [width, height] = [color.width.max(opacity.width), color.height.max(opacity.height)];
        let pixels = u64::from(width) * u64::from(height);
        [color, opacity].iter().filter_map(|picture| picture.encoded).for_each(|image| self.budget.include(image));
        self.budget.spend(4 * pixels).map_err(|(expected, found)| Fault::pointer(at, expected, found))?;
        let texel = |i: u64| {
            let (x, y) = ((i % u64::from(width)) as u32, (i / u64::from(width)) as u32);
            let [r, g, b] = sh::dc_from_rgb(color.at(x, y, size));
            [r, g, b, activation::map_logit(opacity.at(x, y, size)[0])]
        };
        Ok(Atlas::new(Texture::new(width, height, 4, (0..pixels).flat_map(texel).collect())?, None)?)
    }

    /// Displayed value of a shader input: a colour in the blending space, or a number. An unavailable image is
    /// replaced, with a note, by the texture's fallback or the default.
    fn picture(
        &mut self,
        stage: &Stage<'_>,
        shader: usize,
        input: &'static str,
        default: [f32; 3],
        is_color: bool,
        notes: &mut Vec<String>,
    ) -> Result<Picture, Fault> {
        let space = self.space;
        let shown = |rgb: [f32; 3]| if is_color { space.from_linear(rgb) } else { rgb };
        let (texture, output) = match stage.input(shader, input) {
            Some(Source::Output { prim, name }) => (prim, name),
            Some(Source::Value(value)) => {
                let value = match value.as_numbers().as_deref() {
                    Some(&[v]) => [v as f32; 3],
                    Some(&[r, g, b]) => [r, g, b].map(|v| v as f32),
                    _ => default,
                };
                return Ok(Picture::constant(shown(value)));
            }
            None => return Ok(Picture::constant(shown(default))),
        };
        let at = stage.path(texture);
        let mut without = |what: &str| {
            notes.push(format!("{at}: {what}, replaced by a constant {input}"));
            Ok(Picture::constant(shown(default)))
        };
        let id = stage.text(texture, "info:id").unwrap_or("without an info:id");
        if id != "UsdUVTexture" {
            return without(&format!("a shader other than UsdUVTexture, {id}"));
        }
        let Some(Source::Value(Value::Asset(file))) = stage.input(texture, "inputs:file") else {
            return without("a texture without an image");
        };
        let channels = match output.strip_prefix("outputs:").unwrap_or_default() {
            "r" => [0; 3],
            "g" => [1; 3],
            "b" => [2; 3],
            "a" => [3; 3],
            _ => [0, 1, 2],
        };
        let texels = match self.place.read(file).and_then(decode) {
            Ok(texels) => texels,
            Err((expected, found)) => {
                notes.push(format!("{at}.inputs:file is left out: expected {expected}, found {found}"));
                let stated = stage.numbers::<4>(texture, "inputs:fallback");
                return Ok(Picture::constant(shown(stated.map_or(default, |v| channels.map(|c| v[c] as f32)))));
            }
        };
        let Texels { width, height, rgba, is_srgb_by_custom, encoded: identity } = texels;
        // `auto` means sRGB for 8-bit colour images; alpha is always linear.
        let stated = stage.text(texture, "inputs:sourceColorSpace").unwrap_or("auto");
        let is_srgb = stated == "sRGB" || stated == "auto" && is_color && is_srgb_by_custom;
        let [scale, bias] = [("inputs:scale", 1.0), ("inputs:bias", 0.0)]
            .map(|(name, default)| stage.numbers::<4>(texture, name).unwrap_or([default; 4]).map(|v| v as f32));
        let is_plain = (scale, bias) == ([1.0; 4], [0.0; 4]);
        let encoded = is_color && is_srgb && is_plain && space == ColorSpace::SrgbDisplay;
        let value = |texel: &[f32; 4]| {
            let stored = channels.map(|c| texel[c]);
            if encoded {
                return stored;
            }
            let linear = channels.map(|c| {
                let v = if is_srgb && c < 3 { color::srgb_to_linear(texel[c]) } else { texel[c] };
                v * scale[c] + bias[c]
            });
            shown(linear)
        };
        Ok(Picture {
            width,
            height,
            texels: rgba.iter().map(value).collect(),
            coordinates: Some(Coordinates::of(stage, texture)),
            encoded: Some(identity),
        })
    }
}

/// Fault that prevents reading the maps to which a mesh refers; its material is then shown instead.
pub(super) fn check(stage: &Stage<'_>, mesh: usize, materials: &mut Materials<'_>) -> Option<Breach> {
    let fault = materials.exact(stage, mesh)?.err()?;
    Some(Breach { code: "USD_MAP", is_error: true, fault })
}

/// Shader connected to the surface output of a material.
fn preview_surface(stage: &Stage<'_>, material: usize) -> Option<usize> {
    let Some(Source::Output { prim, .. }) = stage.input(material, "outputs:surface") else { return None };
    (stage.text(prim, "info:id") == Some("UsdPreviewSurface")).then_some(prim)
}
