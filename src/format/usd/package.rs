//! Location of a layer's files: beside it, or in the same `.usdz`.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::maps::Mismatch;
use crate::format::FormatError;
use crate::format::archive::{UntilError, write_zip};
use crate::format::error::{Fault, open_file, read_file, shown};
use crate::format::gltf::{self, resolve};

/// Alignment of members' data (the specification of USDZ), which allows memory mapping.
const ALIGNMENT: u16 = 64;

/// Greatest length of a package: USDZ has no Zip64.
const MAX_LENGTH: u64 = u32::MAX as u64;

/// Upper bound on a member's bytes besides its content and twice its name: two headers, and alignment.
const MEMBER_HEADERS: u64 = 30 + 46 + 2 * ALIGNMENT as u64;

type Archive = ZipArchive<BufReader<File>>;

/// Base of asset paths.
pub(super) enum Place {
    Folder(PathBuf),
    /// Package that stays open; its members are read on request.
    Package {
        archive: Box<Archive>,
        folder: String,
    },
}

impl Place {
    /// Content of the file at an asset path.
    pub(super) fn read(&mut self, path: &str) -> Result<Vec<u8>, Mismatch> {
        match self {
            Self::Folder(folder) => resolve(&as_uri(path), folder),
            Self::Package { archive, folder } => {
                let outside = || ("a file of the package".to_owned(), format!("`{path}`"));
                let name = joined(folder, path, &['/', '\\']).ok_or_else(outside)?;
                // On other systems than Windows `\` may be a part of a name.
                let as_written = joined(folder, path, &['/']).filter(|name| archive.index_for_name(name).is_some());
                let is_there = archive.index_for_name(&name).is_some();
                member(archive, &as_written.filter(|_| !is_there).unwrap_or(name))
            }
        }
    }
}

/// Name of the member at a `path` relative to `folder`, with any of these characters between folders; `None` if it leads
/// out of the package.
fn joined(folder: &str, path: &str, between: &[char]) -> Option<String> {
    let mut parts: Vec<&str> = folder.split('/').filter(|part| !part.is_empty()).collect();
    for part in path.split(between).filter(|part| !part.is_empty() && *part != ".") {
        if part == ".." {
            parts.pop()?;
        } else {
            parts.push(part);
        }
    }
    Some(parts.join("/"))
}

/// Total length of the files at asset paths beside a layer, each counted once.
pub(super) fn bytes_of_files<'a>(paths: impl Iterator<Item = &'a str>, folder: &Path) -> u64 {
    let uris: Vec<String> = paths.map(as_uri).collect();
    gltf::bytes_of_files(uris.iter().map(String::as_str), folder)
}

/// Escapes percent signs, which are ordinary characters in asset paths, and sets `/` for the `\` of programs on Windows.
fn as_uri(path: &str) -> String {
    path.replace('%', "%25").replace('\\', "/")
}

fn member(archive: &mut Archive, name: &str) -> Result<Vec<u8>, Mismatch> {
    let unreadable = |reason: String| ("a readable file".to_owned(), format!("`{name}` ({reason})"));
    let index = archive.index_for_name(name).ok_or_else(|| unreadable("not in the package".to_owned()))?;
    stored(archive, index)
}

/// Reads a member. Members are not compressed, so the package bounds the memory needed.
fn stored(archive: &mut Archive, index: usize) -> Result<Vec<u8>, Mismatch> {
    let unreadable = |e: zip::result::ZipError| ("a readable file".to_owned(), e.to_string());
    let mut member = archive.by_index(index).map_err(unreadable)?;
    if member.compression() != CompressionMethod::Stored {
        let found = format!("`{}` ({})", member.name().map_err(unreadable)?, member.compression());
        return Err(("files that are not compressed, as USDZ demands".to_owned(), found));
    }
    let mut content = vec![];
    member.read_to_end(&mut content).map_err(|e| ("a readable file".to_owned(), e.to_string()))?;
    Ok(content)
}

/// Layer, and the context needed to read it.
pub(super) struct Opened {
    pub(super) layer: Vec<u8>,
    pub(super) place: Place,
    /// Name of the layer in a package.
    pub(super) member: Option<String>,
}

/// Places a layer's fault in its package.
pub(super) fn located(fault: Fault, member: Option<&String>) -> Fault {
    match member {
        Some(name) => fault.in_member(name),
        None => fault,
    }
}

/// Opens the layer at `path`, and locates its files.
pub(super) fn open(path: &Path) -> Result<Opened, FormatError> {
    let mut file = open_file(path)?;
    let start = file.fill_buf().map_err(|source| FormatError::Read { file: path.to_owned(), source })?;
    if start.starts_with(b"PK\x03\x04") {
        return package(file).map_err(|fault| fault.in_file(path));
    }
    let place = Place::Folder(path.parent().unwrap_or(Path::new("")).to_owned());
    Ok(Opened { layer: read_file(path)?, place, member: None })
}

