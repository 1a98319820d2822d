//! Stored size of a scene.

use std::path::Path;

use super::error::file_bytes;
use super::gltf::{self, Asset};
use super::{Format, FormatError, detect, sog, usd};

/// Total length in bytes of a scene file and of the files that belong to it: buffers and images of a glTF, maps and
/// images of a USD layer, images of a SOG folder, and all folders of a SOG with levels of detail. Each file counts
/// once; missing files do not count.
///
/// # Errors
/// If the file cannot be read, is not a scene, or does not determine its files.
pub fn stored_bytes(path: &Path) -> Result<u64, FormatError> {
    let own = file_bytes(path)?;
    Ok(match detect(path)? {
        Format::Glb | Format::Gltf => gltf::sizes(&Asset::open(path)?, own).total,
        Format::Sog => own + sog::bytes_beside(path)?,
        Format::Usda | Format::Usdc | Format::Usdz => own + usd::bytes_beside(path)?,
        _ => own,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::test_scenes::random_scene;
    use crate::format::{WriteOptions, inspect, write_scene};
    use crate::scene::PixelFilter;

    #[test]
    fn all_files_of_a_scene_count() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("sog")).unwrap();
        // Files that do not belong to a scene.
        std::fs::write(folder.path().join("sog/notes.txt"), [0; 99]).unwrap();
        std::fs::write(folder.path().join("notes.png"), [0; 99]).unwrap();
        let scene = random_scene(40, 2, 2, 5);
        for name in ["a.glb", "a.gltf", "a.usda", "a.usdz", "sog/meta.json", "a.sog", "a.ply", "a.spz"] {
            let path = folder.path().join(name);
            let report = if name == "sog/meta.json" {
                sog::write(&path, &scene.splats, PixelFilter::DILATION)
            } else {
                write_scene(&path, &scene, &WriteOptions::default())
            };
            let written = report.unwrap().bytes;
            assert_eq!(stored_bytes(&path).unwrap(), written, "{name}");
            let summary = inspect(&path).unwrap();
            assert_eq!((summary.bytes, summary.bytes_by_part.values().sum()), (written, written), "{name}");
        }
    }
}
