use glam::{DVec3, Vec2, Vec3};
use proptest::prelude::*;

use super::*;
use crate::format::map_budget::MapBudget;
use crate::format::test_scenes::{camera, random_scene, read_turned};
use crate::format::{WriteOptions, write_scene};
use crate::scene::{Splats, sh};

fn assert_close(a: &Splats, b: &Splats) {
    assert_eq!((a.means(), a.sh_degree(), a.sh()), (b.means(), b.sh_degree(), b.sh()));
    assert_eq!(a.rotations(), b.rotations());
    for i in 0..a.len() {
        // f32 has 24 bits: applying exp and ln changes s by 6e-8, plus rounding.
        assert!((a.log_scales()[i] - b.log_scales()[i]).abs().max_element() < 1e-6);
        let opacity = |s: &Splats| 1.0 / (1.0 + (-f64::from(s.opacity_logits()[i])).exp());
        assert!((opacity(a) - opacity(b)).abs() <= 1e-6 * opacity(a), "{} {}", opacity(a), opacity(b));
    }
}

pub(super) fn folder_with(text: &str) -> (tempfile::TempDir, std::path::PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    std::fs::write(&path, format!("#usda 1.0\n{text}")).unwrap();
    (folder, path)
}

pub(super) fn read_text(text: &str) -> Content {
    let (_folder, path) = folder_with(text);
    read(&path).unwrap()
}

fn refusal(text: &str) -> String {
    let (folder, path) = folder_with(text);
    read(&path).unwrap_err().to_string().replace(&folder.path().display().to_string(), "")
}

#[test]
fn a_projection_of_its_own_is_named() {
    let notes = |hint: &str| {
        let body = format!("uniform token projectionModeHint = \"{hint}\" point3f[] positions = [(1, 2, 3)]");
        read_text(&format!("def ParticleField3DGaussianSplat \"S\" {{ {body} }}")).notes
    };
    let of_hint = |hint| notes(hint).into_iter().filter(|note| note.contains("projectionModeHint")).collect::<Vec<_>>();
    assert!(of_hint("perspective").is_empty());
    assert_eq!(of_hint("tangential"), ["/S.projectionModeHint: `tangential`, read as perspective"]);
}

#[test]
fn round_trip() {
    let folder = tempfile::tempdir().unwrap();
    for seed in 0..8 {
        let scene = random_scene(20, 1 + seed as u32 % 3, seed as u32 % 4, seed);
        let cameras =
            [("IMG_01.jpg", camera()), ("b", camera().resized(320, 200)), ("splats", camera()), ("7é", camera())];
        let cameras = cameras.map(|(name, camera)| (name.to_owned(), camera));
        let path = folder.path().join(format!("scène @ {seed}.{}", ["usda", "USDZ"][seed as usize % 2]));
        write(&path, &scene, &cameras, None).unwrap();
        let back = read(&path).unwrap();
        assert_eq!(back.notes, Vec::<String>::new());
        assert_eq!(back.scene.meshes, scene.meshes, "geometry, UVs and maps bit for bit");
        assert_eq!(back.scene.composition, scene.composition);
        assert_close(&scene.splats, &back.scene.splats);
        assert!(!back.y_up && back.cameras.len() == cameras.len());
        for ((name, camera), (name_back, camera_back)) in cameras.iter().zip(&back.cameras) {
            assert_eq!((name, camera.intrinsics()), (name_back, camera_back.intrinsics()));
            // `Camera::new` orthonormalises the rotation again.
            assert!(camera.rotation().abs_diff_eq(camera_back.rotation(), 1e-14));
            assert_eq!(camera.translation(), camera_back.translation());
        }
    }
}

