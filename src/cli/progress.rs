//! Progress of a command, reported to a person (a bar), to a program (JSON lines) or not at all.

use std::collections::VecDeque;
use std::io::{self, Write as _};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::sync::{Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use centaur::format::one_line;
use centaur::optimize::{Phase, Progress};
use indicatif::{HumanDuration, ProgressBar, ProgressStyle};

use super::output;
use super::shared::MessageArgs;

/// Progress of a training run: of its iterations, and, before, between and after its phases, what else it does.
pub(super) struct Reporter {
    bar: ProgressBar,
    json: bool,
    /// Phases of the run, with their iterations.
    phases: Vec<(Phase, u32)>,
    last: Option<Progress>,
    held_out: Option<f64>,
    pace: Pace,
    /// While no iteration is reported.
    spinner: Option<Spinner>,
}

impl Reporter {
    /// Starts progress of a run with these phases, see [`centaur::optimize::TrainOptions::phases`].
    pub(super) fn new(messages: &MessageArgs, phases: Vec<(Phase, u32)>) -> Self {
        Self::on(output::bar(messages, 0), tells_programs(messages), phases)
    }

    fn on(bar: ProgressBar, json: bool, phases: Vec<(Phase, u32)>) -> Self {
        let pace = Pace::default();
        let mut reporter = Self { bar, json, phases, last: None, held_out: None, pace, spinner: None };
        reporter.spin("starting");
        reporter
    }

    pub(super) fn update(&mut self, p: &Progress) {
        if self.json {
            tell(p);
        }
        if self.last.is_none_or(|last| last.phase != p.phase) {
            self.held_out = None;
            self.pace = Pace::default();
        }
        self.held_out = p.psnr.or(self.held_out);
        self.pace.reach(u64::from(p.iteration), Instant::now());
        self.last = Some(*p);
        let times = self.times(p);
        self.show(p, &times);
        if p.iteration == p.of {
            self.spin(self.after(p.phase));
        }
    }

    /// What a run does after the iterations of a phase, which may take minutes.
    fn after(&self, phase: Phase) -> &'static str {
        let makes_surface = self.phases.iter().any(|(phase, _)| *phase == Phase::Surface);
        match phase {
            Phase::Surface => "making the surface",
            Phase::Warmup if makes_surface => "judging triangles",
            Phase::Warmup => "adding the splats",
            Phase::Joint => "finishing",
        }
    }

    /// Speed of this phase, and the time until the end of the run if all phases were as fast.
    fn times(&self, p: &Progress) -> String {
        let later = self.phases.iter().skip_while(|(phase, _)| *phase != p.phase).skip(1);
        let later: u64 = later.map(|(_, iterations)| u64::from(*iterations)).sum();
        let left = u64::from(p.of.saturating_sub(p.iteration)) + later;
        let speed = self.pace.speed();
        match (left, later) {
            // What remains is no iteration.
            (0, _) => format!("{speed}  "),
            (_, 0) => format!("{speed}  ETA {}  ", self.pace.time_of(left)),
            _ => format!("{speed}  run ETA {}  ", self.pace.time_of(left)),
        }
    }

    /// Draws a report. Label, numbers and text change at once: those of two phases are never seen together.
    fn show(&mut self, p: &Progress, times: &str) {
        if self.spinner.take().is_some() {
            self.bar.set_style(style("{prefix:9} {bar:16} {pos}/{len}  {wide_msg}"));
        }
        // Splats rest in the warm-up.
        let splats = if p.phase == Phase::Warmup { String::new() } else { format!("  {} splats", p.splats) };
        let held_out = self.held_out.map_or(String::new(), |db| format!("  held-out {db:.2} dB"));
        let text = format!("{times}loss {:.4}{splats}{held_out}", p.loss);
        // Unlike `set_prefix` and `set_message`, these do not draw.
        self.bar.clone().with_prefix(p.phase.name()).with_message(text);
        self.bar.update(|state| {
            state.set_len(u64::from(p.of));
            state.set_pos(u64::from(p.iteration));
        });
    }

    /// Shows what the run does until the next report.
    fn spin(&mut self, what: &'static str) {
        self.bar.set_style(style("{spinner} {msg}  {elapsed}"));
        self.bar.reset_elapsed();
        self.bar.set_message(what);
        self.spinner = Some(Spinner::new(&self.bar));
    }

    /// Tells a note above the bar.
    pub(super) fn say(&self, text: &str, as_json: bool) {
        self.bar.suspend(|| output::say(text, as_json));
    }

    /// Leaves the last report on the terminal.
    pub(super) fn finish(mut self) {
        if let Some(last) = self.last {
            self.show(&last, "");
            self.bar.abandon();
        } else {
            self.spinner = None;
            self.bar.finish_and_clear();
        }
    }
}

