//! Batches prepared on background threads. Worker w of W makes batches w, w + W, w + 2 W, ... and
//! sends them through its own channel. The consumer receives from the channels in turn, so the
//! order does not depend on the threads. At most two batches per worker wait.

use std::panic::resume_unwind;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::{self, JoinHandle};

use crate::error::Error;
use crate::training::batch::{Batch, PatchSource};

/// Finished batches that may wait per worker while it makes the next one. A batch of 64 patches of
/// 128 x 128 takes 75 MB.
const AHEAD: usize = 1;

/// Delivers the batches of a run in order. Dropping it ends and joins its threads.
pub struct BatchLoader {
    workers: Vec<Worker>,
    turn: usize,
}

struct Worker {
    /// `None` only while the loader is dropped.
    batches: Option<Receiver<Result<Batch, Error>>>,
    thread: Option<JoinHandle<()>>,
}

impl BatchLoader {
    /// Starts `source.workers()` threads; `start` is the number of the first batch.
    pub fn new(source: Arc<PatchSource>, start: u64) -> Self {
        Self::of_numbers(source, start, |number| number)
    }

    /// As [`new`](Self::new), for a part of all batches: `number(n)` is the number of the nth of them.
    pub fn of_numbers(
        source: Arc<PatchSource>,
        start: u64,
        number: impl Fn(u64) -> u64 + Clone + Send + 'static,
    ) -> Self {
        let stride = source.workers().max(1);
        let worker = |first: u64| {
            let (source, number) = (Arc::clone(&source), number.clone());
            let (sender, batches) = sync_channel(AHEAD);
            let thread = thread::spawn(move || {
                for n in (first..).step_by(stride) {
                    // The receiver is closed when the loader is dropped.
                    if sender.send(source.batch(number(n))).is_err() {
                        break;
                    }
                }
            });
            Worker {
                batches: Some(batches),
                thread: Some(thread),
            }
        };
        let workers = (start..).take(stride).map(worker).collect();
        Self { workers, turn: 0 }
    }

    /// Waits for the next batch.
    ///
    /// # Errors
    /// As [`PatchSource::batch`], for the batch that failed.
    #[expect(
        clippy::should_implement_trait,
        reason = "the stream is endless: an Option would never be None"
    )]
    pub fn next(&mut self) -> Result<Batch, Error> {
        let turn = self.turn;
        self.turn = (turn + 1) % self.workers.len();
        let worker = &mut self.workers[turn];
        let batches = worker.batches.as_ref().expect("it is there until the drop");
        batches
            .recv()
            .unwrap_or_else(|_| match worker.thread.take().map(JoinHandle::join) {
                Some(Err(panic)) => resume_unwind(panic),
                _ => unreachable!("a worker only ends when its receiver is dropped"),
            })
    }
}

impl Drop for BatchLoader {
    fn drop(&mut self) {
        // Closes all receivers first, so that every worker stops at its next delivery.
        for worker in &mut self.workers {
            worker.batches = None;
        }
        for worker in &mut self.workers {
            if let Some(thread) = worker.thread.take() {
                // The thread has already reported its panic, and a drop must not panic.
                let _ = thread.join();
            }
        }
    }
}