/// As in a file where somebody has moved a scene below a prim of their own.
#[test]
fn the_rule_of_blending_may_stand_further_down() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let mut scene = random_scene(20, 1, 1, 3);
    scene.composition.lambda = 0.25;
    write(&path, &scene, &[("a".to_owned(), camera())], None).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let start = text.find("\ndef ").unwrap();
    // Paths of a layer are absolute.
    let root = text[start..].split('"').nth(1).unwrap();
    let below = text[start..].replace(&format!("</{root}"), &format!("</World/{root}"));
    std::fs::write(&path, format!("{}\ndef Xform \"World\" {{{below}}}\n", &text[..start])).unwrap();
    let back = read(&path).unwrap();
    assert_eq!((&back.scene.composition, back.y_up), (&scene.composition, false));
    assert_eq!(back.scene.meshes, scene.meshes);
    assert_close(&scene.splats, &back.scene.splats);
    assert!(back.cameras[0].1.rotation().abs_diff_eq(camera().rotation(), 1e-9));
}

#[test]
fn parts_may_be_absent_and_names_strange() {
    let folder = tempfile::tempdir().unwrap();
    for (splats, meshes) in [(0, 0), (0, 1), (3, 0)] {
        let scene = random_scene(splats, meshes, 0, 2);
        for name in ["a:b@c %20.usda", "a.usdz", "-.usda"] {
            let path = folder.path().join(name);
            write(&path, &scene, &[], None).unwrap();
            let back = read(&path).unwrap();
            assert_eq!((back.scene.splats.len(), back.scene.meshes.len()), (splats, meshes as usize));
            assert!(back.notes.is_empty(), "{:?}", back.notes);
        }
    }
    assert!(write(&folder.path().join("none/a.usda"), &random_scene(1, 1, 0, 2), &[], None).is_err());
}

#[test]
fn the_record_of_the_training_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let record =
        serde_json::json!({ "capture": "a \"b\"\n@c@ é", "loss": [0.1, 1e-7, null], "settings": { "x": true } });
    for name in ["a.usda", "a.usdz"] {
        let path = folder.path().join(name);
        write(&path, &random_scene(1, 0, 0, 2), &[], Some(&record)).unwrap();
        let back = read(&path).unwrap();
        assert_eq!((back.record.as_ref(), back.notes), (Some(&record), vec![]));
    }
    let text = |entry: &str| read_text(&format!("(\n customLayerData = {{\n {entry}\n }}\n metersPerUnit = 1\n)\n"));
    let other = text("string other = \"1\"");
    assert_eq!((other.record, &other.notes[..]), (None, &["1 entry of customLayerData left out".to_owned()][..]));
    let broken = text("string centaur = \"{\"");
    assert_eq!(
        (broken.record, &broken.notes[0][..]),
        (None, "/customLayerData/centaur: the record of the training is not JSON and is left out")
    );
}

#[test]
fn a_package_is_aligned_stored_and_begins_with_its_layer() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usdz");
    let (written, beside) = write(&path, &random_scene(10, 2, 2, 3), &[], None).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(written, bytes.len() as u64);
    assert!(beside.is_empty(), "a package holds all");
    let mut archive = zip::ZipArchive::new(std::io::Cursor::new(bytes)).unwrap();
    assert!(archive.len() >= 7);
    for i in 0..archive.len() {
        let member = archive.by_index(i).unwrap();
        assert_eq!(member.data_start().unwrap() % 64, 0, "{:?}", member.name());
        assert_eq!(member.compression(), zip::CompressionMethod::Stored);
        assert_eq!(i == 0, member.name().unwrap() == "scene.usda");
    }
}

