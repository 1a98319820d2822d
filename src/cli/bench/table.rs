//! Table of the results, beside published ones.

mod markdown;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::{Result, bail};
use serde::Serialize;
use serde_json::Value;

use super::flags;
use super::jobs::Made;
use super::protocol::Protocol;
use super::published::{self, Known};
use super::record::{self, Record};

/// Row of a scene, or of the mean over a variant's scenes.
#[derive(Clone, Debug, Default, Serialize)]
struct Row {
    scene: String,
    /// Number of runs of which the row is the mean.
    runs: usize,
    masked: Masked,
    psnr: Option<f64>,
    /// SSIM over windows inside the image under protocol A, as by `NerfBaselines`; otherwise INRIA's.
    ssim: Option<f64>,
    flip: Option<f64>,
    lpips: Option<Lpips>,
    splats: Option<f64>,
    /// Number of mesh triangles; 0 for splats only.
    triangles: Option<f64>,
    total_floats: Option<f64>,
    file_bytes: Option<f64>,
    /// Time of all phases. None for jobs that shared, or may have shared, the machine in any of their runs.
    training_seconds: Option<f64>,
    /// Time per iteration of the joint phase. None for jobs that shared, or may have shared, the machine in any run.
    seconds_per_iteration: Option<f64>,
    /// Frames per second. None for jobs that shared, or may have shared, the machine.
    fps: Option<f64>,
}

/// Views scored with photograph and render multiplied by a mask. Scores of different kinds are not comparable.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Masked {
    #[default]
    None,
    Some,
    All,
}

#[derive(Clone, Debug, Serialize)]
struct Lpips {
    net: String,
    /// Distance with colours from −1 to 1.
    normalized: f64,
    /// Distance with colours from 0 to 1.
    unnormalized: f64,
}

#[derive(Clone, Debug, Serialize)]
struct Section {
    variant: String,
    flags: Vec<String>,
    /// Flags by scene, for scenes that have flags of their own in `scenes.json`.
    scene_flags: BTreeMap<String, Vec<String>>,
    notes: Vec<Note>,
    rows: Vec<Row>,
    /// Mean over the scenes common to all variants, if there are any.
    mean: Option<Row>,
}

/// Note given by trainings of a variant.
#[derive(Clone, Debug, Serialize)]
struct Note {
    /// Text of the note, without the capture's path if its folder is named like the scene.
    text: String,
    /// Scenes whose trainings gave the note.
    scenes: BTreeSet<String>,
}

/// Published result on the same scenes.
#[derive(Clone, Debug, Serialize)]
struct Published {
    method: &'static str,
    /// Description of the images or scenes, if other than these.
    over: Option<&'static str>,
    psnr: f64,
    ssim: Option<f64>,
    /// LPIPS; none if ours uses another network.
    lpips: Option<f64>,
    /// Whether `lpips` uses colours −1…1; otherwise 0…1.
    lpips_normalized: bool,
}

/// Results by variant and scene.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Table {
    protocol: Option<Protocol>,
    scores: String,
    /// Convention of the table's SSIM, whatever conventions `scores` also lists.
    ssim_convention: &'static str,
    adapters: BTreeSet<String>,
    /// Scenes common to all variants.
    common: BTreeSet<String>,
    variants: Vec<Section>,
    published: Vec<Published>,
    /// Description of the published results.
    published_note: Option<&'static str>,
}

