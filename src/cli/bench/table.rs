//! What came of it, beside what others have published.

use std::fmt;

use serde::Serialize;
use serde_json::Value;

use super::jobs::{Job, MIPNERF360, Protocol};

/// Means over the nine scenes of Mip-NeRF 360: PSNR, SSIM, LPIPS of VGG. Under protocol B as the papers of Mip-Splatting and
/// HERA print them (LPIPS of colours 0…1), under A by `NerfBaselines` (colours −1…1). METHODS 10.2.
const PUBLISHED_B: [(&str, [f64; 3]); 6] = [
    ("Mip-NeRF 360", [27.57, 0.793, 0.234]),
    ("Zip-NeRF", [28.54, 0.828, 0.189]),
    ("3DGS, retrained", [27.70, 0.826, 0.202]),
    ("Mip-Splatting", [27.79, 0.827, 0.205]),
    ("HERA", [27.61, 0.828, 0.199]),
    ("HERA, filtered", [27.75, 0.829, 0.194]),
];
const PUBLISHED_A: [(&str, [f64; 3]); 7] = [
    ("Zip-NeRF", [28.553, 0.829, 0.218]),
    ("3DGS-MCMC", [27.983, 0.835, 0.224]),
    ("Scaffold-GS", [27.714, 0.813, 0.262]),
    ("Mip-NeRF 360", [27.681, 0.792, 0.272]),
    ("Mip-Splatting", [27.492, 0.815, 0.258]),
    ("3DGS", [27.434, 0.814, 0.257]),
    ("2DGS", [26.815, 0.796, 0.297]),
];

/// One scene, or the mean of a variant's scenes.
#[derive(Clone, Debug, Default, Serialize)]
struct Row {
    scene: String,
    /// Runs that it is the mean of.
    runs: usize,
    psnr: Option<f64>,
    ssim_inria: Option<f64>,
    /// Network and distances, colours −1…1 and 0…1.
    lpips: Option<(String, f64, f64)>,
    splats: Option<f64>,
    total_floats: Option<f64>,
    file_bytes: Option<f64>,
    seconds_per_iteration: Option<f64>,
    fps: Option<f64>,
}

#[derive(Clone, Debug, Serialize)]
struct Section {
    variant: String,
    rows: Vec<Row>,
    mean: Row,
}

/// What others print of the same scenes.
#[derive(Clone, Debug, Serialize)]
struct Published {
    method: &'static str,
    psnr: f64,
    ssim: f64,
    lpips: f64,
}

/// Results by variant and scene.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Table {
    protocol: Protocol,
    scores: String,
    variants: Vec<Section>,
    published: Vec<Published>,
}

impl Table {
    /// Of jobs with what `centaur train --json` said of them.
    pub(super) fn new(done: &[(&Job, Value)], protocol: Protocol) -> Self {
        let mut names: Vec<&str> = done.iter().map(|(job, _)| job.variant.as_str()).collect();
        let mut seen = std::collections::HashSet::new();
        names.retain(|name| seen.insert(*name));
        let sections: Vec<Section> = names.into_iter().map(|name| Section::new(name, done)).collect();
        let is_complete = |section: &Section| {
            section.rows.len() == MIPNERF360.len()
                && MIPNERF360.iter().all(|(name, _)| section.rows.iter().any(|row| row.scene == *name))
        };
        let rows: &[(&str, [f64; 3])] = if protocol == Protocol::A { &PUBLISHED_A } else { &PUBLISHED_B };
        let published = if sections.iter().any(is_complete) { rows } else { &[] };
        Self {
            protocol,
            scores: done.iter().find_map(|(_, v)| v["evaluation"]["protocol"].as_str()).unwrap_or_default().to_owned(),
            published: published
                .iter()
                .map(|&(method, [psnr, ssim, lpips])| Published { method, psnr, ssim, lpips })
                .collect(),
            variants: sections,
        }
    }
}

impl Section {
    fn new(variant: &str, done: &[(&Job, Value)]) -> Self {
        let own: Vec<&(&Job, Value)> = done.iter().filter(|(job, _)| job.variant == variant).collect();
        let mut scenes: Vec<&str> = own.iter().map(|(job, _)| job.scene.as_str()).collect();
        scenes.sort_unstable();
        scenes.dedup();
        let row = |scene: &str| {
            let runs = own.iter().filter(|(job, _)| job.scene == scene).map(|(_, value)| Row::of(scene, value));
            Row::mean(scene, &runs.collect::<Vec<_>>())
        };
        let rows: Vec<Row> = scenes.into_iter().map(row).collect();
        Self { variant: variant.to_owned(), mean: Row::mean("mean", &rows), rows }
    }
}

impl Row {
    fn of(scene: &str, result: &Value) -> Self {
        let e = &result["evaluation"];
        let number = |name: &str| e[name].as_f64();
        let lpips = &e["lpips"];
        let net = lpips["net"].as_str().map(str::to_owned);
        let distances = lpips["normalized"].as_f64().zip(lpips["unnormalized"].as_f64());
        Self {
            scene: scene.to_owned(),
            runs: 1,
            psnr: number("psnr"),
            ssim_inria: number("ssim_inria"),
            lpips: net.zip(distances).map(|(net, (a, b))| (net, a, b)),
            splats: number("splats"),
            total_floats: number("total_floats"),
            file_bytes: number("file_bytes"),
            seconds_per_iteration: number("seconds_per_iteration"),
            fps: number("fps"),
        }
    }

