//! Parallel work on separate threads. The threads of a pool may wait for the calling thread, as
//! training threads wait for their loader, so a pool could deadlock.

use std::env;
use std::num::NonZero;
use std::panic::resume_unwind;
use std::sync::{Mutex, OnceLock, PoisonError};
use std::thread::{self, Builder};

/// The variable that limits rayon's pool also limits these threads.
const LIMIT: &str = "RAYON_NUM_THREADS";

/// Number of threads: [`LIMIT`], or the number of processors available to this process.
pub(crate) fn available() -> usize {
    static AVAILABLE: OnceLock<usize> = OnceLock::new();
    *AVAILABLE.get_or_init(|| {
        let processors = thread::available_parallelism().map_or(1, NonZero::get);
        limited(env::var(LIMIT).ok().as_deref(), processors)
    })
}

/// Reads the variable as rayon does: ignores 0 and values that are not numbers.
fn limited(variable: Option<&str>, processors: usize) -> usize {
    let asked = variable.and_then(|value| value.parse().ok());
    asked.filter(|threads| *threads > 0).unwrap_or(processors)
}

/// Maps `work` over the items, in order, on this many threads including the calling one. If the
/// system cannot start more threads, the available ones do the work.
pub(crate) fn map<T: Send, U: Send>(
    threads: usize,
    items: Vec<T>,
    work: impl Fn(T) -> U + Sync,
) -> Vec<U> {
    if threads.min(items.len()) <= 1 {
        return items.into_iter().map(work).collect();
    }
    let threads = threads.min(items.len());
    let queue = Mutex::new(items.into_iter().enumerate());
    let next = || queue.lock().unwrap_or_else(PoisonError::into_inner).next();
    let share = || {
        let mut done = Vec::new();
        while let Some((index, item)) = next() {
            done.push((index, work(item)));
        }
        done
    };
    let mut done: Vec<(usize, U)> = thread::scope(|scope| {
        let others: Vec<_> = (1..threads)
            .map_while(|_| Builder::new().spawn_scoped(scope, share).ok())
            .collect();
        let mut done = share();
        for other in others {
            done.extend(other.join().unwrap_or_else(|panic| resume_unwind(panic)));
        }
        done
    });
    done.sort_unstable_by_key(|(index, _)| *index);
    done.into_iter().map(|(_, result)| result).collect()
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use super::*;

    #[test]
    fn results_stand_in_the_order_of_the_items() {
        for threads in [0, 1, 2, 3, 7, 100] {
            for count in [0, 1, 2, 3, 10, 1000] {
                let tripled = map(threads, (0..count).collect(), |item| 3 * item);
                let expected: Vec<usize> = (0..count).map(|item| 3 * item).collect();
                assert_eq!(tripled, expected, "{threads} threads");
            }
        }
    }

    #[test]
    fn rayons_variable_limits_the_threads() {
        for (variable, threads) in [("1", 1), ("3", 3), ("0", 8), ("", 8), ("two", 8)] {
            assert_eq!(limited(Some(variable), 8), threads, "{variable:?}");
        }
        assert_eq!(limited(None, 8), 8);
    }

    #[test]
    fn a_panic_comes_back() {
        let work = |item: usize| assert!(item != 3);
        let panicked = catch_unwind(AssertUnwindSafe(|| map(2, (0..4).collect(), work)));
        assert!(panicked.is_err());
    }
}
