//! Streamed SOG: `lod-meta.json`, a spatial tree over folders of splats in several levels of detail. Described at
//! <https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/>.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::{Map, Value};

use super::files::FileSet;
use super::left_out;
use crate::atomic::folder_of;
use crate::format::SplatFile;
use crate::format::content::pixel_filter_of;
use crate::format::error::{Fault, FormatError, file_bytes, from_json, read_file, shown};
use crate::format::inside::inside;
use crate::format::splat_record::SplatRecord;
use crate::scene::SplatArrays;

pub(super) const INDEX: &str = "lod-meta.json";

#[derive(Deserialize)]
struct Index {
    /// Splats drawn at every level.
    environment: Option<String>,
    /// Paths of `meta.json` files, relative to the index.
    filenames: Vec<String>,
    tree: Node,
    /// Number of splats of each level in the whole tree.
    counts: Option<Vec<usize>>,
    #[serde(flatten)]
    rest: Map<String, Value>,
}

/// Keys of an index that carry no further information on the finest level.
const OF_LEVELS: [&str; 5] = ["asset", "count", "lodErrors", "lodLevels", "version"];

#[derive(Deserialize)]
struct Node {
    #[serde(default)]
    children: Vec<Node>,
    /// Parts by level; 0 is the finest.
    #[serde(default)]
    lods: BTreeMap<u32, Part>,
}

impl Node {
    /// Finest level of any leaf.
    fn finest(&self) -> Option<u32> {
        self.children.iter().filter_map(Self::finest).chain(self.lods.keys().next().copied()).min()
    }
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

/// Total length of all existing levels, each folder or bundle counted once.
pub(super) fn bytes_beside(path: &Path) -> Result<u64, FormatError> {
    let index = Index::read(path)?;
    let names = index.filenames.iter().chain(&index.environment);
    let sets: BTreeSet<PathBuf> = names.filter_map(|name| inside(folder_of(path), name).ok()).collect();
    // Coarse levels are not read, and need not be readable.
    let bytes = |set: &PathBuf| Some(file_bytes(set).ok()? + FileSet::open(set).ok()?.bytes_beside().unwrap_or(0));
    Ok(sets.iter().filter_map(bytes).sum())
}

/// Reads the splats of the finest level; for parts whose file is missing, those of the finest level available. Notes
/// state, in a sentence each, what is missing, left out or contradictory.
pub(super) fn read(path: &Path) -> Result<SplatFile, FormatError> {
    let index = Index::read(path)?;
    let folder = folder_of(path);
    let there: Vec<Option<_>> = index.filenames.iter().map(|name| inside(folder, name).ok()).collect();
    let (mut found, level) = (Finest::default(), index.tree.finest());
    if let Some(level) = level {
        collect(&index.tree, "/tree", level, &there, &mut found).map_err(|fault| fault.in_file(path))?;
    }
    let mut notes = vec![];
    if found.coarser > 0 {
        notes.push(format!(
            "the files of the finest level are missing for {} part(s) of the scene; coarser ones are read",
            found.coarser
        ));
    }
    let stated = index.counts.as_ref().zip(level).and_then(|(counts, level)| counts.get(level as usize));
    if let Some(stated) = stated.filter(|&&stated| stated != found.stated) {
        notes.push(format!("counts says {stated} splats of the finest level, its parts {}", found.stated));
    }
    let unknown = index.rest.keys().map(String::as_str).filter(|key| !OF_LEVELS.contains(key));
    notes.extend(left_out(INDEX, unknown));

    let mut by_file: BTreeMap<usize, Vec<Part>> = BTreeMap::new();
    found.parts.into_iter().for_each(|part| by_file.entry(part.file).or_default().push(part));
    let (mut sources, mut antialiased) = (vec![], false);
    // Notes are deduplicated, because most files give the same ones.
    let mut of_sets = BTreeSet::new();
    let mut taken = HashSet::new();
    for (file, mut own) in by_file {
        let Some(meta) = &there[file] else { continue };
        if !taken.insert(meta) {
            let (at, found) = (format!("/filenames/{file}"), shown(index.filenames[file].as_bytes()));
            return Err(Fault::pointer(at, "each file once", format!("{found} again")).in_file(path));
        }
        own.sort_by_key(|part| part.offset);
        let SplatFile { splats, pixel_filter, notes: said, .. } = set_of(meta)?;
        antialiased |= pixel_filter.normalized;
        of_sets.extend(said);
        check_parts(&own, splats.len(), file).map_err(|fault| fault.in_file(path))?;
        sources.push((splats, own));
    }
    if let Some(name) = &index.environment {
        let fault = |(expected, found): (String, String)| Fault::pointer("/environment", expected, found).in_file(path);
        let SplatFile { splats, pixel_filter, notes: said, .. } = set_of(&inside(folder, name).map_err(fault)?)?;
        antialiased |= pixel_filter.normalized;
        of_sets.extend(said);
        let all = Part { file: 0, offset: 0, count: splats.len() };
        sources.push((splats, vec![all]));
    }
    let degree = sources.iter().map(|(splats, _)| splats.sh_degree()).max().unwrap_or(0);
    let mut arrays = SplatArrays::with_capacity(0, degree);
    for (splats, parts) in &sources {
        let indices = parts.iter().flat_map(|part| part.offset..part.offset + part.count);
        indices.for_each(|i| arrays.push(&SplatRecord::of(splats, i)));
    }
    notes.extend(of_sets);
    let splats = arrays.check().map_err(|e| Fault::from(e).under("/tree").in_file(path))?;
    Ok(SplatFile { pixel_filter: pixel_filter_of(antialiased), notes, ..SplatFile::of(splats) })
}

/// Splats of one folder or bundle; never of another index, because indices might refer to each other in a cycle.
fn set_of(path: &Path) -> Result<SplatFile, FormatError> {
    FileSet::open(path)?.splats().map_err(|fault| fault.in_file(path))
}

/// Parts that are read for the finest level.
#[derive(Default)]
struct Finest {
    parts: Vec<Part>,
    /// Number of parts of a coarser level, used because the finest one's file is missing.
    coarser: usize,
    /// Number of splats of the finest level in the tree, whether or not their files exist.
    stated: usize,
}

/// Collects the parts of `level`, the finest. A leaf without that level has no splats there: what coarser levels show
/// in its place belongs to other leaves.
fn collect(node: &Node, at: &str, level: u32, there: &[Option<impl Sized>], found: &mut Finest) -> Result<(), Fault> {
    if let Some(finest) = node.lods.get(&level) {
        let is_there = |part: &Part| there.get(part.file).is_some_and(Option::is_some);
        let part = node.lods.values().find(|part| is_there(part)).ok_or_else(|| {
            let expected = "the file of at least one level of detail of every part";
            Fault::pointer(format!("{at}/lods"), expected, "none of this part")
        })?;
        found.parts.push(*part);
        found.coarser += usize::from(!is_there(finest));
        found.stated = found.stated.saturating_add(finest.count);
    }
    let mut children = node.children.iter().enumerate();
    children.try_for_each(|(i, child)| collect(child, &format!("{at}/children/{i}"), level, there, found))
}

/// Checks the parts of one file, sorted by offset: they must lie within the file and not overlap, so that no splat
/// occurs twice.
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
    use serde_json::json;