impl Table {
    /// Builds the table of the results in `folder`.
    ///
    /// # Errors
    /// If the results are of several protocols, those of a variant have different flags, or those of a scene have
    /// different flags in `scenes.json`.
    pub(super) fn new(done: &[Record], folder: &Path) -> Result<Self> {
        let folder = folder.display();
        let protocol = done.first().and_then(|record| record.made.protocol);
        if let Some(other) = done.iter().find(|record| record.made.protocol != protocol) {
            bail!("{folder}: expected results of one protocol, found another in {}", other.file.display());
        }
        let mut of_scenes = BTreeMap::new();
        for record in done {
            let Made { variant, scene, scene_flags, .. } = &record.made;
            if of_scenes.entry((variant, scene)).or_insert(scene_flags) != &scene_flags {
                let file = record.file.display();
                bail!(
                    "{folder}: expected results of {scene} with the same flags in scenes.json, found others in {file}"
                );
            }
        }
        let names: BTreeSet<&str> = done.iter().map(|record| record.made.variant.as_str()).collect();
        let of = |name: &str| done.iter().filter(|r| r.made.variant == name).collect::<Vec<&Record>>();
        let scenes = |records: &[&Record]| records.iter().map(|r| r.made.scene.clone()).collect::<BTreeSet<String>>();
        let shared = |a: BTreeSet<String>, b: BTreeSet<String>| a.intersection(&b).cloned().collect();
        let common = names.iter().map(|name| scenes(&of(name))).reduce(shared).unwrap_or_default();
        let mut variants = vec![];
        for name in names {
            let own = of(name);
            if let Some(other) = own.iter().find(|record| record.made.flags != own[0].made.flags) {
                bail!(
                    "{folder}: expected results of `{name}` of the same flags, found others in {}",
                    other.file.display()
                );
            }
            variants.push(Section::new(name, &own, &common));
        }
        let resizes =
            |made: &Made| made.scene_flags.iter().chain(&made.flags).any(|flag| flags::chooses_pictures(flag));
        let resized = done.iter().any(|record| resizes(&record.made));
        let sides: BTreeSet<u64> = done.iter().flat_map(longer_sides).collect();
        let masked = done.iter().any(|record| Masked::of(record) != Masked::None);
        let known = published::of(&common, protocol, resized, masked, &sides);
        let has_vgg =
            variants.iter().any(|v| v.mean.as_ref().and_then(|m| m.lpips.as_ref()).is_some_and(|l| l.net == "vgg"));
        let word = |record: &Record, name: &str| record.result["evaluation"][name].as_str().map(str::to_owned);
        Ok(Self {
            protocol,
            scores: {
                let said: BTreeSet<String> = done.iter().filter_map(|record| word(record, "protocol")).collect();
                said.into_iter().collect::<Vec<_>>().join("; or: ")
            },
            ssim_convention: if protocol == Some(Protocol::A) { "windows inside the picture" } else { "INRIA" },
            adapters: done.iter().filter_map(|record| word(record, "adapter")).collect(),
            published: known.map_or(vec![], |known| Published::of(known, has_vgg)),
            published_note: known.map(|known| known.note),
            common,
            variants,
        })
    }
}

impl Note {
    /// Distinct notes, in order of occurrence.
    fn of(own: &[&Record]) -> Vec<Self> {
        let mut notes: Vec<Self> = vec![];
        for Record { made: Made { scene, .. }, result, .. } in own {
            for note in record::notes(result) {
                let is_there = |place: &str| Path::new(place).file_name().is_some_and(|name| name == scene.as_str());
                let text = note.split_once(": ").filter(|(place, _)| is_there(place)).map_or(note, |(_, what)| what);
                match notes.iter_mut().find(|known| known.text == text) {
                    Some(known) => {
                        known.scenes.insert(scene.clone());
                    }
                    None => notes.push(Self { text: text.to_owned(), scenes: BTreeSet::from([scene.clone()]) }),
                }
            }
        }
        notes
    }
}

impl Published {
    fn of(known: &Known, with_lpips: bool) -> Vec<Self> {
        let row = |mean: &published::Mean| Self {
            method: mean.method,
            over: mean.over,
            psnr: mean.psnr,
            ssim: mean.ssim,
            lpips: mean.lpips.filter(|_| with_lpips),
            lpips_normalized: known.normalized,
        };
        known.means.iter().map(row).collect()
    }
}

impl Section {
    fn new(variant: &str, own: &[&Record], common: &BTreeSet<String>) -> Self {
        let scenes: BTreeSet<&str> = own.iter().map(|record| record.made.scene.as_str()).collect();
        let row = |scene: &str| {
            let runs = own.iter().filter(|record| record.made.scene == scene).map(|record| Row::of(record));
            Row::mean(scene, &runs.collect::<Vec<_>>())
        };
        let rows: Vec<Row> = scenes.into_iter().map(row).collect();
        let shared: Vec<Row> = rows.iter().filter(|row| common.contains(&row.scene)).cloned().collect();
        let name =
            if shared.len() == rows.len() { "mean".to_owned() } else { format!("mean of {} common", shared.len()) };
        let mean = (!shared.is_empty()).then(|| Row::mean(&name, &shared));
        let flags = own.first().map_or(vec![], |r| r.made.flags.clone());
        let of_scenes = own.iter().map(|r| (r.made.scene.clone(), r.made.scene_flags.clone()));
        let scene_flags = of_scenes.filter(|(_, flags)| !flags.is_empty()).collect();
        Self { variant: variant.to_owned(), flags, scene_flags, notes: Note::of(own), rows, mean }
    }
}

