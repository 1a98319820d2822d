//! Core glTF of others, by hand: one small document per feature.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{Vec2, Vec3};
use serde_json::{Value, json};

use super::extension::HYBRID;
use super::*;
use crate::base64;
use crate::format::map_budget::{self, MapBudget};
use crate::format::test_scenes::black_png;
use crate::format::{WriteOptions, activation, read_file, write_scene};
use crate::scene::{ColorSpace, Mesh, sh};

/// A document whose accessors are made of the given arrays, one buffer view each.
#[derive(Default)]
pub(super) struct Builder {
    pub(super) bytes: Vec<u8>,
    pub(super) views: Vec<Value>,
    pub(super) accessors: Vec<Value>,
}

impl Builder {
    pub(super) fn view(&mut self, bytes: &[u8]) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self.views.push(json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() }));
        self.bytes.extend_from_slice(bytes);
        self.views.len() - 1
    }

    pub(super) fn accessor(&mut self, component: u32, kind: &str, count: usize, bytes: &[u8]) -> usize {
        let view = self.view(bytes);
        self.accessors.push(json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }));
        self.accessors.len() - 1
    }

    pub(super) fn floats<const N: usize>(&mut self, values: &[[f32; N]]) -> usize {
        let kind = match N {
            1 => "SCALAR",
            2 => "VEC2",
            3 => "VEC3",
            4 => "VEC4",
            _ => "MAT4",
        };
        let bytes: Vec<u8> = values.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
        let index = self.accessor(5126, kind, values.len(), &bytes);
        self.bounded(index)
    }

    /// POSITION must have bounds; that they are true is for validators.
    fn bounded(&mut self, accessor: usize) -> usize {
        self.accessors[accessor]["min"] = json!([0, 0, 0]);
        self.accessors[accessor]["max"] = json!([1, 1, 1]);
        accessor
    }

    pub(super) fn normalized(&mut self, component: u32, kind: &str, count: usize, bytes: &[u8]) -> usize {
        let index = self.accessor(component, kind, count, bytes);
        self.accessors[index]["normalized"] = json!(true);
        index
    }

    /// The file, with `rest` in place of what it has by default: one node with mesh 0.
    pub(super) fn file(&self, rest: &Value) -> Vec<u8> {
        let text = format!("data:application/octet-stream;base64,{}", base64::encode(&self.bytes));
        let mut document = json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
            "bufferViews": self.views, "accessors": self.accessors,
            "buffers": [{ "byteLength": self.bytes.len(), "uri": text }],
        });
        rest.as_object().unwrap().iter().for_each(|(key, value)| document[key] = value.clone());
        document.to_string().into_bytes()
    }

    #[expect(clippy::needless_pass_by_value, reason = "documents are written where they are read")]
    pub(super) fn read(&self, rest: Value) -> Result<SceneFile, String> {
        let asset = Asset::parse(&self.file(&rest), PathBuf::new());
        asset.and_then(|asset| read::scene(&asset)).map_err(|fault| fault.in_file(Path::new("f")).to_string())
    }
}

const CORNERS: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
const UVS: [[f32; 2]; 3] = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];

pub(super) fn triangle() -> (Builder, Value) {
    let mut b = Builder::default();
    let (position, uv) = (b.floats(&CORNERS), b.floats(&UVS));
    (b, json!({ "POSITION": position, "TEXCOORD_0": uv }))
}

/// Colour and opacity that a texel shows.
fn shown(mesh: &Mesh, texel: usize) -> [f32; 4] {
    let t = &mesh.atlas().base().texels()[4 * texel..];
    let [r, g, b] = sh::rgb_from_dc([t[0], t[1], t[2]]);
    [r, g, b, activation::opacity(t[3])]
}

#[track_caller]
pub(super) fn near(found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len());
    assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() <= tolerance), "{found:?}, expected {expected:?}");
}

#[test]
fn copies_at_seams_have_numbers_without_gaps_and_one_place() {
    let mut b = Builder::default();
    let position = b.floats(&[
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 0.0, 1.0],
    ]);
    for (of_corners, fault) in [
        ([0, 1, 2, 0, 1, 3], ""),
        ([0, 1, 2, 0, 1, 4], "expected surface vertices without gaps, found none that is 3"),
        ([0, 1, 2, 0, 1, 6], "expected surface vertices below 6, found 6"),
        ([0, 1, 2, 1, 0, 3], "expected copies of a surface vertex in one place, found vertex 1 in two"),
    ] {
        let source = b.accessor(5121, "SCALAR", 6, &of_corners);
        let extension = json!({ "EXT_gaussian_splatting_hybrid": { "surfaceVertices": source } });
        let read = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": position }, "extensions": extension }] }],
        }));
        match read {
            Ok(file) => assert_eq!((fault, file.scene.meshes[0].positions().len()), ("", 4)),
            Err(message) => assert!(!fault.is_empty() && message.ends_with(fault), "{message}"),
        }
    }
}

#[test]
fn an_opacity_without_harmonics_is_noted() {
    let (mut b, attributes) = triangle();
    let opacity = b.floats(&[[0.5]]);
    let radiance =
        json!({ "colorSpace": "srgb_rec709_display", "opacity": { "accessor": opacity, "width": 1, "height": 1 } });
    let file = b.read(json!({
        "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
        "materials": [{ "extensions": { "EXT_gaussian_splatting_hybrid": radiance } }],
    }));
    let notes = file.unwrap().notes;
    assert!(notes.iter().any(|note| note.contains("hybrid/opacity: not read without sphericalHarmonics")), "{notes:?}");
}

