//! Training record, kept in the scene's file for immediate and later reports.

use std::collections::HashSet;

use centaur::capture::Capture;
use centaur::metrics::plot::Plot;
use centaur::optimize::{Phase, Progress, TrainOptions, Trained};
use centaur::scene::OrderMode;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Approximate number of curve points kept: some kilobytes, and as many as a plot can show.
const MOST_POINTS: usize = 300;

/// Record in `asset.extras.centaur` of a scene trained here; in USD in the string `centaur` of `customLayerData`. Older
/// files end after the settings.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Record {
    /// Name of the capture.
    capture: String,
    /// Number of sparse points of the capture with which training began.
    #[serde(default)]
    points: Option<usize>,
    /// Whether the capture's photographs had masks.
    #[serde(default)]
    masks: Option<bool>,
    /// Names of the held-out views.
    #[serde(default)]
    held_out: Option<Vec<String>>,
    /// `TrainOptions`, by field name.
    settings: Map<String, Value>,
    /// Name of the adapter used for training.
    #[serde(default)]
    pub(super) adapter: Option<String>,
    /// Mean wall time of a joint iteration, in seconds.
    #[serde(default)]
    pub(super) seconds_per_iteration: Option<f64>,
    /// Wall time of all phases and the steps between them, in seconds.
    #[serde(default)]
    pub(super) training_seconds: Option<f64>,
    /// Peak GPU memory of training, in bytes.
    #[serde(default)]
    pub(super) training_peak_gpu_bytes: Option<u64>,
    /// Curves of the phases, in training order.
    #[serde(default)]
    history: Vec<Curves>,
}

/// Progress reports of one phase, thinned; columns have equal length.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Curves {
    phase: Phase,
    /// Number of iterations of the phase.
    of: u32,
    /// Last iteration represented by each point.
    iteration: Vec<u32>,
    /// Mean loss over these iterations, to a millionth.
    loss: Vec<f64>,
    splats: Vec<usize>,
    /// Mean of the PSNR measured in these iterations, to a thousandth of a dB.
    psnr: Vec<Option<f64>>,
}

impl Record {
    pub(super) fn new(
        capture: &Capture,
        options: &TrainOptions,
        adapter: &str,
        trained: &Trained,
    ) -> serde_json::Result<Self> {
        Ok(Self {
            capture: capture.name.clone(),
            points: Some(capture.points.len()),
            masks: Some(capture.has_masks()),
            held_out: Some(
                options.split.split(&capture.views).1.iter().map(|&i| capture.views[i].name.clone()).collect(),
            ),
            settings: by_name(options)?,
            adapter: Some(adapter.to_owned()),
            seconds_per_iteration: trained.seconds_per_iteration,
            training_seconds: Some(trained.training_seconds),
            training_peak_gpu_bytes: Some(trained.peak_gpu_bytes),
            history: thinned(&trained.history),
        })
    }

    /// Reads the record from the extras of a file; none if they are something else.
    pub(super) fn read(extras: &Value) -> Option<Self> {
        let mut record = Self::deserialize(extras).ok()?;
        record.adapter = record.adapter.map(|name| printable(&name));
        Some(record)
    }

    /// Note if the record is of a capture with another name.
    pub(super) fn of_another(&self, capture: &Capture) -> Option<String> {
        (self.capture != capture.name).then(|| {
            let [before, now] = [&self.capture, &capture.name].map(|name| printable(name));
            format!("the scene was trained on a capture called {before}, this one is called {now}")
        })
    }

