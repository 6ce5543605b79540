//! Work on the crate's own threads, while Python stays responsive.
//!
//! The calling thread releases the GIL and waits. It takes the GIL only to call back and, ten times a
//! second, to check for signals, which Python handles in its main thread alone. No thread that computes
//! ever takes the GIL.

use std::any::Any;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender, TryRecvError};
use std::sync::{Arc, OnceLock};
use std::thread::{self, Builder};
use std::time::Duration;

use demc_infer::compute::on_threads;
use demc_model::ops::{self, ISA_VARIABLE, Isa};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;

use crate::error::{DemcError, exception};

/// Time between two checks for signals.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(100);

/// Time that a thread without other work sleeps while Python runs a callback.
const IDLE_SLEEP: Duration = Duration::from_micros(200);

/// For work that sends no messages.
pub const UNHEARD: Option<fn(Python<'_>, ()) -> PyResult<()>> = None;

/// What the work uses to call back.
pub struct Caller<M> {
    /// `None` if nobody listens.
    messages: Option<Sender<M>>,
    replies: Receiver<()>,
    stopped: Arc<AtomicBool>,
}

impl<M> Caller<M> {
    /// Passes a message to the callback and waits until it returns. Breaks if the callback raised an
    /// exception or a signal arrived: the work should end.
    pub fn call(&self, message: M) -> ControlFlow<()> {
        if let Some(messages) = &self.messages
            && !self.is_stopped()
            && messages.send(message).is_ok()
        {
            // The callback may denoise, too: this thread takes part meanwhile.
            while let Err(TryRecvError::Empty) = self.replies.try_recv() {
                if rayon::yield_now() != Some(rayon::Yield::Executed) {
                    thread::sleep(IDLE_SLEEP);
                }
            }
        }
        if self.is_stopped() {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    }

    /// Whether the work should end.
    fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }
}

/// Runs `work` on the crate's threads without the GIL. `callback` gets the messages of `work` in the
/// calling thread; without it, none are sent.
///
/// # Errors
/// - The exception of the callback or of a signal's handler, after the work has ended.
/// - Limits of the process that are too low, or a fork after an earlier call.
/// - A panic of the work.
pub fn run<M: Send, R: Send>(
    py: Python<'_>,
    work: impl FnOnce(Caller<M>) -> R + Send,
    mut callback: Option<impl FnMut(Python<'_>, M) -> PyResult<()> + Send>,
) -> PyResult<R> {
    check_process()?;
    Isa::from_environment()
        .map_err(|error| DemcError::new_err(format!("{ISA_VARIABLE}: {error}")))?;
    py.detach(|| {
        let stopped = Arc::new(AtomicBool::new(false));
        let (sender, messages) = mpsc::channel();
        let (reply, replies) = mpsc::channel();
        // The sender lives as long as the work, also if nobody listens: its end is the work's end.
        let alive = sender.clone();
        let caller = Caller {
            messages: callback.is_some().then_some(sender),
            replies,
            stopped: stopped.clone(),
        };
        let work = move || {
            let done = on_threads(move || work(caller));
            drop(alive);
            done
        };
        thread::scope(|scope| {
            let worker = Builder::new()
                .name("demc".into())
                .spawn_scoped(scope, work)
                .map_err(|error| {
                    PyRuntimeError::new_err(format!("cannot start a thread: {error}"))
                })?;
            let mut raised = None;
            loop {
                let message = match messages.recv_timeout(SIGNAL_INTERVAL) {
                    Ok(message) => Some(message),
                    Err(RecvTimeoutError::Timeout) => None,
                    Err(RecvTimeoutError::Disconnected) => break,
                };
                let awaited = message.is_some();
                let outcome = Python::attach(|py| {
                    py.check_signals()?;
                    match (&mut callback, message) {
                        (Some(callback), Some(message)) if raised.is_none() => {
                            callback(py, message)
                        }
                        _ => Ok(()),
                    }
                });
                if let Err(error) = outcome {
                    stopped.store(true, Ordering::Relaxed);
                    raised.get_or_insert(error);
                }
                if awaited {
                    // Nobody is left to wait if the work panicked.
                    let _ = reply.send(());
                }
            }
            let done = worker.join();
            ops::return_kept();
            match (raised, done) {
                (Some(error), _) => Err(error),
                (None, Ok(done)) => done.map_err(exception),
                (None, Err(panic)) => Err(internal(&*panic)),
            }
        })
    })
}

/// A child of `fork` has none of the threads that its parent started, and would wait forever.
fn check_process() -> PyResult<()> {
    static STARTED_IN: OnceLock<u32> = OnceLock::new();
    let own = std::process::id();
    if *STARTED_IN.get_or_init(|| own) == own {
        Ok(())
    } else {
        Err(PyRuntimeError::new_err(
            "demc was used before this process was forked, so its threads are missing here; \
             start processes with the method \"spawn\" of multiprocessing",
        ))
    }
}

/// The exception for a panic, which has printed its place on stderr.
fn internal(panic: &(dyn Any + Send)) -> PyErr {
    let text = panic
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| panic.downcast_ref::<&str>().copied());
    PyRuntimeError::new_err(format!(
        "internal error of demc: {}; please report it",
        text.unwrap_or("no message")
    ))
}