/// One splat of degree 1, red towards +x, in a file in centimetres with z up, below three prims that transform it.
const FOREIGN: &str = r#"(
    upAxis = "Z"
    metersPerUnit = 0.01
)
def Xform "World" {
    double3 xformOp:translate = (100, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Xform "Turn" {
        float xformOp:rotateZ = 90
        double xformOp:scale = 7
        uniform token[] xformOpOrder = ["xformOp:rotateZ"]
        def ParticleField3DGaussianSplat "S" {
            quath xformOp:orient = (1, 0, 0, 0)
            float3 xformOp:scale = (2, 2, 2)
            uniform token[] xformOpOrder = ["xformOp:orient", "xformOp:scale"]
            point3h[] positionsh = [(10, 20, 30), (0, 0, 0)]
            quatf[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0), (1, 0, 0, 0)]
            float3[] scales = [(1, 2, 3), (1, 1, 1)]
            float[] opacities = [0.25]
            uniform int radiance:sphericalHarmonicsDegree = 1
            float3[] radiance:sphericalHarmonicsCoefficients = [
                (0, 0, 0), (0, 0, 0), (0, 0, 0), (-1, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0)]
        }
    }
}
def Camera "C" {
    float focalLength = 24
    float horizontalAperture = 36
    float verticalAperture = 18
    float horizontalApertureOffset = 3.6
    float verticalApertureOffset = -1.8
    double3 xformOp:translate = (0, 0, 200)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def PointInstancer "P" {
    def Scope "Prototypes" {
        def Mesh "M" {
            int[] faceVertexCounts = [3]
            int[] faceVertexIndices = [0, 1, 2]
            point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        }
        def Camera "Below" {}
    }
}
def Mesh "hidden" { token visibility = "invisible" }
"#;

/// Rendering depends only on the ratio of aperture to focal length, but Blender shows both in millimetres.
#[test]
fn sensors_are_as_wide_as_film() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    write(&path, &random_scene(1, 0, 0, 4), &[("a".to_owned(), camera())], None).unwrap();
    let layer = document(std::fs::read(&path).unwrap()).unwrap();
    let stage = Stage::new(&layer);
    let of_camera = (0..stage.prims.len()).find(|&i| stage.prims[i].type_name == "Camera").unwrap();
    let millimetres = |name: &str| {
        let metres_per_unit = layer.field("metersPerUnit").and_then(document::Value::as_number).unwrap();
        stage.number(of_camera, name).unwrap() * 0.1 * metres_per_unit * 1000.0
    };
    let k = *camera().intrinsics();
    assert!((millimetres("horizontalAperture") - 36.0).abs() < 1e-5);
    assert!((millimetres("focalLength") - 36.0 * k.fx / f64::from(k.width)).abs() < 1e-5);
}

/// Foreign files are y up and scenes y down; written again, they are upright.
#[test]
fn what_others_wrote_stays_where_it_is_however_often_it_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let layer = r#"#usda 1.0
( metersPerUnit = 1 )
def Mesh "M" {
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 1, 2), (1, 1, 2), (0, 3, 2)]
    uniform token subdivisionScheme = "none"
}
def Camera "C" {
    double3 xformOp:translate = (0.5, 2, 7)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"#;
    std::fs::write(at("theirs.usda"), layer).unwrap();
    let theirs = read_turned(&at("theirs.usda"), true);
    let options = WriteOptions { cameras: &theirs.cameras, ..WriteOptions::default() };
    for name in ["a.usda", "a.usdz", "a.glb"] {
        write_scene(&at(name), &theirs.scene, &options).unwrap();
        read_turned(&at(name), false);
    }
    // Programs that do not know our frame see the scene where the original was.
    let ours = std::fs::read_to_string(at("a.usda")).unwrap();
    let seen = ours.replace("\"capture\"", "\"theirs\"");
    assert_ne!(seen, ours);
    std::fs::write(at("a.usda"), seen).unwrap();
    read_turned(&at("a.usda"), true);
}