/// Time between two frames of a spinner.
const FRAME: Duration = Duration::from_millis(125);

/// Draws a bar with a spinner again and again, until it is dropped.
struct Spinner {
    /// Ends the thread when dropped.
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Spinner {
    fn new(bar: &ProgressBar) -> Self {
        if bar.is_hidden() {
            return Self { stop: None, thread: None };
        }
        let (stop, stopped) = mpsc::channel();
        let bar = bar.clone();
        let turn = move || {
            while stopped.recv_timeout(FRAME) == Err(RecvTimeoutError::Timeout) {
                bar.tick();
            }
        };
        // It stands still where no further thread is permitted; `enable_steady_tick` would panic.
        Self { stop: Some(stop), thread: thread::Builder::new().name("spinner".into()).spawn(turn).ok() }
    }
}

impl Drop for Spinner {
    fn drop(&mut self) {
        drop(self.stop.take());
        // What is drawn next is not drawn over.
        let _ = self.thread.take().map(JoinHandle::join);
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
    pace: Pace,
}

impl Views {
    /// Starts progress; `phase` is one word for the work on the views.
    pub(super) fn new(messages: &MessageArgs, phase: &'static str, of: usize) -> Self {
        let bar = output::bar(messages, of as u64);
        bar.set_style(style("{prefix:9} {bar:16} {pos}/{len} views  {wide_msg}"));
        let (json, start, pace) = (tells_programs(messages), Instant::now(), Pace::default());
        let views = Self { bar, json, phase, view: 0, of, start, pace };
        views.show();
        views
    }

    /// Counts one more finished view.
    pub(super) fn advance(&mut self) {
        self.reach(self.view + 1);
    }

    /// Sets the number of finished views; smaller than before if work starts again.
    pub(super) fn reach(&mut self, view: usize) {
        self.view = view;
        self.pace.reach(view as u64, Instant::now());
        self.show();
        if self.json {
            let Self { phase, view, of, start, .. } = self;
            let seconds = start.elapsed().as_secs_f64();
            tell(&serde_json::json!({ "phase": phase, "view": view, "of": of, "seconds": seconds }));
        }
    }

    fn show(&self) {
        let left = self.of.saturating_sub(self.view) as u64;
        let eta = if left > 0 { format!("ETA {}", self.pace.time_of(left)) } else { String::new() };
        self.bar.clone().with_prefix(self.phase).with_message(eta);
        self.bar.update(|state| state.set_pos(self.view as u64));
    }

    /// Removes the bar from the terminal.
    pub(super) fn finish(self) {
        self.bar.finish_and_clear();
    }
}

/// Progress of the jobs of a benchmark, several of which may be done at the same time.
pub(super) struct Jobs {
    bar: ProgressBar,
    messages: MessageArgs,
    of: usize,
    start: Instant,
    /// Number of finished jobs, and their pace.
    done: Mutex<(usize, Pace)>,
}

impl Jobs {
    pub(super) fn new(messages: &MessageArgs, of: usize) -> Self {
        let bar = output::bar(messages, of as u64);
        bar.set_style(style("{pos}/{len} jobs  {bar:16}  {prefix}  {wide_msg}"));
        let (messages, start, mut pace) = (messages.clone(), Instant::now(), Pace::default());
        pace.reach(0, start);
        let jobs = Self { bar, messages, of, start, done: Mutex::new((0, pace)) };
        jobs.estimate(jobs.of, &Pace::default());
        jobs
    }

    /// Shows which job was begun last.
    pub(super) fn begin(&self, job: &str) {
        self.bar.set_message(one_line(job).into_owned());
    }

    /// Counts a job that has ended, in this way; one of another runner, which may be tried again, has none.
    pub(super) fn end(&self, job: &str, how: Option<&str>) {
        let mut done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        let (count, pace) = &mut *done;
        *count += 1;
        pace.reach(*count as u64, Instant::now());
        self.estimate(self.of.saturating_sub(*count), pace);
        self.bar.inc(1);
        if how.is_some() && tells_programs(&self.messages) {
            let (count, of, seconds) = (*count, self.of, self.start.elapsed().as_secs_f64());
            tell(&serde_json::json!({
                "phase": "jobs", "job": count, "of": of, "name": job, "outcome": how, "seconds": seconds
            }));
        }
    }

    fn estimate(&self, left: usize, pace: &Pace) {
        self.bar.set_prefix(format!("ETA {}", pace.time_of(left as u64)));
    }

    /// Prints a line above the bar, if there is one.
    pub(super) fn print(&self, line: &str) {
        self.bar.println(one_line(line));
    }

    /// Tells why a job has failed, with --quiet too.
    pub(super) fn fail(&self, why: &str) {
        if self.messages.json {
            return output::say(why, true);
        }
        let _ = self.bar.suspend(|| writeln!(io::stderr(), "{}", output::without_codes(&one_line(why))));
    }

