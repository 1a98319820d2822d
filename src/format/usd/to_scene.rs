//! Conversion of a layer to a hybrid scene.

use std::collections::BTreeMap;

use glam::{DMat4, DVec3};

use super::compose::OUTWARD;
use super::document::{Layer, Prim, Property, PropertyKind, Specifier, Value, field};
use super::inherited::{BIND_TRANSFORM, Constants, JOINTS};
use super::materials::Materials;
use super::package::Place;
use super::primvar::holder;
use super::stage::{Placed, Stage};
use super::{foreign, frame, names, splats, surfaces, views, xform};
use crate::format::activation::layers;
use crate::format::cameras::short;
use crate::format::content::Content;
use crate::format::error::Fault;
use crate::format::gltf::extension::parse_color_space;
use crate::format::placed::{self, NOT_DRAWN, join};
use crate::scene::frame::HALF_TURN;
use crate::scene::{ColorSpace, Composition, HybridScene, OrderMode, PixelFilter};

/// Type name of splats.
pub(super) const SPLATS: &str = "ParticleField3DGaussianSplat";

/// Types of prims that only group, or that belong to others.
const SILENT: [&str; 10] =
    ["", "Xform", "Scope", "Material", "Shader", "NodeGraph", "GeomSubset", "SkelRoot", "RenderSettings", "Backdrop"];

/// Reads a layer whose files are in `place`: in the frame of the capture if it is ours, else y up.
pub(super) fn scene(layer: &Layer, place: &mut Place) -> Result<Content, Fault> {
    let stage = Stage::new(layer);
    let mut notes = vec![];
    let to_world = units(layer, &mut notes)?;
    let root = contract_prim(&stage);
    let mut composition = composition(&stage, root, &mut notes)?;
    let is_ours = is_ours(&stage);
    let to_scene = if is_ours { HALF_TURN } else { DMat4::IDENTITY };
    let mut materials = Materials::new(place, composition.color_space);
    let mut left_out = Counts::default();
    left_out.layer(layer);
    let (mut parts, mut meshes, mut cameras) = (vec![], vec![], vec![]);
    for found in place_all(&stage, to_world, &mut left_out)? {
        let prim = stage.prims[found.prim];
        let at = || stage.path(found.prim);
        match prim.type_name.as_str() {
            SPLATS => {
                let mut part = splats::read(&stage, found.prim, &mut notes)?;
                if placed::place(&mut part, found.transform) {
                    parts.push((at(), part));
                } else {
                    notes.push(format!("{}: {NOT_DRAWN}", at()));
                }
            }
            "Mesh" => meshes.extend(surfaces::read(&stage, &found, &mut materials, &mut notes)?),
            "Camera" => match views::read(&stage, found.prim, found.transform, to_scene) {
                Ok((camera, note)) => {
                    notes.extend(note.map(|note| format!("{}: {note}", at())));
                    cameras.push((display_name(prim), camera));
                }
                Err(reason) => notes.push(format!("{}: camera left out: {reason}", at())),
            },
            other if SILENT.contains(&other) => {}
            other => left_out.add(&format!("of type {other} left out")),
        }
    }
    notes.extend(left_out.lines());
    if root.is_none() {
        composition.layers = layers(&meshes);
    }
    let mut scene = HybridScene { splats: join(parts)?, meshes, composition };
    if is_ours {
        scene = frame::back(scene).map_err(|e| Fault::from(e).under("/"))?;
    }
    let record = record(layer, &mut notes);
    Ok(Content { scene, states_composition: root.is_some(), cameras, notes, y_up: !is_ours, record })
}

/// Record of how the scene was made, if the layer has one.
fn record(layer: &Layer, notes: &mut Vec<String>) -> Option<serde_json::Value> {
    let Some(Value::Dictionary(entries)) = layer.field("customLayerData") else { return None };
    let entry = entries.iter().find(|entry| entry.key == names::RECORD)?;
    let record = entry.value.as_text().and_then(|text| serde_json::from_str(text).ok());
    if record.is_none() {
        notes.push(format!(
            "/customLayerData/{}: the record of the training is not JSON and is left out",
            names::RECORD
        ));
    }
    record
}

/// Name of a camera.
pub(super) fn display_name(prim: &Prim) -> String {
    short(field(&prim.metadata, "displayName").and_then(Value::as_text).unwrap_or(&prim.name))
}