#[test]
fn units_axes_and_nested_transforms_are_applied() {
    let file = read_text(FOREIGN);
    assert!(file.y_up && file.scene.meshes.is_empty() && file.cameras.len() == 1);
    let splats = &file.scene.splats;
    // Scaled (20, 40, 60), rotated about z (−40, 20, 60), moved (60, 20, 60), then in metres with y down.
    assert!(splats.means()[0].abs_diff_eq(Vec3::new(0.6, -0.6, 0.2), 1e-6), "{}", splats.means()[0]);
    let scales = splats.log_scales()[0].exp();
    assert!(scales.abs_diff_eq(Vec3::new(0.02, 0.04, 0.06), 1e-7), "{scales}");
    // The local x axis points along y of the file, which is z in the scene; the local z axis along z of the file, which
    // is −y.
    let axes = [Vec3::X, Vec3::Z].map(|axis| splats.rotations()[0] * axis);
    assert!(axes[0].abs_diff_eq(Vec3::Z, 1e-6) && axes[1].abs_diff_eq(-Vec3::Y, 1e-6), "{axes:?}");
    let red = |d: DVec3| -> f64 {
        let basis = sh::basis(d.to_array());
        splats.sh_of(0).iter().zip(basis).map(|(c, y)| f64::from(c[0]) * y).sum()
    };
    assert!(red(DVec3::Z) > 0.48 && red(DVec3::X).abs() < 1e-6 && red(DVec3::Y).abs() < 1e-6);
    // With too few opacities, the opacity is taken as 1.
    assert!(splats.opacity_logits()[0] > 16.0);

    let (name, camera) = &file.cameras[0];
    let k = camera.intrinsics();
    assert_eq!((name.as_str(), k.width, k.height), ("C", 2160, 1080));
    let close = |a: f64, b: f64| (a - b).abs() < 1e-3;
    assert!(
        close(k.fx, 1440.0) && close(k.fy, 1440.0) && close(k.cx, 0.4 * 2160.0) && close(k.cy, 0.4 * 1080.0),
        "{k:?}"
    );
    // The camera is two metres up and looks down; its right axis is x.
    assert!(camera.center().abs_diff_eq(-2.0 * DVec3::Y, 1e-9));
    assert!(camera.to_camera(DVec3::ZERO).abs_diff_eq(2.0 * DVec3::Z, 1e-9));
    assert!((camera.rotation() * DVec3::X).abs_diff_eq(DVec3::X, 1e-9));

    assert_eq!(
        file.notes,
        [
            "/World/Turn/S.orientations: 3 values for 2, cut",
            "/World/Turn/S.opacities: 1 values for 2, not used",
            "/World/Turn/S: 2 opacities not between 0 and 1 or scales not above 0 are clamped, so that their logit or logarithm is finite",
            "/C: a camera without an image size is taken to have 2160×1080 pixels",
            "1 prim left out because invisible, with all below",
            "1 prim of type PointInstancer left out, with all below",
        ]
    );
}

/// From a file that usdcat made of one that we wrote.
#[test]
fn the_record_of_the_training_is_read_from_binary_too() {
    let at = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/usd").join(name);
    for name in ["record.usda", "record.usdc"] {
        let file = read(&at(name)).unwrap();
        assert_eq!(file.record, Some(serde_json::json!({ "iterations": 7 })), "{name}");
        assert_eq!(file.notes.last().unwrap(), "3 entries of customLayerData left out", "{name}");
    }
}

/// Winding is counter-clockwise as seen from the front: a mirror or a left-handed orientation alone reverses it, both
/// together do not.
#[test]
fn the_front_of_a_face_stays_its_front() {
    for (orientation, scale, expected) in [
        ("rightHanded", 1, [0, 1, 2]),
        ("leftHanded", 1, [0, 2, 1]),
        ("rightHanded", -1, [0, 2, 1]),
        ("leftHanded", -1, [0, 1, 2]),
    ] {
        let file = read_text(&format!(
            r#"( metersPerUnit = 1 )
def Mesh "T" {{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    texCoord2f[] primvars:st = [(0, 0), (0.25, 0), (0, 0.5)] ( interpolation = "faceVarying" )
    uniform token orientation = "{orientation}"
    uniform token subdivisionScheme = "none"
    float3 xformOp:scale = ({scale}, 1, 1)
    uniform token[] xformOpOrder = ["xformOp:scale"]
}}
"#
        ));
        let mesh = &file.scene.meshes[0];
        assert_eq!(mesh.triangles(), [expected], "{orientation} {scale}");
        let uvs = [Vec2::new(0.0, 1.0), Vec2::new(0.25, 1.0), Vec2::new(0.0, 0.5)];
        assert_eq!(mesh.corner_uvs()[0], expected.map(|corner| uvs[corner as usize]), "{orientation} {scale}");
    }
}

