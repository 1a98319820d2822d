//! Conversion of a hybrid scene to a layer and the images beside it.

use glam::{DMat4, Mat3, Vec3};

use super::document::{Entry, Field, Layer, Prim, Value};
use super::{frame, maps, names};
use crate::format::activation;
use crate::scene::frame::{HALF_TURN, OPENGL_FROM_OPENCV, node_of_camera, sh_signs};
use crate::scene::{Camera, ColorSpace, Composition, HybridScene, Mesh, PixelFilter, Splats, sh};

/// Sensor width assigned to cameras, 36 mm: USD measures it in tenths of the layer's unit, a metre.
const APERTURE: f64 = 0.36;

/// Layer, and the files to which it refers.
pub(super) struct Export {
    pub(super) layer: Layer,
    pub(super) files: Vec<(String, Vec<u8>)>,
}

/// Converts a scene; `prefix` begins the names of files. On failure: the reason for which an image cannot be encoded.
pub(super) fn export(
    scene: &HybridScene,
    cameras: &[(String, Camera)],
    record: Option<&serde_json::Value>,
    prefix: &str,
) -> Result<Export, String> {
    let space = scene.composition.color_space;
    let mut root = Prim::new("Xform", names::ROOT);
    root.metadata.push(Field { edit: None, name: "kind".to_owned(), value: Value::text("component") });
    contract(&mut root, &scene.composition);
    let mut looks = Prim::new("Scope", names::LOOKS);
    let mut files = vec![];
    for (i, mesh) in scene.meshes.iter().enumerate() {
        let name = format!("mesh_{i}");
        let file = |what: &str| format!("{prefix}{name}_{what}");
        let [base, bands] = [file("base.exr"), file("bands.exr")];
        let [color, opacity] = [file("color.png"), file("opacity.png")];
        root.children.push(surface(mesh, &name, &base, mesh.atlas().bands().map(|_| bands.as_str())));
        looks.children.push(material(&name, &color, &opacity));
        files.push((color, maps::color_png(mesh.atlas(), space)));
        files.push((opacity, maps::opacity_png(mesh.atlas())));
        files.push((base, maps::exr(mesh.atlas().base())?));
        if let Some(map) = mesh.atlas().bands() {
            files.push((bands, maps::exr(&frame::turned_map(map))?));
        }
    }
    if !scene.splats.is_empty() {
        root.children.push(splats(&scene.splats, space));
    }
    for ((name, camera), identifier) in cameras.iter().zip(names::identifiers(cameras, &root.children)) {
        root.children.push(view(name, &identifier, camera, scene.composition.near));
    }
    if !looks.children.is_empty() {
        root.children.push(looks);
    }
    let field = |name: &str, value| Field { edit: None, name: name.to_owned(), value };
    let mut metadata = vec![field("comment", Value::text(concat!("Centaur ", env!("CARGO_PKG_VERSION"))))];
    metadata.extend(record.map(|record| {
        let value = Value::Text(record.to_string());
        let entry = Entry { type_name: "string".to_owned(), key: names::RECORD.to_owned(), value };
        field("customLayerData", Value::Dictionary(vec![entry]))
    }));
    metadata.extend([
        field("defaultPrim", Value::text(names::ROOT)),
        field("metersPerUnit", Value::Number(1.0)),
        field("upAxis", Value::text("Y")),
    ]);
    Ok(Export { layer: Layer { metadata, prims: vec![root] }, files })
}

/// Writes the composition as custom attributes, because no USD schema has one.
fn contract(root: &mut Prim, c: &Composition) {
    root.set_custom("token", names::FRAME, Value::text(names::CAPTURE));
    root.set_custom("token", names::MODE, Value::text(c.mode.name()));
    root.set_custom("float", names::LAMBDA, Value::Floats(vec![c.lambda]));
    root.set_custom("int", names::LAYERS, Value::Integers(vec![i64::from(c.layers)]));
    root.set_custom("token", names::COLOR_SPACE, Value::text(c.color_space.name()));
    root.set_custom("float3", names::BACKGROUND, Value::Floats(c.background.to_vec()));
    root.set_custom("float", names::NEAR, Value::Floats(vec![c.near]));
    if c.pixel_filter != PixelFilter::default() {
        root.set_custom("float", names::FILTER_VARIANCE, Value::Floats(vec![c.pixel_filter.variance]));
        root.set_custom("int", names::FILTER_NORMALIZED, Value::Integers(vec![c.pixel_filter.normalized.into()]));
    }
}

fn flat<const N: usize>(rows: impl Iterator<Item = [f32; N]>) -> Value {
    Value::Floats(rows.flatten().collect())
}

