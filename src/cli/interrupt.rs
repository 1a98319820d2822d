//! Handling of Ctrl-C and, on Unix, terminations and hangups: commands that support it stop by themselves, all others
//! leave no temporary files behind.

use std::io::{self, IsTerminal as _, Write as _};
#[cfg(unix)]
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use centaur::atomic;

use super::output;
use super::shared::MessageArgs;

/// Of a terminal that goes away, or a connection to it.
const SIGHUP: i32 = 1;
/// Signal of Ctrl-C, on any system with signals.
const SIGINT: i32 = 2;

/// Interval within which a repeated signal counts as the same request: `timeout` sends two, one to its child and one to
/// the child's group.
const ONE_WISH: Duration = Duration::from_millis(300);

/// Stop request of a command that stops by itself.
struct Stop {
    flag: Arc<AtomicBool>,
    /// Whether it tells a program of it, in JSON.
    json: bool,
    /// By which signal it was asked first.
    by: Option<i32>,
    /// Which signal, of those that end it when they come once more, was the first, and when.
    asked: Option<(i32, Instant)>,
}

static STOP: Mutex<Option<Stop>> = Mutex::new(None);

/// Installs the handlers: from here on, a signal ends the program as usual, but after [`atomic::abandon_all`].
pub(super) fn handle() -> Result<()> {
    #[cfg(windows)]
    ctrlc::set_handler(|| obey(SIGINT)).context("cannot handle Ctrl-C")?;
    // Handled by one thread, so that of two signals the first is the request.
    #[cfg(unix)]
    {
        use signal_hook::{consts, consts::SIGTERM, iterator::Signals};
        // Writing beyond `ulimit -f` then gives an error, as on a full disk, instead of ending the program silently.
        signal_hook::flag::register(consts::SIGXFSZ, Arc::default()).context("cannot handle SIGXFSZ")?;
        let mut signals = Signals::new([SIGINT, SIGTERM]).context("cannot handle Ctrl-C")?;
        if !ignores_hangups() {
            signals.add_signal(SIGHUP).context("cannot handle SIGHUP")?;
        }
        let thread = std::thread::Builder::new().spawn(move || signals.forever().for_each(obey));
        thread.context("cannot handle Ctrl-C")?;
    }
    Ok(())
}

/// Whether `nohup` or a shell has set hangups to be ignored, which is then kept: according to Linux or, elsewhere, to a
/// child.
#[cfg(unix)]
fn ignores_hangups() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    match mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()) {
        Some(mask) => mask & (1 << (SIGHUP - 1)) != 0,
        None => child_ignores_hangups(),
    }
}

/// Whether a child, which inherits what is ignored, survives a hangup.
#[cfg(unix)]
fn child_ignores_hangups() -> bool {
    survives(Command::new("/bin/sh").args(["-c", "kill -HUP $$"]))
}

/// Whether a command that sends itself a signal succeeds.
#[cfg(unix)]
fn survives(command: &mut Command) -> bool {
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok_and(|status| status.success())
}

/// Flag for a command to poll, which the next signal sets instead of ending the program; a further signal ends it.
pub(super) fn stop_flag(messages: &MessageArgs) -> Arc<AtomicBool> {
    let flag = Arc::default();
    let stop = Stop { flag: Arc::clone(&flag), json: messages.json, by: None, asked: None };
    *STOP.lock().unwrap_or_else(PoisonError::into_inner) = Some(stop);
    flag
}

/// The end of a command that has stopped because it was asked to, and has said so: nothing is left to be printed.
#[derive(Debug, thiserror::Error)]
#[error("stopped")]
pub(super) struct Stopped {
    /// As of a program that the signal has ended.
    pub(super) exit_code: u8,
}

/// The end of one whose last words are `printed`, also where nobody reads them: by the signal that asked, or as if by
/// Ctrl-C where none did.
pub(super) fn stopped(printed: Result<()>) -> Result<()> {
    match printed {
        Err(error) if !output::is_read_enough(&error) => Err(error),
        _ => {
            let by = STOP.lock().unwrap_or_else(PoisonError::into_inner).as_ref().and_then(|stop| stop.by);
            Err(Stopped { exit_code: u8::try_from(128 + by.unwrap_or(SIGINT)).unwrap_or(u8::MAX) }.into())
        }
    }
}

/// Says on stderr that the signal was heard, since a step may take minutes; with --quiet, too, which is of what nobody
/// asked for. By a thread of its own: where nobody reads stderr, the next signal is heard all the same.
fn acknowledge(as_json: bool) {
    let _ = std::thread::Builder::new().spawn(move || {
        let said = "stopping after the current step, and keeping what is done; a second time ends at once";
        if as_json {
            return output::say(said, as_json);
        }
        let mut stderr = io::stderr();
        // Starts a new line after a progress bar or the terminal's `^C`.
        let start = if stderr.is_terminal() { "\n" } else { "" };
        let _ = writeln!(stderr, "{start}note: {said}");
    });
}

fn obey(signal: i32) {
    if let Some(stop) = &mut *STOP.lock().unwrap_or_else(PoisonError::into_inner) {
        // A lost terminal sends hangups itself and through its shell, and session managers terminate the rest: these
        // count as one request.
        let is_one_wish = |&mut (by, at): &mut (i32, Instant)| signal == by && at.elapsed() < ONE_WISH;
        if signal == SIGHUP || is_one_wish(stop.asked.get_or_insert_with(|| (signal, Instant::now()))) {
            // Before the command can see that it was asked.
            stop.by = stop.by.or(Some(signal));
            if !stop.flag.swap(true, Ordering::Relaxed) {
                acknowledge(stop.json);
            }
            return;
        }
    }
    atomic::abandon_all();
    // A shell that runs commands in sequence stops only if a signal has ended one.
    #[cfg(unix)]
    let _ = signal_hook::low_level::emulate_default_handler(signal);
    // Exit code by the convention of shells.
    std::process::exit(128 + signal);
}

#[cfg(test)]
mod tests {
    #[cfg(unix)]
    #[test]
    fn a_child_tells_as_well_as_linux_whether_hangups_are_ignored() {
        assert_eq!(super::child_ignores_hangups(), super::ignores_hangups());
    }

    #[cfg(unix)]
    #[test]
    fn a_child_survives_a_hangup_where_it_is_ignored() {
        use std::process::Command;
        let ignoring = r#"trap "" HUP; exec /bin/sh -c "kill -HUP \$\$""#;
        assert!(super::survives(Command::new("/bin/sh").args(["-c", ignoring])));
        // Tests may run under `nohup`; a shell cannot undo that, and other systems have no program that can.
        if cfg!(target_os = "linux") {
            let usual = ["--default-signal=HUP", "/bin/sh", "-c", "kill -HUP $$"];
            assert!(!super::survives(Command::new("env").args(usual)));
        }
    }
}
