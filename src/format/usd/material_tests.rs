//! Materials and maps of surfaces, as written by us and by other programs.

use glam::Vec2;

use super::tests::{folder_with, read_text};
use super::*;
use crate::format::map_budget::MapBudget;
use crate::format::test_scenes::{black_png, random_scene};
use crate::scene::{ColorSpace, Texture, sh};

#[test]
fn without_its_own_maps_a_mesh_shows_its_pictures() {
    let folder = tempfile::tempdir().unwrap();
    for seed in [2, 3] {
        let path = folder.path().join("a.usda");
        let scene = random_scene(0, 1, 1, seed);
        write(&path, &scene, &[], None).unwrap();
        std::fs::remove_file(folder.path().join("a_mesh_0_base.exr")).unwrap();
        let back = read(&path).unwrap();
        assert_eq!(back.notes.len(), 2, "{:?}", back.notes);
        let (before, after) = (scene.meshes[0].atlas().base(), back.scene.meshes[0].atlas().base());
        assert_eq!(back.scene.meshes[0].atlas().sh_degree(), 0);
        for (a, b) in before.texels().chunks_exact(4).zip(after.texels().chunks_exact(4)) {
            let rgb = |t: &[f32]| sh::rgb_from_dc([t[0], t[1], t[2]]).map(|c| c.clamp(0.0, 1.0));
            // Half a step of 8 bits; for scenes blended in linear light this is multiplied by the slope of the curve,
            // at most 2.3.
            let step = if scene.composition.color_space == ColorSpace::SrgbDisplay { 0.5 } else { 1.15 } / 255.0;
            let same = |a: f32, b: f32, step: f32| (a - b).abs() <= step + 1e-6;
            assert!((0..3).all(|c| same(rgb(a)[c], rgb(b)[c], step)), "{a:?} {b:?}");
            let opacity = |t: &[f32]| 1.0 / (1.0 + (-t[3]).exp());
            assert!(same(opacity(a), opacity(b), 0.5 / 255.0));
        }
    }
    // With the pictures missing, the fallback of the texture is used, or else the default value.
    for entry in std::fs::read_dir(folder.path()).unwrap().map(Result::unwrap) {
        if entry.path().extension().is_some_and(|extension| extension == "png") {
            std::fs::remove_file(entry.path()).unwrap();
        }
    }
    let path = folder.path().join("a.usda");
    let back = read(&path).unwrap();
    assert!(back.notes.iter().any(|note| note.contains(".inputs:file is left out: expected ")), "{:?}", back.notes);
    let text = std::fs::read_to_string(&path).unwrap();
    let file = text.lines().find(|line| line.contains("asset inputs:file")).unwrap();
    let stated = format!("{file}\nfloat4 inputs:fallback = (0.2, 0.4, 0.6, 0.5)");
    std::fs::write(&path, text.replace(file, &stated)).unwrap();
    let base = read(&path).unwrap().scene.meshes[0].atlas().base().clone();
    let rgb = sh::rgb_from_dc([base.texels()[0], base.texels()[1], base.texels()[2]]);
    let is_stated = |color: ColorSpace| (0..3).all(|c| (rgb[c] - color.from_linear([0.2, 0.4, 0.6])[c]).abs() < 1e-6);
    assert!(base.texels().len() == 4 && ColorSpace::ALL.into_iter().any(is_stated), "{rgb:?}");
}

