//! Conversion of materials: our maps, textures, factors, emission and vertex colours.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::Vec2;
use serde_json::{Value, json};

use super::core_tests::{Builder, UVS, near, triangle};
use super::extension::HYBRID;
use super::*;
use crate::format::activation;
use crate::format::map_budget::{self, MapBudget};
use crate::format::test_scenes::black_png;
use crate::scene::{ColorSpace, Mesh, sh};

/// Colour and opacity of a texel.
fn shown(mesh: &Mesh, texel: usize) -> [f32; 4] {
    let t = &mesh.atlas().base().texels()[4 * texel..];
    let [r, g, b] = sh::rgb_from_dc([t[0], t[1], t[2]]);
    [r, g, b, activation::opacity(t[3])]
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
    // Scaled to (2u, v/2), rotated to (v/2, −2u), then moved: the order of KHR_texture_transform.
    let at = |[u, v]: [f32; 2]| [0.5 + 0.5 * v, 0.25 - 2.0 * u];
    for (uv, corner) in UVS.iter().zip(&mesh.corner_uvs()[0]) {
        near(&corner.to_array(), &at(*uv), 1e-6);
    }
    // −1.75 to 0.25 in v are three tiles, 0.5 to 1 in u is one; the bands are repeated like the base.
    let read = file(source(&moved), source(&moved), json!({})).unwrap();
    let mesh = &read.scene.meshes[0];
    let bands = mesh.atlas().bands().unwrap();
    assert_eq!([mesh.atlas().base().height(), bands.height(), bands.width()], [6, 6, 2]);
    for (uv, corner) in UVS.iter().zip(&mesh.corner_uvs()[0]) {
        let [u, v] = at(*uv);
        near(&corner.to_array(), &[u, (v + 2.0) / 3.0], 1e-6);
    }
    // UVs and texels do not depend on the node, and SH bands rotate with it: the radiance seen along x is now seen
    // along y.
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
    // All maps of a material must have the transform of coefficient 0.
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

#[test]
fn texels_of_plain_integers_are_refused() {
    let (mut b, attributes) = triangle();
    let (plain, normalized) =
        (b.accessor(5121, "VEC3", 1, &[10, 20, 30, 0]), b.normalized(5121, "VEC3", 1, &[10, 20, 30, 0]));
    let read = |accessor: usize| {
        let coefficients = [json!({ "accessor": accessor, "width": 1, "height": 1 })];
        let harmonics = json!({ "degree": 0, "coefficients": coefficients });
        let radiance = json!({ "colorSpace": "srgb_rec709_display", "sphericalHarmonics": harmonics });
        b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
            "materials": [{ "extensions": { HYBRID: radiance } }],
        }))
    };
    assert!(read(normalized).is_ok());
    let message = read(plain).unwrap_err();
    let said = "/coefficients/0/accessor: expected 3 component(s), of Float or a normalised type, found 3 of U8";
    assert!(message.ends_with(said), "{message}");
}

#[test]
fn what_is_cut_out_of_the_one_layer_is_noted() {
    let (b, attributes) = triangle();
    let notes = |alpha: f32, stated: Value| {
        let file = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
            "materials": [{
                "alphaMode": "MASK", "doubleSided": true, "extensions": { "KHR_materials_unlit": {} },
                "pbrMetallicRoughness": { "baseColorFactor": [1, 1, 1, alpha] },
            }],
            "scenes": [{ "nodes": [0], "extensions": stated }],
        }));
        file.unwrap().notes
    };
    let layers = |layers: u32| json!({ HYBRID: { "colorSpace": "srgb_rec709_display", "layers": layers } });
    let said = "/materials/0: areas that its alpha mask cuts out use up the single layer stated: surfaces behind them may be missing";
    assert_eq!(notes(0.2, layers(1)), [said]);
    assert_eq!(notes(0.2, json!({ HYBRID: { "colorSpace": "srgb_rec709_display" } })), [said], "one is the default");
    for (alpha, stated) in [(0.2, layers(2)), (0.9, layers(1)), (0.2, json!({}))] {
        assert_eq!(notes(alpha, stated), Vec::<String>::new());
    }
}