    /// Note if scored views were trained on, `known` being the views of the capture at that time: either none was held
    /// out, or others were, because every eighth view of another list is another one.
    pub(super) fn saw<'a>(&self, known: &HashSet<&str>, scored: impl IntoIterator<Item = &'a str>) -> Option<String> {
        if self.settings.get("split").is_some_and(|split| split == "all") {
            return Some("the scene was trained on all views, including those that are scored".to_owned());
        }
        let held_out: HashSet<&str> = self.held_out.as_ref()?.iter().map(String::as_str).collect();
        let (mut count, mut seen) = (0, 0);
        for name in scored {
            count += 1;
            seen += usize::from(known.contains(name) && !held_out.contains(name));
        }
        (seen > 0).then(|| {
            format!("the scene was trained on {seen} of the {count} views that are scored: the capture lists or holds out other views than in training")
        })
    }

    /// Note if masks were applied in training or scoring only.
    pub(super) fn other_masks(&self, capture: &Capture) -> Option<String> {
        let trained = self.masks.filter(|masks| *masks != capture.has_masks())?;
        let (then, now) = if trained { ("with masks", "without them") } else { ("without masks", "with masks") };
        Some(format!("the scene was trained {then}, but is scored {now}"))
    }

    /// Settings as rows of a table.
    pub(super) fn settings(&self) -> Vec<(String, String)> {
        let settings = self.settings.iter().map(|(name, value)| as_flag(name, value));
        let of_capture = [
            self.points.map(|n| ("points of the capture".to_owned(), n.to_string())),
            self.masks.map(|masks| ("masks".to_owned(), masks.to_string())),
        ];
        settings.chain(of_capture.into_iter().flatten()).collect()
    }

    /// Training curves, phases in sequence. Splats are unchanged, and not drawn, during the warm-up.
    pub(super) fn plots(&self) -> Vec<Plot> {
        let (mut loss, mut psnr, mut splats, mut parts) = (vec![], vec![], vec![], vec![]);
        let mut before = 0.0;
        for curves in &self.history {
            let at = || curves.iteration.iter().map(|&i| before + f64::from(i));
            loss.extend(at().zip(curves.loss.iter().copied()));
            psnr.extend(at().zip(&curves.psnr).filter_map(|(at, db)| Some((at, (*db)?))));
            if curves.phase != Phase::Warmup {
                splats.extend(at().zip(curves.splats.iter().map(|&n| n as f64)));
            }
            parts.push((before, curves.phase.name().to_owned()));
            before += f64::from(curves.of);
        }
        // A run of one phase has no named parts.
        parts = if parts.len() > 1 { parts } else { vec![] };
        [("loss", true, loss), ("held-out PSNR (dB)", false, psnr), ("splats", false, splats)]
            .into_iter()
            .filter(|(_, _, points)| !points.is_empty())
            .map(|(title, log_y, points)| {
                let parts = parts.clone();
                Plot { title: title.into(), x_label: "iteration".into(), log_y, points, parts }
            })
            .collect()
    }
}

/// An option as the flag of `centaur train` that sets it, and its value as given there; for switches, `on` or `off`.
fn as_flag(name: &str, value: &Value) -> (String, String) {
    let flag = if name == "split" { "all-views".to_owned() } else { name.replace('_', "-") };
    let switch = |is_on: bool| String::from(if is_on { "on" } else { "off" });
    let given = match (name, value) {
        ("split", _) => switch(value == "all"),
        ("planar" | "shell", Value::Bool(true)) => "auto".to_owned(),
        (_, Value::Bool(is_on)) => switch(*is_on),
        ("mode", Value::String(mode)) if mode == OrderMode::SurfaceConsistent.name() => "surface-consistent".to_owned(),
        (_, Value::String(text)) => text.clone(),
        // λ always has a value, and JSON cannot represent infinity.
        ("lambda", Value::Null) => "inf".to_owned(),
        (_, Value::Null) => "default".to_owned(),
        (_, other) => other.to_string(),
    };
    (format!("--{flag}"), given)
}

/// Options by field name. Converted via text, in which an f32 such as 0.01 keeps its short form.
pub(super) fn by_name(options: &TrainOptions) -> serde_json::Result<Map<String, Value>> {
    serde_json::from_str(&serde_json::to_string(options)?)
}

/// Text that is safe for a terminal.
fn printable(name: &str) -> String {
    name.chars().filter(|c| !c.is_control()).take(200).collect()
}