#[test]
fn meshes_and_materials_of_others() {
    let (folder, path) = folder_with(
        r#"( metersPerUnit = 1
)
def "W" (
    prepend references = @other.usda@
) {
    rel material:binding = </W/M>
    def Mesh "quad" {
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [3, 2, 1, 0]
        point3f[] points.timeSamples = { 1: [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], 2: [] }
        texCoord2f[] primvars:map = [(0, 0), (1, 0.25)] ( interpolation = "vertex" )
        int[] primvars:map:indices = [0, 1, 1, 0]
        uniform token subdivisionScheme = "none"
    }
    def Material "M" {
        color3f inputs:tint = (0.2, 0.4, 0.6)
        token outputs:surface.connect = <S.outputs:surface>
        def Shader "S" {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = <../../M.inputs:tint>
            float inputs:opacity.connect = </W/M/T.outputs:a>
        }
        def Shader "T" {
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @./t.png@
            float4 inputs:scale = (1, 1, 1, 0.5)
            float2 inputs:st.connect = <../R.outputs:result>
        }
        def Shader "R" {
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "map"
        }
    }
}
"#,
    );
    let png = image::RgbaImage::from_fn(2, 1, |x, _| image::Rgba([0, 0, 0, [0, 255][x as usize]]));
    png.save(folder.path().join("t.png")).unwrap();
    let file = read(&path).unwrap();
    let mesh = &file.scene.meshes[0];
    assert_eq!(mesh.triangles(), [[3, 2, 1], [3, 1, 0]]);
    let uv = |u, v| Vec2::new(u, v);
    assert_eq!(mesh.corner_uvs()[0], [uv(0.0, 1.0), uv(1.0, 0.75), uv(1.0, 0.75)]);
    let base = mesh.atlas().base();
    let opacity = |i: usize| 1.0 / (1.0 + (-base.texels()[4 * i + 3]).exp());
    assert!(base.width() == 2 && opacity(0) < 1e-6 && (opacity(1) - 0.5).abs() < 1e-6);
    assert!(base.texels()[3] > -17.0, "filtered, clear weighs no more than opaque: {}", base.texels()[3]);
    let rgb = sh::rgb_from_dc([base.texels()[0], base.texels()[1], base.texels()[2]]);
    let expected = [0.2, 0.4, 0.6].map(crate::scene::color::linear_to_srgb);
    assert!((0..3).all(|c| (rgb[c] - expected[c]).abs() < 1e-6), "{rgb:?}");
    assert_eq!(
        file.notes,
        [
            "/W/M/S: only its diffuse colour is shown, unlit",
            "1 prim with animation, read at its first time",
            "1 prim with references to other layers, which are not followed",
        ]
    );
}

/// A triangle whose material has this input, and these shaders beside its own.
fn triangle(uvs: &str, input: &str, shaders: &str) -> String {
    format!(
        r#"( metersPerUnit = 1 )
def Mesh "M" {{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    texCoord2f[] primvars:st = {uvs} ( interpolation = "vertex" )
    uniform token subdivisionScheme = "none"
    rel material:binding = </M/M>
    def Material "M" {{
        token outputs:surface.connect = <S.outputs:surface>
        def Shader "S" {{ uniform token info:id = "UsdPreviewSurface" {input} }}
        {shaders}
    }}
}}
"#
    )
}

/// An emission map that is black except for a few lights must not blacken a textured surface; a default grey is
/// replaced by an emission map.
#[test]
fn emission_is_shown_where_there_is_no_picture_of_the_colour() {
    let read_with = |inputs: &str| {
        let (folder, path) = folder_with(&triangle(
            "[(0, 0), (1, 0), (0, 1)]",
            inputs,
            r#"def Shader "Red" { uniform token info:id = "UsdUVTexture" asset inputs:file = @./red.png@ }
def Shader "Black" { uniform token info:id = "UsdUVTexture" asset inputs:file = @./black.png@ }"#,
        ));
        for (name, color) in [("red.png", [255, 0, 0]), ("black.png", [0; 3])] {
            image::RgbImage::from_pixel(1, 1, image::Rgb(color)).save(folder.path().join(name)).unwrap();
        }
        let file = read(&path).unwrap();
        let rgb = sh::rgb_from_dc(file.scene.meshes[0].atlas().base().texels()[..3].try_into().unwrap());
        (rgb.map(|v| (v * 255.0).round()), file.notes[0].rsplit(": ").next().unwrap().to_owned())
    };
    let [diffuse, emissive] = ["diffuse", "emissive"].map(|what| format!("only its {what} colour is shown, unlit"));
    let to = |input: &str, texture: &str| format!("color3f inputs:{input}Color.connect = <../{texture}.outputs:rgb>");
    let both = format!("{}\n{}", to("diffuse", "Red"), to("emissive", "Black"));
    assert_eq!(read_with(&both), ([255.0, 0.0, 0.0], diffuse));
    let grey = format!("color3f inputs:diffuseColor = (0.8, 0.8, 0.8)\n{}", to("emissive", "Red"));
    for inputs in [to("emissive", "Red"), grey] {
        assert_eq!(read_with(&inputs), ([255.0, 0.0, 0.0], emissive.clone()));
    }
}