/// Transform from the layer's units and axes to metres and y up.
pub(super) fn units(layer: &Layer, notes: &mut Vec<String>) -> Result<DMat4, Fault> {
    let scale = match layer.field("metersPerUnit").map(Value::as_number) {
        None => {
            notes.push("metersPerUnit is not stated: lengths are not converted".to_owned());
            1.0
        }
        Some(Some(scale)) if scale > 0.0 && scale.is_finite() => scale,
        Some(_) => return Err(Fault::pointer("/metersPerUnit", "a positive number", "another value")),
    };
    let turn = match layer.field("upAxis").map(|axis| axis.as_text().unwrap_or_default()) {
        None | Some("Y") => DMat4::IDENTITY,
        Some("Z") => DMat4::from_cols_array(&[1., 0., 0., 0., 0., 0., -1., 0., 0., 1., 0., 0., 0., 0., 0., 1.]),
        Some(other) => return Err(Fault::pointer("/upAxis", "Y or Z", format!("`{other}`"))),
    };
    Ok(if scale == 1.0 { turn } else { DMat4::from_scale(DVec3::splat(scale)) * turn })
}

/// Whether the layer is a capture's world, turned.
pub(super) fn is_ours(stage: &Stage<'_>) -> bool {
    contract_prim(stage).is_some_and(|root| stage.text(root, names::FRAME) == Some(names::CAPTURE))
}

/// Prim that states the composition: our default prim, or wherever another program has put it in its scene.
fn contract_prim(stage: &Stage<'_>) -> Option<usize> {
    stage.prims.iter().position(|prim| prim.property(names::MODE).is_some())
}

fn composition(stage: &Stage<'_>, root: Option<usize>, notes: &mut Vec<String>) -> Result<Composition, Fault> {
    let Some(root) = root else {
        let of_splats = (0..stage.prims.len()).filter(|&i| stage.prims[i].type_name == SPLATS);
        let mut stated: Option<ColorSpace> = None;
        for prim in of_splats {
            match splats::color_space(stage, prim) {
                Ok(None) => {}
                Ok(Some(space)) if *stated.get_or_insert(space) == space => {}
                Ok(Some(_)) => {
                    notes.push(format!("{}: blended in the colour space of the first splats", stage.path(prim)));
                }
                Err(other) => notes.push(format!("{}: colour space `{other}` is taken as sRGB", stage.path(prim))),
            }
        }
        return Ok(Composition { color_space: stated.unwrap_or_default(), ..Composition::default() });
    };
    let at = |name: &str| format!("{}.{name}", stage.path(root));
    let mode = stage.text(root, names::MODE).unwrap_or_default();
    let Some(mode) = OrderMode::ALL.into_iter().find(|m| m.name() == mode) else {
        let expected = "stable, surfaceConsistent or direct";
        return Err(Fault::pointer(at(names::MODE), expected, format!("`{mode}`")));
    };
    let usual = Composition::default();
    let color_space = match stage.text(root, names::COLOR_SPACE) {
        Some(token) => parse_color_space(token, &stage.path(root))?,
        None => usual.color_space,
    };
    let composition = Composition {
        mode,
        lambda: stage.number(root, names::LAMBDA).map_or(usual.lambda, |v| v as f32),
        layers: stage.number(root, names::LAYERS).map_or(usual.layers, |v| v as u32),
        color_space,
        background: stage.numbers::<3>(root, names::BACKGROUND).map_or(usual.background, |c| c.map(|v| v as f32)),
        near: stage.number(root, names::NEAR).map_or(usual.near, |v| v as f32),
        pixel_filter: PixelFilter {
            variance: stage.number(root, names::FILTER_VARIANCE).map_or(usual.pixel_filter.variance, |v| v as f32),
            normalized: stage.number(root, names::FILTER_NORMALIZED).is_some_and(|v| v != 0.0),
        },
    };
    // Fields of the composition have the names of its attributes.
    composition.validate().map_err(|e| Fault::from(e).under(stage.path(root)))?;
    Ok(composition)
}