/// Holes are excluded, both for an existing face and for an index beyond the faces.
#[test]
fn holes_are_no_faces() {
    let mesh = |holes: &str| {
        read_text(&format!(
            r#"( metersPerUnit = 1 )
def Mesh "M" {{
    int[] faceVertexCounts = [3, 4, 3]
    int[] faceVertexIndices = [0, 1, 2, 0, 2, 3, 4, 5, 4, 3]
    int[] holeIndices = {holes}
    point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0), (5, 0, 0)]
    texCoord2f[] primvars:st = [(0, 0), (0.1, 0), (0.2, 0)] ( interpolation = "uniform" )
    uniform token subdivisionScheme = "none"
    def GeomSubset "A" {{ int[] indices = [1] rel material:binding = </Red> }}
}}
def Material "Red" {{}}
"#
        ))
    };
    let file = mesh("[1, 3]");
    let [mesh_of_two] = &file.scene.meshes[..] else { panic!("{}", file.scene.meshes.len()) };
    assert_eq!(mesh_of_two.triangles(), [[0, 1, 2], [5, 4, 3]]);
    assert_eq!(mesh_of_two.corner_uvs()[1], [Vec2::new(0.2, 1.0); 3]);
    assert_eq!(file.notes[0], "/M.holeIndices: 1 of 2 are not faces and are ignored");
    let none = mesh("[2, 1, 0]");
    assert_eq!(
        (none.scene.meshes.len(), &none.notes[..]),
        (0, &["/M: a mesh without triangles is left out".to_owned()][..])
    );
}

/// Notes exclude data that we write ourselves, and data that programs add to all of their files.
#[test]
fn what_others_added_is_named() {
    let text = |own: &str, custom: &str| {
        read_text(&format!(
            "( customLayerData = {{ string creator = \"b\" dictionary cameraSettings = {{ int a = 1 }} {own} }} metersPerUnit = 1 )
            def \"W\" ( customData = {{ dictionary Blender = {{ bool generated = 1 }} {own} }} ) {{
                custom string userProperties:blender:object_name = \"W\"
                custom token centaur:later = \"a\"
                custom point3h[] positionsh = []
                custom double3 xformOp:translate = (1, 2, 3)
                {custom}
            }}
            def \"V\" {{ token info = \"a\" ( customData = {{ {own} }} ) }}"
        ))
        .notes
    };
    assert_eq!(text("", ""), Vec::<String>::new());
    assert_eq!(
        text("int a = 1 float2 b = (1, 2)", "custom rel other custom float userProperties:weight = 2"),
        [
            "2 entries of customLayerData left out",
            "1 prim with custom properties left out",
            "2 prims with customData left out",
        ]
    );
}

#[test]
fn concave_polygons_keep_their_area() {
    let file = read_text(
        r#"def Mesh "M" {
    int[] faceVertexCounts = [5]
    int[] faceVertexIndices = [0, 1, 2, 3, 4]
    point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (1, 0.5, 0), (0, 2, 0)]
    uniform token subdivisionScheme = "none"
}
"#,
    );
    let mesh = &file.scene.meshes[0];
    let corners = mesh.triangles().iter().map(|t| t.map(|v| mesh.positions()[v as usize]));
    let areas: Vec<f32> = corners.map(|[a, b, c]| 0.5 * (b - a).cross(c - a).length()).collect();
    // A stage without metersPerUnit is in centimetres.
    let unit = mesh.positions()[1].length() / 2.0;
    assert!((areas.iter().sum::<f32>() / (unit * unit) - 2.5).abs() < 1e-5, "{areas:?}");
}