/// A floor whose tile is rotated and repeats three times along u: the repeated picture is written out, and corners are
/// transformed.
#[test]
fn textures_are_transformed_and_repeat() {
    let scene = |wrap: &str| {
        let shaders = format!(
            r#"def Shader "T" {{
    uniform token info:id = "UsdUVTexture"
    asset inputs:file = @./t.png@
    token inputs:wrapS = "{wrap}"
    token inputs:wrapT = "{wrap}"
    float2 inputs:st.connect = <../X.outputs:result>
}}
def Shader "X" {{
    uniform token info:id = "UsdTransform2d"
    float2 inputs:in.connect = <../R.outputs:result>
    float inputs:rotation = 90
    float2 inputs:scale = (2, 3)
    float2 inputs:translation = (3, 0)
}}
def Shader "R" {{
    uniform token info:id = "UsdPrimvarReader_float2"
    string inputs:varname = "st"
}}"#
        );
        triangle("[(0, 0), (1, 0), (0, 1)]", "color3f inputs:diffuseColor.connect = </M/M/T.outputs:rgb>", &shaders)
    };
    let read_with = |wrap: &str, png: image::DynamicImage| {
        let (folder, path) = folder_with(&scene(wrap));
        png.save(folder.path().join("t.png")).unwrap();
        let mut file = read(&path).unwrap();
        (file.scene.meshes.remove(0), file.notes)
    };
    let grey_of = |x: u32, y: u32| [[10, 20], [30, 40]][y as usize][x as usize];
    let colors = image::RgbImage::from_fn(2, 2, |x, y| image::Rgb([grey_of(x, y); 3]));
    let (clamped, _) = read_with("clamp", colors.clone().into());
    // Scaled to (2s, 3t), rotated to (−3t, 2s), moved by 3; v points down.
    let expected = [[3.0, 1.0], [3.0, -1.0], [0.0, 1.0]].map(Vec2::from);
    for (found, expected) in clamped.corner_uvs()[0].iter().zip(expected) {
        assert!(found.abs_diff_eq(expected, 1e-6), "{found} {expected}");
    }
    assert_eq!((clamped.atlas().base().width(), clamped.atlas().base().height()), (2, 2));
    let (tiled, notes) = read_with("repeat", colors.clone().into());
    let base = tiled.atlas().base();
    assert_eq!((base.width(), base.height(), notes.len()), (6, 4, 1), "{notes:?}");
    for (found, expected) in tiled.corner_uvs()[0].iter().zip(expected) {
        let expected = Vec2::new(expected.x / 3.0, (expected.y + 1.0) / 2.0);
        assert!(found.abs_diff_eq(expected, 1e-6), "{found} {expected}");
    }
    // Values not stored as 8-bit colours are linear.
    let grey = |mesh: &crate::scene::Mesh| sh::rgb_from_dc(mesh.atlas().base().texels()[..3].try_into().unwrap())[0];
    assert!((grey(&tiled) - 10.0 / 255.0).abs() < 1e-6);
    let (linear, _) = read_with("clamp", image::GrayImage::from_pixel(1, 1, image::Luma([10])).into());
    assert!((grey(&linear) - crate::scene::color::linear_to_srgb(10.0 / 255.0)).abs() < 1e-6);
}

/// Beyond the borders of an image that neither repeats nor is clamped, USD has black.
#[test]
fn textures_that_are_left_for_black_are_named() {
    let said = |wrap: &str, uvs: &str| {
        let shaders = format!(
            r#"def Shader "T" {{
    uniform token info:id = "UsdUVTexture"
    asset inputs:file = @./t.png@
    {wrap}
}}"#
        );
        let input = "color3f inputs:diffuseColor.connect = <../T.outputs:rgb>";
        let (folder, path) = folder_with(&triangle(uvs, input, &shaders));
        std::fs::write(folder.path().join("t.png"), black_png(1, 1)).unwrap();
        let notes = read(&path).unwrap().notes;
        let said = "/M: a texture that is black beyond its borders is extended by its edge there instead";
        notes.iter().filter(|note| *note == said).count()
    };
    let modes = |s: &str, t: &str| format!("token inputs:wrapS = \"{s}\" token inputs:wrapT = \"{t}\"");
    let [within, beyond_s] = ["[(0, -0.0001), (1, 0), (0, 1.0001)]", "[(0, 0), (1.5, 0), (0, 1)]"];
    for black in ["black", "useMetadata"] {
        assert_eq!(said(&modes(black, black), within), 0);
        assert_eq!(said(&modes(black, black), beyond_s), 1);
        assert_eq!(said(&modes("clamp", black), beyond_s), 0);
        assert_eq!(said(&modes(black, "repeat"), beyond_s), 1);
    }
    assert_eq!([said("", within), said("", beyond_s), said(&modes("mirror", "clamp"), beyond_s)], [0, 1, 0]);
}

