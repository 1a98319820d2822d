//! Table of the results, beside published ones.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

use anyhow::{Result, bail};
use centaur::format::one_line;
use serde::Serialize;
use serde_json::Value;

use super::jobs::{self, Made, Protocol};
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
        let resizes = |made: &Made| made.scene_flags.iter().chain(&made.flags).any(|flag| jobs::chooses_pictures(flag));
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

/// Upper bound on notes below the table. Notes with numbers may differ for every job.
const MOST_NOTES: usize = 20;

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

    /// Mark after a scene's name.
    fn mark(self) -> &'static str {
        match self {
            Self::None => "",
            Self::Some => ", partly masked",
            Self::All => ", masked",
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

    fn cells(&self) -> String {
        let number =
            |value: Option<f64>, decimals: usize| value.map_or("–".to_owned(), |v| format!("{v:.decimals$}"));
        let lpips = self.lpips.as_ref();
        [
            self.runs.to_string(),
            number(self.psnr, 2),
            number(self.ssim, 3),
            number(self.flip, 3),
            lpips.map_or("–", |l| &l.net).to_owned(),
            number(lpips.map(|l| l.normalized), 3),
            number(lpips.map(|l| l.unnormalized), 3),
            number(self.splats, 0),
            number(self.triangles, 0),
            number(self.total_floats.map(|v| v / 1e6), 2),
            number(self.file_bytes.map(|v| v / 1e6), 1),
            number(self.training_seconds, 1),
            number(self.seconds_per_iteration, 3),
            number(self.fps, 1),
        ]
        .join(" | ")
    }
}

impl Table {
    fn write_notes(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let all = || self.variants.iter().flat_map(|of| of.notes.iter().map(move |note| (&of.variant, note)));
        if all().next().is_some() {
            writeln!(f, "\nNotes of the trainings:\n")?;
        }
        for (variant, Note { text, scenes }) in all().take(MOST_NOTES) {
            let scenes = scenes.iter().map(String::as_str).collect::<Vec<_>>().join(", ");
            writeln!(f, "- {variant}, {}: {}", one_line(&scenes), one_line(text))?;
        }
        match all().count().saturating_sub(MOST_NOTES) {
            0 => Ok(()),
            more => writeln!(f, "- and {more} more, which table.json has"),
        }
    }
}

/// Formats the table as Markdown.
impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sizes = match self.protocol {
            Some(Protocol::A) => {
                "Scenes of Mip-NeRF 360 at the image sizes of protocol A (images of the data set), others as they are; SSIM in the table uses only windows inside the image, whatever is stated next"
            }
            Some(Protocol::B) => {
                "Scenes of Mip-NeRF 360 at the image sizes of protocol B (full-size images scaled down here), others as they are"
            }
            None => "Images of the size given by the flags",
        };
        writeln!(f, "{sizes}; {}.", self.scores)?;
        writeln!(f, "Adapter: {}.", self.adapters.iter().map(String::as_str).collect::<Vec<_>>().join("; "))?;
        for Section { variant, flags, .. } in self.variants.iter().filter(|section| !section.flags.is_empty()) {
            writeln!(f, "Flags of {variant}: `{}`.", flags.join(" "))?;
        }
        for Section { variant, scene_flags, .. } in &self.variants {
            for flags in scene_flags.values().collect::<BTreeSet<_>>() {
                let alike = scene_flags.iter().filter(|(_, own)| *own == flags);
                let scenes: Vec<&str> = alike.map(|(scene, _)| scene.as_str()).collect();
                writeln!(f, "Flags of {variant} for {}: `{}`.", scenes.join(", "), flags.join(" "))?;
            }
        }
        writeln!(
            f,
            "\n| variant | scene | runs | PSNR | SSIM | FLIP | LPIPS by | LPIPS −1…1 | LPIPS 0…1 | splats | triangles | M floats | MB | training, s | s/joint iteration | fps |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|")?;
        for section in &self.variants {
            for row in &section.rows {
                // A scene may have any name that a folder can have.
                let scene = one_line(&row.scene).replace('|', "\\|");
                writeln!(f, "| {} | {scene}{} | {} |", section.variant, row.masked.mark(), row.cells())?;
            }
            if let Some(mean) = &section.mean {
                let name = [&mean.scene, mean.masked.mark()].concat();
                writeln!(f, "| **{}** | **{name}** | {} |", section.variant, mean.cells())?;
            }
        }
        let number = |value: Option<f64>| value.map_or("–".to_owned(), |v| v.to_string());
        for p in &self.published {
            let (lpips, net) = (number(p.lpips), if p.lpips.is_some() { "vgg" } else { "–" });
            // Each source has LPIPS by one convention.
            let (a, b) = if p.lpips_normalized { (&*lpips, "–") } else { ("–", &*lpips) };
            let over = p.over.map_or("published".to_owned(), |over| format!("published: {over}"));
            writeln!(
                f,
                "| *{}* | {over} | | {} | {} | | {net} | {a} | {b} | | | | | | | |",
                p.method,
                p.psnr,
                number(p.ssim)
            )?;
        }
        if self.variants.iter().flat_map(|section| &section.rows).any(|row| row.masked != Masked::None) {
            writeln!(
                f,
                "\nMasked rows: photographs and renders are multiplied by masks; in partly masked rows, those of views that have a mask. Such scores do not compare \
                 with others: there is no mean over both, and no published row beside them."
            )?;
        }
        if self.variants.iter().flat_map(|section| &section.rows).any(|row| row.psnr == Some(f64::INFINITY)) {
            writeln!(
                f,
                "\nPSNR of inf: in 8 bits, a view is equal to its photograph, so that there is no finite mean."
            )?;
        }
        if let Some(note) = self.published_note {
            writeln!(f, "\nPublished rows: {note}.")?;
        }
        self.write_notes(f)
    }
}