fn package(mut file: BufReader<File>) -> Result<Opened, Fault> {
    let end = file.seek(SeekFrom::End(0)).map_err(|e| Fault::unreadable(0, &e))? as usize;
    let archive = ZipArchive::new(file);
    let mut archive = archive.map_err(|e| Fault::byte(end, "the directory of a zip before", e.to_string()))?;
    let directory = archive.central_directory_start() as usize;
    let unlisted = |e: zip::result::ZipError| Fault::byte(directory, "the directory of a zip", e.to_string());
    // First member by place in the file, which need not be the first in the directory.
    let mut first: Option<(u64, usize, String)> = None;
    for i in 0..archive.len() {
        let member = archive.by_index_raw(i).map_err(unlisted)?;
        if first.as_ref().is_none_or(|(start, ..)| member.header_start() < *start) {
            let name = member.name().map_err(unlisted)?;
            first = Some((member.header_start(), i, name.into_owned()));
        }
    }
    let (start, index, name) = first.ok_or_else(|| Fault::byte(directory, "a package with a layer", "an empty one"))?;
    if !is_layer(name.as_bytes()) {
        let expected = "a package whose first file is its layer, a .usda, .usdc or .usd";
        return Err(Fault::byte(start as usize, expected, shown(name.as_bytes())));
    }
    let unread = |(expected, found)| Fault::byte(start as usize, expected, found);
    let layer = stored(&mut archive, index).map_err(unread)?;
    let folder = name.rsplit_once('/').map_or("", |(folder, _)| folder).to_owned();
    Ok(Opened { layer, place: Place::Package { archive: Box::new(archive), folder }, member: Some(name) })
}

/// Whether a file that begins with `start` is a zip whose first member is a layer.
pub(super) fn is_package(start: &[u8]) -> bool {
    // The length of the name is at byte 26 of the member's header, the name at byte 30.
    let Some(length) = start.get(26..28).filter(|_| start.starts_with(b"PK\x03\x04")) else { return false };
    let length = usize::from(u16::from_le_bytes([length[0], length[1]]));
    is_layer(start.get(30..30 + length).unwrap_or_default())
}

/// Whether a file of this name is a layer.
fn is_layer(name: &[u8]) -> bool {
    let name = name.to_ascii_lowercase();
    [&b".usda"[..], b".usdc", b".usd"].iter().any(|extension| name.ends_with(extension))
}

/// Writes a package: the layer first, then the files, all aligned and uncompressed.
pub(super) fn write<W: Write + Seek>(
    out: W,
    layer: impl FnOnce(&mut Limited<'_, ZipWriter<UntilError<W>>>) -> std::io::Result<()>,
    files: &[(String, Vec<u8>)],
) -> std::io::Result<()> {
    write_within(MAX_LENGTH, out, layer, files)
}

/// Same as [`write()`], limited to `limit` bytes: exceeding them is an error, reported at the end of the layer at the
/// latest.
fn write_within<W: Write + Seek>(
    limit: u64,
    out: W,
    layer: impl FnOnce(&mut Limited<'_, ZipWriter<UntilError<W>>>) -> std::io::Result<()>,
    files: &[(String, Vec<u8>)],
) -> std::io::Result<()> {
    const LAYER: &str = "scene.usda";
    let member = |name: &str, length: usize| (length + 2 * name.len()) as u64 + MEMBER_HEADERS;
    // The end of the directory takes another 22 bytes.
    let besides = files.iter().map(|(name, content)| member(name, content.len())).sum::<u64>() + member(LAYER, 0) + 22;
    let left = limit.checked_sub(besides).ok_or_else(too_long)?;
    write_zip(out, |zip| {
        // Without a date, the package depends only on its content.
        let options =
            SimpleFileOptions::default().compression_method(CompressionMethod::Stored).with_alignment(ALIGNMENT);
        zip.start_file(LAYER, options)?;
        layer(&mut Limited { out: zip, left })?;
        for (name, content) in files {
            zip.start_file(name.as_str(), options)?;
            zip.write_all(content)?;
        }
        Ok(())
    })
}

fn too_long() -> std::io::Error {
    std::io::Error::other("a .usdz cannot hold more than 4 GiB; a .usda can")
}

/// Writer that accepts a limited number of bytes.
pub(super) struct Limited<'a, W> {
    out: &'a mut W,
    left: u64,
}

impl<W: Write> Write for Limited<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.out.write(bytes)?;
        let left = self.left.checked_sub(written as u64);
        self.left = left.ok_or_else(too_long)?;
        Ok(written)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_package_is_no_longer_than_its_directory_can_say() {
        let files = [("maps/a.png".to_owned(), vec![7; 5_000]), ("b.png".to_owned(), vec![7; 10])];
        let written = |limit: u64, length: usize| {
            let mut out = std::io::Cursor::new(vec![]);
            write_within(limit, &mut out, |layer| layer.write_all(&vec![b' '; length]), &files)
                .map(|()| out.into_inner())
        };
        for length in [0, 1_000, 3_000] {
            for limit in (5_000..9_000).step_by(7) {
                match written(limit, length) {
                    Ok(package) => assert!(package.len() as u64 <= limit, "{} bytes for {limit}", package.len()),
                    Err(e) => {
                        assert!(limit < (length + 5_010 + 700) as u64, "{length} bytes in {limit}");
                        assert!(e.to_string().contains("4 GiB"), "{e}");
                    }
                }
            }
        }
    }
}