fn thinned(history: &[Progress]) -> Vec<Curves> {
    let group = history.len().div_ceil(MOST_POINTS).max(1);
    let rounded = |v: f64, steps: f64| (v * steps).round() / steps;
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let curves = |reports: &[Progress]| {
        let Progress { phase, of, .. } = reports[0];
        let mut curves = Curves { phase, of, iteration: vec![], loss: vec![], splats: vec![], psnr: vec![] };
        for reports in reports.chunks(group) {
            let Progress { iteration, splats, .. } = reports[reports.len() - 1];
            let losses: Vec<f64> = reports.iter().map(|p| p.loss).collect();
            let psnr: Vec<f64> = reports.iter().filter_map(|p| p.psnr).collect();
            curves.iteration.push(iteration);
            curves.loss.push(rounded(mean(&losses), 1e6));
            curves.splats.push(splats);
            curves.psnr.push((!psnr.is_empty()).then(|| rounded(mean(&psnr), 1e3)));
        }
        curves
    };
    history.chunk_by(|a, b| a.phase == b.phase).map(curves).collect()
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;
    use crate::cli::Cli;

    fn report(phase: Phase, iteration: u32, of: u32) -> Progress {
        let psnr = iteration.is_multiple_of(500).then_some(20.0);
        Progress { phase, iteration, of, loss: 1.0 / 3.0, splats: 7, psnr, seconds: 0.0 }
    }

    /// Reports after every tenth iteration.
    fn history(phases: &[(Phase, u32)]) -> Vec<Progress> {
        phases.iter().flat_map(|&(phase, of)| (10..=of).step_by(10).map(move |i| report(phase, i, of))).collect()
    }

    fn record(history: &[Progress]) -> Record {
        let extras = serde_json::json!({ "capture": "garden", "settings": { "ssim_weight": 0.2, "mode": "stable" } });
        Record { history: thinned(history), ..Record::read(&extras).unwrap() }
    }

    #[test]
    fn long_histories_are_thinned_to_what_a_plot_shows() {
        let long = record(&history(&[(Phase::Surface, 15_000), (Phase::Warmup, 9000), (Phase::Joint, 15_000)]));
        let text = serde_json::to_string(&long).unwrap();
        assert!(text.len() < 12_000, "{} bytes", text.len());
        let back = Record::read(&serde_json::from_str(&text).unwrap()).unwrap();
        assert_eq!(back.history, long.history);
        let plots = back.plots();
        assert_eq!(plots.iter().map(|p| &*p.title).collect::<Vec<_>>(), ["loss", "held-out PSNR (dB)", "splats"]);
        let points = &plots[0].points;
        assert!((150..=310).contains(&points.len()), "{} points", points.len());
        assert!(points[0].0 < 500.0 && points.is_sorted_by(|a, b| a.0 < b.0), "{points:?}");
        assert_eq!(*points.last().unwrap(), (39_000.0, 0.333_333));
        assert_eq!(plots[1].points.len(), 78, "a mean of PSNR where there was one");
        let rested = |x: f64| (15_000.0..=24_000.0).contains(&x);
        assert!(!plots[2].points.iter().any(|&(x, _)| rested(x) && x != 15_000.0));
        let part = |x: f64, name: &str| (x, name.to_owned());
        assert!(
            plots.iter().all(|p| p.parts == [part(0.0, "surface"), part(15_000.0, "warm-up"), part(24_000.0, "joint")])
        );
    }

    #[test]
    fn short_histories_are_kept_whole() {
        let Plot { points, parts, .. } = &record(&history(&[(Phase::Joint, 200)])).plots()[0];
        assert!(parts.is_empty());
        assert_eq!(points.iter().map(|p| p.0 as u32).collect::<Vec<_>>(), (10..=200).step_by(10).collect::<Vec<_>>());
    }

    #[test]
    fn settings_are_as_they_were_given() {
        let options = TrainOptions { ssim_weight: 0.2, ..TrainOptions::default() };
        let rows = |lambda: f32| {
            let settings = by_name(&TrainOptions { lambda, ..options.clone() }).unwrap();
            Record { settings, ..record(&[]) }.settings()
        };
        let value = |lambda: f32, name: &str| rows(lambda).into_iter().find(|row| row.0 == name).unwrap().1;
        assert_eq!([0.01, f32::INFINITY].map(|lambda| value(lambda, "--lambda")), ["0.01", "inf"]);
        assert_eq!(["--ssim-weight", "--max-floats"].map(|name| value(0.01, name)), ["0.2", "default"]);
        assert_eq!(
            ["--mode", "--planar", "--all-views"].map(|name| value(0.01, name)),
            ["surface-consistent", "auto", "off"]
        );
        assert_eq!(["--density", "--antialias"].map(|name| value(0.01, name)), ["mcmc", "off"]);
        // Each is a flag, and each value of several that a flag has is one.
        let command = Cli::command();
        let train = command.find_subcommand("train").unwrap();
        for (flag, value) in rows(0.01).into_iter().filter(|(name, _)| name.starts_with("--")) {
            let flag = train.get_arguments().find(|of| of.get_long() == Some(&flag[2..])).expect(&flag);
            let values: Vec<String> = flag.get_possible_values().iter().map(|v| v.get_name().to_owned()).collect();
            assert!(
                !flag.get_action().takes_values() || values.is_empty() || values.contains(&value),
                "{value}: {values:?}"
            );
        }
    }

    #[test]
    fn views_that_were_trained_on_are_told() {
        let known = HashSet::from(["0", "1", "8", "9"]);
        let saw = |record: &Record, scored: &[&str]| record.saw(&known, scored.iter().copied());
        let own = Record { held_out: Some(vec!["0".to_owned(), "8".to_owned()]), ..record(&[]) };
        assert_eq!((saw(&own, &["0", "8"]), saw(&own, &["new"])), (None, None));
        let said = saw(&own, &["1", "8", "9"]).unwrap();
        assert!(said.starts_with("the scene was trained on 2 of the 3 views that are scored: "), "{said}");
        // Older files lack this record.
        assert_eq!(saw(&record(&[]), &["1"]), None);
    }

    #[test]
    fn files_without_a_history_have_no_plots_and_other_extras_are_not_ours() {
        let old = record(&[]);
        assert!(old.plots().is_empty() && old.seconds_per_iteration.is_none() && old.training_seconds.is_none());
        let row = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        assert_eq!(old.settings(), [row("--mode", "stable"), row("--ssim-weight", "0.2")]);
        for extras in [serde_json::json!("a note"), serde_json::json!({ "capture": "c", "settings": {}, "history": 3 })]
        {
            assert!(Record::read(&extras).is_none(), "{extras}");
        }
    }
}