    /// Of numbers that all rows have.
    fn mean(scene: &str, rows: &[Self]) -> Self {
        let mean = |value: &dyn Fn(&Self) -> Option<f64>| {
            rows.iter().map(value).sum::<Option<f64>>().filter(|_| !rows.is_empty()).map(|sum| sum / rows.len() as f64)
        };
        let net = rows.first().and_then(|row| row.lpips.as_ref().map(|l| l.0.clone()));
        let distances = mean(&|r| r.lpips.as_ref().map(|l| l.1)).zip(mean(&|r| r.lpips.as_ref().map(|l| l.2)));
        Self {
            scene: scene.to_owned(),
            runs: rows.iter().map(|row| row.runs).sum(),
            psnr: mean(&|r| r.psnr),
            ssim_inria: mean(&|r| r.ssim_inria),
            lpips: net.zip(distances).map(|(net, (a, b))| (net, a, b)),
            splats: mean(&|r| r.splats),
            total_floats: mean(&|r| r.total_floats),
            file_bytes: mean(&|r| r.file_bytes),
            seconds_per_iteration: mean(&|r| r.seconds_per_iteration),
            fps: mean(&|r| r.fps),
        }
    }

    fn cells(&self) -> String {
        let number =
            |value: Option<f64>, decimals: usize| value.map_or("–".to_owned(), |v| format!("{v:.decimals$}"));
        let lpips = |which: fn(&(String, f64, f64)) -> f64| number(self.lpips.as_ref().map(which), 3);
        [
            self.runs.to_string(),
            number(self.psnr, 2),
            number(self.ssim_inria, 3),
            lpips(|l| l.1),
            lpips(|l| l.2),
            number(self.splats, 0),
            number(self.total_floats.map(|v| v / 1e6), 2),
            number(self.file_bytes.map(|v| v / 1e6), 1),
            number(self.seconds_per_iteration, 3),
            number(self.fps, 1),
        ]
        .join(" | ")
    }
}

/// Markdown.
impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let protocol =
            if self.protocol == Protocol::A { "A (pictures of the data set)" } else { "B (pictures scaled down here)" };
        writeln!(f, "Mip-NeRF 360's sizes by protocol {protocol}; {}.\n", self.scores)?;
        writeln!(
            f,
            "| variant | scene | runs | PSNR | SSIM | LPIPS −1…1 | LPIPS 0…1 | splats | M floats | MB | s/iteration | fps |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|---|")?;
        for section in &self.variants {
            for row in &section.rows {
                writeln!(f, "| {} | {} | {} |", section.variant, row.scene, row.cells())?;
            }
            writeln!(f, "| **{}** | **mean** | {} |", section.variant, section.mean.cells())?;
        }
        for p in &self.published {
            // Each source has LPIPS by one convention.
            let (a, b) = if self.protocol == Protocol::A {
                (p.lpips.to_string(), "–".into())
            } else {
                ("–".to_owned(), p.lpips.to_string())
            };
            writeln!(f, "| *{}* | published | | {} | {} | {a} | {b} | | | | | |", p.method, p.psnr, p.ssim)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;
    use serde_json::json;

    use super::super::jobs;
    use super::*;
    use crate::cli::{Cli, Command};

    #[test]
    fn seeds_then_scenes_are_averaged_and_sets_that_are_whole_meet_published_rows() {
        let folder = tempfile::tempdir().unwrap();
        let result = |psnr: f64| {
            let lpips = json!({ "net": "vgg", "normalized": 0.3, "unnormalized": 0.2 });
            json!({ "evaluation": { "psnr": psnr, "ssim_inria": 0.8, "lpips": lpips, "splats": 1000, "protocol": "scored so" } })
        };
        let table = |scenes: &[&str]| {
            let name = folder.path().join(scenes.len().to_string());
            scenes.iter().for_each(|scene| std::fs::create_dir_all(name.join(scene).join("sparse")).unwrap());
            let words = [
                "centaur",
                "bench",
                name.to_str().unwrap(),
                "-o",
                "out",
                "--seeds",
                "0,1",
                "--variant",
                "a",
                "--variant",
                "b",
            ];
            let Command::Bench(args) = Cli::try_parse_from(words).unwrap().command else { unreachable!() };
            let all = jobs::all(&args).unwrap();
            let done: Vec<(&Job, Value)> = all
                .iter()
                .map(|job| {
                    let psnr = if job.scene == "room" { 30.0 } else { 26.0 }
                        + job.seed as f64
                        + if job.variant == "b" { 0.5 } else { 0.0 };
                    (job, result(psnr))
                })
                .collect();
            Table::new(&done, Protocol::B)
        };
        let two = table(&["room", "garden"]);
        let text = two.to_string();
        assert!(text.contains("| a | garden | 2 | 26.50 | 0.800 | 0.300 | 0.200 | 1000 |"), "{text}");
        assert!(
            text.contains("| **a** | **mean** | 4 | 28.50 |") && text.contains("| **b** | **mean** | 4 | 29.00 |"),
            "{text}"
        );
        assert!(text.contains("protocol B") && text.contains("scored so") && !text.contains("HERA"), "{text}");
        let nine = table(&MIPNERF360.map(|(name, _)| name));
        assert!(nine.to_string().contains("| *HERA, filtered* | published | | 27.75 | 0.829 | – | 0.194 |"), "{nine}");
        assert_eq!(serde_json::to_value(&two).unwrap()["variants"][1]["mean"]["psnr"], 29.0);
    }
}
