//! Typed JSON structures of the two extensions, the only place where their names and keys occur. Schemas and their
//! prose are in `schema/EXT_gaussian_splatting_hybrid`.

use std::collections::BTreeMap;

use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::format::error::{Fault, shown};
use crate::scene::{ColorSpace, Composition, OrderMode, PixelFilter};

/// Extension for splats as a POINTS primitive.
pub(crate) const KHR_SPLATS: &str = "KHR_gaussian_splatting";
/// Extension that combines meshes and splats to one scene. Not yet registered; to rename it, change this constant.
pub(crate) const HYBRID: &str = "EXT_gaussian_splatting_hybrid";
/// Extension of the mesh material that serves as fallback for core viewers.
pub(crate) const UNLIT: &str = "KHR_materials_unlit";
pub(super) const EMISSIVE_STRENGTH: &str = "KHR_materials_emissive_strength";
/// Extension with a base colour by another name, in files that predate the core's. Archived by Khronos.
pub(super) const SPECULAR_GLOSSINESS: &str = "KHR_materials_pbrSpecularGlossiness";
/// Extension for splats compressed by SPZ, within the object of [`KHR_SPLATS`]. A Khronos draft.
pub(crate) const SPZ: &str = "KHR_gaussian_splatting_compression_spz_2";
/// Extension for scaled, rotated and shifted texture coordinates.
pub(crate) const TEXTURE_TRANSFORM: &str = "KHR_texture_transform";
/// Extension for images in `WebP`.
pub(crate) const WEBP: &str = "EXT_texture_webp";

/// Extension for instances of a mesh at one node.
pub(crate) const INSTANCING: &str = "EXT_mesh_gpu_instancing";
/// Extension for animations of properties other than those of nodes.
pub(crate) const ANIMATION_POINTER: &str = "KHR_animation_pointer";
/// Extension for hidden nodes.
pub(super) const VISIBILITY: &str = "KHR_node_visibility";

/// Name of the root node of the whole scene, and key of our own `extras`.
pub(crate) const ROOT_NODE: &str = "centaur_world";
pub(crate) const EXTRAS: &str = "centaur";

/// Name of nodes inserted above the scene of a document to transform it.
pub(crate) const MOVED_NODE: &str = "moved";

pub(crate) const ROTATION: &str = "KHR_gaussian_splatting:ROTATION";
pub(crate) const SCALE: &str = "KHR_gaussian_splatting:SCALE";
/// Names of these attributes in early drafts.
pub(super) const DRAFT_ROTATION: &str = "_ROTATION";
pub(super) const DRAFT_SCALE: &str = "_SCALE";
pub(crate) const OPACITY: &str = "KHR_gaussian_splatting:OPACITY";

/// `extensions.name` of an object.
pub(crate) fn extension_of<'a>(object: &'a Value, name: &str) -> Option<&'a Value> {
    object.get("extensions")?.get(name)
}

/// JSON pointer to the property that an animation channel animates by [`ANIMATION_POINTER`].
pub(crate) fn animated_property(channel: &Value) -> Option<&str> {
    extension_of(channel.get("target")?, ANIMATION_POINTER)?.get("pointer")?.as_str()
}

/// Attribute names of SH coefficients 0..(d+1)², in the order of `scene::sh::basis`.
pub(crate) fn sh_attributes(degree: u32) -> impl Iterator<Item = String> {
    (0..=degree).flat_map(|l| (0..=2 * l).map(move |m| format!("{KHR_SPLATS}:SH_DEGREE_{l}_COEF_{m}")))
}

/// `mesh.primitive.extensions.KHR_gaussian_splatting`.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Khr {
    /// Required, like the colour space; early drafts had neither.
    pub(crate) kernel: Option<String>,
    pub(crate) color_space: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) projection: Option<String>,
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub(crate) extensions: serde_json::Map<String, Value>,
}

/// `KHR_gaussian_splatting.extensions.KHR_gaussian_splatting_compression_spz_2`.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Spz {
    pub(crate) buffer_view: usize,
}