/// In core glTF the transform of a skinned mesh's own node is ignored; the transform from scene to capture frame is
/// not.
#[test]
fn what_is_seen_of_a_skinned_mesh_does_not_turn_with_its_node() {
    let (mut b, mut attributes) = triangle();
    b.skinned(&mut attributes, [[0; 4]; 3], [[1.0, 0.0, 0.0, 0.0]; 3]);
    let coefficients =
        [0.1f32, 0.2, 0.3, 0.4].map(|v| json!({ "accessor": b.floats(&[[v, -v, 0.5]]), "width": 1, "height": 1 }));
    let harmonics = json!({ "degree": 1, "coefficients": coefficients });
    let radiance = json!({ "colorSpace": "srgb_rec709_display", "sphericalHarmonics": harmonics });
    let bands = |root: Value| {
        let file = b.read(json!({
            "meshes": [{ "primitives": [{ "attributes": attributes, "material": 0 }] }],
            "materials": [{ "extensions": { HYBRID: radiance } }],
            "skins": [{ "joints": [1] }],
            "scenes": [{ "nodes": [2] }],
            "nodes": [{ "mesh": 0, "skin": 0, "rotation": [0, 0, 0.6, 0.8] }, {}, root],
        }));
        file.unwrap().scene.meshes[0].atlas().bands().unwrap().texels().to_vec()
    };
    let stored = [0.2, -0.2, 0.5, 0.3, -0.3, 0.5, 0.4, -0.4, 0.5];
    near(&bands(json!({ "children": [0, 1], "rotation": [0, 1, 0, 0] })), &stored, 1e-6);
    // Of the components y, z and x, the first two are negated in the frame of captures.
    let turned = [-0.2, 0.2, -0.5, -0.3, 0.3, -0.5, 0.4, -0.4, 0.5];
    let ours =
        json!({ "children": [0, 1], "rotation": [1, 0, 0, 0], "name": "centaur_world", "extras": { "centaur": {} } });
    near(&bands(ours), &turned, 1e-6);
}

/// One picture can serve as all coefficients, and counts once for each.
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
                "doubleSided": true, "extensions": { "KHR_materials_unlit": {} },
            }],
            "textures": [{ "source": 0 }], "images": [image],
        }));
        let file = file.unwrap();
        let said = format!("/materials/0/pbrMetallicRoughness/baseColorTexture: left out: {reason}");
        assert!(file.notes.len() == 1 && file.notes[0].starts_with(&said), "{:?}", file.notes);
        // Half the linear light is 0.735 in sRGB.
        near(&shown(&file.scene.meshes[0], 0), &[0.735_357, 1.0, 1.0, 1.0], 1e-5);
    }
}

/// A PNG with the value `texel(x, y)` at each texel.
fn png_of(width: u32, height: u32, texel: impl Fn(u32, u32) -> [u8; 4]) -> Vec<u8> {
    let mut png = std::io::Cursor::new(vec![]);
    ::image::RgbaImage::from_fn(width, height, |x, y| ::image::Rgba(texel(x, y)))
        .write_to(&mut png, ::image::ImageFormat::Png)
        .unwrap();
    png.into_inner()
}

/// Primitives of a material whose texture 0 is the picture in a buffer view, read by a sampler.
fn pictured(b: &Builder, view: usize, primitives: &[Value], material: &Value, sampler: &Value) -> Content {
    let file = b.read(json!({
        "meshes": [{ "primitives": primitives }], "materials": [material], "samplers": [sampler],
        "textures": [{ "source": 0, "sampler": 0 }], "images": [{ "bufferView": view, "mimeType": "image/png" }],
    }));
    file.unwrap()
}