/// All drawn prims, with their world transforms and what they inherit. Meshes that move with a skeleton lie where they
/// were when they were bound to it, which is where they rest if the skeleton does.
pub(super) fn place_all(stage: &Stage<'_>, to_world: DMat4, left_out: &mut Counts) -> Result<Vec<Placed>, Fault> {
    let root = Placed { prim: 0, transform: to_world, binding: None, skeleton: None, constants: Constants::default() };
    // Those that are not drawn, as skeletons often are not, have a place, too.
    let mut places: Vec<Placed> = Vec::with_capacity(stage.prims.len());
    let mut drawn: Vec<bool> = Vec::with_capacity(stage.prims.len());
    for (i, prim) in stage.prims.iter().enumerate() {
        let parent = stage.parents[i];
        let above = parent.map_or(root, |parent| places[parent]);
        let is_drawn = parent.is_none_or(|parent| drawn[parent]) && is_drawn(prim, left_out);
        if is_drawn {
            left_out.prim(prim);
        }
        let transform = match world(stage, i, above.transform, to_world) {
            Err(fault) if is_drawn => return Err(fault),
            transform => transform.unwrap_or(above.transform),
        };
        places.push(Placed {
            prim: i,
            transform,
            binding: stage.binding(i).map(|own| own.below(above.binding)).or(above.binding),
            skeleton: stage.related(i, "skel:skeleton").or(above.skeleton),
            constants: above.constants.below(prim, i),
        });
        drawn.push(is_drawn);
    }
    let drawn = places.iter().zip(drawn).filter(|(_, is_drawn)| *is_drawn);
    drawn.map(|(placed, _)| as_bound(stage, placed, &places)).collect()
}

/// World transform of a prim below one with the transform `above`.
fn world(stage: &Stage<'_>, prim: usize, above: DMat4, to_world: DMat4) -> Result<DMat4, Fault> {
    let (local, resets) = xform::local(stage, prim)?;
    let above = if resets { to_world } else { above };
    finite(stage, prim, if local == DMat4::IDENTITY { above } else { above * local })
}

fn finite(stage: &Stage<'_>, prim: usize, transform: DMat4) -> Result<DMat4, Fault> {
    let fault = || Fault::pointer(stage.path(prim), "a finite transform", "numbers that are not");
    transform.is_finite().then_some(transform).ok_or_else(fault)
}

/// Placement of a prim, with a skeleton only if it is a mesh with joints. USD takes the points of such a mesh to the
/// frame of the skeleton as they were bound to it, and ignores the transform of the mesh.
fn as_bound(stage: &Stage<'_>, placed: &Placed, places: &[Placed]) -> Result<Placed, Fault> {
    let is_moved = stage.prims[placed.prim].type_name == "Mesh" && holder(stage, placed, JOINTS).is_some();
    let Some(skeleton) = placed.skeleton.filter(|_| is_moved) else { return Ok(Placed { skeleton: None, ..*placed }) };
    let bind = holder(stage, placed, BIND_TRANSFORM).and_then(|prim| stage.numbers::<16>(prim, BIND_TRANSFORM));
    // As in operations, USD's rows are our columns.
    let bind = bind.map_or(DMat4::IDENTITY, |rows| DMat4::from_cols_array(&rows));
    Ok(Placed { transform: finite(stage, placed.prim, places[skeleton].transform * bind)?, ..*placed })
}

fn is_drawn(prim: &Prim, left_out: &mut Counts) -> bool {
    if field(&prim.metadata, "active").and_then(Value::as_number) == Some(0.0) {
        return false;
    }
    // Prims that are overrides or classes are not drawn by themselves, but what an override refers to may define it.
    if prim.specifier != Specifier::Def {
        if prim.specifier == Specifier::Over {
            left_out.arcs(prim);
        }
        return false;
    }
    if prim.value("visibility").and_then(Value::as_text) == Some("invisible") {
        left_out.add("left out because invisible, with all below");
        return false;
    }
    // Prototypes of a `PointInstancer` are below it, and are not drawn there.
    if prim.type_name == "PointInstancer" {
        left_out.add("of type PointInstancer left out, with all below");
        return false;
    }
    if matches!(prim.value("purpose").and_then(Value::as_text), Some("proxy" | "guide")) {
        left_out.add("of purpose proxy or guide left out, with all below");
        return false;
    }
    true
}

/// Counts of content that is left out, by kind.
#[derive(Default)]
pub(super) struct Counts(BTreeMap<String, usize>);

impl Counts {
    fn add(&mut self, what: &str) {
        match self.0.get_mut(what) {
            Some(count) => *count += 1,
            None => drop(self.0.insert(what.to_owned(), 1)),
        }
    }

    fn layer(&mut self, layer: &Layer) {
        if layer.field("subLayers").is_some() {
            self.0.insert("sublayers not read".to_owned(), 0);
        }
        match foreign::entries(&layer.metadata, "customLayerData") {
            0 => {}
            1 => drop(self.0.insert("1 entry of customLayerData left out".to_owned(), 0)),
            n => drop(self.0.insert(format!("{n} entries of customLayerData left out"), 0)),
        }
    }