/// Used properties of `material.extensions.KHR_materials_pbrSpecularGlossiness`.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct SpecularGlossiness {
    #[serde(default = "white")]
    pub(super) diffuse_factor: [f32; 4],
    pub(super) diffuse_texture: Option<TextureRef>,
}

fn white() -> [f32; 4] {
    [1.0; 4]
}

/// `node.extensions.EXT_mesh_gpu_instancing`.
#[derive(Deserialize)]
pub(super) struct Instancing {
    /// Accessors with one element per instance.
    pub(super) attributes: BTreeMap<String, usize>,
}

/// `textureInfo.extensions.KHR_texture_transform`.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
pub(crate) struct TextureTransform {
    pub(crate) offset: [f32; 2],
    pub(crate) rotation: f32,
    pub(crate) scale: [f32; 2],
    pub(crate) tex_coord: Option<u32>,
}

impl Default for TextureTransform {
    fn default() -> Self {
        Self { offset: [0.0; 2], rotation: 0.0, scale: [1.0; 2], tex_coord: None }
    }
}

/// `scene.extensions.EXT_gaussian_splatting_hybrid`.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct SceneContract {
    pub(crate) color_space: String,
    #[serde(default = "view_z")]
    pub(crate) sort_key: String,
    #[serde(default = "stable")]
    pub(crate) mode: String,
    /// Absent means infinite, which JSON cannot represent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) lambda: Option<f32>,
    #[serde(default = "one")]
    pub(crate) layers: u32,
    #[serde(default)]
    pub(crate) background: [f32; 3],
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) near: Option<f32>,
    #[serde(default, skip_serializing_if = "Footprint::is_usual")]
    pub(crate) footprint: Footprint,
}

/// Widening of projections: [`PixelFilter`].
#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct Footprint {
    variance: f32,
    normalized: bool,
}

impl Default for Footprint {
    fn default() -> Self {
        PixelFilter::default().into()
    }
}

impl From<PixelFilter> for Footprint {
    fn from(PixelFilter { variance, normalized }: PixelFilter) -> Self {
        Self { variance, normalized }
    }
}

impl Footprint {
    fn is_usual(&self) -> bool {
        *self == Self::default()
    }
}

fn view_z() -> String {
    "viewZ".to_owned()
}

fn stable() -> String {
    "stable".to_owned()
}

fn one() -> u32 {
    1
}

/// `material.extensions.EXT_gaussian_splatting_hybrid`.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Radiance {
    pub(crate) color_space: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) opacity: Option<OpacityField>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) spherical_harmonics: Option<ShField>,
}

#[derive(Serialize, Deserialize)]
pub(crate) struct OpacityField {
    #[serde(flatten)]
    pub(crate) source: TexelSource,
    /// Activation applied after texture filtering: `none` or `logistic`.
    #[serde(default = "none")]
    pub(crate) activation: String,
}

fn none() -> String {
    "none".to_owned()
}

#[derive(Serialize, Deserialize)]
pub(crate) struct ShField {
    pub(crate) degree: u32,
    #[serde(default = "node")]
    pub(crate) frame: String,
    pub(crate) coefficients: Vec<TexelSource>,
}

fn node() -> String {
    "node".to_owned()
}

/// Field over UV space: `accessor` with `width` and `height`, or `texture`.
#[derive(Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct TexelSource {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) accessor: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) width: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) height: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) sampler: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) texture: Option<TextureRef>,
    #[serde(default, skip_serializing_if = "is_zero")]
    pub(crate) tex_coord: u32,
    #[serde(default, skip_serializing_if = "is_zero")]
    pub(crate) channel: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) offset: Option<Vec<f32>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) scale: Option<Vec<f32>>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct TextureRef {
    pub(crate) index: usize,
    #[serde(default)]
    pub(crate) tex_coord: u32,
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    pub(crate) extensions: serde_json::Map<String, Value>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde's signature")]
fn is_zero(n: &u32) -> bool {
    *n == 0
}

/// `mesh.primitive.extensions.EXT_gaussian_splatting_hybrid` of a triangle primitive.
#[derive(Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct Surface {
    /// Accessor: for each glTF vertex, the vertex of the surface (before it was split at UV seams).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) surface_vertices: Option<usize>,
    /// Accessor: key times of `translations`, in seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) times: Option<usize>,
    /// Accessor: displacement added to POSITION at each key time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) translations: Option<usize>,
    /// `LINEAR` or `STEP`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) interpolation: Option<String>,
}

