//! Ctrl-C and, on Unix, terminations: a command that can stops by itself, any other leaves no temporary files behind.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context as _, Result};
use centaur::atomic;

/// Of Ctrl-C, wherever there are signals.
const SIGINT: i32 = 2;

/// Of a command that stops by itself soon after this is set, which has not been asked to yet.
static FLAG: Mutex<Option<Arc<AtomicBool>>> = Mutex::new(None);

/// From here on a signal ends the program as it would any other, but for what [`atomic::abandon_all`] does before. A hangup is left as it
/// is: `nohup` has it ignored.
pub(super) fn handle() -> Result<()> {
    #[cfg(windows)]
    ctrlc::set_handler(|| obey(SIGINT)).context("cannot handle Ctrl-C")?;
    // By one thread: of two signals the first is the one that asks.
    #[cfg(unix)]
    {
        use signal_hook::{consts::SIGTERM, iterator::Signals};
        let mut signals = Signals::new([SIGINT, SIGTERM]).context("cannot handle Ctrl-C")?;
        let thread = std::thread::Builder::new().spawn(move || signals.forever().for_each(obey));
        thread.context("cannot handle Ctrl-C")?;
    }
    Ok(())
}

/// A flag for the command to poll, which the next signal sets rather than end the program; the one after that ends it.
pub(super) fn stop_flag() -> Arc<AtomicBool> {
    let flag = Arc::default();
    *FLAG.lock().unwrap_or_else(PoisonError::into_inner) = Some(Arc::clone(&flag));
    flag
}

fn obey(signal: i32) {
    let flag = FLAG.lock().unwrap_or_else(PoisonError::into_inner).take();
    if let Some(flag) = flag {
        return flag.store(true, Ordering::Relaxed);
    }
    atomic::abandon_all();
    // A shell that does one command after the other stops only where a signal has ended one.
    #[cfg(unix)]
    let _ = signal_hook::low_level::emulate_default_handler(signal);
    // As shells have it.
    std::process::exit(128 + signal);
}