fn extent(corners: impl Iterator<Item = [Vec3; 2]>) -> Value {
    let join = |a: [Vec3; 2], b: [Vec3; 2]| [a[0].min(b[0]), a[1].max(b[1])];
    let ends = corners.reduce(join).unwrap_or_default();
    flat(ends.iter().map(|p| p.clamp(Vec3::splat(f32::MIN), Vec3::splat(f32::MAX)).to_array()))
}

fn splats(splats: &Splats, space: ColorSpace) -> Prim {
    let mut prim = Prim::new("ParticleField3DGaussianSplat", "splats");
    prim.apply("ColorSpaceAPI");
    // The kernel ends at three standard deviations.
    let boxes = splats.means().iter().zip(splats.log_scales()).zip(splats.rotations()).map(|((&mean, s), &q)| {
        let axes = Mat3::from_quat(frame::turned_rotation(q));
        let s = Vec3::from(s.to_array().map(activation::scale));
        let squares = [axes.x_axis * s.x, axes.y_axis * s.y, axes.z_axis * s.z].map(|a| a * a);
        let reach = 3.0 * Vec3::from((squares[0] + squares[1] + squares[2]).to_array().map(f32::sqrt));
        let mean = frame::turned(mean);
        [mean - reach, mean + reach]
    });
    prim.set("float3[]", "extent", extent(boxes));
    prim.set("point3f[]", "positions", flat(splats.means().iter().map(|&p| frame::turned(p).to_array())));
    let quaternion = |&q| {
        let [x, y, z, w] = frame::turned_rotation(q).to_array();
        [w, x, y, z]
    };
    prim.set("quatf[]", "orientations", flat(splats.rotations().iter().map(quaternion)));
    let scales = splats.log_scales().iter().map(|s| s.to_array().map(activation::scale));
    prim.set("float3[]", "scales", flat(scales));
    prim.set("float[]", "opacities", flat(splats.opacity_logits().iter().map(|&l| [activation::opacity(l)])));
    let (degree, k) = (splats.sh_degree(), sh::coefficients(splats.sh_degree()));
    prim.set_uniform("int", "radiance:sphericalHarmonicsDegree", Value::Integers(vec![i64::from(degree)]));
    let signs = sh_signs(OPENGL_FROM_OPENCV);
    let coefficients = splats.sh().iter().enumerate().map(|(i, c)| c.map(|v| v * signs[i % k]));
    prim.set("float3[]", "radiance:sphericalHarmonicsCoefficients", flat(coefficients))
        .with("elementSize", Value::Number(k as f64))
        .with("interpolation", Value::text("vertex"));
    prim.set_uniform("token", "projectionModeHint", Value::text("perspective"));
    // Centaur sorts by depth along the view's axis.
    prim.set_uniform("token", "sortingModeHint", Value::text("zDepth"));
    let token = if space == ColorSpace::SrgbDisplay { names::SRGB } else { names::LINEAR };
    prim.set_uniform("token", "colorSpace:name", Value::text(token));
    prim
}

fn surface(mesh: &Mesh, name: &str, base: &str, bands: Option<&str>) -> Prim {
    let mut prim = Prim::new("Mesh", name);
    prim.apply("MaterialBindingAPI");
    prim.set_uniform("bool", "doubleSided", Value::Integers(vec![1]));
    let points = || mesh.positions().iter().map(|&p| frame::turned(p));
    prim.set("float3[]", "extent", extent(points().map(|p| [p, p])));
    prim.set("int[]", "faceVertexCounts", Value::Integers(vec![3; mesh.triangles().len()]));
    let indices = mesh.triangles().as_flattened().iter().map(|&v| i64::from(v));
    prim.set("int[]", "faceVertexIndices", Value::Integers(indices.collect()));
    prim.set("point3f[]", "points", flat(points().map(|p| p.to_array())));
    let corners = || mesh.corner_uvs().as_flattened().iter().map(glam::Vec2::to_array);
    // USD's UV origin is at the bottom left.
    prim.set("texCoord2f[]", "primvars:st", flat(corners().map(|[u, v]| [u, 1.0 - v])))
        .with("interpolation", Value::text("faceVarying"));
    // 1 − v rounds; exact inversion requires v itself.
    prim.set_custom("float[]", names::EXACT_V, flat(corners().map(|[_, v]| [v])));
    prim.set_custom("asset", names::BASE_MAP, Value::Asset(format!("./{base}")));
    if let Some(bands) = bands {
        prim.set_custom("asset", names::BANDS_MAP, Value::Asset(format!("./{bands}")));
    }
    prim.relate("material:binding", format!("/{}/{}/{name}", names::ROOT, names::LOOKS));
    prim.set_uniform("token", "subdivisionScheme", Value::text("none"));
    prim
}