#[test]
fn texel_sources_are_transformed_and_repeat() {
    let (mut b, attributes) = triangle();
    let mut png = std::io::Cursor::new(vec![]);
    let texels = [[0u8, 64, 128], [255, 0, 0], [9, 8, 7], [1, 2, 3]];
    ::image::RgbImage::from_raw(2, 2, texels.concat()).unwrap().write_to(&mut png, ::image::ImageFormat::Png).unwrap();
    let view = b.view(png.get_ref());
    let accessor = b.floats(&[[0.1f32, 0.2, 0.3]; 4]);
    let moved = json!({ "offset": [0.5, 0.25], "scale": [2, 0.5], "rotation": std::f32::consts::FRAC_PI_2 });
    let source =
        |transform: &Value| json!({ "texture": { "index": 0, "extensions": { "KHR_texture_transform": transform } } });
    let placed = |node: Value, opacity: Value, bands: Value, sampler: Value| {
        let radiance = json!({
            "colorSpace": "srgb_rec709_display", "opacity": opacity,
            "sphericalHarmonics": { "degree": 1, "coefficients": [source(&moved), bands, source(&moved), source(&moved)] },
        });
        b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
            "materials": [{ "alphaMode": "BLEND", "doubleSided": true, "extensions": { "EXT_gaussian_splatting_hybrid": radiance } }],
            "textures": [{ "source": 0, "sampler": 0 }], "samplers": [sampler],
            "images": [{ "bufferView": view, "mimeType": "image/png" }],
            "nodes": [node],
        }))
    };
    let file = |opacity: Value, bands: Value, sampler: Value| placed(json!({ "mesh": 0 }), opacity, bands, sampler);
    let clamped = json!({ "wrapS": 33071, "wrapT": 33071 });
    let read = file(source(&moved), source(&moved), clamped.clone()).unwrap();
    let mesh = &read.scene.meshes[0];
    near(&mesh.atlas().base().texels()[..3], &[0.0, 64.0 / 255.0, 128.0 / 255.0], 1e-6);
    // Scaled to (2u, v/2), turned to (v/2, −2u), moved: as the extension multiplies.
    let at = |[u, v]: [f32; 2]| [0.5 + 0.5 * v, 0.25 - 2.0 * u];
    for (uv, corner) in UVS.iter().zip(&mesh.corner_uvs()[0]) {
        near(&corner.to_array(), &at(*uv), 1e-6);
    }
    // −1.75 to 0.25 in v are three tiles, 0.5 to 1 in u one; the bands are repeated like the base.
    let read = file(source(&moved), source(&moved), json!({})).unwrap();
    let mesh = &read.scene.meshes[0];
    let bands = mesh.atlas().bands().unwrap();
    assert_eq!([mesh.atlas().base().height(), bands.height(), bands.width()], [6, 6, 2]);
    for (uv, corner) in UVS.iter().zip(&mesh.corner_uvs()[0]) {
        let [u, v] = at(*uv);
        near(&corner.to_array(), &[u, (v + 2.0) / 3.0], 1e-6);
    }
    // So they are where a node puts them, and turned with it: what was seen along x is seen along y.
    let shifted = placed(json!({ "mesh": 0, "translation": [1, 2, 3] }), source(&moved), source(&moved), json!({}));
    let shifted = shifted.unwrap().scene.meshes.remove(0);
    assert_eq!((shifted.corner_uvs(), shifted.atlas()), (mesh.corner_uvs(), mesh.atlas()));
    let quarter = json!({ "mesh": 0, "rotation": [0, 0, 0.5_f64.sqrt(), 0.5_f64.sqrt()] });
    let turned = placed(quarter, source(&moved), source(&moved), json!({})).unwrap().scene.meshes.remove(0);
    assert_eq!((turned.corner_uvs(), turned.atlas().base()), (mesh.corner_uvs(), mesh.atlas().base()));
    let [x, y] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]].map(sh::basis);
    let along = |mesh: &Mesh, basis: &[f64], texel: usize| -> f64 {
        let coefficients = &mesh.atlas().bands().unwrap().texels()[9 * texel..];
        (0..3).map(|k| basis[1 + k] * f64::from(coefficients[3 * k])).sum()
    };
    for texel in 0..12 {
        let [before, after] = [along(mesh, &x, texel), along(&turned, &y, texel)];
        assert!((before - after).abs() < 1e-6, "{texel}: {before} {after}");
    }
    // Every map of a material lies where coefficient 0 does.
    let other = file(source(&json!({ "offset": [0.5, 0.25] })), source(&moved), clamped.clone()).unwrap_err();
    assert!(other.contains("hybrid/opacity: expected the KHR_texture_transform of coefficient 0, found"), "{other}");
    let plain = json!({ "accessor": accessor, "width": 2, "height": 2 });
    let other = file(source(&moved), plain, clamped.clone()).unwrap_err();
    assert!(other.contains("/coefficients/1: expected the KHR_texture_transform of coefficient 0"), "{other}");
    let second = json!({ "texture": { "index": 0, "extensions": { "KHR_texture_transform": { "texCoord": 1 } } } });
    let other = file(source(&moved), second, clamped).unwrap_err();
    assert!(other.contains("/coefficients/1: expected texCoord 0, as of coefficient 0, found 1"), "{other}");
    let malformed = file(source(&moved), source(&json!({ "offset": [1, "x"] })), json!({})).unwrap_err();
    assert!(
        malformed.contains("/coefficients/1/texture/extensions/KHR_texture_transform/offset/1: expected"),
        "{malformed}"
    );
}

/// One picture may stand for all coefficients, each of which takes as much as it does.
#[test]
fn maps_are_counted_coefficient_by_coefficient() {
    let (mut b, attributes) = triangle();
    let png = black_png(256, 256);
    let view = b.view(&png);
    let radiance = json!({
        "colorSpace": "srgb_rec709_display",
        "sphericalHarmonics": { "degree": 1, "coefficients": vec![json!({ "texture": { "index": 0 } }); 4] },
    });
    let file = b.file(&json!({
        "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
        "materials": [{ "extensions": { "EXT_gaussian_splatting_hybrid": radiance } }],
        "textures": [{ "source": 0 }], "images": [{ "bufferView": view, "mimeType": "image/png" }],
    }));
    let asset = Asset::parse(&file, PathBuf::new()).map_err(|_| ()).unwrap();
    let (floats, most) = (256 * 256, (map_budget::ALWAYS + map_budget::MAX_RATIO * png.len() as u64) / 4);
    for (room, fault) in [
        (13, None),
        (12, Some("/EXT_gaussian_splatting_hybrid: expected maps of at most ")),
        (8, Some("/sphericalHarmonics/coefficients/2: expected maps of at most ")),
    ] {
        let mut budget = MapBudget::new(0);
        budget.spend(most - room * floats).unwrap();
        let material = asset.document.materials().next().unwrap();
        let maps =
            material::maps(&asset, &material, ColorSpace::default(), (&mut budget, &mut HashMap::new()), &mut vec![]);
        let message = maps.map(|maps| maps.atlas.floats()).map_err(|fault| fault.in_file(Path::new("f")).to_string());
        match fault {
            None => assert_eq!(message, Ok(13 * 256 * 256)),
            Some(fault) => assert!(message.as_ref().unwrap_err().contains(fault), "{message:?}"),
        }
    }
}

#[test]
fn positions_in_every_component_type() {
    let cases: [(u32, bool, Vec<u8>, f32); 8] = [
        (5120, false, vec![0, 0, 0, 127, 0x80, 0], 127.0),
        (5120, true, vec![0, 0, 0, 127, 0x81, 0], 1.0),
        (5121, false, vec![0, 0, 0, 200, 0, 0], 200.0),
        (5121, true, vec![0, 0, 0, 255, 0, 0], 1.0),
        (5122, false, [0i16, 0, 0, 300, -300, 0].iter().flat_map(|v| v.to_le_bytes()).collect(), 300.0),
        (5122, true, [0i16, 0, 0, 32767, -32768, 0].iter().flat_map(|v| v.to_le_bytes()).collect(), 1.0),
        (5123, false, [0u16, 0, 0, 40000, 0, 0].iter().flat_map(|v| v.to_le_bytes()).collect(), 40000.0),
        (5123, true, [0u16, 0, 0, 65535, 0, 0].iter().flat_map(|v| v.to_le_bytes()).collect(), 1.0),
    ];
    for (component, normalized, bytes, x) in cases {
        let mut b = Builder::default();
        // Of three vertices the last is another first; elements of 3 or 6 bytes lie 4 or 8 apart.
        let size = bytes.len() / 2;
        let row = |r: &[u8]| {
            let mut r = r.to_vec();
            r.resize(size.next_multiple_of(4), 0);
            r
        };
        let padded = [row(&bytes[..size]), row(&bytes[size..]), row(&bytes[..size])].concat();
        let position = b.accessor(component, "VEC3", 3, &padded);
        b.accessors[position]["normalized"] = json!(normalized);
        b.bounded(position);
        b.views[0]["byteStride"] = json!(size.next_multiple_of(4));
        let rest = json!({
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": position } }] }],
            "extensionsUsed": ["KHR_mesh_quantization"], "extensionsRequired": ["KHR_mesh_quantization"],
        });
        let mesh = b.read(rest).unwrap().scene.meshes.remove(0);
        assert_eq!(mesh.positions()[1].x, x, "{component} {normalized}");
        assert!(mesh.positions()[1].y <= 0.0 && mesh.positions()[1].y >= -300.0);
        if component == 5122 && normalized {
            assert_eq!(mesh.positions()[1].y, -1.0, "both lowest values are −1");
        }
    }
}

