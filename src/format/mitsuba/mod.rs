//! Mitsuba 3 export: a scene as XML, for rendering; not read back.
//!
//! `NAME.xml` is rendered by our plug-ins, [`PLUGINS`], a Python file written beside it (`python hybrid_rf.py NAME.xml
//! -o picture.exr`). They render splats and meshes by the image model `ray`: each splat at its peak along the exact
//! ray, everything in order of depth along the ray, SH by the direction to the mean.
//!
//! `NAME.stock.xml` has the splats only, for unmodified Mitsuba (`ellipsoidsmesh` and `volprim_rf_basic`): splats in
//! the order in which the ray enters their shells, SH by the ray's direction, over black, and a film without alpha. It
//! needs none of our Python files.
//!
//! Splats, meshes and maps are written beside either file, as for every rendering program (`exchange`). The frame is
//! the scene's.

#[cfg(test)]
mod tests;
mod xml;

use std::path::Path;

use glam::{DMat3, DMat4, DVec3};

use self::xml::Element;
use super::exchange::{self, Beside};
use super::{FormatError, Loss, WriteReport, atomic_write};
use crate::scene::{Camera, ColorSpace, Composition, HybridScene, OrderMode};

/// Name and content of the plug-ins, a Python file that also serves as renderer.
pub const PLUGINS: (&str, &str) = ("hybrid_rf.py", include_str!("hybrid_rf.py"));

/// File-name ending of exports for Mitsuba without our plug-ins.
const STOCK: &str = ".stock.xml";

/// Radii of shells in standard deviations. At the first, a splat of opacity 1 falls below 1/255. The second is for our
/// integrator, which misses a shell that begins within a rounding error of another one: it would have to miss both.
const EXTENTS: [&str; 2] = ["3.33", "3.5"];

/// Number of splats above which a warning is given.
const MANY_SPLATS: usize = 2_000_000;

/// Writes the scene and its accompanying files, the document last.
///
/// # Errors
/// If a file cannot be written.
pub(super) fn write(
    path: &Path,
    scene: &HybridScene,
    cameras: &[(String, Camera)],
) -> Result<WriteReport, FormatError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let is_stock = name.ends_with(STOCK);
    let stem = exchange::stem(path, if is_stock { STOCK } else { ".xml" });
    let (document, mut beside, loss, notes) = if is_stock {
        let splats = HybridScene { meshes: vec![], ..scene.clone() };
        let beside = exchange::write(path, &stem, &splats)?;
        let usual = Composition::default();
        let is = &scene.composition;
        let composition = !scene.meshes.is_empty() || (is.background, is.near) != (usual.background, usual.near);
        let loss = Loss { meshes: scene.meshes.len(), composition, ..Loss::default() };
        (stock(scene, &beside, cameras), beside, loss, stock_notes(scene, cameras))
    } else {
        let mut beside = exchange::write(path, &stem, scene)?;
        beside.add(PLUGINS.0.to_owned(), |name| {
            atomic_write(&path.with_file_name(name), PLUGINS.1.as_bytes()).map(|()| PLUGINS.1.len() as u64)
        })?;
        // Of the composition, the order along the ray replaces mode and λ; it equals that of `direct`.
        let composition = is_hybrid(scene) && scene.composition.mode != OrderMode::Direct;
        let loss = Loss { composition, ..Loss::default() };
        (hybrid(scene, &beside, cameras), beside, loss, hybrid_notes(scene, cameras))
    };
    let text = document.document();
    beside.bytes += text.len() as u64;
    atomic_write(path, text.as_bytes())?;
    Ok(WriteReport { bytes: beside.bytes, loss, beside: beside.files, notes })
}

fn is_hybrid(scene: &HybridScene) -> bool {
    !scene.splats.is_empty() && !scene.meshes.is_empty()
}

fn hybrid_notes(scene: &HybridScene, cameras: &[(String, Camera)]) -> Vec<String> {
    let mut notes = vec![];
    if !scene.splats.is_empty() {
        notes.push(
            "Mitsuba shows the image model `ray`; Centaur trains with `ewa`, and renders with it by default".to_owned(),
        );
    }
    if is_hybrid(scene) && scene.composition.mode != OrderMode::Direct {
        let mode = scene.composition.mode.name();
        notes.push(format!("splats and surfaces are ordered by depth along every ray, not by mode `{mode}`"));
    }
    notes.extend(shared_notes(scene, cameras));
    notes
}

fn stock_notes(scene: &HybridScene, cameras: &[(String, Camera)]) -> Vec<String> {
    let mut notes = vec![
        "splats are ordered by where rays enter them, with SH evaluated along the ray, opacity up to 0.9999, over black, \
         and the film has no alpha"
            .to_owned(),
    ];
    let skewed = |k: &crate::scene::Intrinsics| (k.fx / k.fy - 1.0).abs() > 1e-9;
    let count = cameras.iter().filter(|(_, camera)| skewed(camera.intrinsics())).count();
    if count > 0 {
        notes.push(format!("{count} camera(s) have pixels that are not square, which Mitsuba does not support: fx is used for both axes"));
    }
    notes.extend(shared_notes(scene, cameras));
    notes
}

