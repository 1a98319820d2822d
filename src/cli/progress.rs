//! One training run, told to a person (a bar), a program (JSON lines) or no one.

use std::io::{self, Write as _};

use centaur::optimize::{Phase, Progress};
use indicatif::{ProgressBar, ProgressStyle};

use super::output;
use super::shared::MessageArgs;

pub(super) struct Reporter {
    bar: ProgressBar,
    json: bool,
    phase: Option<Phase>,
    held_out: Option<f64>,
}

impl Reporter {
    pub(super) fn new(messages: &MessageArgs) -> Self {
        let bar = output::bar(messages, 0);
        let style = "{prefix:9} {bar:16} {pos}/{len}  {per_sec}  ETA {eta}  {wide_msg}";
        bar.set_style(ProgressStyle::with_template(style).expect("the template is a constant"));
        // --quiet silences the lines too: --json --quiet leaves the one object on stdout.
        let json = messages.json && !messages.quiet;
        Self { bar, json, phase: None, held_out: None }
    }

    pub(super) fn update(&mut self, p: &Progress) {
        if self.json {
            // Progress is a courtesy: a reader that has gone away does not stop the training.
            let _ = writeln!(io::stderr(), "{}", serde_json::json!({ "progress": p }));
        }
        if self.phase != Some(p.phase) {
            self.phase = Some(p.phase);
            self.held_out = None;
            self.bar.reset();
        }
        self.held_out = p.psnr.or(self.held_out);
        self.bar.set_length(u64::from(p.of));
        self.bar.set_position(u64::from(p.iteration));
        self.bar.set_prefix(match p.phase {
            Phase::Surface => "surface",
            Phase::Warmup => "maps",
            Phase::Joint => "training",
        });
        let held_out = self.held_out.map_or(String::new(), |db| format!("  held-out {db:.2} dB"));
        self.bar.set_message(format!("loss {:.4}  {} splats{held_out}", p.loss, p.splats));
    }

    /// Leaves the last state of the bar on the terminal.
    pub(super) fn finish(self) {
        self.bar.abandon();
    }
}