#[test]
fn parts_of_a_mesh_have_materials_of_their_own() {
    let file = read_text(
        r#"( metersPerUnit = 1 )
def Material "Red" {
    token outputs:surface.connect = </Red/S.outputs:surface>
    def Shader "S" { uniform token info:id = "UsdPreviewSurface" color3f inputs:emissiveColor = (1, 0, 0) }
}
def Mesh "M" {
    int[] faceVertexCounts = [3, 4, 3]
    int[] faceVertexIndices = [0, 1, 2, 0, 2, 3, 4, 5, 4, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0), (5, 0, 0)]
    texCoord2f[] primvars:st = [(0, 0), (0.1, 0), (0.2, 0)] ( interpolation = "uniform" )
    uniform token subdivisionScheme = "none"
    color3f[] primvars:displayColor = [(0, 0, 1)]
    def GeomSubset "A" { int[] indices = [1, 7] rel material:binding = </Red> }
    def GeomSubset "B" { int[] indices = [0] }
}
"#,
    );
    let [blue, red] = &file.scene.meshes[..] else { panic!("{}", file.scene.meshes.len()) };
    assert_eq!(blue.triangles(), [[0, 1, 2], [5, 4, 3]], "vertices keep their order");
    assert_eq!(blue.positions().iter().map(|p| p.x).collect::<Vec<_>>(), [0., 1., 2., 3., 4., 5.]);
    assert_eq!(red.triangles(), [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(red.positions().iter().map(|p| p.x).collect::<Vec<_>>(), [0., 2., 3., 4.]);
    assert_eq!((blue.corner_uvs()[1], red.corner_uvs()[1]), ([Vec2::new(0.2, 1.0); 3], [Vec2::new(0.1, 1.0); 3]));
    let color = |mesh: &crate::scene::Mesh| sh::rgb_from_dc(mesh.atlas().base().texels()[..3].try_into().unwrap());
    assert_eq!([color(blue), color(red)].map(|rgb| rgb.map(f32::round)), [[0., 0., 1.], [1., 0., 0.]]);
}

#[test]
fn the_stronger_binding_counts_and_a_deletion_is_none() {
    let material = |name: &str, rgb: &str| {
        let shader = format!("uniform token info:id = \"UsdPreviewSurface\" color3f inputs:diffuseColor = {rgb}");
        let surface = format!("token outputs:surface.connect = </{name}/S.outputs:surface>");
        format!("def Material \"{name}\" {{ {surface}\n def Shader \"S\" {{ {shader} }} }}\n")
    };
    let materials = [("Red", "(1, 0, 0)"), ("Green", "(0, 1, 0)"), ("Blue", "(0, 0, 1)")];
    let materials = materials.map(|(name, rgb)| material(name, rgb)).concat();
    let colors = |strength: &str, own: &str, of_part: &str| {
        let file = read_text(&format!(
            r#"( metersPerUnit = 1 )
{materials}
def Xform "P" {{
    rel material:binding = </Blue> {strength}
    def Mesh "M" {{
        int[] faceVertexCounts = [3, 3]
        int[] faceVertexIndices = [0, 1, 2, 1, 3, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]
        uniform token subdivisionScheme = "none"
        {own}
        def GeomSubset "A" {{ int[] indices = [1] {of_part} }}
    }}
}}
"#
        ));
        let color = |mesh: &crate::scene::Mesh| sh::rgb_from_dc(mesh.atlas().base().texels()[..3].try_into().unwrap());
        file.scene.meshes.iter().map(|mesh| color(mesh).map(f32::round)).collect::<Vec<_>>()
    };
    let [red, green, blue]: [[f32; 3]; 3] = [[1., 0., 0.], [0., 1., 0.], [0., 0., 1.]];
    let [to_red, to_green] = ["rel material:binding = </Red>", "rel material:binding = </Green>"];
    let of_strength = |strength: &str| format!("( bindMaterialAs = \"{strength}ThanDescendants\" )");
    assert_eq!(colors("", to_red, ""), [red]);
    assert_eq!(colors("", &format!("delete {to_red}"), &format!("delete {to_green}")), [blue]);
    assert_eq!(colors(&of_strength("weaker"), to_red, to_green), [red, green]);
    assert_eq!(colors(&of_strength("stronger"), to_red, to_green), [blue]);
    assert_eq!(colors("", &format!("{to_red} {}", of_strength("stronger")), to_green), [red]);
}

/// Values are in hundredths: RGB as shown, and opacity.
#[test]
fn colours_of_meshes_are_inherited_and_averaged() {
    let shown = |above: &str, own: &str| {
        let file = read_text(&format!(
            r#"( metersPerUnit = 1 )
def Xform "P" {{
    {above}
    def Mesh "M" {{
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 2]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
        uniform token subdivisionScheme = "none"
        {own}
    }}
}}
"#
        ));
        let texel = file.scene.meshes[0].atlas().base().texels();
        let [r, g, b] = sh::rgb_from_dc(texel[..3].try_into().unwrap());
        let opacity = 1.0 / (1.0 + (-texel[3]).exp());
        let is_mean = file.notes[0].ends_with("is shown in one colour, the mean of several");
        ([r, g, b, opacity].map(|v| (100.0 * v).round()), is_mean)
    };
    let colors = |values: &str, more: &str| format!("color3f[] primvars:displayColor = {values} {more}\n");
    let red = colors("[(1, 0, 0)]", "");
    assert_eq!(shown("", ""), ([50.0, 50.0, 50.0, 100.0], false));
    assert_eq!(shown(&red, "float[] primvars:displayOpacity = [0.25]"), ([100.0, 0.0, 0.0, 25.0], false));
    assert_eq!(shown(&red, &colors("None", "")), ([100.0, 0.0, 0.0, 100.0], false));
    // Only constant primvars are inherited.
    let of_points = colors("[(1, 0, 0), (0, 1, 0), (0, 0, 1)]", "( interpolation = \"vertex\" )");
    assert_eq!(shown(&of_points, ""), ([50.0, 50.0, 50.0, 100.0], false));
    let indexed = |indices: &str| format!("{of_points} int[] primvars:displayColor:indices = {indices}");
    assert_eq!(shown(&red, &indexed("[2, 2, 2]")), ([0.0, 0.0, 100.0, 100.0], false));
    // Half red and half green, in linear light; one index is beyond the values.
    assert_eq!(shown("", &indexed("[0, 1, 9]")), ([74.0, 74.0, 0.0, 100.0], true));
}