/// Mip levels and filters weight colours by opacity.
#[test]
fn a_clear_texel_does_not_erase_three_opaque_ones() {
    let mean = |file: Content| {
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

/// `KHR_materials_pbrSpecularGlossiness`, as in files older than the core's metallic-roughness materials.
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
    // Half the linear light is 0.735 in sRGB.
    near(&colour, &[0.735_357, 0.2, 0.0, 64.0 / 255.0], 1e-5);
    assert_eq!(uvs, UVS.map(|uv| Vec2::from(uv) / 2.0 + Vec2::new(0.25, 0.0)));
    assert_eq!(notes, ["/materials/0: only its diffuse colour is shown, unlit"]);
    // What has no picture of its own, or is black, is shown by what it emits.
    let (colour, _, notes) = read(json!({ "diffuseFactor": [1, 1, 1, 0.25] }), json!([0.5, 1, 1]));
    near(&colour, &[0.735_357, 0.2, 0.0, 0.25], 1e-5);
    assert_eq!(notes, ["/materials/0: only its emission is shown, unlit"]);
    // A texture that is not there.
    let (colour, _, notes) =
        read(json!({ "diffuseFactor": [1, 0, 0, 1], "diffuseTexture": texture(7) }), json!([0, 0, 0]));
    near(&colour, &[1.0, 0.0, 0.0, 1.0], 1e-5);
    let said = "/materials/0/extensions/KHR_materials_pbrSpecularGlossiness/diffuseTexture: left out: /textures/7: ";
    assert!(notes[1].starts_with(said), "{notes:?}");
}

#[test]
fn what_repeats_too_often_repeats_at_a_lower_resolution() {
    let (mut b, attributes) = triangle();
    let view = b.view(&png_of(4, 2, |x, y| if x < 2 { [(100 * y) as u8, 0, 0, 255] } else { [0, 0, 200, 255] }));
    // 20,000 texels in a row are more than a texture may have.
    let transform = json!({ "KHR_texture_transform": { "scale": [5000, 1] } });
    let material = json!({
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0, "extensions": transform } },
        "doubleSided": true, "extensions": { "KHR_materials_unlit": {} },
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
    // Triangles of one colour share a mesh.
    let [tinted, plain] = &file.scene.meshes[..] else { panic!("{}", file.scene.meshes.len()) };
    assert_eq!([tinted, plain].map(|mesh| mesh.triangles().len()), [2, 1]);
    // Half the linear light is 0.735 in sRGB.
    near(&shown(tinted, 0), &[0.735_357, 0.2, 0.0, 64.0 / 255.0], 1e-5);
    near(&shown(tinted, 1), &[0.735_357, 0.2, 0.0, 0.0], 1e-5);
    near(&shown(plain, 0), &[1.0, 0.2, 0.0, 128.0 / 255.0], 1e-5);
    let file = pictured(&b, view, &[varied], &material, &json!({}));
    assert_eq!(
        file.notes,
        ["/nodes/0: vertex colours of a textured mesh are left out, because they are not all equal"]
    );
    near(&shown(&file.scene.meshes[0], 0), &[1.0, 0.2, 0.0, 128.0 / 255.0], 1e-5);
}

#[test]
fn samplers_of_sharp_texels_are_noted() {
    let (mut b, attributes) = triangle();
    let view = b.view(&png_of(2, 2, |x, y| [(255 * x) as u8, (255 * y) as u8, 0, 255]));
    let primitives = [json!({ "attributes": attributes, "material": 0 })];
    let unlit = json!({
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } },
        "doubleSided": true, "extensions": { "KHR_materials_unlit": {} },
    });
    let note = "/textures/0: its sampler's NEAREST is read as linear filtering";
    assert_eq!(pictured(&b, view, &primitives, &unlit, &json!({ "magFilter": 9728 })).notes, [note]);
    for linear in [json!({}), json!({ "magFilter": 9729, "minFilter": 9984 })] {
        assert!(pictured(&b, view, &primitives, &unlit, &linear).notes.is_empty());
    }
    // One picture serves as emission and as opacity.
    let glowing = json!({
        "alphaMode": "BLEND", "doubleSided": true, "emissiveFactor": [1, 1, 1], "emissiveTexture": { "index": 0 },
        "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 }, "baseColorFactor": [0, 0, 0, 1] },
    });
    let notes = pictured(&b, view, &primitives, &glowing, &json!({ "magFilter": 9728 })).notes;
    assert_eq!(notes, ["/materials/0: only its emission is shown, unlit", note]);
}