#[test]
fn sparse_elements_with_and_without_a_base() {
    for based in [true, false] {
        let (mut b, attributes) = triangle();
        let (indices, values) = (b.view(&[1, 2]), b.view(bytemuck::cast_slice(&[[7.0f32, 8.0, 9.0], [4.0, 5.0, 6.0]])));
        let position = attributes["POSITION"].as_u64().unwrap() as usize;
        b.accessors[position]["sparse"] = json!({
            "count": 2, "indices": { "bufferView": indices, "componentType": 5121 }, "values": { "bufferView": values },
        });
        if !based {
            b.accessors[position].as_object_mut().unwrap().remove("bufferView");
        }
        let rest = |b: &Builder| b.read(json!({ "meshes": [{ "primitives": [{ "attributes": attributes }] }] }));
        let mesh = rest(&b).unwrap().scene.meshes.remove(0);
        assert_eq!(mesh.positions(), [Vec3::ZERO, Vec3::new(7.0, 8.0, 9.0), Vec3::new(4.0, 5.0, 6.0)]);
        // Counts beyond the data are named, not reserved.
        b.accessors[position]["sparse"]["count"] = json!(4_000_000_000u32);
        assert!(rest(&b).unwrap_err().contains("/sparse/count: expected 4000000000 elements"), "{:?}", rest(&b).err());
        b.accessors[position]["sparse"]["count"] = json!(2);
        b.accessors[position]["count"] = json!(4_000_000_000u32);
        let message = rest(&b).unwrap_err();
        assert!(message.starts_with("f: /accessors/0") && message.contains("expected"), "{message}");
        b.accessors[position]["count"] = json!(2);
        assert!(rest(&b).unwrap_err().contains("/accessors/0/sparse: expected indices below 2, found 2"));
    }
}

#[test]
fn accessors_without_data_are_zeros_unless_draco_has_it() {
    let (mut b, attributes) = triangle();
    let read = |b: &Builder, extensions: &Value| {
        let primitive = json!({ "attributes": attributes, "extensions": extensions });
        b.read(json!({ "meshes": [{ "primitives": [primitive] }] })).map(|file| file.scene.meshes)
    };
    let draco = json!({ "KHR_draco_mesh_compression": { "bufferView": 0, "attributes": { "POSITION": 0 } } });
    let [position, uv] =
        ["POSITION", "TEXCOORD_0"].map(|name| usize::try_from(attributes[name].as_u64().unwrap()).unwrap());
    b.accessors[uv].as_object_mut().unwrap().remove("bufferView");
    assert_eq!(read(&b, &json!({})).unwrap()[0].corner_uvs(), [[Vec2::ZERO; 3]]);
    assert!(read(&b, &draco).is_ok(), "accessors have positions as well");
    b.accessors[position].as_object_mut().unwrap().remove("bufferView");
    assert_eq!(read(&b, &json!({})).unwrap()[0].positions(), [Vec3::ZERO; 3]);
    let message = read(&b, &draco).unwrap_err();
    assert!(
        message
            .ends_with("expected a primitive with its data in accessors, found one that is compressed by Draco alone")
    );
    b.accessors[position]["count"] = json!(4_000_000_000u32);
    let message = read(&b, &json!({})).unwrap_err();
    assert!(message.starts_with("f: /accessors/0/count: expected at most "), "{message}");
}

#[test]
fn positions_need_no_bounds() {
    let (mut b, attributes) = triangle();
    let document = json!({ "meshes": [{ "primitives": [{ "attributes": attributes }] }] });
    let bounds = |b: &Builder| {
        let asset = Asset::parse(&b.file(&document), PathBuf::new()).map_err(|_| ()).unwrap();
        describe(&asset).map_err(|_| ()).unwrap().nodes[0].bounds
    };
    assert!(bounds(&b).is_some());
    b.accessors[0].as_object_mut().unwrap().retain(|key, _| !["min", "max"].contains(&key.as_str()));
    assert_eq!(b.read(document.clone()).unwrap().scene.meshes[0].positions()[1], Vec3::X);
    assert!(bounds(&b).is_none(), "nobody has said any");
}

#[test]
fn nodes_made_invisible_are_left_out() {
    let (b, attributes) = triangle();
    let read = |is_visible: bool| {
        let file = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
            "cameras": [{ "type": "perspective", "perspective": { "yfov": 1.0, "aspectRatio": 2.0, "znear": 0.1 } }],
            "nodes": [
                { "children": [1, 2] },
                { "mesh": 0, "children": [3], "extensions": { "KHR_node_visibility": { "visible": is_visible } } },
                { "mesh": 0 },
                { "mesh": 0, "camera": 0, "extensions": { "KHR_node_visibility": { "visible": false } } },
            ],
            "extensionsUsed": ["KHR_node_visibility"],
            "extensionsRequired": ["KHR_node_visibility"],
        }));
        let file = file.unwrap();
        assert_eq!(file.notes[0], "1 node made invisible left out, with what is below");
        assert!(file.cameras.is_empty());
        file.scene.meshes[0].triangles().len()
    };
    assert_eq!([true, false].map(read), [2, 1]);
}

#[test]
fn primitives_without_positions_are_left_out() {
    let (b, attributes) = triangle();
    let mut bare = attributes.clone();
    bare.as_object_mut().unwrap().remove("POSITION");
    let splats = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" });
    let document = json!({
        "meshes": [{ "primitives": [
            { "attributes": bare }, { "attributes": attributes },
            { "attributes": bare, "mode": 0, "extensions": { "KHR_gaussian_splatting": splats } },
        ] }],
        "extensionsUsed": ["KHR_gaussian_splatting"],
    });
    let file = b.read(document.clone()).unwrap();
    let said = |primitive: usize| format!("/meshes/0/primitives/{primitive}: left out: it has no POSITION");
    assert_eq!((file.notes.first(), file.notes.last()), (Some(&said(0)), Some(&said(2))));
    assert_eq!((file.scene.meshes[0].triangles().len(), file.scene.splats.len()), (1, 0));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    std::fs::write(&path, b.file(&document)).unwrap();
    let mesh = crate::format::mesh_import::read(&path).unwrap();
    assert_eq!((mesh.triangles.len(), mesh.notes), (1, vec![said(0), said(2)]));
    let asset = Asset::open(&path).unwrap();
    let primitives = &describe(&asset).map_err(|_| ()).unwrap().nodes[0].primitives;
    assert_eq!(primitives.iter().map(|p| p.vertices).collect::<Vec<_>>(), [0, 3, 0]);
}