/// Their colours cannot be evaluated; the note names the shader.
#[test]
fn shaders_that_are_no_pictures_have_one_colour() {
    for (shader, what) in [
        (
            r#"uniform token info:id = "UsdPrimvarReader_float3""#,
            "a shader other than UsdUVTexture, UsdPrimvarReader_float3",
        ),
        ("", "a shader other than UsdUVTexture, without an info:id"),
        (r#"uniform token info:id = "UsdUVTexture""#, "a texture without an image"),
    ] {
        let file = read_text(&format!(
            r#"( metersPerUnit = 1 )
def Material "M" {{
    token outputs:surface.connect = </M/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </M/P.outputs:result>
    }}
    def Shader "P" {{ {shader} }}
}}
def Mesh "T" {{
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    uniform token subdivisionScheme = "none"
    rel material:binding = </M>
}}
"#
        ));
        let base = file.scene.meshes[0].atlas().base();
        let rgb = sh::rgb_from_dc(base.texels()[..3].try_into().unwrap());
        let grey = crate::scene::color::linear_to_srgb(0.18);
        assert!(rgb.iter().all(|c| (c - grey).abs() < 1e-6), "{rgb:?}");
        let expected = format!("/M/P: {what}, replaced by a constant inputs:diffuseColor");
        assert!(file.notes.contains(&expected), "{:?}", file.notes);
    }
}