    /// Tells a note above the bar.
    pub(super) fn say(&self, text: &str) {
        self.bar.suspend(|| output::say(text, self.messages.json));
    }

    /// Removes the bar from the terminal.
    pub(super) fn finish(self) {
        self.bar.finish_and_clear();
    }
}

/// Reports that the pace is measured by: some hundreds of iterations, among which are evaluations of held-out views.
const MEASURED: usize = 64;

/// Pace of work, from the last reports of it. What was before the first report does not count: compiling kernels, and,
/// in a resumed run, all that an earlier one did.
#[derive(Default)]
struct Pace {
    /// Numbers of steps that were done, and when.
    reports: VecDeque<(u64, Instant)>,
}

impl Pace {
    /// Takes a report of how many steps are done: fewer than before if work starts again.
    fn reach(&mut self, done: u64, now: Instant) {
        if self.reports.back().is_some_and(|(before, _)| done < *before) {
            self.reports.clear();
        }
        self.reports.push_back((done, now));
        if self.reports.len() > MEASURED {
            self.reports.pop_front();
        }
    }

    fn seconds_per_step(&self) -> Option<f64> {
        let ((from, start), (to, end)) = (self.reports.front()?, self.reports.back()?);
        let seconds = (*end - *start).as_secs_f64();
        (to > from && seconds > 0.0).then(|| seconds / (to - from) as f64)
    }

    /// Iterations per second; where that is less than one, seconds per iteration.
    fn speed(&self) -> String {
        match self.seconds_per_step() {
            None => "–/s".to_owned(),
            Some(seconds) if seconds > 1.0 => format!("{seconds:.1} s/iteration"),
            Some(seconds) => format!("{:.1}/s", 1.0 / seconds),
        }
    }

    /// Estimated time of so many steps.
    fn time_of(&self, steps: u64) -> String {
        let seconds = self.seconds_per_step().map(|seconds| seconds * steps as f64);
        let time = seconds.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
        time.map_or("–".to_owned(), |time| format!("{:#}", HumanDuration(time)))
    }
}

fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).expect("the template is a constant")
}

/// Whether progress is printed as JSON lines. --quiet suppresses them, too: --json --quiet leaves the one object on
/// stdout.
fn tells_programs(messages: &MessageArgs) -> bool {
    messages.json && !messages.quiet
}

