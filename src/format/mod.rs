//! File formats: what is written to and read from disk. Readers check everything and name file, place, expectation
//! and finding; writers go through a temporary file, so that nothing half-written is ever seen.

mod activation;
mod atomic;
mod color;
mod error;
pub mod gltf;
mod inspect;
mod loss;
pub mod mesh_import;
pub mod ply;
#[cfg(test)]
mod test_scenes;

use std::path::Path;

pub use atomic::{atomic_write, atomic_write_with};
pub use error::{FormatError, Location};
pub use inspect::{CompositionSummary, MeshSummary, SplatSummary, Summary, inspect};
pub use loss::{Loss, SplatError, WriteReport};

use crate::scene::{Composition, HybridScene};

/// What a file is, by its first bytes.
enum Kind {
    Gltf,
    Ply,
}

/// Reads a hybrid scene from a `.glb` or `.gltf` file, or splats alone from an INRIA `.ply`; told apart by content.
///
/// # Errors
/// If the file cannot be read or is none of these; see [`gltf::read`] and [`ply::read`].
pub fn read_scene(path: &Path) -> Result<HybridScene, FormatError> {
    match kind(path)? {
        Kind::Gltf => Ok(gltf::read(path)?.scene),
        Kind::Ply => Ok(HybridScene { splats: ply::read(path)?, meshes: vec![], composition: Composition::default() }),
    }
}

fn kind(path: &Path) -> Result<Kind, FormatError> {
    use std::io::Read as _;
    let failed = |source| FormatError::Read { file: path.to_owned(), source };
    let mut start = vec![];
    // Enough to see past the white space with which JSON may begin.
    std::fs::File::open(path).and_then(|f| f.take(256).read_to_end(&mut start)).map_err(failed)?;
    let first = start.iter().find(|b| !b.is_ascii_whitespace());
    if start.starts_with(b"glTF") || first == Some(&b'{') {
        Ok(Kind::Gltf)
    } else if start.starts_with(b"ply") {
        Ok(Kind::Ply)
    } else {
        let expected = "a .glb, .gltf or .ply file";
        let found = if start.is_empty() { "an empty file" } else { "other content" };
        Err(error::Fault::whole(expected, found).in_file(path))
    }
}
