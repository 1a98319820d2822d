//! Execution of jobs: each is a training in its own process, whose memory is released with it.

use std::fs::File;
use std::io::{self, Seek as _, Write as _};
#[cfg(unix)]
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, Once};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, anyhow, bail};
use centaur::atomic::Lock;
use centaur::format::atomic_write;
use serde_json::Value;

use super::Args;
use super::jobs::{self, Job, Made};
use super::record;
use crate::cli::progress::Jobs;
use crate::cli::{interrupt, output};

/// Outcome of a job that did not fail.
enum Ended {
    /// Done, with the training's notes.
    Done(Vec<String>),
    /// Interrupted by Ctrl-C; there is a checkpoint.
    Interrupted,
    /// Done, or being done, by another runner.
    Elsewhere,
}

/// Outcome of all jobs.
pub(super) struct Outcome<'j> {
    /// Failed jobs, with reasons.
    pub(super) failed: Vec<(&'j Job, String)>,
    /// Without a result: another runner is at them, or the run was stopped.
    pub(super) left: Vec<&'j Job>,
    /// By Ctrl-C, before all were done: some are left.
    pub(super) is_stopped: bool,
}

/// Between attempts at jobs that another runner is at: one that is killed leaves a training, which ends within seconds.
const FIRST_PAUSE: Duration = Duration::from_millis(250);
const LONGEST_PAUSE: Duration = Duration::from_secs(10);

/// Does the jobs, and waits for those that another runner is at as long as `args` say.
pub(super) fn work<'j>(open: &[&'j Job], args: &Args) -> Outcome<'j> {
    let stop = interrupt::stop_flag(&args.messages);
    let mut outcome = attempt(open, args, &stop);
    let (wait, start) = (Duration::from_secs(args.wait), Instant::now());
    if !outcome.is_stopped && !outcome.left.is_empty() && !wait.is_zero() {
        let jobs = output::counted(outcome.left.len(), "job");
        args.say(&format!("{jobs} left to another runner: waiting for at most {} s", args.wait));
    }
    let mut pause = FIRST_PAUSE;
    while !outcome.is_stopped && !outcome.left.is_empty() && start.elapsed() < wait {
        sleep(pause.min(wait.saturating_sub(start.elapsed())), &stop);
        pause = (pause * 2).min(LONGEST_PAUSE);
        let Outcome { failed, left, is_stopped } = attempt(&outcome.left, args, &stop);
        outcome.failed.extend(failed);
        outcome.left = left;
        outcome.is_stopped = is_stopped;
    }
    outcome
}

/// Until the run is stopped, at most.
fn sleep(time: Duration, stop: &AtomicBool) {
    let start = Instant::now();
    while start.elapsed() < time && !stop.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(50).min(time));
    }
}

/// Does each job that no other runner is at.
fn attempt<'j>(open: &[&'j Job], args: &Args, stop: &AtomicBool) -> Outcome<'j> {
    let progress = Jobs::new(&args.messages, open.len());
    let at_a_time = open.len().min(args.jobs.into());
    let known = if args.shares_machine() { 0 } else { at_a_time };
    let (queue, failed) = (Mutex::new(open.iter()), Mutex::new(vec![]));
    let interrupted = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..at_a_time {
            scope.spawn(|| {
                while !stop.load(Ordering::Relaxed) {
                    let next = queue.lock().map_or(None, |mut queue| queue.next());
                    let Some(&job) = next else { break };
                    let name = job.name();
                    progress.begin(&name);
                    let start = Instant::now();
                    let how = match train(job, known, stop, args) {
                        Ok(Ended::Done(notes)) => {
                            progress.print(&format!("{name}: {:.1} min", start.elapsed().as_secs_f64() / 60.0));
                            notes.iter().for_each(|note| progress.say(&format!("{name}: {note}")));
                            Some("done")
                        }
                        Ok(Ended::Interrupted) => {
                            interrupted.store(true, Ordering::Relaxed);
                            Some("interrupted")
                        }
                        Ok(Ended::Elsewhere) => None,
                        Err(reason) => {
                            progress.fail(&format!("{name}: {reason:#}"));
                            if let Ok(mut failed) = failed.lock() {
                                failed.push((job, format!("{reason:#}")));
                            }
                            Some("failed")
                        }
                    };
                    progress.end(&name, how);
                }
            });
        }
    });
    progress.finish();
    let failed = failed.into_inner().unwrap_or_default();
    let has_failed = |job: &Job| failed.iter().any(|(failed, _)| std::ptr::eq(*failed, job));
    let left: Vec<&Job> = open.iter().copied().filter(|job| !job.result.is_file() && !has_failed(job)).collect();
    let is_asked_to_stop = stop.load(Ordering::Relaxed) || interrupted.load(Ordering::Relaxed);
    let is_stopped = is_asked_to_stop && !left.is_empty();
    Outcome { failed, left, is_stopped }
}

/// Text before the number of concurrent jobs in the first line of a lock file.
const AT_A_TIME: &str = "jobs at a time: ";