/// Material with colour as emission, independent of lights, and opacity as coverage.
fn material(name: &str, color: &str, opacity: &str) -> Prim {
    let path = format!("/{}/{}/{name}", names::ROOT, names::LOOKS);
    let mut material = Prim::new("Material", name);
    material.connect("token", "outputs:surface", format!("{path}/surface.outputs:surface"));

    let mut shader = Prim::new("Shader", "surface");
    shader.set_uniform("token", "info:id", Value::text("UsdPreviewSurface"));
    shader.set("color3f", "inputs:diffuseColor", Value::Floats(vec![0.0; 3]));
    shader.connect("color3f", "inputs:emissiveColor", format!("{path}/color.outputs:rgb"));
    shader.connect("float", "inputs:opacity", format!("{path}/opacity.outputs:r"));
    // Without this mode, transparent parts would still reflect and emit.
    shader.set("token", "inputs:opacityMode", Value::text("presence"));
    shader.set("float", "inputs:roughness", Value::Floats(vec![1.0]));
    shader.set("color3f", "inputs:specularColor", Value::Floats(vec![0.0; 3]));
    shader.set("int", "inputs:useSpecularWorkflow", Value::Integers(vec![1]));
    shader.declare("token", "outputs:surface");

    let texture = |name: &str, file: &str, space: &str, output: (&str, &str)| {
        let mut texture = Prim::new("Shader", name);
        texture.set_uniform("token", "info:id", Value::text("UsdUVTexture"));
        texture.set("asset", "inputs:file", Value::Asset(format!("./{file}")));
        texture.set("token", "inputs:sourceColorSpace", Value::text(space));
        texture.connect("float2", "inputs:st", format!("{path}/st.outputs:result"));
        texture.set("token", "inputs:wrapS", Value::text("clamp"));
        texture.set("token", "inputs:wrapT", Value::text("clamp"));
        texture.declare(output.0, output.1);
        texture
    };
    let mut reader = Prim::new("Shader", "st");
    reader.set_uniform("token", "info:id", Value::text("UsdPrimvarReader_float2"));
    reader.set("string", "inputs:varname", Value::text("st"));
    reader.declare("float2", "outputs:result");
    material.children = vec![
        shader,
        texture("color", color, "sRGB", ("float3", "outputs:rgb")),
        texture("opacity", opacity, "raw", ("float", "outputs:r")),
        reader,
    ];
    material
}

/// Camera prim with this identifier.
pub(super) fn view(name: &str, identifier: &str, camera: &Camera, near: f32) -> Prim {
    let mut prim = Prim::new("Camera", identifier);
    if name != identifier {
        prim.metadata.push(Field { edit: None, name: "displayName".to_owned(), value: Value::text(name) });
    }
    let k = camera.intrinsics();
    let [width, height] = k.size().to_array();
    let focal = APERTURE * k.fx / width;
    let vertical = focal * height / k.fy;
    let float = |value: f64| Value::Floats(vec![value as f32]);
    prim.set("float2", "clippingRange", Value::Floats(vec![near, near.max(1.0) * 1e6]));
    prim.set("float", "focalLength", float(focal));
    prim.set("float", "horizontalAperture", float(APERTURE));
    prim.set("float", "horizontalApertureOffset", float((0.5 * width - k.cx) * APERTURE / width));
    prim.set("token", "projection", Value::text("perspective"));
    prim.set("float", "verticalAperture", float(vertical));
    prim.set("float", "verticalApertureOffset", float((k.cy - 0.5 * height) * vertical / height));
    let turn = DMat4::from_mat3(node_of_camera(camera));
    let to_world = HALF_TURN * DMat4::from_translation(camera.center()) * turn;
    prim.set("matrix4d", "xformOp:transform", Value::Doubles(to_world.to_cols_array().to_vec()));
    prim.set_uniform("token[]", "xformOpOrder", Value::List(vec![Value::text("xformOp:transform")]));
    let size = vec![i64::from(k.width), i64::from(k.height)];
    prim.set_custom("int2", names::IMAGE_SIZE, Value::Integers(size));
    prim.set_custom("double4", names::INTRINSICS, Value::Doubles(vec![k.fx, k.fy, k.cx, k.cy]));
    let pose = DMat4::from_translation(camera.translation()) * DMat4::from_mat3(camera.rotation());
    prim.set_custom("matrix4d", names::POSE, Value::Doubles(pose.to_cols_array().to_vec()));
    prim
}
