//! Protection of captures, which have the same file names, from being overwritten or hidden by camera paths.

use std::path::Path;

use serde::Deserialize;

use crate::atomic::folder_of;
use crate::format::FormatError;
use crate::format::error::Fault;

/// Generator entry of `transforms.json` files that Centaur writes.
pub(super) const GENERATOR: &str = "centaur cameras";

/// Files of COLMAP models that Centaur writes.
pub(super) const FILES: [&str; 3] = ["cameras.txt", "images.txt", "points3D.txt"];

/// Content of `points3D.txt` in COLMAP models that Centaur writes.
pub(super) const NO_POINTS: &str = "# No points: a path of `centaur cameras`\n";

/// Rejects a folder for a COLMAP model if it holds any part of a capture other than an earlier model of ours.
pub(super) fn spare_in(folder: &Path) -> Result<(), FormatError> {
    refuse(folder, part_of_capture(folder, &["images"]).or_else(|| part_above(folder)))
}

/// Part of a capture in the parent folder, if `folder` is called `colmap` and would therefore be searched for that
/// capture's model.
fn part_above(folder: &Path) -> Option<String> {
    let whole = folder.canonicalize().or_else(|_| std::path::absolute(folder)).ok()?;
    let is_looked_into = |path: &Path| path.file_name().is_some_and(|name| name.eq_ignore_ascii_case("colmap"));
    let above = [folder, &whole].into_iter().filter(|path| is_looked_into(path)).filter_map(Path::parent);
    above.map(|above| if above.as_os_str().is_empty() { Path::new(".") } else { above }).find_map(|above| {
        let names = parts_of_capture(above, &["images"]).into_iter();
        names.filter(|name| name != "colmap").map(|name| format!("../{name}")).next()
    })
}

/// Rejects a path for a `transforms*.json` if it would replace one that is not ours, or would be read instead of an
/// existing capture.
pub(super) fn spare(path: &Path) -> Result<(), FormatError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if !is_transforms(&name) || is_our_transforms(path) {
        return Ok(());
    }
    refuse(path, if path.exists() { Some(name) } else { part_of_capture(folder_of(path), &[]) })
}

fn refuse(target: &Path, found: Option<String>) -> Result<(), FormatError> {
    let fault =
        |name| Fault::whole("a folder without a capture, which the cameras would replace or hide", format!("`{name}`"));
    found.map_or(Ok(()), |name| Err(fault(name).in_file(target)))
}

/// First part of a capture in a folder, by name; names in `besides` count too.
fn part_of_capture(folder: &Path, besides: &[&str]) -> Option<String> {
    parts_of_capture(folder, besides).into_iter().next()
}

fn parts_of_capture(folder: &Path, besides: &[&str]) -> Vec<String> {
    let mut names = entries(folder);
    names.sort_unstable();
    names.retain(|name| match &name[..] {
        "sparse" => !is_our_model(&folder.join(name)),
        "0" => entries(&folder.join(name)).iter().any(|file| ["cameras.bin", "cameras.txt"].contains(&&file[..])),
        "colmap" | "cameras.bin" | "cameras.txt" | "frames.bin" | "frames.txt" => true,
        other => besides.contains(&other) || is_transforms(other) && !is_our_transforms(&folder.join(other)),
    });
    names
}

/// Names of the entries of a folder; empty if it is not a folder.
fn entries(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

fn is_transforms(name: &str) -> bool {
    name.starts_with("transforms") && Path::new(name).extension().is_some_and(|e| e == "json")
}

fn is_our_transforms(path: &Path) -> bool {
    #[derive(Deserialize)]
    struct Probe {
        generator: String,
    }
    let text = std::fs::read(path).unwrap_or_default();
    serde_json::from_slice::<Probe>(&text).is_ok_and(|probe| probe.generator == GENERATOR)
}

/// Whether a folder `sparse` is empty, or holds a model of ours and nothing else.
fn is_our_model(sparse: &Path) -> bool {
    let is_ours = |model: &Path| {
        let points = std::fs::read(model.join(FILES[2])).unwrap_or_default();
        points == NO_POINTS.as_bytes() && entries(model).iter().all(|name| FILES.contains(&&name[..]))
    };
    entries(sparse).iter().all(|name| name == "0" && is_ours(&sparse.join(name)))
}