/// Prints progress.
fn tell(progress: &impl serde::Serialize) {
    output::json_line(&serde_json::json!({ "progress": progress }));
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use indicatif::{ProgressDrawTarget, TermLike};

    use super::*;

    /// Terminal that keeps the lines that were drawn, and empty ones where it was cleared.
    #[derive(Clone, Debug, Default)]
    struct Screen(Arc<Mutex<Vec<String>>>);

    impl TermLike for Screen {
        fn width(&self) -> u16 {
            120
        }

        fn move_cursor_up(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_down(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_right(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn move_cursor_left(&self, _: usize) -> io::Result<()> {
            Ok(())
        }

        fn write_line(&self, text: &str) -> io::Result<()> {
            self.write_str(text)
        }

        fn write_str(&self, text: &str) -> io::Result<()> {
            // The rest of a line is filled with blanks.
            if !text.trim().is_empty() {
                self.0.lock().unwrap().push(text.trim_end().to_owned());
            }
            Ok(())
        }

        fn clear_line(&self) -> io::Result<()> {
            self.0.lock().unwrap().push(String::new());
            Ok(())
        }

        fn flush(&self) -> io::Result<()> {
            Ok(())
        }
    }

    /// Lines drawn of a run with these phases, from its report `from` on, and what is left of them at its end.
    fn drawn(phases: &[(Phase, u32)], from: usize) -> (Vec<String>, String) {
        let screen = Screen::default();
        let target = ProgressDrawTarget::term_like(Box::new(screen.clone()));
        let bar = ProgressBar::with_draw_target(Some(0), target);
        let mut reporter = Reporter::on(bar, false, phases.to_vec());
        let reports = phases.iter().flat_map(|&(phase, of)| (1..=of / 10).map(move |i| (phase, 10 * i, of)));
        for (phase, iteration, of) in reports.skip(from) {
            let psnr = (iteration == of).then_some(20.0);
            reporter.update(&Progress { phase, iteration, of, loss: 0.1, splats: 7, psnr, seconds: 0.0 });
        }
        reporter.finish();
        let mut lines = std::mem::take(&mut *screen.0.lock().unwrap());
        let left = lines.last().cloned().unwrap_or_default();
        lines.retain(|line| !line.is_empty());
        lines.dedup();
        (lines, left)
    }

    #[test]
    fn a_bar_is_of_one_phase_and_what_is_between_them_is_said() {
        let phases = [(Phase::Surface, 20), (Phase::Warmup, 30), (Phase::Joint, 20)];
        let (lines, left) = drawn(&phases, 0);
        assert_eq!(lines.last(), Some(&left));
        let is_report = |line: &&String| ["surface ", "warm-up ", "joint "].iter().any(|label| line.starts_with(label));
        let reports: Vec<&String> = lines.iter().filter(is_report).collect();
        let expected = [
            ("surface ", " 10/20  –/s  run ETA –  loss 0.1000  7 splats"),
            ("surface ", "  loss 0.1000  7 splats  held-out 20.00 dB"),
            ("warm-up ", " 10/30  –/s  run ETA –  loss 0.1000"),
            ("warm-up ", "  loss 0.1000"),
            ("warm-up ", "  loss 0.1000  held-out 20.00 dB"),
            ("joint ", " 10/20  –/s  ETA –  loss 0.1000  7 splats"),
            ("joint ", "  loss 0.1000  7 splats  held-out 20.00 dB"),
            ("joint ", " 20/20  loss 0.1000  7 splats  held-out 20.00 dB"),
        ];
        assert_eq!(reports.len(), expected.len(), "{lines:#?}");
        for (line, (start, end)) in reports.iter().zip(expected) {
            assert!(line.starts_with(start) && line.ends_with(end), "{line}, not {start}…{end}");
        }
        for what in ["starting", "making the surface", "judging triangles", "finishing"] {
            assert!(lines.iter().any(|line| line.contains(&format!(" {what}  "))), "{what}: {lines:#?}");
        }
    }

    /// Nothing is judged of a given mesh, and no surface is made without one.
    #[test]
    fn a_run_is_said_to_do_what_it_does() {
        let lines = |phases: &[(Phase, u32)]| drawn(phases, 0).0.join("\n");
        let given = lines(&[(Phase::Warmup, 10), (Phase::Joint, 10)]);
        assert!(given.contains("adding the splats") && !given.contains("judging"), "{given}");
        let splats = lines(&[(Phase::Joint, 10)]);
        assert!(!["adding", "judging", "making"].iter().any(|what| splats.contains(what)), "{splats}");
    }

    #[test]
    fn a_run_that_ends_before_its_first_report_leaves_no_bar() {
        let (lines, left) = drawn(&[(Phase::Joint, 10)], 1);
        assert!(lines.iter().all(|line| line.contains("starting")) && left.is_empty(), "{lines:?}, left: {left}");
    }

    /// If all iterations before the stop counted as done in no time, the estimate for the resumed run would be too
    /// short; and compiling kernels takes longer than many iterations.
    #[test]
    fn the_pace_is_that_of_what_follows_the_first_report() {
        let (start, mut pace) = (Instant::now(), Pace::default());
        let after = |seconds| start + Duration::from_secs(seconds);
        assert_eq!((pace.speed(), pace.time_of(9)), ("–/s".to_owned(), "–".to_owned()));
        pace.reach(1010, after(100));
        assert_eq!((pace.speed(), pace.time_of(9)), ("–/s".to_owned(), "–".to_owned()));
        pace.reach(1020, after(104));
        assert_eq!((pace.speed(), pace.time_of(100)), ("2.5/s".to_owned(), "40s".to_owned()));
        pace.reach(1030, after(150));
        assert_eq!((pace.speed(), pace.time_of(100)), ("2.5 s/iteration".to_owned(), "4m".to_owned()));
        assert_eq!(pace.time_of(0), "0s");
        // Work that starts again may be of another size, and slow beginnings are forgotten.
        pace.reach(10, after(160));
        assert_eq!(pace.time_of(9), "–");
        for i in 0..100 {
            pace.reach(20 + 10 * i, after(1000 + i));
        }
        assert_eq!((pace.speed(), pace.time_of(100)), ("10.0/s".to_owned(), "10s".to_owned()));
    }

    #[test]
    fn the_first_view_says_nothing_of_the_others() {
        let mut views = Views::new(&MessageArgs { quiet: true, json: false }, "rendering", 3);
        let mut told = vec![views.bar.message()];
        for _ in 0..3 {
            thread::sleep(Duration::from_millis(2));
            views.advance();
            told.push(views.bar.message());
        }
        assert_eq!(told, ["ETA –", "ETA –", "ETA 0s", ""]);
    }

    #[test]
    fn the_time_of_jobs_is_known_once_one_is_done() {
        let jobs = Jobs::new(&MessageArgs { quiet: true, json: false }, 3);
        let mut told = vec![jobs.bar.prefix()];
        for _ in 0..3 {
            thread::sleep(Duration::from_millis(2));
            jobs.end("a", Some("done"));
            told.push(jobs.bar.prefix());
        }
        assert_eq!(told, ["ETA –", "ETA 0s", "ETA 0s", "ETA 0s"]);
    }
}
