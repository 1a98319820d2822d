//! Ctrl-C and, on Unix, terminations and hangups: a command that can stops by itself, any other leaves no temporary files behind.

use std::io::{self, IsTerminal as _, Write as _};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use centaur::atomic;

use super::output;

/// Of a terminal that goes away, or a connection to it.
const SIGHUP: i32 = 1;
/// Of Ctrl-C, wherever there are signals.
const SIGINT: i32 = 2;

/// The same signal so soon again is the same wish: `timeout` sends two, one to its child and one to the group that this is in.
const ONE_WISH: Duration = Duration::from_millis(300);

/// How to ask a command that stops by itself.
struct Stop {
    flag: Arc<AtomicBool>,
    /// By which signal it was asked first.
    by: Option<i32>,
    /// Which signal, of those that end it when they come once more, was the first, and when.
    asked: Option<(i32, Instant)>,
}

static STOP: Mutex<Option<Stop>> = Mutex::new(None);

/// From here on a signal ends the program as it would any other, but for what [`atomic::abandon_all`] does before.
pub(super) fn handle() -> Result<()> {
    #[cfg(windows)]
    ctrlc::set_handler(|| obey(SIGINT)).context("cannot handle Ctrl-C")?;
    // By one thread: of two signals the first is the one that asks.
    #[cfg(unix)]
    {
        use signal_hook::{consts, consts::SIGTERM, iterator::Signals};
        // Beyond `ulimit -f` to write is an error then, as on a full disk, and no end without a word.
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

/// Whether `nohup` or a shell has hangups ignored, which then remains so: by Linux's word or, elsewhere, where no message goes to a terminal.
#[cfg(unix)]
fn ignores_hangups() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    match mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()) {
        Some(mask) => mask & (1 << (SIGHUP - 1)) != 0,
        None => !io::stderr().is_terminal(),
    }
}

/// A flag for the command to poll, which the next signal sets rather than end the program; the one after that ends it.
pub(super) fn stop_flag() -> Arc<AtomicBool> {
    let flag = Arc::default();
    *STOP.lock().unwrap_or_else(PoisonError::into_inner) =
        Some(Stop { flag: Arc::clone(&flag), by: None, asked: None });
    flag
}

/// The end of a command that has stopped because it was asked to, and has said so: nothing is left to be printed.
#[derive(Debug, thiserror::Error)]
#[error("stopped")]
pub(super) struct Stopped {
    /// As of a program that the signal has ended.
    pub(super) exit_code: u8,
}

/// The end of one whose last words are `printed`, also where nobody reads them: by the signal that asked, or as if by Ctrl-C where none did.
pub(super) fn stopped(printed: Result<()>) -> Result<()> {
    match printed {
        Err(error) if !output::is_read_enough(&error) => Err(error),
        _ => {
            let by = STOP.lock().unwrap_or_else(PoisonError::into_inner).as_ref().and_then(|stop| stop.by);
            Err(Stopped { exit_code: u8::try_from(128 + by.unwrap_or(SIGINT)).unwrap_or(u8::MAX) }.into())
        }
    }
}

/// Says on stderr that the signal was heard, since a step may take minutes; with --quiet, too, which is of what nobody asked for. By a thread
/// of its own: where nobody reads stderr, the next signal is heard all the same.
fn acknowledge() {
    let _ = std::thread::Builder::new().spawn(|| {
        let mut stderr = io::stderr();
        // Behind a progress bar and the `^C` of a terminal.
        let start = if stderr.is_terminal() { "\n" } else { "" };
        let _ = writeln!(
            stderr,
            "{start}note: stopping after the current step, and keeping what is done; a second time ends at once"
        );
    });
}

fn obey(signal: i32) {
    if let Some(stop) = &mut *STOP.lock().unwrap_or_else(PoisonError::into_inner) {
        // A terminal that goes away hangs up by itself and by its shell, and whoever ends a session terminates what is left: no second wish.
        let is_one_wish = |&mut (by, at): &mut (i32, Instant)| signal == by && at.elapsed() < ONE_WISH;
        if signal == SIGHUP || is_one_wish(stop.asked.get_or_insert_with(|| (signal, Instant::now()))) {
            // Before the command can see that it was asked.
            stop.by = stop.by.or(Some(signal));
            if !stop.flag.swap(true, Ordering::Relaxed) {
                acknowledge();
            }
            return;
        }
    }
    atomic::abandon_all();
    // A shell that does one command after the other stops only where a signal has ended one.
    #[cfg(unix)]
    let _ = signal_hook::low_level::emulate_default_handler(signal);
    // As shells have it.
    std::process::exit(128 + signal);
}