#[test]
fn integers_may_be_written_as_other_numbers() {
    let (b, attributes) = triangle();
    let document = b.file(&json!({ "meshes": [{ "primitives": [{ "attributes": attributes }] }] }));
    let text = String::from_utf8(document).unwrap();
    let other = text.replace("5126", "5126.0").replace(r#""count":3"#, r#""count":0.3e1"#);
    assert_ne!(other, text);
    let read = |text: &str| {
        let asset = Asset::parse(text.as_bytes(), PathBuf::new());
        asset.and_then(|asset| read::scene(&asset)).map_err(|_| ()).unwrap().scene
    };
    assert_eq!(read(&other), read(&text));
    // Of such accessors the validator sees what they hold.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    std::fs::write(&path, &other).unwrap();
    let findings = crate::format::validate(&path).unwrap().findings;
    let said = "/accessors/0/max: expected 0, the max of component 2, found 1";
    assert!(findings.iter().any(|finding| finding.to_string().contains(said)), "{findings:?}");
}

#[test]
fn a_document_without_scenes_shows_all_its_nodes() {
    let (b, attributes) = triangle();
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes }] }], "scenes": [],
        "nodes": [{ "mesh": 0, "translation": [0, 0, 1] }, { "children": [0] }, { "mesh": 0 }],
    });
    let file = b.read(document.clone()).unwrap();
    assert_eq!(file.scene.meshes[0].triangles().len(), 2);
    assert_eq!(file.notes[0], "/scenes: there are none: all nodes are shown");
    // Moved, it is written with one, below which all of it is.
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("a.gltf"), b.file(&document)).unwrap();
    let options = ReadOptions { keep_document: true, ..ReadOptions::default() };
    let read = read_file(&at("a.gltf"), &options).unwrap();
    let mut source = read.source.unwrap();
    source.follow(DMat4::from_translation(glam::DVec3::X), &read.scene, &[]);
    let options = WriteOptions { source: Some(&source), ..WriteOptions::default() };
    write_scene(&at("b.gltf"), &read.scene, &options).unwrap();
    let written: Value = serde_json::from_slice(&std::fs::read(at("b.gltf")).unwrap()).unwrap();
    assert_eq!((&written["scenes"], &written["nodes"][3]["children"]), (&json!([{ "nodes": [3] }]), &json!([1, 2])));
}

#[test]
fn pictures_of_the_core_that_cannot_be_had_are_left_out() {
    let (mut b, attributes) = triangle();
    let nonsense = b.view(b"no picture");
    for (image, reason) in [
        (json!({ "uri": "missing.png" }), "/images/0/uri: expected "),
        (
            json!({ "bufferView": nonsense, "mimeType": "image/png" }),
            "/images/0: expected a PNG, JPEG or WebP image, found ",
        ),
    ] {
        let file = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
            "materials": [{
                "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 }, "baseColorFactor": [0.5, 1, 1, 1] },
                "extensions": { "KHR_materials_unlit": {} },
            }],
            "textures": [{ "source": 0 }], "images": [image],
        }));
        let file = file.unwrap();
        let said = format!("/materials/0/pbrMetallicRoughness/baseColorTexture is left out: {reason}");
        assert!(file.notes.len() == 1 && file.notes[0].starts_with(&said), "{:?}", file.notes);
        // Half the light is 0.735 in sRGB.
        near(&shown(&file.scene.meshes[0], 0), &[0.735_357, 1.0, 1.0, 1.0], 1e-5);
    }
}

#[test]
fn what_leaves_the_base_colour_alone_may_be_required() {
    let (b, attributes) = triangle();
    let unshown = [
        "KHR_materials_clearcoat",
        "KHR_lights_punctual",
        "KHR_materials_variants",
        "KHR_animation_pointer",
        "KHR_xmp_json_ld",
        "EXT_mesh_features",
        "EXT_structural_metadata",
    ];
    let read = |required: &[&str]| {
        let document = json!({
            "meshes": [{ "primitives": [{ "attributes": attributes }] }], "extensionsRequired": required,
        });
        b.read(document).unwrap().notes
    };
    let said = unshown.map(|name| format!("/extensionsRequired: {name} is not shown"));
    assert_eq!(read(&unshown)[..unshown.len()], said);
    // These are shown.
    assert_eq!(read(&["KHR_materials_emissive_strength", "KHR_materials_pbrSpecularGlossiness"]), read(&[]));
}

/// A PNG whose texel (x, y) is this.
fn png_of(width: u32, height: u32, texel: impl Fn(u32, u32) -> [u8; 4]) -> Vec<u8> {
    let mut png = std::io::Cursor::new(vec![]);
    ::image::RgbaImage::from_fn(width, height, |x, y| ::image::Rgba(texel(x, y)))
        .write_to(&mut png, ::image::ImageFormat::Png)
        .unwrap();
    png.into_inner()
}

/// Primitives of a material whose texture 0 is the picture in a buffer view, read by a sampler.
fn pictured(b: &Builder, view: usize, primitives: &[Value], material: &Value, sampler: &Value) -> SceneFile {
    let file = b.read(json!({
        "meshes": [{ "primitives": primitives }], "materials": [material], "samplers": [sampler],
        "textures": [{ "source": 0, "sampler": 0 }], "images": [{ "bufferView": view, "mimeType": "image/png" }],
    }));
    file.unwrap()
}

