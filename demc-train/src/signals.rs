//! Ctrl-C, SIGTERM and SIGHUP: the first asks the run to save and stop, the second stops it at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use anyhow::Context;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

/// What a user, a batch system and a closed terminal send.
#[cfg(unix)]
const SIGNALS: [i32; 3] = [SIGINT, SIGTERM, signal_hook::consts::SIGHUP];
#[cfg(not(unix))]
const SIGNALS: [i32; 2] = [SIGINT, SIGTERM];

/// Listens until it is dropped; after that the first signal ends the process.
pub struct Signals {
    /// 0, or the signal that came.
    came: Arc<AtomicUsize>,
    /// Whether the next signal ends the process.
    armed: Arc<AtomicBool>,
}

impl Signals {
    /// From now on a signal is a wish.
    ///
    /// # Errors
    /// A system that lets nobody listen.
    pub fn listen() -> anyhow::Result<Self> {
        let (came, armed) = <(Arc<AtomicUsize>, Arc<AtomicBool>)>::default();
        for signal in SIGNALS {
            // In this order: the signal that arms does not end the process itself.
            flag::register_conditional_shutdown(signal, exit_code(signal), armed.clone())
                .and_then(|_| flag::register(signal, armed.clone()))
                .and_then(|_| flag::register_usize(signal, came.clone(), signal as usize))
                .with_context(|| format!("listening for signal {signal}"))?;
        }
        Ok(Signals { came, armed })
    }

    /// The signal that came, if one has.
    pub fn came(&self) -> Option<i32> {
        match self.came.load(Ordering::Relaxed) {
            0 => None,
            signal => Some(signal as i32),
        }
    }
}

impl Drop for Signals {
    fn drop(&mut self) {
        self.armed.store(true, Ordering::Relaxed);
    }
}

/// The exit code of a process that a signal ended, as shells have it.
pub fn exit_code(signal: i32) -> i32 {
    128 + signal
}

/// The signal's name.
pub fn name(signal: i32) -> &'static str {
    signal_hook::low_level::signal_name(signal).unwrap_or("a signal")
}