#[test]
fn what_cannot_be_taken_over_is_refused_in_one_line() {
    let splats = |body: &str| format!("def ParticleField3DGaussianSplat \"S\" {{ {body} }}");
    let one = "point3f[] positions = [(0,0,0)] float3[] scales = [(1,1,1)] float[] opacities = [0.5] ";
    for (text, message) in [
        (splats("float3 positions = (1, 2, 3) half[] x = []"), None),
        (splats("int[] positions = [1]"), Some("/a.usda: /S.positions: expected floats, 3 an element, found `int[]`")),
        (
            splats("uniform int radiance:sphericalHarmonicsDegree = -1"),
            Some("/a.usda: /S.radiance:sphericalHarmonicsDegree: expected a degree of 0 to 3, found -1"),
        ),
        (
            splats(&format!("{one} quatf[] orientations = [(0,0,0,0)]")),
            Some("/a.usda: /S: expected a non-zero quaternion, found [0, 0, 0, 0] in rotations[0]"),
        ),
        (
            splats("uniform token[] xformOpOrder = [\"xformOp:scale\"]"),
            Some("/a.usda: /S.xformOp:scale: expected finite numbers of an xformOp, found 0 numbers"),
        ),
        (
            "def Mesh \"M\" { int[] faceVertexCounts = [3] int[] faceVertexIndices = [0, 1, 2] }".to_owned(),
            Some("/a.usda: /M.faceVertexIndices: expected indices below 0, found 0"),
        ),
        (
            "def Mesh \"M\" { int[] faceVertexCounts = [4294967295, -1] }".to_owned(),
            Some("/a.usda: /M.faceVertexCounts: expected indices of 32 bits, found -1"),
        ),
        ("( upAxis = \"X\" )".to_owned(), Some("/a.usda: /upAxis: expected Y or Z, found `X`")),
        (
            "( metersPerUnit = 0 )".to_owned(),
            Some("/a.usda: /metersPerUnit: expected a positive number, found another value"),
        ),
        (
            "def \"S\" { token centaur:mode = \"odd\" }".to_owned(),
            Some("/a.usda: /S.centaur:mode: expected stable, surfaceConsistent or direct, found `odd`"),
        ),
    ] {
        match message {
            Some(message) => assert_eq!(refusal(&text), message),
            None => assert_eq!(read_text(&text).scene.splats.len(), 1),
        }
    }
}

#[test]
fn splats_under_a_flat_transform_are_not_drawn() {
    let ops = "float3 xformOp:scale = (1, 0, 2) uniform token[] xformOpOrder = [\"xformOp:scale\"]";
    let splats = |name: &str, more: &str| {
        format!("def ParticleField3DGaussianSplat \"{name}\" {{ point3f[] positions = [(0,0,0)] {more} }}\n")
    };
    let file = read_text(&format!("{}{}", splats("S", ops), splats("T", "")));
    assert_eq!(file.scene.splats.len(), 1);
    let said = "/S: splats under a flat transform are not drawn";
    assert!(file.notes.iter().any(|note| note == said), "{:?}", file.notes);
}

/// As in OpenUSD at the earliest time, which is one for all.
#[test]
fn what_moves_is_read_at_its_first_time() {
    let file = read_text(
        r#"( metersPerUnit = 1 )
def ParticleField3DGaussianSplat "S" {
    point3f[] positions = [(0, 0, 0)]
    point3f[] positions.timeSamples = { 7: [(0, 0, 3)], 5: [(0, 0, 2)] }
    double3 xformOp:translate = (1, 2, 3)
    double3 xformOp:translate.timeSamples = { 10: (20, 0, 0), 1: (10, 0, 0) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"#,
    );
    assert_eq!(file.scene.splats.means(), [Vec3::new(10.0, 0.0, -2.0)]);
    assert_eq!(file.notes.last().unwrap(), "1 prim with animation, read at its first time");
}

/// Otherwise the layer is not where programs look for it.
#[test]
fn the_first_file_of_a_package_is_its_layer() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usdz");
    let mut zip = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
    let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    for (name, content) in [("x.png", &b"png"[..]), ("a.usda", &b"#usda 1.0\n"[..])] {
        zip.start_file(name, options).unwrap();
        std::io::Write::write_all(&mut zip, content).unwrap();
    }
    zip.finish().unwrap();
    assert_eq!(crate::format::detect(&path).unwrap(), Format::Usdz);
    let message = read(&path).unwrap_err().to_string();
    let said =
        "a.usdz: byte 0: expected a package whose first file is its layer, a .usda, .usdc or .usd, found `x.png`";
    assert!(message.ends_with(said), "{message}");
}

#[test]
fn members_are_found_by_names_with_backslashes() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    write(&at("a.usda"), &random_scene(0, 1, 0, 2), &[], None).unwrap();
    let text = std::fs::read_to_string(at("a.usda")).unwrap();
    let scene = read(&at("a.usda")).unwrap().scene;
    let names =
        std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let maps: Vec<String> = names.filter(|name| name != "a.usda").collect();
    assert!(maps.iter().all(|name| name.starts_with("a_mesh")), "{maps:?}");
    // Folders, and parts of names.
    for begin in ["maps/a_mesh", r"maps\a_mesh"] {
        let members: Vec<(String, Vec<u8>)> =
            maps.iter().map(|name| (name.replacen("a_mesh", begin, 1), std::fs::read(at(name)).unwrap())).collect();
        let text = text.replace("./a_mesh", r"./maps\a_mesh");
        let layer = |out: &mut package::Limited<'_, _>| std::io::Write::write_all(out, text.as_bytes());
        package::write(std::fs::File::create(at("a.usdz")).unwrap(), layer, &members).unwrap();
        let back = read(&at("a.usdz")).unwrap();
        assert!(back.scene == scene && back.notes.is_empty(), "{begin}: {:?}", back.notes);
    }
}