/// As mips and the filter make it.
#[test]
fn a_clear_texel_does_not_erase_three_opaque_ones() {
    let mean = |file: SceneFile| {
        let texels = file.scene.meshes[0].atlas().base().texels();
        assert_eq!(texels.len(), 16);
        activation::opacity(texels.iter().skip(3).step_by(4).sum::<f32>() / 4.0)
    };
    let (mut b, attributes) = triangle();
    let view = b.view(&png_of(2, 2, |x, y| [255, 255, 255, if x + y == 0 { 0 } else { 255 }]));
    let primitive = json!({ "attributes": attributes, "material": 0 });
    for mode in ["MASK", "BLEND"] {
        let material = json!({ "alphaMode": mode, "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } });
        let found = mean(pictured(&b, view, std::slice::from_ref(&primitive), &material, &json!({})));
        assert!(found >= 0.5, "{mode}: {found}");
    }
    let (opacity, colour) = (b.floats(&[[0.0f32], [1.0], [1.0], [1.0]]), b.floats(&[[0.1f32, 0.2, 0.3]; 4]));
    let of = |accessor: usize| json!({ "accessor": accessor, "width": 2, "height": 2 });
    let radiance = json!({
        "colorSpace": "srgb_rec709_display", "opacity": of(opacity),
        "sphericalHarmonics": { "degree": 0, "coefficients": [of(colour)] },
    });
    let material = json!({ "extensions": { HYBRID: radiance } });
    let found = mean(pictured(&b, view, &[primitive], &material, &json!({})));
    assert!(found >= 0.5, "of the extension: {found}");
}

/// As files from before the core had settled its materials have it.
#[test]
fn diffuse_colours_take_the_place_of_base_colours() {
    let (mut b, mut attributes) = triangle();
    attributes["TEXCOORD_1"] = json!(b.floats(&UVS.map(|uv| uv.map(|v| v / 2.0))));
    let view = b.view(&png_of(2, 1, |_, _| [255, 51, 0, 128]));
    let primitives = [json!({ "attributes": attributes, "material": 0 })];
    let read = |specular_glossiness: Value, emissive: Value| {
        let material = json!({
            "alphaMode": "BLEND", "doubleSided": true, "emissiveFactor": emissive, "emissiveTexture": { "index": 0 },
            "extensions": { "KHR_materials_pbrSpecularGlossiness": specular_glossiness },
        });
        let clamped = json!({ "wrapS": 33071, "wrapT": 33071 });
        let file = pictured(&b, view, &primitives, &material, &clamped);
        let colour = shown(&file.scene.meshes[0], 0);
        (colour, file.scene.meshes[0].corner_uvs()[0], file.notes)
    };
    let texture = |index: usize| {
        let transform = json!({ "offset": [0.25, 0] });
        json!({ "index": index, "texCoord": 1, "extensions": { "KHR_texture_transform": transform } })
    };
    let both = json!({ "diffuseFactor": [0.5, 1, 1, 0.5], "diffuseTexture": texture(0), "glossinessFactor": 0 });
    let (colour, uvs, notes) = read(both, json!([1, 1, 1]));
    // Half the light is 0.735 in sRGB.
    near(&colour, &[0.735_357, 0.2, 0.0, 64.0 / 255.0], 1e-5);
    assert_eq!(uvs, UVS.map(|uv| Vec2::from(uv) / 2.0 + Vec2::new(0.25, 0.0)));
    assert_eq!(notes, ["/materials/0: shown by its diffuse colour alone, unlit"]);
    // What has no picture of its own, or is black, is shown by what it emits.
    let (colour, _, notes) = read(json!({ "diffuseFactor": [1, 1, 1, 0.25] }), json!([0.5, 1, 1]));
    near(&colour, &[0.735_357, 0.2, 0.0, 0.25], 1e-5);
    assert_eq!(notes, ["/materials/0: shown by its emission alone, unlit"]);
    // A texture that is not there.
    let (colour, _, notes) =
        read(json!({ "diffuseFactor": [1, 0, 0, 1], "diffuseTexture": texture(7) }), json!([0, 0, 0]));
    near(&colour, &[1.0, 0.0, 0.0, 1.0], 1e-5);
    let said = "/materials/0/extensions/KHR_materials_pbrSpecularGlossiness/diffuseTexture is left out: /textures/7: ";
    assert!(notes[1].starts_with(said), "{notes:?}");
}

#[test]
fn what_repeats_too_often_repeats_at_a_lower_resolution() {
    let (mut b, attributes) = triangle();
    let view = b.view(&png_of(4, 2, |x, y| if x < 2 { [(100 * y) as u8, 0, 0, 255] } else { [0, 0, 200, 255] }));
    // 20,000 texels side by side are more than a texture may have.
    let transform = json!({ "KHR_texture_transform": { "scale": [5000, 1] } });
    let material = json!({
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0, "extensions": transform } },
        "extensions": { "KHR_materials_unlit": {} },
    });
    let file = pictured(&b, view, &[json!({ "attributes": attributes, "material": 0 })], &material, &json!({}));
    let said = "/materials/0: a texture that repeats too often is repeated at a lower resolution, 2×1";
    assert_eq!(file.notes, [said]);
    let mesh = &file.scene.meshes[0];
    assert_eq!((mesh.atlas().base().width(), mesh.atlas().base().height()), (10_000, 1));
    for tile in [0, 1, 4999] {
        near(&shown(mesh, 2 * tile), &[50.0 / 255.0, 0.0, 0.0, 1.0], 1e-5);
        near(&shown(mesh, 2 * tile + 1), &[0.0, 0.0, 200.0 / 255.0, 1.0], 1e-5);
    }
    near(mesh.corner_uvs()[0].map(|uv| uv.to_array()).as_flattened(), UVS.as_flattened(), 1e-6);
}

#[test]
fn one_colour_of_all_vertices_is_a_factor_of_a_texture() {
    let (mut b, attributes) = triangle();
    let view = b.view(&png_of(2, 1, |x, _| [255, 51, 0, if x == 0 { 128 } else { 0 }]));
    let mut primitive = |colours: [[f32; 4]; 3]| {
        let mut attributes = attributes.clone();
        attributes["COLOR_0"] = json!(b.floats(&colours));
        json!({ "attributes": attributes, "material": 0 })
    };
    let [tinted, white] = [[0.5, 1.0, 1.0, 0.5], [1.0; 4]].map(|colour| primitive([colour; 3]));
    let varied = primitive([[1.0; 4], [1.0; 4], [0.0; 4]]);
    let material = json!({
        "alphaMode": "BLEND", "doubleSided": true, "extensions": { "KHR_materials_unlit": {} },
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } },
    });
    let file = pictured(&b, view, &[tinted.clone(), white, tinted], &material, &json!({}));
    assert!(file.notes.is_empty(), "{:?}", file.notes);
    // Those of one colour are one mesh.
    let [tinted, plain] = &file.scene.meshes[..] else { panic!("{}", file.scene.meshes.len()) };
    assert_eq!([tinted, plain].map(|mesh| mesh.triangles().len()), [2, 1]);
    // Half the light is 0.735 in sRGB.
    near(&shown(tinted, 0), &[0.735_357, 0.2, 0.0, 64.0 / 255.0], 1e-5);
    near(&shown(tinted, 1), &[0.735_357, 0.2, 0.0, 0.0], 1e-5);
    near(&shown(plain, 0), &[1.0, 0.2, 0.0, 128.0 / 255.0], 1e-5);
    let file = pictured(&b, view, &[varied], &material, &json!({}));
    assert_eq!(file.notes, ["/nodes/0: colours of vertices beside a texture are left out, as they differ"]);
    near(&shown(&file.scene.meshes[0], 0), &[1.0, 0.2, 0.0, 128.0 / 255.0], 1e-5);
}

#[test]
fn samplers_of_sharp_texels_are_noted() {
    let (mut b, attributes) = triangle();
    let view = b.view(&png_of(2, 2, |x, y| [(255 * x) as u8, (255 * y) as u8, 0, 255]));
    let primitives = [json!({ "attributes": attributes, "material": 0 })];
    let unlit = json!({
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } }, "extensions": { "KHR_materials_unlit": {} },
    });
    let note = "/textures/0: its sampler's NEAREST is read as linear filtering";
    assert_eq!(pictured(&b, view, &primitives, &unlit, &json!({ "magFilter": 9728 })).notes, [note]);
    for linear in [json!({}), json!({ "magFilter": 9729, "minFilter": 9984 })] {
        assert!(pictured(&b, view, &primitives, &unlit, &linear).notes.is_empty());
    }
    // What it emits and what covers it are one picture.
    let glowing = json!({
        "alphaMode": "BLEND", "doubleSided": true, "emissiveFactor": [1, 1, 1], "emissiveTexture": { "index": 0 },
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 }, "baseColorFactor": [0, 0, 0, 1] },
    });
    let notes = pictured(&b, view, &primitives, &glowing, &json!({ "magFilter": 9728 })).notes;
    assert_eq!(notes, ["/materials/0: shown by its emission alone, unlit", note]);
}

