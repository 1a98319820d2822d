//! Scenes of a data set: its captures, and the flags with which `scenes.json` lists them.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use anyhow::{Context as _, Result, anyhow, ensure};
use centaur::capture;
use serde::Deserialize;

use crate::cli::output;

/// Capture of a data set.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Scene {
    /// Folder of the capture, relative to the data set.
    pub(super) capture: PathBuf,
    /// Flags of `centaur train` for the scene, which those of the command replace; its size also by an equivalent flag.
    #[serde(default)]
    pub(super) flags: Vec<String>,
}

/// Content of `scenes.json`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Listed {
    scenes: BTreeMap<String, Scene>,
}

/// Scenes by name: those listed in the folder's `scenes.json`, else its subfolders that contain a capture. What is left
/// out is told, in JSON if `json`.
pub(super) fn scenes(dataset: &Path, json: bool) -> Result<BTreeMap<String, Scene>> {
    let list = dataset.join("scenes.json");
    if list.is_file() {
        return listed(&list);
    }
    // A capture without cameras shall fail by name, not be missing from the table.
    let is_one = |path: &Path| capture::is_capture(path) || path.join("sparse").is_dir();
    ensure!(
        !is_one(dataset),
        "{}: is itself a capture: give the folder that contains it, and --scenes with its name",
        dataset.display()
    );
    let mut found = BTreeMap::new();
    let unread = || format!("{}: cannot read", dataset.display());
    for entry in std::fs::read_dir(dataset).with_context(unread)? {
        let path = entry.with_context(unread)?.path();
        let Some(name) = path.file_name().filter(|_| is_one(&path)) else { continue };
        match name.to_str() {
            // Hidden folders belong to other programs.
            Some(name) if name.starts_with('.') => {}
            // Jobs are listed one per line.
            Some(name) if name.contains(char::is_control) => {
                output::say(&format!("{name:?}: left out: its name holds a control character"), json);
            }
            Some(name) => {
                found.insert(name.to_owned(), Scene { capture: name.into(), flags: vec![] });
            }
            None => output::say(&format!("{}: left out: its name is not UTF-8", path.display()), json),
        }
    }
    ensure!(
        !found.is_empty(),
        "{}: expected a folder of captures, each with a COLMAP model or transforms.json, found none in it",
        dataset.display()
    );
    Ok(found)
}

/// Form of `scenes.json`, in one line.
const FORM: &str =
    r#"{"scenes": {"NAME": {"capture": "FOLDER", "flags": ["--downscale", "2"]}}}, flags being optional"#;

/// Reads `scenes.json`. Its names become file names, and its folders must lie within its own.
fn listed(list: &Path) -> Result<BTreeMap<String, Scene>> {
    let here = || list.display().to_string();
    let text = std::fs::read(list).with_context(|| format!("{}: cannot read", here()))?;
    // Windows editors write a byte order mark before the first brace.
    let text = text.strip_prefix("\u{feff}".as_bytes()).unwrap_or(&text);
    let Listed { scenes } =
        serde_json::from_slice(text).map_err(|e| anyhow!("{}: expected {FORM}, found {e}", here()))?;
    ensure!(!scenes.is_empty(), "{}: expected scenes, found none", here());
    for (name, scene) in &scenes {
        let safe = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        ensure!(
            !name.is_empty() && name.chars().all(safe),
            "{}: expected names of letters, digits, - and _, found `{name}`",
            here()
        );
        // Files whose names differ by case alone are one on many systems.
        let twin = scenes.keys().find(|other| *other != name && other.eq_ignore_ascii_case(name));
        ensure!(
            twin.is_none(),
            "{}: expected names that differ by more than case, found {}",
            here(),
            [Some(name), twin].into_iter().flatten().map(String::as_str).collect::<Vec<_>>().join(" and ")
        );
        let is_within = scene.capture.components().all(|part| matches!(part, Component::Normal(_)));
        ensure!(
            is_within && !scene.capture.as_os_str().is_empty(),
            "{}: expected the folder of {name} within its own, found {}",
            here(),
            scene.capture.display()
        );
    }
    Ok(scenes)
}