#[test]
fn texture_coordinates_are_transformed() {
    // The lower left quarter of the picture, rotated (the example in the extension's specification).
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
    // Half the linear light is 0.735 in sRGB.
    near(&read(factor), &[0.735_357, 0.0, 0.0, 0.5 * half], 1e-5);
}

/// Surfaces with transparency or cut-outs need several layers.
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

/// As in models whose parts share one texture sheet.
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
            "materials": [{
                "doubleSided": true, "extensions": extensions,
                "pbrMetallicRoughness": { "baseColorFactor": [0.2, 0.4, 0.6, 1] },
            }],
            "extensionsUsed": ["KHR_materials_unlit"],
        })
    };
    assert!(b.read(document(json!({ "KHR_materials_unlit": {} }))).unwrap().notes.is_empty());
    assert_eq!(b.read(document(json!({}))).unwrap().notes, ["/materials/0: only its base colour is shown, unlit"]);
}

#[test]
fn materials_of_one_side_are_counted_where_they_are_drawn() {
    let (b, attributes) = triangle();
    let drawn = |material: usize, mode: u32| json!({ "attributes": attributes, "material": material, "mode": mode });
    let unlit = |mode: &str, is_double_sided: bool| {
        let extensions = json!({ "KHR_materials_unlit": {} });
        json!({ "alphaMode": mode, "doubleSided": is_double_sided, "extensions": extensions })
    };
    let materials = [unlit("OPAQUE", false), unlit("BLEND", false), unlit("OPAQUE", true)];
    let notes = |primitives: &[Value]| {
        b.read(json!({ "meshes": [{ "primitives": primitives }], "materials": materials })).unwrap().notes
    };
    let said = "drawn from both sides: glTF hides the backs of such surfaces";
    let all = [drawn(0, 4), drawn(1, 4), drawn(2, 4), drawn(0, 4)];
    assert_eq!(notes(&all), [format!("2 single-sided materials are {said}")]);
    assert_eq!(notes(&all[..1]), [format!("1 single-sided material is {said}")]);
    let lines = "/nodes/0: a primitive that is neither triangles nor splats is left out";
    assert_eq!(notes(&[drawn(0, 1), drawn(2, 4)]), [lines]);
}

/// As written by Blender for a picture that is connected to the emission, and for a lamp; a material with a base colour
/// picture is shown by that.
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
    // Half the linear light is 0.735 in sRGB.
    near(&color, &[0.735_357, 0.2, 0.0, 0.25], 1e-5);
    assert_eq!(notes, ["/materials/0: only its emission is shown, unlit"]);
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
    assert_eq!(notes[0], "/materials/0: only its base colour is shown, unlit");
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
    let said = "/nodes/0: texture coordinates are replaced by those of the map of its vertex colours";
    assert_eq!(file.notes, [said]);
    let mesh = &file.scene.meshes[0];
    let width = mesh.atlas().base().width() as f32;
    for (uv, colour) in
        mesh.corner_uvs()[0].iter().zip([[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.2]])
    {
        let texel = (*uv * Vec2::new(width, mesh.atlas().base().height() as f32)).floor();
        near(&shown(mesh, (texel.y * width + texel.x) as usize), &colour, 1e-6);
    }
    // A single colour needs no map.
    b.bytes.truncate(b.bytes.len() - 12);
    b.bytes.extend([255, 255, 255, 51].repeat(3));
    let file = read(&b).unwrap();
    assert!(file.notes.is_empty(), "{:?}", file.notes);
    let mesh = &file.scene.meshes[0];
    assert_eq!(mesh.atlas().floats(), 4);
    near(&shown(mesh, 0), &[1.0, 1.0, 1.0, 0.2], 1e-6);
}