fn shared_notes(scene: &HybridScene, cameras: &[(String, Camera)]) -> Vec<String> {
    let mut notes = vec![];
    if cameras.is_empty() {
        notes.push("there are no cameras: add a <sensor> to render images".to_owned());
    }
    let count = scene.splats.len();
    if count > MANY_SPLATS {
        notes.push(format!("{count} splats: {COST}"));
    }
    notes
}

/// Cost of many splats: for a million, in one shell each, 2.9 GB and 196 s were measured.
const COST: &str = "Mitsuba takes about 3 GB of memory and 3 minutes (512×512 pixels, 2 cores) per million splats, which get \
                    one shell instead of two, so that some that overlap may be missed";

fn hybrid(scene: &HybridScene, beside: &Beside, cameras: &[(String, Camera)]) -> Element {
    let c = &scene.composition;
    let space = if c.color_space == ColorSpace::SrgbDisplay { "srgb" } else { "linear" };
    let integrator = Element::plugin("integrator", "hybrid_rf")
        .with("float", "near", c.near)
        .with("integer", "surfaces", c.layers)
        .with("rgb", "background", xml::numbers(&c.background))
        .with("string", "color_space", space)
        .with("string", "sh_direction", "mean")
        .with("string", "output", "linear");
    let mut root = Element::scene().child(integrator);
    for (name, camera) in cameras {
        let k = camera.intrinsics();
        let sensor = Element::plugin("sensor", "hybrid_pinhole")
            .with("string", "label", name)
            .with("float", "focal_x", k.fx)
            .with("float", "focal_y", k.fy)
            .with("float", "center_x", k.cx)
            .with("float", "center_y", k.cy)
            .child(pose(camera))
            .child(Element::plugin("sampler", "pixel_center").with("integer", "sample_count", 1))
            .child(film(camera, "rgba"));
        root = root.child(sensor);
    }
    let extents = if scene.splats.len() > MANY_SPLATS { &EXTENTS[..1] } else { &EXTENTS };
    root = root.children(beside.splats.iter().flat_map(|file| extents.iter().map(|extent| splats(file, extent))));
    root.children(beside.meshes.iter().map(|mesh| {
        let maps = mesh.maps.iter().enumerate();
        let maps = maps.fold(Element::plugin("bsdf", "hybrid_maps"), |maps, (k, file)| {
            maps.with("string", &format!("map_{k:02}"), file)
        });
        Element::plugin("shape", "ply")
            .with("string", "filename", &mesh.surface)
            .with("boolean", "face_normals", true)
            .child(maps)
    }))
}

fn stock(scene: &HybridScene, beside: &Beside, cameras: &[(String, Camera)]) -> Element {
    let decodes = scene.composition.color_space == ColorSpace::SrgbDisplay;
    let integrator = Element::plugin("integrator", "volprim_rf_basic").with("integer", "max_depth", 4096).with(
        "boolean",
        "srgb_primitives",
        decodes,
    );
    let mut root = Element::scene().child(integrator);
    for (_, camera) in cameras {
        let k = camera.intrinsics();
        let [width, height] = k.size().to_array();
        let sensor = Element::plugin("sensor", "perspective")
            .with("string", "fov_axis", "x")
            .with("float", "fov", k.fov_x().to_degrees())
            // Mitsuba's is the offset of the film's centre from the principal point: a positive one moves the axis to
            // the left and up.
            .with("float", "principal_point_offset_x", 0.5 - k.cx / width)
            .with("float", "principal_point_offset_y", 0.5 - k.cy / height)
            .with("float", "near_clip", scene.composition.near)
            .with("float", "far_clip", scene.composition.near.max(1.0) * 1e6)
            .child(pose(camera))
            .child(Element::plugin("sampler", "independent").with("integer", "sample_count", 16))
            .child(film(camera, "rgb"));
        root = root.child(sensor);
    }
    root.children(beside.splats.as_deref().map(|file| splats(file, EXTENTS[0])))
}

fn splats(file: &str, extent: &str) -> Element {
    // `ellipsoids`, the exact shape, loses small splats to rounding.
    Element::plugin("shape", "ellipsoidsmesh").with("string", "filename", file).with("float", "extent", extent)
}

fn film(camera: &Camera, channels: &str) -> Element {
    let k = camera.intrinsics();
    Element::plugin("film", "hdrfilm")
        .with("integer", "width", k.width)
        .with("integer", "height", k.height)
        .with("string", "pixel_format", channels)
        .with("string", "component_format", "float32")
        .child(Element::plugin("rfilter", "box"))
}

/// Camera→world transform. Mitsuba's cameras look along +z, with x to the left and y up.
fn pose(camera: &Camera) -> Element {
    let axes = camera.rotation().transpose() * DMat3::from_diagonal(DVec3::new(-1.0, -1.0, 1.0));
    let pose = DMat4::from_translation(camera.center()) * DMat4::from_mat3(axes);
    let rows = pose.transpose().to_cols_array();
    Element::named("transform", "to_world").child(Element::new("matrix").attribute("value", xml::numbers(&rows)))
}