#[test]
fn paths_do_not_lead_out_of_folder_or_package() {
    let folder = tempfile::tempdir().unwrap();
    let inner = folder.path().join("in");
    std::fs::create_dir(&inner).unwrap();
    let scene = random_scene(0, 1, 0, 2);
    write(&inner.join("a.usda"), &scene, &[], None).unwrap();
    let text = std::fs::read_to_string(inner.join("a.usda")).unwrap();
    // As written on Windows.
    std::fs::write(inner.join("b.usda"), text.replace("./a_mesh", r".\a_mesh")).unwrap();
    assert_eq!(read(&inner.join("b.usda")).unwrap().scene, read(&inner.join("a.usda")).unwrap().scene);
    std::fs::rename(inner.join("a_mesh_0_base.exr"), folder.path().join("a_mesh_0_base.exr")).unwrap();
    for path in
        ["../a_mesh_0_base.exr", "/etc/passwd", "%2e%2e/a_mesh_0_base.exr", r"..\a_mesh_0_base.exr", r"\a", r"C:\a"]
    {
        std::fs::write(inner.join("a.usda"), text.replace("./a_mesh_0_base.exr", path)).unwrap();
        assert!(
            read(&inner.join("a.usda")).unwrap().notes[0].contains(".centaur:baseMap: the maps cannot be read"),
            "{path}"
        );
    }
    let package = inner.join("a.usdz");
    let file = std::fs::File::create(&package).unwrap();
    let text = text.replace("./a_mesh_0_base.exr", "../a_mesh_0_base.exr").replace("./a_mesh", "../a_mesh");
    let layer = |out: &mut package::Limited<'_, _>| std::io::Write::write_all(out, text.as_bytes());
    package::write(file, layer, &[]).unwrap();
    let notes = read(&package).unwrap().notes.join("; ");
    assert!(notes.contains("is left out: expected a file of the package, found `../a_mesh_0_color.png`"), "{notes}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn damaged_files_do_not_panic(which in 0usize..2, at: usize, byte: u8, cut: usize, seed in 0u64..3) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(["a.usda", "a.usdz"][which]);
        write(&path, &random_scene(2, 1, 1, seed), &[("c".to_owned(), camera())], None).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        let at = at % bytes.len();
        bytes[at] = byte;
        std::fs::write(&path, &bytes).unwrap();
        let _ = read(&path);
        bytes.truncate(cut % bytes.len());
        std::fs::write(&path, &bytes).unwrap();
        let _ = read(&path);
    }

    #[test]
    fn damaged_maps_do_not_panic(at: usize, byte: u8, cut: usize) {
        let mut bytes = maps::exr(random_scene(0, 1, 0, 1).meshes[0].atlas().base()).unwrap();
        let at = at % bytes.len();
        bytes[at] = byte;
        let _ = maps::from_exr(&bytes, true, &mut MapBudget::new(0));
        bytes.truncate(cut % bytes.len());
        let _ = maps::from_exr(&bytes, true, &mut MapBudget::new(0));
    }
}