#[test]
fn texture_coordinates_are_transformed() {
    // The lower left quarter of the picture, turned (the example of the extension's text).
    let transform =
        json!({ "offset": [0, 1], "rotation": std::f64::consts::FRAC_PI_2, "scale": [0.5, 0.5], "texCoord": 1 });
    let (mut b, mut attributes) = triangle();
    attributes["TEXCOORD_1"] = attributes["TEXCOORD_0"].clone();
    attributes.as_object_mut().unwrap().remove("TEXCOORD_0");
    let mut png = std::io::Cursor::new(vec![]);
    ::image::RgbaImage::from_fn(2, 2, |x, y| ::image::Rgba([(255 * x) as u8, (255 * y) as u8, 0, 128]))
        .write_to(&mut png, ::image::ImageFormat::Png)
        .unwrap();
    let view = b.view(png.get_ref());
    let document = |texture: Value, material: Value| {
        let mut material = material;
        material["pbrMetallicRoughness"]["baseColorTexture"] = texture;
        json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }], "materials": [material],
            "textures": [{ "source": 0 }], "images": [{ "bufferView": view, "mimeType": "image/png" }],
            "extensionsUsed": ["KHR_texture_transform"], "extensionsRequired": ["KHR_texture_transform"],
        })
    };
    let texture = json!({ "index": 0, "extensions": { "KHR_texture_transform": transform } });
    let mesh = b.read(document(texture.clone(), json!({}))).unwrap().scene.meshes.remove(0);
    let [a, bb, c] = mesh.corner_uvs()[0];
    // (u, v) → (v/2, 1 − u/2).
    near(&[a.x, a.y, bb.x, bb.y, c.x, c.y], &[0.0, 1.0, 0.0, 0.5, 0.5, 1.0], 1e-6);

    // Alpha modes and factors, at texel (1, 0): red, alpha 128.
    let read = |material: Value| shown(&b.read(document(texture.clone(), material)).unwrap().scene.meshes[0], 1);
    near(&read(json!({})), &[1.0, 0.0, 0.0, 1.0], 1e-6);
    let half = 128.0 / 255.0;
    near(&read(json!({ "alphaMode": "BLEND" })), &[1.0, 0.0, 0.0, half], 1e-6);
    near(&read(json!({ "alphaMode": "MASK" })), &[1.0, 0.0, 0.0, 1.0], 1e-6);
    near(&read(json!({ "alphaMode": "MASK", "alphaCutoff": 0.6 })), &[1.0, 0.0, 0.0, 0.0], 1e-6);
    let factor = json!({ "alphaMode": "BLEND", "pbrMetallicRoughness": { "baseColorFactor": [0.5, 1, 1, 0.5] } });
    // Half the light is 0.735 in sRGB.
    near(&read(factor), &[0.735_357, 0.0, 0.0, 0.5 * half], 1e-5);
}

/// Behind a cut-out there is more.
#[test]
fn what_is_behind_clear_surfaces_is_shown_where_nothing_says_how() {
    let (b, attributes) = triangle();
    for (mode, alpha, layers) in [("OPAQUE", 0.5, 1), ("BLEND", 1.0, 1), ("BLEND", 0.9, 4), ("MASK", 0.1, 4)] {
        let material = json!({ "alphaMode": mode, "pbrMetallicRoughness": { "baseColorFactor": [1, 1, 1, alpha] } });
        let mut rest = json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
            "materials": [material],
        });
        assert_eq!(b.read(rest.clone()).unwrap().scene.composition.layers, layers, "{mode} {alpha}");
        rest["scenes"] =
            json!([{ "nodes": [0], "extensions": { (HYBRID): { "colorSpace": "srgb_rec709_display", "layers": 2 } } }]);
        assert_eq!(b.read(rest).unwrap().scene.composition.layers, 2);
    }
}

/// As where many parts of a model are cut from one sheet.
#[test]
fn materials_of_one_picture_share_their_map() {
    let (mut b, attributes) = triangle();
    let mut png = std::io::Cursor::new(vec![]);
    let picture =
        ::image::RgbaImage::from_fn(32, 16, |x, y| ::image::Rgba([8 * x as u8, 16 * y as u8, 77, 255 - x as u8]));
    picture.write_to(&mut png, ::image::ImageFormat::Png).unwrap();
    let view = b.view(png.get_ref());
    let material = |texture: usize, red: f32| json!({ "alphaMode": "BLEND", "pbrMetallicRoughness": { "baseColorTexture": { "index": texture }, "baseColorFactor": [red, 1, 1, 1] } });
    let primitives: Vec<Value> = (0..3).map(|m| json!({ "attributes": attributes, "material": m })).collect();
    let file = b
        .read(json!({
            "meshes": [{ "primitives": primitives }],
            "materials": [material(0, 1.0), material(1, 1.0), material(0, 0.5)],
            "textures": [{ "source": 0 }, { "source": 1 }],
            "images": [{ "bufferView": view, "mimeType": "image/png" }, { "bufferView": view, "mimeType": "image/png" }],
        }))
        .unwrap();
    let maps: Vec<&[f32]> = file.scene.meshes.iter().map(|mesh| mesh.atlas().base().texels()).collect();
    assert!(std::ptr::eq(maps[0], maps[1]) && !std::ptr::eq(maps[0], maps[2]));
    for (x, y) in [(0, 0), (31, 15), (7, 11)] {
        let expected = picture.get_pixel(x, y).0.map(|v| f32::from(v) / 255.0);
        let texel = (y * 32 + x) as usize;
        let found = shown(&file.scene.meshes[0], texel);
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?} {expected:?}");
        let half = crate::scene::color::linear_to_srgb(0.5 * crate::scene::color::srgb_to_linear(expected[0]));
        assert!((shown(&file.scene.meshes[2], texel)[0] - half).abs() < 1e-5);
    }
}

#[test]
fn unlit_materials_are_taken_over_without_a_note() {
    let (b, attributes) = triangle();
    let document = |extensions: Value| {
        json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
            "materials": [{ "extensions": extensions, "pbrMetallicRoughness": { "baseColorFactor": [0.2, 0.4, 0.6, 1] } }],
            "extensionsUsed": ["KHR_materials_unlit"],
        })
    };
    assert!(b.read(document(json!({ "KHR_materials_unlit": {} }))).unwrap().notes.is_empty());
    assert_eq!(b.read(document(json!({}))).unwrap().notes, ["/materials/0: shown by its base colour alone, unlit"]);
}

/// As Blender writes a picture that is plugged into the emission, and a lamp; what has a picture of its own is shown by that.
#[test]
fn emission_is_shown_where_there_is_nothing_else() {
    let (mut b, mut attributes) = triangle();
    attributes["COLOR_0"] = json!(b.normalized(5121, "VEC4", 3, &[0; 12]));
    let mut png = std::io::Cursor::new(vec![]);
    ::image::RgbaImage::from_pixel(1, 1, ::image::Rgba([255, 51, 0, 128]))
        .write_to(&mut png, ::image::ImageFormat::Png)
        .unwrap();
    let view = b.view(png.get_ref());
    let read = |material: Value| {
        let file = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }], "materials": [material],
            "textures": [{ "source": 0 }], "images": [{ "bufferView": view, "mimeType": "image/png" }],
            "extensionsUsed": ["KHR_materials_emissive_strength", "KHR_materials_unlit"],
        }));
        let file = file.unwrap();
        (shown(&file.scene.meshes[0], 0), file.notes)
    };
    let (color, notes) = read(json!({
        "emissiveTexture": { "index": 0 }, "emissiveFactor": [0.5, 1, 1], "alphaMode": "BLEND", "doubleSided": true,
        "pbrMetallicRoughness": { "baseColorFactor": [1, 1, 1, 0.25] },
    }));
    // Half the light is 0.735 in sRGB.
    near(&color, &[0.735_357, 0.2, 0.0, 0.25], 1e-5);
    assert_eq!(notes, ["/materials/0: shown by its emission alone, unlit"]);
    let black = json!({ "baseColorFactor": [0, 0, 0, 1] });
    let strength = json!({ "KHR_materials_emissive_strength": { "emissiveStrength": 0.5 } });
    let lamp = json!({ "emissiveFactor": [1, 0, 0], "pbrMetallicRoughness": black, "extensions": strength });
    near(&read(lamp.clone()).0, &[0.735_357, 0.0, 0.0, 1.0], 1e-5);
    let mut unlit = lamp;
    unlit["extensions"] = json!({ "KHR_materials_unlit": {} });
    near(&read(unlit).0, &[0.0, 0.0, 0.0, 1.0], 1e-5);
    let both = |factor: Value| {
        let base = json!({ "baseColorTexture": { "index": 0 }, "baseColorFactor": factor });
        json!({
            "emissiveTexture": { "index": 0 }, "emissiveFactor": [0.5, 1, 1], "alphaMode": "BLEND", "doubleSided": true,
            "pbrMetallicRoughness": base,
        })
    };
    let (_, notes) = read(both(json!([1, 1, 1, 1])));
    assert_eq!(notes[0], "/materials/0: shown by its base colour alone, unlit");
    // A picture whose alpha covers what it emits: the factor of its colour is black.
    let covered = both(json!([0, 0, 0, 1]));
    near(&read(covered.clone()).0, &[0.735_357, 0.2, 0.0, 128.0 / 255.0], 1e-5);
    let mut constant = covered;
    constant.as_object_mut().unwrap().remove("emissiveTexture");
    near(&read(constant).0, &[0.735_357, 1.0, 1.0, 128.0 / 255.0], 1e-5);
}