/// Band maps with a number of channels that no degree has, beside a valid map.
#[test]
fn a_map_of_bands_is_named_by_its_channels() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    let mut scenes = (0..9).map(|seed| random_scene(0, 1, 1, seed));
    let scene = scenes.find(|scene| scene.meshes[0].atlas().bands().is_some()).unwrap();
    write(&path, &scene, &[], None).unwrap();
    for channels in [1, 2, 4, 5, 12] {
        let names: Vec<String> = (0..channels).map(|i| format!("c{i:02}")).collect();
        let map = Texture::new(1, 1, channels, vec![0.0; channels as usize]).unwrap();
        let file = crate::format::exr::encode(&map, 0, &names).unwrap();
        std::fs::write(folder.path().join("a_mesh_0_bands.exr"), file).unwrap();
        let expected = "9, 24 or 45 channels, of the SH bands above the first";
        let message = format!("those of the material are shown instead: expected {expected}, found {channels}");
        let notes = read(&path).unwrap().notes;
        assert_eq!(notes[0], format!("/Scene/mesh_0.centaur:bandsMap: the maps cannot be read, {message}"));
    }
}

/// The maps of a material get the width of one picture and the height of the other.
#[test]
fn maps_that_files_of_this_size_do_not_justify_are_refused() {
    let shader = |name: &str, file: &str| {
        format!("def Shader \"{name}\" {{ token info:id = \"UsdUVTexture\" asset inputs:file = @{file}@ }}\n")
    };
    let (folder, path) = folder_with(&format!(
        "def Mesh \"M\" {{
            point3f[] points = [(0,0,0), (1,0,0), (0,1,0)]
            int[] faceVertexCounts = [3]
            int[] faceVertexIndices = [0,1,2]
            rel material:binding = </L>
        }}
        def Material \"L\" {{
            token outputs:surface.connect = </L/S.outputs:surface>
            def Shader \"S\" {{
                token info:id = \"UsdPreviewSurface\"
                color3f inputs:diffuseColor.connect = </L/C.outputs:rgb>
                float inputs:opacity.connect = </L/O.outputs:r>
            }}
            {}{}
        }}",
        shader("C", "wide.png"),
        shader("O", "high.png")
    ));
    let put = |name: &str, width, height| std::fs::write(folder.path().join(name), black_png(width, height)).unwrap();
    put("wide.png", 64, 1);
    put("high.png", 1, 32);
    assert_eq!(read(&path).unwrap().scene.meshes[0].atlas().base().texels().len(), 4 * 64 * 32);
    put("wide.png", 16384, 1);
    put("high.png", 1, 16384);
    let message = read(&path).unwrap_err().to_string();
    assert!(
        message.contains("/L/S: expected maps of at most ") && message.ends_with("found 4294967296 bytes"),
        "{message}"
    );
}

/// With a window allowed by EXR and more than four channels, the number of samples overflows 64 bits.
#[test]
fn maps_of_any_window_are_refused_in_one_line() {
    let mut bytes = [20_000_630, 2].map(u32::to_le_bytes).concat();
    let mut attribute = |name: &str, kind: &str, value: &[u8]| {
        let length = (value.len() as u32).to_le_bytes();
        bytes.extend([name.as_bytes(), &[0], kind.as_bytes(), &[0], &length, value].concat());
    };
    // Eight channels of 32-bit floats per pixel.
    let channel = |name: char| [&[name as u8, 0][..], &[2_i32, 0, 1, 1].map(i32::to_le_bytes).concat()].concat();
    attribute("channels", "chlist", &[('a'..='h').flat_map(channel).collect(), vec![0]].concat());
    attribute("compression", "compression", &[3]);
    let (least, most) = (-(1 << 30) + 2, (1 << 30) - 3);
    let window = [least, least, most, most].map(i32::to_le_bytes).concat();
    attribute("dataWindow", "box2i", &window);
    attribute("displayWindow", "box2i", &window);
    attribute("lineOrder", "lineOrder", &[0]);
    attribute("pixelAspectRatio", "float", &1_f32.to_le_bytes());
    attribute("screenWindowCenter", "v2f", &[0; 8]);
    attribute("screenWindowWidth", "float", &1_f32.to_le_bytes());
    bytes.push(0);
    let (expected, found) = maps::from_exr(&bytes, false, &mut MapBudget::new(0)).unwrap_err();
    assert_eq!(expected, "one EXR image that its file can hold");
    assert_eq!(found, format!("1 of 2147483644×2147483644 in {} bytes", bytes.len()));
}
