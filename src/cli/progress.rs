//! Progress of a command, reported to a person (a bar), to a program (JSON lines) or not at all.

use std::io::{self, Write as _};
use std::time::Instant;

use centaur::optimize::{Phase, Progress};
use indicatif::{ProgressBar, ProgressStyle};

use super::output;
use super::shared::MessageArgs;

/// Progress of a training run.
pub(super) struct Reporter {
    bar: ProgressBar,
    json: bool,
    phase: Option<Phase>,
    held_out: Option<f64>,
}

impl Reporter {
    pub(super) fn new(messages: &MessageArgs) -> Self {
        let bar = bar(messages, 0, "{prefix:9} {bar:16} {pos}/{len}  {per_sec}  ETA {eta}  {wide_msg}");
        Self { bar, json: tells_programs(messages), phase: None, held_out: None }
    }

    pub(super) fn update(&mut self, p: &Progress) {
        if self.json {
            tell(p);
        }
        let begins = self.phase != Some(p.phase);
        if begins {
            self.phase = Some(p.phase);
            self.held_out = None;
            self.bar.reset();
        }
        self.held_out = p.psnr.or(self.held_out);
        self.bar.set_length(u64::from(p.of));
        self.bar.set_position(u64::from(p.iteration));
        if begins {
            // For a resumed run, earlier iterations must not count for the speed.
            self.bar.reset_eta();
        }
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

/// Progress of work that proceeds view by view.
pub(super) struct Views {
    bar: ProgressBar,
    json: bool,
    phase: &'static str,
    view: usize,
    of: usize,
    start: Instant,
}

impl Views {
    /// Starts progress; `phase` is one word for the work on the views.
    pub(super) fn new(messages: &MessageArgs, phase: &'static str, of: usize) -> Self {
        let bar = bar(messages, of as u64, "{prefix:9} {bar:16} {pos}/{len} views  ETA {eta}");
        bar.set_prefix(phase);
        bar.tick();
        Self { bar, json: tells_programs(messages), phase, view: 0, of, start: Instant::now() }
    }

    /// Counts one more finished view.
    pub(super) fn advance(&mut self) {
        self.reach(self.view + 1);
    }

    /// Sets the number of finished views; smaller than before if work starts again.
    pub(super) fn reach(&mut self, view: usize) {
        self.view = view;
        self.bar.set_position(view as u64);
        if self.json {
            let Self { phase, view, of, start, .. } = self;
            let seconds = start.elapsed().as_secs_f64();
            tell(&serde_json::json!({ "phase": phase, "view": view, "of": of, "seconds": seconds }));
        }
    }

    /// Removes the bar from the terminal.
    pub(super) fn finish(self) {
        self.bar.finish_and_clear();
    }
}

fn bar(messages: &MessageArgs, length: u64, template: &str) -> ProgressBar {
    let bar = output::bar(messages, length);
    bar.set_style(ProgressStyle::with_template(template).expect("the template is a constant"));
    bar
}

/// Whether progress is printed as JSON lines. --quiet suppresses them, too: --json --quiet leaves the one object on
/// stdout.
fn tells_programs(messages: &MessageArgs) -> bool {
    messages.json && !messages.quiet
}

/// Prints progress; a reader that has gone away does not stop the command.
fn tell(progress: &impl serde::Serialize) {
    let _ = writeln!(io::stderr(), "{}", serde_json::json!({ "progress": progress }));
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// If all iterations before the stop counted as done in no time, the estimate for the resumed run would be too
    /// short.
    #[test]
    fn what_is_left_of_a_resumed_run_takes_as_long_as_its_own_iterations() {
        let mut reporter = Reporter::new(&MessageArgs { quiet: true, json: false });
        // 10 iterations take at least 20 ms.
        let pause = Duration::from_millis(20);
        for (phase, iterations, left) in [(Phase::Warmup, [10, 20], 1980), (Phase::Joint, [1010, 1020], 980)] {
            for iteration in iterations {
                std::thread::sleep(pause);
                let (loss, splats, psnr, seconds) = (0.1, 7, None, 0.0);
                reporter.update(&Progress { phase, iteration, of: 2000, loss, splats, psnr, seconds });
            }
            let least = pause.mul_f64(f64::from(left) / 10.0);
            let eta = reporter.bar.eta();
            assert!(eta > least.mul_f64(0.9), "{phase:?}: {eta:?}, not {least:?}");
        }
    }
}