#[test]
fn colours_of_vertices_become_a_map() {
    let (mut b, mut attributes) = triangle();
    let colours = [255u8, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 51];
    attributes["COLOR_0"] = json!(b.normalized(5121, "VEC4", 3, &colours));
    let material = json!({ "alphaMode": "BLEND", "doubleSided": true, "extensions": { "KHR_materials_unlit": {} } });
    let read = |b: &Builder| {
        b.read(json!({ "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }], "materials": [material] }))
    };
    let file = read(&b).unwrap();
    assert!(file.notes.is_empty(), "{:?}", file.notes);
    let mesh = &file.scene.meshes[0];
    let width = mesh.atlas().base().width() as f32;
    for (uv, colour) in
        mesh.corner_uvs()[0].iter().zip([[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.2]])
    {
        let texel = (*uv * Vec2::new(width, mesh.atlas().base().height() as f32)).floor();
        near(&shown(mesh, (texel.y * width + texel.x) as usize), &colour, 1e-6);
    }
    // One colour needs no map.
    b.bytes.truncate(b.bytes.len() - 12);
    b.bytes.extend([255, 255, 255, 51].repeat(3));
    let file = read(&b).unwrap();
    let mesh = &file.scene.meshes[0];
    assert_eq!(mesh.atlas().floats(), 4);
    near(&shown(mesh, 0), &[1.0, 1.0, 1.0, 0.2], 1e-6);
}

#[test]
fn skins_and_morph_targets_come_in_their_rest_pose() {
    let (mut b, mut attributes) = triangle();
    attributes["JOINTS_0"] = json!(b.accessor(5121, "VEC4", 3, &[0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0]));
    let weights = [[1.0f32, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0]];
    attributes["WEIGHTS_0"] = json!(b.floats(&weights));
    let delta = b.floats(&[[0.0f32, 0.0, 1.0]; 3]);
    // Joint 0 was bound one unit along x; joint 1 at the origin.
    let mut bind = glam::Mat4::IDENTITY;
    bind.w_axis.x = -1.0;
    let inverse = b.floats(&[bind.to_cols_array(), glam::Mat4::IDENTITY.to_cols_array()]);
    let document = json!({
        "meshes": [{ "primitives": [{ "attributes": attributes, "targets": [{ "POSITION": delta }] }], "weights": [0.25] }],
        "skins": [{ "joints": [1, 2], "inverseBindMatrices": inverse }],
        // The node of a skinned mesh has no say.
        "nodes": [
            { "mesh": 0, "skin": 0, "translation": [100, 100, 100], "children": [1, 2] },
            { "translation": [-100, -100, -100] }, { "translation": [-100, -98, -100] },
        ],
    });
    let mesh = b.read(document.clone()).unwrap().scene.meshes.remove(0);
    // z by the target. x, y: vertex 0 of joint 0 at 0; vertex 1 of joint 1; vertex 2 halfway between both.
    let expected = [Vec3::new(-1.0, 0.0, 0.25), Vec3::new(1.0, 2.0, 0.25), Vec3::new(-0.5, 2.0, 0.25)];
    assert_eq!(mesh.positions(), expected);
    let mut outside = document.clone();
    outside["skins"][0]["joints"] = json!([1]);
    assert!(b.read(outside).unwrap_err().contains("JOINTS_0: expected joints below 1, found 1 at vertex 1"));
    let mut apart = document;
    apart["nodes"][0]["children"] = json!([1]);
    assert!(
        b.read(apart)
            .unwrap_err()
            .contains("/skins/0/joints: expected joints in the scene of their mesh, found node 2")
    );
}

#[test]
fn meshes_of_one_material_become_one() {
    let (b, attributes) = triangle();
    let primitive = |material: usize| json!({ "attributes": attributes, "material": material });
    let file = b
        .read(json!({
            "meshes": [{ "primitives": [primitive(0), primitive(1)] }],
            "materials": [{}, {}],
            "nodes": [{ "mesh": 0, "children": [1] }, { "mesh": 0, "scale": [-2, 2, 2] }],
        }))
        .unwrap();
    let counts: Vec<usize> = file.scene.meshes.iter().map(|m| m.triangles().len()).collect();
    assert_eq!(counts, [2, 2]);
    let mesh = &file.scene.meshes[0];
    assert_eq!(mesh.triangles(), [[0, 1, 2], [3, 5, 4]], "a mirrored front stays a front");
    assert_eq!(mesh.positions()[4], Vec3::new(-2.0, 0.0, 0.0));
}

/// As many programs write the parts of a mesh that have materials of their own.
#[test]
fn parts_that_share_vertices_have_those_that_they_use() {
    let mut b = Builder::default();
    let position = b.floats(&[[0f32, 0., 0.], [1., 0., 0.], [0., 1., 0.], [5., 5., 5.], [1., 1., 0.]]);
    let uv = b.floats(&[[0f32, 0.], [1., 0.], [0., 1.], [0.5, 0.5], [1., 1.]]);
    let mut part = |corners: [u8; 3], material: usize| {
        let indices = b.accessor(5121, "SCALAR", 3, &corners);
        json!({ "attributes": { "POSITION": position, "TEXCOORD_0": uv }, "indices": indices, "material": material })
    };
    let parts = [part([0, 1, 2], 0), part([4, 2, 1], 1)];
    let meshes = |primitives: &[Value]| {
        let mesh = json!({ "meshes": [{ "primitives": primitives }], "materials": [{}, {}] });
        b.read(mesh).unwrap().scene.meshes
    };
    let [first, second] = &meshes(&parts)[..] else { panic!("two meshes") };
    assert_eq!(first.positions(), [Vec3::ZERO, Vec3::X, Vec3::Y]);
    assert_eq!(second.positions(), [Vec3::X, Vec3::Y, Vec3::new(1.0, 1.0, 0.0)]);
    assert_eq!((second.triangles(), second.corner_uvs()[0]), (&[[2, 1, 0]][..], [Vec2::ONE, Vec2::Y, Vec2::X]));
    // Alone, it keeps what the file has.
    let [alone] = &meshes(&parts[1..])[..] else { panic!("one mesh") };
    assert_eq!((alone.positions().len(), alone.triangles()), (5, &[[4, 2, 1]][..]));
}

#[test]
fn repeated_use_of_a_mesh_is_bounded() {
    let mut b = Builder::default();
    let position = b.floats(&vec![[0.5f32; 3]; 8000]);
    let nodes: Vec<Value> = (0..20_000).map(|_| json!({ "mesh": 0 })).collect();
    let message = b
        .read(json!({
            "meshes": [{ "primitives": [{ "attributes": { "POSITION": position } }] }],
            "nodes": nodes, "scenes": [{ "nodes": (0..20_000).collect::<Vec<_>>() }],
        }))
        .unwrap_err();
    assert!(message.contains("bytes of arrays from a file of this size, found more, by repeated use"), "{message}");
}

/// Primitives of a mesh at many nodes are many more than the file has of either.
#[test]
fn primitives_at_many_nodes_say_the_same_once() {
    let (b, attributes) = triangle();
    let at_nodes = |nodes: usize, primitives: usize, part: &Value| {
        json!({
            "meshes": [{ "primitives": vec![part; primitives] }],
            "nodes": vec![json!({ "mesh": 0 }); nodes], "scenes": [{ "nodes": (0..nodes).collect::<Vec<_>>() }],
        })
    };
    let lines = json!({ "attributes": attributes, "mode": 1 });
    let notes = b.read(at_nodes(3, 40, &lines)).unwrap().notes;
    let said =
        |node: usize| format!("/nodes/{node}: a primitive that is neither triangles nor splats is left out (40 times)");
    assert_eq!(notes[notes.len() - 3..], [said(0), said(1), said(2)]);
    assert!(notes.len() < 6, "{notes:?}");

    let asset = Asset::parse(&b.file(&at_nodes(1600, 1600, &lines)), PathBuf::new()).map_err(|_| ()).unwrap();
    let message = describe(&asset).unwrap_err().in_file(Path::new("f")).to_string();
    assert!(message.contains("bytes of arrays from a file of this size, found more, by repeated use"), "{message}");
}

#[test]
fn a_file_that_many_buffers_name_is_there_once() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let bytes: Vec<u8> = CORNERS.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(at("a.bin"), &bytes).unwrap();
    let primitive = |accessor: usize| json!({ "attributes": { "POSITION": accessor } });
    let accessor = |view: usize| json!({ "bufferView": view, "componentType": 5126, "type": "VEC3", "count": 3, "min": [0, 0, 0], "max": [1, 1, 0] });
    let buffers = ["a.bin", "./a.bin", "%61.bin"].map(|uri| json!({ "byteLength": 36, "uri": uri }));
    let document = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": (0..3).map(primitive).collect::<Vec<_>>() }],
        "accessors": (0..3).map(accessor).collect::<Vec<_>>(),
        "bufferViews": (0..3).map(|i| json!({ "buffer": i, "byteLength": 36 })).collect::<Vec<_>>(),
        "buffers": buffers,
    });
    std::fs::write(at("a.gltf"), document.to_string()).unwrap();
    let asset = Asset::open(&at("a.gltf")).unwrap();
    assert_eq!((asset.stored_bytes(), asset.buffers.len()), (36, 3));
    let options = ReadOptions { keep_document: true, ..ReadOptions::default() };
    let file = read_file(&at("a.gltf"), &options).unwrap();
    let options = WriteOptions { source: file.source.as_ref(), ..WriteOptions::default() };
    write_scene(&at("b.gltf"), &file.scene, &options).unwrap();
    let written: Value = serde_json::from_slice(&std::fs::read(at("b.gltf")).unwrap()).unwrap();
    assert_eq!(written["buffers"][0]["byteLength"], 36);
    let back = read_file(&at("b.gltf"), &ReadOptions::default()).unwrap().scene;
    let corners: Vec<&[Vec3]> = back.meshes[0].positions().chunks(3).collect();
    assert!(
        corners.len() == 3 && corners.iter().all(|corners| corners[0] == Vec3::ZERO && corners[1] == Vec3::X),
        "{corners:?}"
    );
}

