//! Ctrl-C, SIGTERM and SIGHUP: the first signal requests a clean stop, the second stops at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use anyhow::Context;
use serde::{Deserialize, Serialize};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

/// The signals of a user, a batch system and a closed terminal.
#[cfg(unix)]
const SIGNALS: [i32; 3] = [SIGINT, SIGTERM, signal_hook::consts::SIGHUP];
#[cfg(not(unix))]
const SIGNALS: [i32; 2] = [SIGINT, SIGTERM];

/// A signal that stopped a run. Everything up to a step is saved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stopped {
    /// The signal.
    pub signal: i32,
    /// The last step.
    pub step: u64,
}

/// How work that a signal can stop ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome<T> {
    /// The work is complete.
    Complete(T),
    /// A signal stopped it.
    Stopped(Stopped),
}

/// Records signals until it is dropped; after that the first signal ends the process.
pub struct Signals {
    /// The first signal received, or 0.
    received: Arc<AtomicUsize>,
    /// Whether the next signal ends the process.
    armed: Arc<AtomicBool>,
}

impl Signals {
    /// Starts to record signals.
    ///
    /// # Errors
    /// A system that refuses the signal handlers.
    pub fn listen() -> anyhow::Result<Self> {
        let (received, armed) = <(Arc<AtomicUsize>, Arc<AtomicBool>)>::default();
        for signal in SIGNALS {
            // In this order, the signal that arms the shutdown does not trigger it.
            flag::register_conditional_shutdown(signal, exit_code(signal), armed.clone())
                .and_then(|_| flag::register(signal, armed.clone()))
                .and_then(|_| flag::register_usize(signal, received.clone(), signal as usize))
                .with_context(|| format!("installing a handler of signal {signal}"))?;
        }
        Ok(Signals { received, armed })
    }

    /// The signal received, if any.
    pub fn received(&self) -> Option<i32> {
        match self.received.load(Ordering::Relaxed) {
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

/// The exit code of a process that a signal ended, as in shells.
pub fn exit_code(signal: i32) -> i32 {
    128 + signal
}

/// The name of a signal.
pub fn name(signal: i32) -> &'static str {
    signal_hook::low_level::signal_name(signal).unwrap_or("a signal")
}