    /// Counts what composition has left of the arcs of a prim.
    fn arcs(&mut self, prim: &Prim) {
        for arc in OUTWARD {
            if field(&prim.metadata, arc).is_some() {
                self.add(&format!("with {arc} to other layers, which are not followed"));
            }
        }
        if !prim.variants.is_empty() {
            self.add("with variants, none of which is selected");
        }
    }

    fn prim(&mut self, prim: &Prim) {
        self.arcs(prim);
        let mut metadata = std::iter::once(&prim.metadata).chain(prim.properties.iter().map(|p| &p.metadata));
        if metadata.any(|metadata| foreign::entries(metadata, "customData") > 0) {
            self.add("with customData left out");
        }
        if prim.properties.iter().any(|p| p.custom && foreign::is_property(&p.name)) {
            self.add("with custom properties left out");
        }
        let is_animated =
            |kind: &PropertyKind| matches!(kind, PropertyKind::Attribute { samples, .. } if samples.len() > 1);
        if prim.properties.iter().any(|p| is_animated(&p.kind)) {
            self.add("with animation, read at its first time");
        }
        if prim.properties.iter().any(Property::has_spline) {
            self.add("with splines, which are not read");
        }
    }

    fn lines(self) -> impl Iterator<Item = String> {
        self.0.into_iter().map(|(what, count)| match count {
            0 => what,
            1 => format!("1 prim {what}"),
            _ => format!("{count} prims {what}"),
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use crate::format::usd::tests::read_text;

    /// The skeleton is a guide, which is not drawn, and follows the mesh. The transform mirrors.
    #[test]
    fn meshes_with_joints_lie_where_they_were_bound() {
        let read_with = |root: &str, own: &str| {
            let file = read_text(&format!(
                r#"( metersPerUnit = 1 )
def SkelRoot "R" {{
    {root}
    def Mesh "M" {{
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        uniform token subdivisionScheme = "none"
        double3 xformOp:translate = (0, 50, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        {own}
    }}
    def Skeleton "K" {{
        uniform token purpose = "guide"
        double3 xformOp:translate = (7, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"#
            ));
            let mesh = &file.scene.meshes[0];
            let is_noted = file.notes.contains(&"/R/M: bound to a skeleton: shown as bound, not posed".to_owned());
            (mesh.positions().to_vec(), mesh.triangles()[0], is_noted)
        };
        let at = Vec3::new;
        let skeleton = "rel skel:skeleton = </R/K>";
        let bind = "matrix4d primvars:skel:geomBindTransform = ((-2,0,0,0), (0,2,0,0), (0,0,2,0), (5,0,0,1))";
        let joints = "int[] primvars:skel:jointIndices = [0, 0, 0] ( interpolation = \"vertex\" )";
        let as_bound = (vec![at(12.0, 0.0, 0.0), at(10.0, 0.0, 0.0), at(12.0, -2.0, 0.0)], [0, 2, 1], true);
        assert_eq!(read_with("", &format!("{skeleton} {bind} {joints}")), as_bound);
        assert_eq!(read_with(&format!("{skeleton} {bind}"), joints), as_bound);
        let without_transform = read_with(skeleton, joints).0;
        assert_eq!(without_transform, [at(7.0, 0.0, 0.0), at(8.0, 0.0, 0.0), at(7.0, -1.0, 0.0)]);
        let as_placed = (vec![at(0.0, -50.0, 0.0), at(1.0, -50.0, 0.0), at(0.0, -51.0, 0.0)], [0, 1, 2], false);
        assert_eq!(read_with(&format!("{skeleton} {bind}"), ""), as_placed);
        assert_eq!(read_with(bind, &format!("delete {skeleton} {joints}")), as_placed);
    }

    #[test]
    fn splines_are_named() {
        let file = read_text(
            r#"( metersPerUnit = 1 )
def Camera "C" {
    float focalLength.spline = { bezier, 1: 5; post curve (1, 2), 2: 6 }
    double xformOp:rotateY.spline = { 1: 0, 24: 90 }
    uniform token[] xformOpOrder = ["xformOp:rotateY"]
}
"#,
        );
        assert_eq!(file.cameras.len(), 1);
        assert_eq!(file.notes.last().unwrap(), "1 prim with splines, which are not read");
    }
}