#[test]
fn cameras_with_and_without_perspective() {
    let (b, attributes) = triangle();
    let file = b
        .read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
            "nodes": [{ "mesh": 0, "children": [1, 2] }, { "camera": 0, "name": "wide" }, { "camera": 1 }],
            "cameras": [
                { "type": "perspective", "perspective": { "yfov": 1.0, "aspectRatio": 2.0, "znear": 0.1 } },
                { "type": "orthographic", "orthographic": { "xmag": 1, "ymag": 1, "zfar": 10, "znear": 0.1 } },
            ],
        }))
        .unwrap();
    let [(name, camera)] = &file.cameras[..] else { panic!("{:?}", file.cameras) };
    let k = camera.intrinsics();
    assert_eq!((name.as_str(), k.width, k.height), ("wide", 2160, 1080));
    assert!((2.0 * (540.0 / k.fy).atan() - 1.0).abs() < 1e-6);
    assert!(file.notes.iter().any(|n| n.contains("camera left out: it is orthographic")), "{:?}", file.notes);
}

/// The near plane of a hybrid is asked of all cameras; `gltf` panics over one that is not what it says.
#[test]
fn a_camera_without_what_its_type_names_is_left_out() {
    let (b, attributes) = triangle();
    let file = b
        .read(json!({
            "extensionsUsed": [HYBRID],
            "scenes": [{ "nodes": [0, 1], "extensions": { HYBRID: { "colorSpace": "srgb_rec709_display" } } }],
            "meshes": [{ "primitives": [{ "attributes": attributes }] }],
            "nodes": [{ "mesh": 0 }, { "camera": 0 }],
            "cameras": [{ "type": "perspective", "orthographic": { "xmag": 1, "ymag": 1, "zfar": 10, "znear": 0.1 } }],
        }))
        .unwrap();
    assert!(file.cameras.is_empty() && file.scene.composition.near == Composition::default().near);
    assert!(file.notes.iter().any(|n| n.contains("camera left out")), "{:?}", file.notes);
}

#[test]
fn versions_that_are_not_understood_are_refused() {
    let (b, attributes) = triangle();
    let read = |asset: Value| {
        b.read(json!({ "asset": asset, "meshes": [{ "primitives": [{ "attributes": attributes }] }] })).map(drop)
    };
    for asset in
        [json!({ "version": "2.0" }), json!({ "version": "2.1" }), json!({ "version": "2.7", "minVersion": "2.0" })]
    {
        assert_eq!(read(asset), Ok(()));
    }
    let refused = |asset: Value| read(asset).unwrap_err();
    let expected = "glTF 2.0, or a later 2 that it can be read as";
    assert_eq!(refused(json!({ "version": "3.0" })), format!("f: /asset/version: expected {expected}, found `3.0`"));
    for asset in [json!({ "version": "1.0" }), json!({ "version": "new" }), json!({ "version": "20.0" })] {
        assert!(refused(asset).starts_with("f: /asset/version: expected"));
    }
    let least = refused(json!({ "version": "2.1", "minVersion": "2.1" }));
    assert_eq!(least, format!("f: /asset/minVersion: expected {expected}, found `2.1`"));
}
