//! What others added to a layer beyond schemas, and a scene does not hold.

use super::document::{Field, Value, field};
use super::names;

/// What programs put into every file of theirs, to say that it is theirs or how it looked in their window: entries of
/// `customLayerData` and of `customData`.
const SIGNATURES: [&str; 6] = ["creator", "cameraSettings", "omni_layer", "renderSettings", "Blender", "Maya"];

/// What names of properties begin with that are no content: our own, and under which Blender says what things were called there.
const SIGNED: [&str; 3] = [names::PREFIX, "userProperties:blender:", "userProperties:blenderName:"];

/// What many names of schemas begin with.
const OF_SCHEMAS: [&str; 8] =
    ["colorSpace:", "info:", "inputs:", "material:", "outputs:", "primvars:", "radiance:", "xformOp"];

/// How many entries of the dictionary `name` are neither our own nor signatures.
pub(super) fn entries(metadata: &[Field], name: &str) -> usize {
    let Some(Value::Dictionary(entries)) = field(metadata, name) else { return 0 };
    let says_more = |key: &str| key != names::RECORD && !SIGNATURES.contains(&key);
    entries.iter().filter(|entry| says_more(&entry.key)).count()
}

/// Whether a property that is marked as custom is: scripts without the schema at hand mark what it has, too.
pub(super) fn is_property(name: &str) -> bool {
    !is_of_schema(name) && !SIGNED.iter().chain(&OF_SCHEMAS).any(|beginning| name.starts_with(beginning))
}

#[rustfmt::skip]
fn is_of_schema(name: &str) -> bool {
    matches!(
        name,
        // Of anything, of meshes and their parts, of splats in single precision or half, of cameras.
        "extent" | "purpose" | "visibility"
            | "doubleSided" | "faceVertexCounts" | "faceVertexIndices" | "holeIndices" | "indices" | "normals" | "points"
            | "subdivisionScheme"
            | "opacities" | "opacitiesh" | "orientations" | "orientationsh" | "positions" | "positionsh" | "scales" | "scalesh"
            | "projectionModeHint" | "sortingModeHint"
            | "clippingRange" | "focalLength" | "horizontalAperture" | "horizontalApertureOffset" | "projection"
            | "verticalAperture" | "verticalApertureOffset"
    )
}
