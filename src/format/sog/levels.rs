//! Streamed SOG: `lod-meta.json`, a tree of space over folders of splats in several levels of detail. Described at
//! <https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/>.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::files::FileSet;
use crate::atomic::folder_of;
use crate::format::NotedSplats;
use crate::format::error::{Fault, FormatError, from_json, read_file, shown};
use crate::format::inside::inside;
use crate::format::length::file_bytes;
use crate::format::splat_record::SplatRecord;
use crate::scene::{SplatArrays, Splats};

pub(super) const INDEX: &str = "lod-meta.json";

#[derive(Deserialize)]
struct Index {
    /// Splats that are drawn whatever the level.
    environment: Option<String>,
    /// Each a `meta.json`, relative to the index.
    filenames: Vec<String>,
    tree: Node,
}

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    children: Vec<Node>,
    /// By level; 0 is the finest.
    #[serde(default)]
    lods: BTreeMap<u32, Part>,
}

/// Consecutive splats of a file.
#[derive(Clone, Copy, Deserialize)]
struct Part {
    file: usize,
    offset: usize,
    count: usize,
}

impl Index {
    fn read(path: &Path) -> Result<Self, FormatError> {
        let text = read_file(path)?;
        from_json(&text, 0, "the `lod-meta.json` of a streamed SOG").map_err(|fault| fault.in_file(path))
    }
}

/// Length of all levels that are there, each folder or bundle once.
pub(super) fn bytes_beside(path: &Path) -> Result<u64, FormatError> {
    let index = Index::read(path)?;
    let names = index.filenames.iter().chain(&index.environment);
    let sets: BTreeSet<PathBuf> = names.filter_map(|name| inside(folder_of(path), name).ok()).collect();
    // Coarse levels are not read, and need not be readable.
    let bytes = |set: &PathBuf| Some(file_bytes(set).ok()? + FileSet::open(set).ok()?.bytes_beside().unwrap_or(0));
    Ok(sets.iter().filter_map(bytes).sum())
}

/// The splats of every leaf of the tree at the finest level whose file is there, and a sentence on what is missing.
pub(super) fn read(path: &Path) -> Result<NotedSplats, FormatError> {
    let index = Index::read(path)?;
    let folder = folder_of(path);
    let there: Vec<Option<_>> = index.filenames.iter().map(|name| inside(folder, name).ok()).collect();
    let (mut parts, mut coarser) = (vec![], 0);
    collect(&index.tree, "/tree", &there, &mut parts, &mut coarser).map_err(|fault| fault.in_file(path))?;

    let mut by_file: BTreeMap<usize, Vec<Part>> = BTreeMap::new();
    parts.into_iter().for_each(|part| by_file.entry(part.file).or_default().push(part));
    let (mut sources, mut antialiased) = (vec![], false);
    let mut taken = HashSet::new();
    for (file, mut own) in by_file {
        let Some(meta) = &there[file] else { continue };
        if !taken.insert(meta) {
            let (at, found) = (format!("/filenames/{file}"), shown(index.filenames[file].as_bytes()));
            return Err(Fault::pointer(at, "each file once", format!("{found} again")).in_file(path));
        }
        own.sort_by_key(|part| part.offset);
        let (splats, antialias) = set_of(meta)?;
        antialiased |= antialias;
        check_parts(&own, splats.len(), file).map_err(|fault| fault.in_file(path))?;
        sources.push((splats, own));
    }
    if let Some(name) = &index.environment {
        let fault = |(expected, found): (String, String)| Fault::pointer("/environment", expected, found).in_file(path);
        let (splats, antialias) = set_of(&inside(folder, name).map_err(fault)?)?;
        antialiased |= antialias;
        let all = Part { file: 0, offset: 0, count: splats.len() };
        sources.push((splats, vec![all]));
    }
    let degree = sources.iter().map(|(splats, _)| splats.sh_degree()).max().unwrap_or(0);
    let mut arrays = SplatArrays::with_capacity(0, degree);
    for (splats, parts) in &sources {
        let indices = parts.iter().flat_map(|part| part.offset..part.offset + part.count);
        indices.for_each(|i| arrays.push(&SplatRecord::of(splats, i)));
    }
    let notes = (coarser > 0).then(|| {
        format!("the files of the finest level are missing for {coarser} part(s) of the scene; coarser ones are read")
    });
    let splats = arrays.check().map_err(|e| Fault::from(e).under("/tree").in_file(path))?;
    Ok(NotedSplats::new(splats, antialiased, notes.into_iter().collect()))
}

/// The splats of one folder or bundle, never of another index: a circle of them would have no end.
fn set_of(path: &Path) -> Result<(Splats, bool), FormatError> {
    FileSet::open(path)?.splats().map_err(|fault| fault.in_file(path))
}

