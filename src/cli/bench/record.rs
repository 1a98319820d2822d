//! Results: one file per job, which states how it was made.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, anyhow, bail, ensure};
use serde::Deserialize as _;
use serde_json::Value;

use super::flags::{as_kept, left_of};
use super::jobs::{self, Job, Made};
use super::protocol::Protocol;

/// Finished job.
#[derive(Clone, Debug)]
pub(super) struct Record {
    pub(super) file: PathBuf,
    pub(super) made: Made,
    /// Output of `centaur train --json`.
    pub(super) result: Value,
}

/// Notes of a training, without those on the file of its scene, whose name nobody has chosen: how to show or convert
/// that, or that it was there before.
pub(super) fn notes(result: &Value) -> impl Iterator<Item = &str> {
    let scene = result["scene"].as_str();
    let all = result["notes"].as_array().into_iter().flatten().filter_map(Value::as_str);
    all.filter(move |note| scene.is_none_or(|scene| !note.contains(scene)))
}

/// All results in a folder, `*/*.json`, sorted by name.
pub(super) fn all(folder: &Path) -> Result<Vec<Record>> {
    let mut records = vec![];
    for variant in entries(folder)?.into_iter().filter(|path| path.is_dir()) {
        for file in entries(&variant)?.into_iter().filter(|path| path.extension().is_some_and(|e| e == "json")) {
            // `centaur eval` and others may write here, too, except under names of results.
            let is_ours = is_named_as_a_result(&file);
            let record = match read(file) {
                Ok(Some(record)) => record,
                Err(error) if is_ours => return Err(error),
                Ok(None) | Err(_) => continue,
            };
            let (file, place) = (&record.file, folder.join(record.made.place()));
            let name = file.display();
            ensure!(*file == place, "{name}: expected a result of this place, found that of {}", place.display());
            records.push(record);
        }
    }
    Ok(records)
}

/// Whether a file is named `SCENE-SEED.json`, as by [`Made::place`].
fn is_named_as_a_result(file: &Path) -> bool {
    let seed = |stem: &str| stem.rsplit_once('-').is_some_and(|(_, seed)| seed.parse::<u64>().is_ok());
    file.file_stem().and_then(|stem| stem.to_str()).is_some_and(seed)
}

/// Result in a file, if it is one of a training.
pub(super) fn read(file: PathBuf) -> Result<Option<Record>> {
    let name = || file.display().to_string();
    let advised = || format!("{}: not the result of a training; delete it to repeat the job", name());
    let result: Value = serde_json::from_slice(&std::fs::read(&file).with_context(name)?).with_context(advised)?;
    if result.get("outcome").is_none() {
        return Ok(None);
    }
    let made = result.get("job").ok_or_else(|| anyhow!("{}: expected `job` with flags, found none", name()))?;
    let made = Made::deserialize(made).with_context(name)?;
    // Older results have whole paths, and flags of scenes that others had replaced.
    let flags = as_kept(&made.flags);
    let made = Made { scene_flags: left_of(&as_kept(&made.scene_flags), &flags), flags, ..made };
    Ok(Some(Record { file, made, result }))
}

/// Entries of a folder, sorted by name; empty if it does not exist.
fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let listed = match std::fs::read_dir(folder) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(vec![]),
        listed => listed.and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect::<Result<Vec<_>, _>>()),
    };
    let mut paths = listed.with_context(|| folder.display().to_string())?;
    paths.sort();
    Ok(paths)
}

/// Rejects results of another protocol.
pub(super) fn check_protocol(records: &[Record], expected: Option<Protocol>) -> Result<()> {
    let name = |p: Option<Protocol>| p.map_or("none".to_owned(), |p| p.to_string());
    records.iter().find(|record| record.made.protocol != expected).map_or(Ok(()), |Record { file, made, .. }| {
        let (file, expected, found) = (file.display(), name(expected), name(made.protocol));
        bail!("{file}: expected a result of --protocol {expected}, found {found}")
    })
}

/// Rejects results that are not comparable with those of the jobs: of another protocol, of the same variant with other
/// flags, or of the same scene with another capture or other flags in `scenes.json`.
pub(super) fn check(records: &[Record], jobs: &[Job]) -> Result<()> {
    let jobs: Vec<(Made, &Job)> = jobs.iter().map(|job| (job.made(0), job)).collect();
    jobs.first().map_or(Ok(()), |(job, _)| check_protocol(records, job.protocol))?;
    let mut captures = BTreeMap::new();
    for record in records {
        let (file, made) = (record.file.display(), &record.made);
        if let Some((job, _)) = jobs.iter().find(|(job, _)| job.variant == made.variant && job.flags != made.flags) {
            let (expected, found) = (job.flags.join(" "), made.flags.join(" "));
            bail!(
                "{file}: expected a result of the flags `{expected}`, found `{found}`: give the variant another name"
            );
        }
        if let Some((_, job)) = jobs.iter().find(|(job, _)| job.scene == made.scene) {
            // Another variant may use smaller photographs.
            let images = jobs::images_of(made);
            let found =
                captures.entry((&made.scene, images.clone())).or_insert_with(|| job.fingerprint(images.as_deref()));
            let capture = job.capture.display();
            ensure!(
                found.zip(made.capture).is_none_or(|(expected, found)| expected == found),
                "{file}: expected a result of {capture}, found that of other cameras, photographs, masks or points: give -o another folder"
            );
        }
        // A variant's own size replaces that of its scenes.
        let is_other =
            |job: &Made| job.variant == made.variant && job.scene == made.scene && job.scene_flags != made.scene_flags;
        if let Some((job, _)) = jobs.iter().find(|(job, _)| is_other(job)) {
            let (scene, expected, found) = (&made.scene, job.scene_flags.join(" "), made.scene_flags.join(" "));
            bail!(
                "{file}: expected a result of the flags of {scene} in scenes.json, `{expected}`, found `{found}`: give -o another folder"
            );
        }
    }
    Ok(())
}