/// One training, unless somebody else is at it. `at_a_time` as in [`Made`], of this run of the job.
fn train(job: &Job, at_a_time: usize, stop: &AtomicBool, args: &Args) -> Result<Ended> {
    if let Some(folder) = job.result.parent() {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }
    // The training has a lock of its own, of another name.
    let path = job.result.with_extension("lock");
    let lock = Lock::take(&path).with_context(|| path.display().to_string())?;
    let Some(lock) = lock else { return Ok(Ended::Elsewhere) };
    if !lock.excludes() {
        static SAID: Once = Once::new();
        let folder = path.display();
        SAID.call_once(|| args.say(&format!("{folder}: files cannot be locked here: jobs may be done twice")));
    }
    if job.result.is_file() {
        // The other runner removed the lock file when it had written the result.
        let _ = std::fs::remove_file(path);
        return Ok(Ended::Elsewhere);
    }
    // The time per iteration covers all runs of the job.
    let line = |at_a_time: usize| format!("{AT_A_TIME}{at_a_time}\n");
    let mut file = lock.file();
    let was_so = |file: &File| io::read_to_string(file).is_ok_and(|lock| lock.starts_with(&line(at_a_time)));
    let is_begun = job.is_begun();
    let at_a_time = if is_begun && !was_so(file) { 0 } else { at_a_time };
    let mut command = Command::new(this_program()?);
    // Name shown in lists of processes.
    #[cfg(unix)]
    command.arg0(std::env::args_os().next().unwrap_or_else(|| "centaur".into()));
    command.args(job.command()).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    file.set_len(0)
        .and_then(|()| file.rewind())
        .and_then(|()| file.write_all(line(at_a_time).as_bytes()))
        .with_context(|| format!("{}: expected a lock file that can be written", path.display()))?;
    if cfg!(unix) {
        // As its stderr, the training holds the lock, too, until it ends: after this process is killed, it still writes
        // a checkpoint. On Windows a lock belongs to one process, and keeps others from writing.
        command.stderr(file.try_clone().context("cannot hold a lock")?);
    }
    let mut child = command.spawn().context("cannot start a training")?;
    // The training stops, with a checkpoint, when its stdin closes: at Ctrl-C, a termination, a hangup, and when this
    // process is killed.
    let mut input = child.stdin.take();
    let waiting = std::thread::spawn(move || child.wait_with_output());
    while !waiting.is_finished() {
        if stop.load(Ordering::Relaxed) {
            drop(input.take());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    let output = waiting.join().map_err(|_| anyhow!("cannot wait"))?.context("cannot wait for a training")?;
    let printed: serde_json::Result<Value> = serde_json::from_slice(&output.stdout);
    // Its exit code is that of a signal then.
    if printed.as_ref().is_ok_and(|result| result["outcome"] == "interrupted") {
        return Ok(Ended::Interrupted);
    }
    if !output.status.success() {
        let messages = if cfg!(unix) { std::fs::read(&path).unwrap_or_default() } else { output.stderr };
        let messages = String::from_utf8_lossy(&messages);
        // Notes on the way are no reason.
        let is_other =
            |line: &str| line.trim().is_empty() || line.starts_with(AT_A_TIME) || line.starts_with(r#"{"note":"#);
        let mut lines = messages.lines().filter(|line| !is_other(line));
        let last = lines.next_back().unwrap_or("no message").trim_start_matches("error: ");
        let advice = if is_begun { advice(last, &job.checkpoint()) } else { "" };
        bail!("{last}{advice} ({})", output.status);
    }
    let mut result = printed.context("a training printed no JSON")?;
    result["job"] = {
        let made = job.made(at_a_time);
        serde_json::to_value(Made { capture: job.fingerprint(jobs::images_of(&made).as_deref()), ..made })?
    };
    atomic_write(&job.result, &serde_json::to_vec_pretty(&result)?)?;
    // Runners that lock it next check for the result first.
    let _ = std::fs::remove_file(path);
    Ok(Ended::Done(record::notes(&result).map(str::to_owned).collect()))
}

/// What to do where a training does not go on from its checkpoint, such as after a change of the flags: as a job it
/// always tries to.
fn advice(reason: &str, checkpoint: &Path) -> &'static str {
    let is_refused = reason.strip_prefix(&*checkpoint.to_string_lossy()).is_some_and(|why| why.contains(": expected "));
    if is_refused { ": delete that file to do the job anew, or give the variant another name" } else { "" }
}

/// Path of the running program, even if another has replaced it, such as a new installation: all jobs are done by one
/// program.
fn this_program() -> Result<PathBuf> {
    let running = Path::new("/proc/self/exe");
    if cfg!(target_os = "linux") && running.exists() {
        return Ok(running.to_owned());
    }
    std::env::current_exe().context("cannot find this program")
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;
    use crate::cli::{self, Cli};

    #[test]
    fn who_has_done_all_is_not_stopped() {
        let cli = Cli::try_parse_from(["centaur", "bench", "scenes", "-o", "out"]).unwrap();
        let cli::Command::Bench(args) = cli.command else { unreachable!() };
        let outcome = attempt(&[], &args, &AtomicBool::new(true));
        assert!(!outcome.is_stopped && outcome.left.is_empty());
    }
}