/// The finest part of each leaf of which the file is there; counts the leaves for which that is not the finest of all.
fn collect(
    node: &Node,
    at: &str,
    there: &[Option<impl Sized>],
    parts: &mut Vec<Part>,
    coarser: &mut usize,
) -> Result<(), Fault> {
    let is_there = |part: &Part| there.get(part.file).is_some_and(Option::is_some);
    match node.lods.values().position(is_there) {
        Some(position) => {
            parts.extend(node.lods.values().nth(position));
            *coarser += usize::from(position > 0);
        }
        None if node.lods.is_empty() => {}
        None => {
            let expected = "the file of at least one level of detail of every part";
            return Err(Fault::pointer(format!("{at}/lods"), expected, "none of this part"));
        }
    }
    let mut children = node.children.iter().enumerate();
    children.try_for_each(|(i, child)| collect(child, &format!("{at}/children/{i}"), there, parts, coarser))
}

/// Parts of one file, by offset, must lie in it and not overlap, so that no splat is there twice.
fn check_parts(parts: &[Part], count: usize, file: usize) -> Result<(), Fault> {
    let mut end = 0;
    for part in parts {
        let next = part.offset.checked_add(part.count).filter(|&next| part.offset >= end && next <= count);
        end = next.ok_or_else(|| {
            let expected = format!("separate parts of the {count} splats of file {file}");
            Fault::pointer("/tree", expected, format!("{} from {}", part.count, part.offset))
        })?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::format::test_scenes::random_splats;

    /// Two leaves in levels 0 and 1, and an environment; returns the path of the index.
    fn written(folder: &Path) -> PathBuf {
        for (name, count, degree) in [("0_0", 9, 1), ("1_0", 4, 0), ("env", 2, 2)] {
            std::fs::create_dir(folder.join(name)).unwrap();
            super::super::write(&folder.join(name).join("meta.json"), &random_splats(count, degree, 5)).unwrap();
        }
        let path = folder.join(INDEX);
        let leaf = |fine: [usize; 2], coarse: [usize; 2]| {
            json!({ "lods": {
                "0": { "file": 0, "offset": fine[0], "count": fine[1] },
                "1": { "file": 1, "offset": coarse[0], "count": coarse[1] },
            } })
        };
        let index = json!({
            "lodLevels": 2, "environment": "env/meta.json", "filenames": ["0_0/meta.json", "1_0/meta.json"],
            "tree": { "children": [leaf([0, 6], [0, 3]), leaf([6, 3], [3, 1])] },
        });
        std::fs::write(&path, index.to_string()).unwrap();
        path
    }

    #[test]
    fn the_finest_level_that_is_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let NotedSplats { splats, notes, .. } = read(&path).unwrap();
        assert_eq!((splats.len(), splats.sh_degree(), notes.len()), (9 + 2, 2, 0));
        std::fs::remove_file(folder.path().join("0_0/meta.json")).unwrap();
        let NotedSplats { splats, notes, .. } = read(&path).unwrap();
        assert_eq!((splats.len(), splats.sh_degree(), notes.len()), (4 + 2, 2, 1));
        assert!(notes[0].contains("for 2 part(s)"), "{notes:?}");
        std::fs::remove_file(folder.path().join("1_0/meta.json")).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("expected the file of at least one level"));
    }

    #[test]
    fn all_levels_count_as_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let mut files = vec![path.clone()];
        for name in ["0_0", "1_0", "env"] {
            files.extend(folder.path().join(name).read_dir().unwrap().map(|file| file.unwrap().path()));
        }
        let whole: u64 = files.iter().map(|file| file.metadata().unwrap().len()).sum();
        assert_eq!(crate::format::stored_bytes(&path).unwrap(), whole);
    }

    #[test]
    fn parts_and_paths_are_checked() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let mut index: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        index["filenames"].as_array_mut().unwrap().push(json!("0_0/meta.json"));
        let message = |pointer: &str, value: Value| {
            let mut index = index.clone();
            *index.pointer_mut(pointer).unwrap() = value;
            std::fs::write(&path, index.to_string()).unwrap();
            read(&path).unwrap_err().to_string()
        };
        let twice = message("/tree/children/1/lods/0", json!({ "file": 2, "offset": 0, "count": 1 }));
        assert!(twice.contains("/filenames/2: expected each file once, found `0_0/meta.json` again"), "{twice}");
        let overlap = message("/tree/children/1/lods/0/offset", json!(5));
        assert!(
            overlap.ends_with("/tree: expected separate parts of the 9 splats of file 0, found 3 from 5"),
            "{overlap}"
        );
        assert!(
            message("/tree/children/1/lods/0/count", json!(u64::MAX)).contains("found 18446744073709551615 from 6")
        );
        assert!(message("/environment", json!("../out/meta.json")).contains("/environment: expected a path inside"));
        assert!(message("/filenames", json!([])).contains("at least one level"));
        assert!(message("/tree", json!(3)).contains("expected the `lod-meta.json` of a streamed SOG"));
    }
}
