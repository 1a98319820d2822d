//! Files of a SOG: members of a zip, or of a folder.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Cursor, Read as _, Write as _};
use std::path::{Path, PathBuf};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive};

use super::meta::Meta;
use super::texels::Texels;
use crate::atomic::folder_of;
use crate::format::archive::write_zip;
use crate::format::error::{Fault, FormatError, from_json, read_file};
use crate::format::inside::inside;
use crate::format::{atomic_write, atomic_write_with};

pub(super) const META: &str = "meta.json";
/// Largest accepted `meta.json`: three codebooks of 256 numbers take 20 kB.
const MAX_META: u64 = 1 << 20;

/// Location of the files.
pub(super) struct FileSet {
    place: Place,
    bytes: u64,
}

enum Place {
    Bundle(Box<ZipArchive<Cursor<Vec<u8>>>>),
    Folder(PathBuf),
}

impl FileSet {
    /// Opens a SOG; `path` is a zip, or the `meta.json` of a folder.
    pub(super) fn open(path: &Path) -> Result<Self, FormatError> {
        if is_folder(path) {
            let folder = folder_of(path).to_owned();
            let bytes = folder_bytes(&folder);
            return Ok(Self { place: Place::Folder(folder), bytes });
        }
        Self::bundle(read_file(path)?).map_err(|fault| fault.in_file(path))
    }

    pub(super) fn bundle(zip: Vec<u8>) -> Result<Self, Fault> {
        let bytes = zip.len() as u64;
        let archive = ZipArchive::new(Cursor::new(zip));
        let archive =
            archive.map_err(|e| Fault::byte(bytes as usize, "the directory of a zip before", e.to_string()))?;
        Ok(Self { place: Place::Bundle(Box::new(archive)), bytes })
    }

    /// Total length of all files.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    pub(super) fn meta(&mut self) -> Result<Meta, Fault> {
        let text = match &self.place {
            // Fault without a pointer: the opened file is not referenced by another one.
            Place::Folder(_) => self.read(META, "", MAX_META)?,
            Place::Bundle(archive) if archive.index_for_name(META).is_none() => {
                let directory = archive.central_directory_start() as usize;
                return Err(Fault::byte(
                    directory,
                    format!("`{META}` among the files of the zip"),
                    "none of this name",
                ));
            }
            Place::Bundle(_) => self.read(META, "", MAX_META)?,
        };
        from_json(&text, 0, "the `meta.json` of a SOG").map_err(|fault| self.in_meta(fault))
    }

    /// Total length of the existing images that `meta.json` names, if they are in a folder; each counts once.
    pub(super) fn bytes_beside(&mut self) -> Result<u64, Fault> {
        let Place::Folder(folder) = &self.place else { return Ok(0) };
        let folder = folder.clone();
        let meta = self.meta()?;
        let images: BTreeSet<PathBuf> =
            meta.files().into_iter().filter_map(|name| inside(&folder, name).ok()).collect();
        Ok(images.iter().filter_map(|image| image.metadata().ok()).map(|m| m.len()).sum())
    }

    /// Places a fault in `meta.json`.
    pub(super) fn in_meta(&self, fault: Fault) -> Fault {
        if let Place::Bundle(_) = self.place { fault.in_member(META) } else { fault }
    }

    /// Content of an image that `meta.json` names at the pointer `at`.
    pub(super) fn image(&mut self, name: &str, at: &str) -> Result<Vec<u8>, Fault> {
        // Lossless WebP does not deflate further, so a member much larger than the whole zip is malicious.
        self.read(name, at, self.bytes.saturating_mul(8).saturating_add(1 << 16))
    }

    fn read(&mut self, name: &str, at: &str, limit: u64) -> Result<Vec<u8>, Fault> {
        let missing = |reason: String| Fault::pointer(at, "a readable file", format!("`{name}` ({reason})"));
        let mut content = vec![];
        let read = match &mut self.place {
            Place::Bundle(archive) => {
                // As in a folder, see `inside`; `\` may also be a part of a name.
                let slashed = name.replace('\\', "/");
                let found = if archive.index_for_name(name).is_some() { name } else { slashed.as_str() };
                match archive.by_name(found) {
                    Ok(member) => member.take(limit + 1).read_to_end(&mut content),
                    Err(e) => return Err(missing(e.to_string()).in_member(META)),
                }
            }
            Place::Folder(folder) => {
                let path = inside(folder, name).map_err(|(expected, found)| Fault::pointer(at, expected, found))?;
                let file = File::open(path).map_err(|e| missing(e.to_string()))?;
                file.take(limit + 1).read_to_end(&mut content)
            }
        };
        read.map_err(|e| Fault::unreadable(content.len() as u64, &e).in_member(name))?;
        if content.len() as u64 > limit {
            let most = format!("the end of the file at {limit} bytes");
            return Err(Fault::byte(limit as usize, most, "more").in_member(name));
        }
        Ok(content)
    }
}

/// Whether `path` names the files of a folder rather than a bundle.
pub(super) fn is_folder(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name == META)
}

/// Total length of the files beside `meta.json`; unreadable ones do not count.
fn folder_bytes(folder: &Path) -> u64 {
    let entries = folder.read_dir().into_iter().flatten().filter_map(Result::ok);
    entries.filter_map(|e| e.metadata().ok()).filter(std::fs::Metadata::is_file).map(|m| m.len()).sum()
}

/// Writes all files, images in the order of [`Meta::files`]; returns their length together.
pub(super) fn write(path: &Path, meta: &Meta, images: &[Texels]) -> Result<u64, FormatError> {
    use rayon::prelude::*;
    let failed = |source| FormatError::Write { file: path.to_owned(), source };
    let names = meta.files();
    let meta = serde_json::to_vec(meta).map_err(|e| failed(e.into()))?;
    let images: Vec<Vec<u8>> = images.par_iter().map(Texels::encode).collect();
    let files = names.into_iter().zip(&images).chain([(META, &meta)]);
    if !is_folder(path) {
        return atomic_write_with(path, |out| {
            write_zip(out, |zip| {
                // Without a date, the zip depends only on its content. Compressed images do not deflate.
                let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
                for (name, content) in files {
                    zip.start_file(name, options.large_file(content.len() > i32::MAX as usize))?;
                    zip.write_all(content)?;
                }
                Ok(())
            })
        });
    }
    let mut bytes = 0;
    for (name, content) in files {
        atomic_write(&path.with_file_name(name), content)?;
        bytes += content.len() as u64;
    }
    Ok(bytes)
}
