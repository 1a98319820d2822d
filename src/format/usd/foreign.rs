//! Foreign content of a layer: additions outside schemas that a scene does not hold.

use super::document::{Field, Value, field};
use super::names;

/// Entries of `customLayerData` and of `customData` that programs write into every file to identify themselves or to
/// store their viewport.
const SIGNATURES: [&str; 6] = ["creator", "cameraSettings", "omni_layer", "renderSettings", "Blender", "Maya"];

/// Prefixes of properties that are not content: our own, and those in which Blender stores original names.
const SIGNED: [&str; 3] = [names::PREFIX, "userProperties:blender:", "userProperties:blenderName:"];

/// Common prefixes of property names defined by schemas.
const OF_SCHEMAS: [&str; 8] =
    ["colorSpace:", "info:", "inputs:", "material:", "outputs:", "primvars:", "radiance:", "xformOp"];

/// Number of entries of the dictionary `name` that are neither our own nor signatures.
pub(super) fn entries(metadata: &[Field], name: &str) -> usize {
    let Some(Value::Dictionary(entries)) = field(metadata, name) else { return 0 };
    let says_more = |key: &str| key != names::RECORD && !SIGNATURES.contains(&key);
    entries.iter().filter(|entry| says_more(&entry.key)).count()
}

/// Whether a property marked as custom really is: scripts written without the schema mark the schema's properties, too.
pub(super) fn is_property(name: &str) -> bool {
    !is_of_schema(name) && !SIGNED.iter().chain(&OF_SCHEMAS).any(|beginning| name.starts_with(beginning))
}

#[rustfmt::skip]
fn is_of_schema(name: &str) -> bool {
    matches!(
        name,
        // Properties of any prim, of meshes and their parts, of splats in single or half precision, of cameras.
        "extent" | "purpose" | "visibility"
            | "doubleSided" | "faceVertexCounts" | "faceVertexIndices" | "holeIndices" | "indices" | "normals" | "points"
            | "subdivisionScheme"
            | "opacities" | "opacitiesh" | "orientations" | "orientationsh" | "positions" | "positionsh" | "scales" | "scalesh"
            | "projectionModeHint" | "sortingModeHint"
            | "clippingRange" | "focalLength" | "horizontalAperture" | "horizontalApertureOffset" | "projection"
            | "verticalAperture" | "verticalApertureOffset"
    )
}