/// Longer sides of the images on which a result was scored, as far as it states them.
fn longer_sides(record: &Record) -> Vec<u64> {
    let side = |view: &Value| view["size"].as_array()?.iter().filter_map(Value::as_u64).max();
    record.result["evaluation"]["views"].as_array().map_or(vec![], |views| views.iter().filter_map(side).collect())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn record(variant: &str, scene: &str, seed: u64, psnr: f64) -> Record {
        let lpips = json!({ "net": "vgg", "normalized": 0.3, "unnormalized": 0.2 });
        let evaluation = json!({
            "psnr": psnr, "ssim_inria": 0.8, "ssim_valid": 0.7, "lpips": lpips, "splats": 1000, "fps": 9.5, "protocol": "scored so",
            "adapter": "this one",
        });
        let made = Made {
            variant: variant.to_owned(),
            scene: scene.to_owned(),
            seed,
            capture: None,
            scene_flags: vec![],
            flags: vec!["--flag".to_owned()],
            protocol: Some(Protocol::B),
            at_a_time: 1,
        };
        Record {
            file: format!("out/{variant}/{scene}-{seed}.json").into(),
            made,
            result: json!({ "evaluation": evaluation }),
        }
    }

    fn table(records: &[Record]) -> Table {
        Table::new(records, Path::new("out")).unwrap()
    }

    #[test]
    fn seeds_then_common_scenes_are_averaged() {
        let mut records = vec![];
        for (variant, more) in [("a", 0.0), ("b", 0.5)] {
            for (scene, psnr) in [("room", 30.0), ("garden", 26.0)] {
                records.extend((0..2).map(|seed| record(variant, scene, seed, psnr + seed as f64 + more)));
            }
        }
        let text = table(&records).to_string();
        for part in [
            "| a | garden | 2 | 26.50 | 0.800 | – | vgg | 0.300 | 0.200 | 1000 |",
            "| **a** | **mean** | 4 | 28.50 |",
            "| **b** | **mean** | 4 | 29.00 |",
            "protocol B",
            "scored so",
            "Adapter: this one.",
            "Flags of b: `--flag`.",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(!text.contains("HERA"), "{text}");
        assert_eq!(serde_json::to_value(table(&records)).unwrap()["variants"][1]["mean"]["psnr"], 29.0);
        assert!(!text.contains("inf:"), "{text}");
        // A view equal to its photograph has an infinite PSNR, which is null in JSON; this differs from a missing
        // value.
        let mut perfect = records.clone();
        perfect[0].result["evaluation"]["psnr"] = Value::Null;
        let perfect = table(&perfect).to_string();
        for part in [
            "| a | room | 2 | inf |",
            "| **a** | **mean** | 4 | inf |",
            "| **b** | **mean** | 4 | 29.00 |",
            "PSNR of inf:",
        ] {
            assert!(perfect.contains(part), "{part}: {perfect}");
        }
        // A mean over two scenes is not compared with a mean over three.
        records.push(record("b", "bonsai", 0, 99.0));
        let text = table(&records).to_string();
        assert!(
            text.contains("| b | bonsai | 1 | 99.00 |")
                && text.contains("| **b** | **mean of 2 common** | 4 | 29.00 |"),
            "{text}"
        );
        records.push(record("c", "other", 0, 1.0));
        assert!(!table(&records).to_string().contains("mean"), "nothing is common");
    }

    /// A job that asked for a mesh and has none says so only in its notes.
    #[test]
    fn hybrids_have_triangles_and_trainings_their_say() {
        let mut records: Vec<Record> = ["garden", "room"].map(|scene| record("a", scene, 0, 26.0)).into();
        for (record, [triangles, seconds]) in records.iter_mut().zip([[0.0, 100.0], [900.0, 60.0]]) {
            record.result["evaluation"]["triangles"] = json!(triangles);
            record.result["evaluation"]["training_seconds"] = json!(seconds);
            let masks = format!("captures/{}: has no masks: nothing is masked", record.made.scene);
            record.result["notes"] = json!([masks, "--no-mesh: --warmup has no effect"]);
        }
        let more = [Value::Null, json!("captures/garden: the scene has no mesh:\nwhy")];
        records[0].result["notes"].as_array_mut().unwrap().extend(more);
        let text = table(&records).to_string();
        for part in [
            "| splats | triangles | M floats | MB | training, s | s/joint iteration | fps |\n",
            "| a | garden | 1 | 26.00 | 0.800 | – | vgg | 0.300 | 0.200 | 1000 | 0 | – | – | 100.0 | – | 9.5 |\n",
            "| 1000 | 450 | – | – | 80.0 | – | 9.5 |\n",
            "\nNotes of the trainings:\n\n- a, garden, room: has no masks: nothing is masked\n- a, garden, room: --no-mesh: --warmup",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        let last = text.lines().last().unwrap();
        assert!(last.starts_with("- a, garden: the scene has no mesh:") && last.ends_with("why"), "{text}");
        let json = serde_json::to_value(table(&records)).unwrap();
        assert_eq!(json["variants"][0]["rows"][1]["triangles"], 900.0);
        assert_eq!(json["variants"][0]["notes"][0]["scenes"], json!(["garden", "room"]));
        // The number of notes is limited to a readable one; results of older versions have none.
        records[1].result["notes"] = (0..30).map(|i| format!("note {i}")).collect();
        records[0].result["notes"] = Value::Null;
        let text = table(&records).to_string();
        assert!(text.contains("- a, room: note 19\n- and 10 more, which table.json has\n"), "{text}");
        records.truncate(1);
        records[0].result["evaluation"]["triangles"] = Value::Null;
        let text = table(&records).to_string();
        assert!(text.contains("| 1000 | – | – | – | 100.0 |") && !text.contains("Notes of"), "{text}");
        // Times of jobs that shared the machine are none.
        records[0].made.at_a_time = 2;
        assert!(table(&records).to_string().contains("| 1000 | – | – | – | – | – | – |"));
    }

    #[test]
    fn a_set_that_is_whole_meets_published_rows() {
        let with = |change: &dyn Fn(usize, &mut Record)| {
            let mut records: Vec<Record> =
                jobs::MIPNERF360.iter().map(|(scene, _)| record("a", scene, 0, 27.0)).collect();
            records.iter_mut().enumerate().for_each(|(i, record)| change(i, record));
            table(&records).to_string()
        };
        let b = with(&|_, _| {});
        assert!(b.contains("| *HERA, filtered* | published | | 27.75 | 0.829 | | vgg | – | 0.194 |"), "{b}");
        assert!(b.contains("\nPublished rows: the nine scenes of Mip-NeRF 360") && b.contains("colours 0…1."), "{b}");
        let a = with(&|_, r| r.made.protocol = Some(Protocol::A));
        assert!(a.contains("| *2DGS* | published | | 26.815 | 0.796 | | vgg | 0.297 | – |"), "{a}");
        assert!(a.contains("| a | room | 1 | 27.00 | 0.700 |") && a.contains("inside the image"), "{a}");
        let free = with(&|_, r| r.made.protocol = None);
        assert!(!free.to_lowercase().contains("published"), "of any size: {free}");
        let alex = with(&|_, r| r.result["evaluation"]["lpips"]["net"] = json!("alex"));
        assert!(alex.contains("| *HERA* | published | | 27.61 | 0.828 | | – | – | – |"), "{alex}");
        let mixed = with(&|i, r| r.result["evaluation"]["lpips"]["net"] = json!(if i == 4 { "alex" } else { "vgg" }));
        assert!(mixed.contains("| **a** | **mean** | 9 | 27.00 | 0.800 | – | – | – |"), "{mixed}");
        // Jobs that run at the same time slow each other down.
        for at_a_time in [0, 2] {
            let crowded = with(&|_, r| r.made.at_a_time = at_a_time);
            assert!(b.contains("| 9.5 |") && !crowded.contains("| 9.5 |"), "{crowded}");
        }
    }

    #[test]
    fn sets_that_come_in_one_size_meet_published_rows() {
        let with = |scenes: &[&str], change: &dyn Fn(&mut Record)| {
            let mut records: Vec<Record> = scenes.iter().map(|scene| record("a", scene, 0, 24.0)).collect();
            for record in &mut records {
                record.made.protocol = None;
                change(record);
            }
            table(&records)
        };
        let sized = |size: [u32; 2]| {
            with(&["train", "truck"], &|r| r.result["evaluation"]["views"] = json!([{ "size": size }]))
        };
        assert_eq!((sized([980, 545]).published.len(), sized([1957, 1091]).published.len()), (16, 0));
        let tanks = with(&["train", "truck"], &|_| {}).to_string();
        for part in [
            "| *HERA, filtered* | published: five scenes, unnamed | | 24.39 | 0.824 | | vgg | – | 0.206 |",
            "| *3DGS* | published | | 23.14 | 0.841 | | vgg | – | 0.183 |",
            "| *MeshSplatting* | published | | 20.52 | – | | – | – | – |",
            "\nPublished rows: train and truck of Tanks and Temples",
            "which does not name them",
        ] {
            assert!(tanks.contains(part), "{part}: {tanks}");
        }
        assert_eq!(with(&["train", "truck"], &|r| r.made.protocol = Some(Protocol::B)).published.len(), 16);
        let rooms = with(&["drjohnson", "playroom"], &|_| {}).to_string();
        assert!(
            rooms.contains("| *Brush* | published: nvs-bench, scenes not checked | | 29.85 | 0.911 | | – | – | – |"),
            "{rooms}"
        );
        // No published rows for a subset or a superset of the scenes, for pictures of another size, or with another
        // SSIM.
        let size = |flag: &'static str| move |r: &mut Record| r.made.flags.extend([flag.to_owned(), "2".to_owned()]);
        for other in [
            with(&["truck"], &|_| {}),
            with(&["train", "truck", "Barn"], &|_| {}),
            with(&["train", "playroom"], &|_| {}),
            with(&["train", "truck"], &size("--downscale")),
            with(&["train", "truck"], &size("--max-side=300")),
            with(&["train", "truck"], &|r| r.made.protocol = Some(Protocol::A)),
        ] {
            assert!(other.published.is_empty() && other.published_note.is_none(), "{other}");
        }
        // One variant with the right size is enough: published rows apply to all variants.
        let mut records = vec![];
        for (variant, flag) in [("a", "--antialias"), ("b", "--images")] {
            records.extend(["train", "truck"].map(|scene| record(variant, scene, 0, 24.0)));
            records.iter_mut().filter(|r| r.made.variant == variant).for_each(|r| r.made.flags = vec![flag.to_owned()]);
        }
        assert!(table(&records).published.is_empty());
        records.truncate(2);
        assert_eq!(table(&records).published.len(), 16);
    }

    #[test]
    fn scores_with_masks_stand_alone() {
        let masked = |views: &[bool]| -> Value { views.iter().map(|masked| json!({ "masked": masked })).collect() };
        let mut records = vec![];
        for (scene, psnr, views) in [("demo", 25.0, [false; 2]), ("cup", 30.0, [true; 2]), ("jar", 28.0, [true, false])]
        {
            let mut record = record("a", scene, 0, psnr);
            record.result["evaluation"]["views"] = masked(&views);
            records.push(record);
        }
        let text = table(&records).to_string();
        for part in [
            "| a | demo | 1 | 25.00 |",
            "| a | cup, masked | 1 | 30.00 |",
            "| a | jar, partly masked | 1 | 28.00 |",
            // A figure that masks do not affect, here the number of splats, has a mean.
            "| **a** | **mean, partly masked** | 3 | – | – | – | – | – | – | 1000 |",
            "\nMasked rows: photographs and renders are multiplied by masks",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        let json = serde_json::to_value(table(&records)).unwrap();
        let of = |i: usize| json["variants"][0]["rows"][i]["masked"].clone();
        assert_eq!((of(0), of(1), of(2)), (json!("all"), json!("none"), json!("some")));
        let cup = table(&records[1..2]).to_string();
        assert!(cup.contains("| **a** | **mean, masked** | 1 | 30.00 |"), "{cup}");
        let demo = table(&records[..1]).to_string();
        assert!(demo.contains("| **a** | **mean** | 1 | 25.00 |") && !demo.contains("asked"), "{demo}");
    }

    /// Published rows are of unmasked photographs of the same size.
    #[test]
    fn scores_with_masks_meet_no_published_rows() {
        let with = |masked: bool| {
            let mut records: Vec<Record> = ["Barn", "Caterpillar", "Ignatius", "train", "truck"]
                .iter()
                .map(|scene| record("a", scene, 0, 24.0))
                .collect();
            for r in &mut records {
                r.made.protocol = None;
                r.result["evaluation"]["views"] = json!([{ "size": [980, 545], "masked": masked }]);
            }
            table(&records).published.len()
        };
        assert_eq!((with(false), with(true)), (5, 0));
    }

    /// With the flags that `fetch_captures.py tandt` lists.
    #[test]
    fn scenes_have_flags_of_their_own() {
        let scenes = ["Barn", "Caterpillar", "Ignatius", "train", "truck"];
        let mut records: Vec<Record> = scenes.iter().map(|scene| record("a", scene, 0, 24.0)).collect();
        for r in &mut records {
            r.made.protocol = None;
            if r.made.scene.starts_with(char::is_uppercase) {
                r.made.scene_flags = ["--downscale", "2"].map(str::to_owned).to_vec();
            }
        }
        let five = table(&records);
        assert!(five.published.iter().any(|row| row.method == "HERA, filtered" && row.psnr == 24.39), "{five}");
        assert_eq!(five.variants[0].flags, ["--flag"]);
        assert!(
            five.to_string().contains("\nFlags of a for Barn, Caterpillar, Ignatius: `--downscale 2`.\n"),
            "{five}"
        );
        // A variant with a size of its own has no per-scene flags.
        let mut both = records.clone();
        both.extend(scenes.map(|scene| record("b", scene, 0, 24.0)));
        both.iter_mut().for_each(|r| r.made.protocol = None);
        assert_eq!(table(&both).variants.len(), 2);
        // Downscaled by per-scene flags, the pictures are smaller than those distributed, so no published row applies.
        records.retain(|r| r.made.scene.starts_with('t'));
        assert_eq!(table(&records).published.len(), 16);
        records[0].made.scene_flags = vec!["--downscale=2".to_owned()];
        assert!(table(&records).published.is_empty());
    }

    #[test]
    fn what_does_not_compare_is_refused() {
        let error = |change: fn(&mut Record)| {
            let mut records = [record("a", "room", 0, 1.0), record("a", "room", 1, 1.0)];
            change(&mut records[1]);
            Table::new(&records, Path::new("out")).unwrap_err().to_string()
        };
        let protocol = error(|r| r.made.protocol = None);
        assert_eq!(protocol, "out: expected results of one protocol, found another in out/a/room-1.json");
        let flags = error(|r| r.made.flags.clear());
        assert_eq!(flags, "out: expected results of `a` of the same flags, found others in out/a/room-1.json");
        let scene = error(|r| r.made.scene_flags = vec!["--masks".to_owned()]);
        let expected =
            "out: expected results of room with the same flags in scenes.json, found others in out/a/room-1.json";
        assert_eq!(scene, expected);
    }
}