impl Masked {
    /// Kind of masking, as far as the result states it.
    fn of(record: &Record) -> Self {
        let views = record.result["evaluation"]["views"].as_array().map_or(&[][..], Vec::as_slice);
        match views.iter().filter(|view| view["masked"] == true).count() {
            0 => Self::None,
            n if n == views.len() => Self::All,
            _ => Self::Some,
        }
    }
}

impl Row {
    fn of(record: &Record) -> Self {
        let e = &record.result["evaluation"];
        let number = |name: &str| e[name].as_f64();
        // JSON has no infinity: the PSNR of a view equal to its photograph is null, and so is then the mean.
        let psnr = number("psnr").or_else(|| e.get("psnr")?.is_null().then_some(f64::INFINITY));
        let time = |name: &str| number(name).filter(|_| record.made.at_a_time == 1);
        let lpips = &e["lpips"];
        let distances = lpips["normalized"].as_f64().zip(lpips["unnormalized"].as_f64());
        let lpips = distances.zip(lpips["net"].as_str()).map(|((normalized, unnormalized), net)| Lpips {
            net: net.to_owned(),
            normalized,
            unnormalized,
        });
        Self {
            scene: record.made.scene.clone(),
            runs: 1,
            masked: Masked::of(record),
            psnr,
            ssim: number(if record.made.protocol == Some(Protocol::A) { "ssim_valid" } else { "ssim_inria" }),
            flip: number("flip"),
            lpips,
            splats: number("splats"),
            triangles: number("triangles"),
            total_floats: number("total_floats"),
            file_bytes: number("file_bytes"),
            training_seconds: time("training_seconds"),
            seconds_per_iteration: time("seconds_per_iteration"),
            fps: time("fps"),
        }
    }

    /// Mean of the rows: of numbers that all rows have, of scores of the same kind of [`Masked`], and of distances by
    /// one network.
    fn mean(scene: &str, rows: &[Self]) -> Self {
        let mean = |value: &dyn Fn(&Self) -> Option<f64>| {
            rows.iter().map(value).sum::<Option<f64>>().filter(|_| !rows.is_empty()).map(|sum| sum / rows.len() as f64)
        };
        let masked = rows.first().map_or(Masked::None, |row| row.masked);
        let is_alike = rows.iter().all(|row| row.masked == masked);
        let score = |value: &dyn Fn(&Self) -> Option<f64>| mean(value).filter(|_| is_alike);
        let net = rows.first().and_then(|row| Some(row.lpips.as_ref()?.net.clone()));
        let is_same = |row: &Self| row.lpips.as_ref().map(|l| &l.net) == net.as_ref();
        let net = net.as_ref().filter(|_| rows.iter().all(is_same)).cloned();
        let distances =
            score(&|r| Some(r.lpips.as_ref()?.normalized)).zip(score(&|r| Some(r.lpips.as_ref()?.unnormalized)));
        Self {
            scene: scene.to_owned(),
            runs: rows.iter().map(|row| row.runs).sum(),
            masked: if is_alike { masked } else { Masked::Some },
            psnr: score(&|r| r.psnr),
            ssim: score(&|r| r.ssim),
            flip: score(&|r| r.flip),
            lpips: net.zip(distances).map(|(net, (normalized, unnormalized))| Lpips { net, normalized, unnormalized }),
            splats: mean(&|r| r.splats),
            triangles: mean(&|r| r.triangles),
            total_floats: mean(&|r| r.total_floats),
            file_bytes: mean(&|r| r.file_bytes),
            training_seconds: mean(&|r| r.training_seconds),
            seconds_per_iteration: mean(&|r| r.seconds_per_iteration),
            fps: mean(&|r| r.fps),
        }
    }
}

/// Longer sides of the images on which a result was scored, as far as it states them.
fn longer_sides(record: &Record) -> Vec<u64> {
    let side = |view: &Value| view["size"].as_array()?.iter().filter_map(Value::as_u64).max();
    record.result["evaluation"]["views"].as_array().map_or(vec![], |views| views.iter().filter_map(side).collect())
}
