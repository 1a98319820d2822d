//! Names used in our own layers: of prims, and of attributes outside USD's schemas.

use std::collections::HashSet;

use super::document::Prim;

/// Name of the default prim.
pub(super) const ROOT: &str = "Scene";
/// Name of the scope of materials below the default prim.
pub(super) const LOOKS: &str = "Looks";

/// Key in `customLayerData` of the training record, as JSON.
pub(super) const RECORD: &str = "centaur";

/// Prefix of our attributes' names.
pub(super) const PREFIX: &str = "centaur:";

/// Attribute of the default prim: `capture` if the file is a capture's world turned by [`super::frame`].
pub(super) const FRAME: &str = "centaur:frame";
pub(super) const CAPTURE: &str = "capture";
/// Attributes of the default prim: the fields of `Composition`.
pub(super) const MODE: &str = "centaur:mode";
pub(super) const LAMBDA: &str = "centaur:lambda";
pub(super) const LAYERS: &str = "centaur:layers";
pub(super) const COLOR_SPACE: &str = "centaur:colorSpace";
pub(super) const BACKGROUND: &str = "centaur:background";
pub(super) const NEAR: &str = "centaur:near";
pub(super) const FILTER_VARIANCE: &str = "centaur:pixelFilter:variance";
pub(super) const FILTER_NORMALIZED: &str = "centaur:pixelFilter:normalized";

/// Attributes of a mesh: v of every corner, downwards; the exact maps.
pub(super) const EXACT_V: &str = "centaur:v";
pub(super) const BASE_MAP: &str = "centaur:baseMap";
pub(super) const BANDS_MAP: &str = "centaur:bandsMap";

/// Attributes of a camera: size of the image; fx, fy, cx and cy; world→camera pose in the capture's world.
pub(super) const IMAGE_SIZE: &str = "centaur:imageSize";
pub(super) const INTRINSICS: &str = "centaur:intrinsics";
pub(super) const POSE: &str = "centaur:worldToCamera";

/// Names of the two colour spaces in `ColorSpaceAPI`. USD has no display-referred ones.
pub(super) const SRGB: &str = "srgb_rec709_scene";
pub(super) const LINEAR: &str = "lin_rec709_scene";

/// Identifiers for named objects, distinct from each other and from those in `taken`.
pub(super) fn identifiers<T>(named: &[(String, T)], taken: &[Prim]) -> Vec<String> {
    let mut used: HashSet<String> = taken.iter().map(|p| p.name.clone()).collect();
    used.insert(LOOKS.to_owned());
    let mut identifiers = vec![];
    for (i, (name, _)) in named.iter().enumerate() {
        let plain: String = name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
        let mut identifier = if plain.starts_with(|c: char| c.is_ascii_digit()) || plain.is_empty() {
            format!("camera_{plain}")
        } else {
            plain
        };
        if used.contains(&identifier) {
            identifier = format!("{identifier}_{i}");
            while used.contains(&identifier) {
                identifier.push('_');
            }
        }
        used.insert(identifier.clone());
        identifiers.push(identifier);
    }
    identifiers
}