/// `KHR_gaussian_splatting.extensions.EXT_gaussian_splatting_hybrid`.
#[derive(Deserialize)]
pub(crate) struct SplatExtension {
    pub(crate) binding: Option<BindingObject>,
    /// Deformation field of the splats, which is not played.
    pub(crate) deformation: Option<IgnoredAny>,
}

/// Binding of the splats to the triangles below a node.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct BindingObject {
    pub(crate) node: usize,
    #[serde(default)]
    pub(crate) primitive: usize,
    pub(crate) triangle_count: usize,
    pub(crate) geometry_digest: Option<String>,
    pub(crate) triangles: usize,
    pub(crate) translations: usize,
    pub(crate) rotations: usize,
    pub(crate) scales: usize,
    #[serde(default = "edge_normal")]
    pub(crate) frame: String,
    #[serde(default = "node")]
    pub(crate) spherical_harmonics_frame: String,
}

fn edge_normal() -> String {
    "edgeNormal".to_owned()
}

/// `camera.extras.centaur`: camera parameters that a glTF camera cannot express.
#[derive(Serialize, Deserialize)]
pub(crate) struct ExactCamera {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) fx: f64,
    pub(crate) fy: f64,
    pub(crate) cx: f64,
    pub(crate) cy: f64,
    /// World→camera rotation, row-major; `OpenCV` axes, frame of the capture. Without rotation or translation, the
    /// node's transform applies.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) rotation: Option<[f64; 9]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) translation: Option<[f64; 3]>,
}

pub(crate) fn parse_color_space(token: &str, at: &str) -> Result<ColorSpace, Fault> {
    let named = ColorSpace::ALL.into_iter().find(|space| space.name() == token);
    named.ok_or_else(|| {
        let expected = ColorSpace::ALL.map(ColorSpace::name).join(" or ");
        Fault::pointer(format!("{at}/colorSpace"), expected, format!("`{token}`"))
    })
}

impl SceneContract {
    pub(crate) fn new(c: &Composition) -> Self {
        Self {
            color_space: c.color_space.name().to_owned(),
            sort_key: view_z(),
            mode: c.mode.name().to_owned(),
            lambda: c.lambda.is_finite().then_some(c.lambda),
            layers: c.layers,
            background: c.background,
            near: Some(c.near),
            footprint: c.pixel_filter.into(),
        }
    }

    /// Converts to a composition. `at` is the JSON pointer of this object; `near` applies to scenes that leave the near
    /// plane to their cameras. Unknown choices are replaced by defaults, with a note.
    pub(crate) fn composition(&self, at: &str, near: f32, notes: &mut Vec<String>) -> Result<Composition, Fault> {
        let mode = OrderMode::ALL.into_iter().find(|mode| mode.name() == self.mode);
        let mut note_unknown = |key: &str, token: &str, default: &str| {
            let token = shown(token.as_bytes());
            notes.push(format!("{at}/{key}: {token} is unknown, the default {default} is used"));
        };
        if mode.is_none() {
            note_unknown("mode", &self.mode, &stable());
        }
        if self.sort_key != view_z() {
            note_unknown("sortKey", &self.sort_key, &view_z());
        }
        let composition = Composition {
            mode: mode.unwrap_or(OrderMode::Stable),
            lambda: self.lambda.unwrap_or(f32::INFINITY),
            layers: self.layers,
            color_space: parse_color_space(&self.color_space, at)?,
            background: self.background,
            near: self.near.unwrap_or(near),
            pixel_filter: PixelFilter { variance: self.footprint.variance, normalized: self.footprint.normalized },
        };
        composition.validate().map_err(|e| {
            let field = e.field.replace("pixel_filter.", "footprint/");
            Fault::pointer(format!("{at}/{field}"), e.expected, e.found)
        })?;
        Ok(composition)
    }
}
