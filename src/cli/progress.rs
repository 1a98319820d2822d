//! One training run, told to a person (a bar), a program (JSON lines) or no one; remembered for the report.

use std::io::{self, Write as _};

use centaur::metrics::plot::Plot;
use centaur::optimize::static_scene::Progress;
use indicatif::{ProgressBar, ProgressStyle};

use super::output;
use super::shared::MessageArgs;

pub(super) struct Reporter {
    bar: ProgressBar,
    json: bool,
    loss: Vec<(f64, f64)>,
    psnr: Vec<(f64, f64)>,
    splats: Vec<(f64, f64)>,
}

impl Reporter {
    pub(super) fn new(messages: &MessageArgs) -> Self {
        let bar = output::bar(messages, 0);
        let style = "{prefix:9} {bar:16} {pos}/{len}  {per_sec}  ETA {eta}  {wide_msg}";
        bar.set_style(ProgressStyle::with_template(style).expect("the template is a constant"));
        // --quiet silences the lines too: --json --quiet leaves the one object on stdout.
        let json = messages.json && !messages.quiet;
        Self { bar, json, loss: vec![], psnr: vec![], splats: vec![] }
    }

    pub(super) fn update(&mut self, p: &Progress) {
        let at = f64::from(p.iteration);
        self.loss.push((at, f64::from(p.loss)));
        self.splats.push((at, p.splats as f64));
        self.psnr.extend(p.psnr.map(|db| (at, db)));
        if self.json {
            // Progress is a courtesy: a reader that has gone away does not stop the training.
            let _ = writeln!(io::stderr(), "{}", serde_json::json!({ "progress": p }));
        }
        self.bar.set_length(u64::from(p.total));
        self.bar.set_position(u64::from(p.iteration));
        self.bar.set_prefix(p.phase);
        let held_out = self.psnr.last().map_or(String::new(), |(_, db)| format!("  held-out {db:.2} dB"));
        self.bar.set_message(format!("loss {:.4}  {} splats{held_out}", p.loss, p.splats));
    }

    /// Leaves the last state of the bar on the terminal and gives the curves.
    pub(super) fn finish(self) -> Vec<Plot> {
        self.bar.abandon();
        [("loss", true, self.loss), ("held-out PSNR (dB)", false, self.psnr), ("splats", false, self.splats)]
            .into_iter()
            .filter(|(_, _, points)| !points.is_empty())
            .map(|(title, log_y, points)| Plot { title: title.into(), log_y, points })
            .collect()
    }
}