    use super::*;
    use crate::format::test_scenes::random_splats;
    use crate::scene::PixelFilter;

    /// Writes a scene of two leaves in levels 0 and 1 and an environment; returns the path of the index.
    fn written(folder: &Path) -> PathBuf {
        for (name, count, degree) in [("0_0", 9, 1), ("1_0", 4, 0), ("env", 2, 2)] {
            std::fs::create_dir(folder.join(name)).unwrap();
            let splats = random_splats(count, degree, 5);
            super::super::write(&folder.join(name).join("meta.json"), &splats, PixelFilter::DILATION).unwrap();
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
        let SplatFile { splats, notes, .. } = read(&path).unwrap();
        assert_eq!((splats.len(), splats.sh_degree(), notes.len()), (9 + 2, 2, 0));
        std::fs::remove_file(folder.path().join("0_0/meta.json")).unwrap();
        let SplatFile { splats, notes, .. } = read(&path).unwrap();
        assert_eq!((splats.len(), splats.sh_degree(), notes.len()), (4 + 2, 2, 1));
        assert!(notes[0].contains("for 2 part(s)"), "{notes:?}");
        std::fs::remove_file(folder.path().join("1_0/meta.json")).unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("expected the file of at least one level"));
    }

    /// As written by splat-transform if simplification has moved all splats of a part into another.
    #[test]
    fn a_part_without_the_finest_level_has_no_splats_there() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        let mut index: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        index["tree"]["children"][1]["lods"].as_object_mut().unwrap().remove("0");
        index["counts"] = json!([6, 4]);
        index["version"] = json!(1);
        std::fs::write(&path, index.to_string()).unwrap();
        let SplatFile { splats, notes, .. } = read(&path).unwrap();
        assert_eq!((splats.len(), notes), (6 + 2, vec![]));
        index["counts"] = json!([9, 4]);
        index["camera"] = json!({ "fov": 60 });
        std::fs::write(&path, index.to_string()).unwrap();
        assert_eq!(
            read(&path).unwrap().notes,
            ["counts says 9 splats of the finest level, its parts 6", "`camera` of lod-meta.json: left out"]
        );
        // The file of the part that is not selected is not needed.
        std::fs::remove_file(folder.path().join("1_0/meta.json")).unwrap();
        assert_eq!(read(&path).unwrap().splats.len(), 6 + 2);
    }

    #[test]
    fn what_the_files_say_besides_is_told_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = written(folder.path());
        for name in ["0_0", "env"] {
            let meta = folder.path().join(name).join("meta.json");
            let mut content: Value = serde_json::from_slice(&std::fs::read(&meta).unwrap()).unwrap();
            content["model"] = json!("antialiased");
            content["extras"] = json!({ "a": [1, 2.5] });
            std::fs::write(&meta, content.to_string()).unwrap();
        }
        let SplatFile { pixel_filter, notes, .. } = read(&path).unwrap();
        assert!(pixel_filter.normalized);
        assert_eq!(notes, ["`extras` of meta.json: left out"]);
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
