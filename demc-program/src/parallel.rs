//! Parallel work on separate threads. The threads of a pool may wait for the calling thread, as
//! training threads wait for their loader, so a pool could deadlock.

use std::env;
use std::num::NonZero;
use std::panic::resume_unwind;
use std::sync::{Mutex, OnceLock, PoisonError};
use std::thread::{self, Builder};

/// The variable that limits rayon's pool also limits these threads.
const LIMIT: &str = "RAYON_NUM_THREADS";

/// Maximum number of threads per processor. More only cost time: 2500 per processor took 67 s for
/// an image of 64x64 pixels.
const MOST_PER_PROCESSOR: usize = 4;

/// The number of threads that this process computes with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Threads {
    /// At least 1.
    pub count: usize,
    /// Why the variable `RAYON_NUM_THREADS` is not followed.
    pub note: Option<String>,
}

/// Processes like this one that share the processors.
static SHARED_BY: OnceLock<usize> = OnceLock::new();

/// Says how many processes like this one share the processors of this computer. Call it before
/// [`threads`].
pub fn share_processors(processes: usize) {
    SHARED_BY.get_or_init(|| processes.max(1));
}

/// The processors for this process if `processes` share `online` ones and this one may use
/// `available`.
///
/// A process that may use all of them is not bound to any: it gets its share. One that is bound to
/// some gets these, but no more than its share.
fn own_processors(available: usize, online: usize, processes: usize) -> usize {
    available.min(online / processes).max(1)
}

/// `RAYON_NUM_THREADS`, at most four per processor; by default the number of processors available
/// to this process.
pub fn threads() -> &'static Threads {
    static THREADS: OnceLock<Threads> = OnceLock::new();
    THREADS.get_or_init(|| {
        let available = thread::available_parallelism().map_or(1, NonZero::get);
        let processors = match SHARED_BY.get() {
            None | Some(1) => available,
            Some(processes) => {
                let online = online_processors().unwrap_or(available);
                own_processors(available, online, *processes)
            }
        };
        let variable = env::var_os(LIMIT);
        limited(
            variable.map(|value| value.to_string_lossy().into_owned()),
            processors,
        )
    })
}

/// The processors of this computer, where Linux tells.
fn online_processors() -> Option<usize> {
    let status = std::fs::read_to_string("/sys/devices/system/cpu/online").ok()?;
    let counts = status.trim().split(',').map(|range| {
        let (first, last) = range.split_once('-').unwrap_or((range, range));
        Some(last.parse::<usize>().ok()? + 1 - first.parse::<usize>().ok()?)
    });
    counts.sum()
}

/// Reads the variable. As in rayon, 0 is the default.
fn limited(variable: Option<String>, processors: usize) -> Threads {
    let most = MOST_PER_PROCESSOR * processors;
    let variable = variable.unwrap_or_default();
    let (count, problem) = match variable.parse() {
        Ok(0) => (processors, None),
        Ok(count) if count <= most => (count, None),
        // Also a number that does not fit.
        _ if !variable.is_empty() && variable.bytes().all(|byte| byte.is_ascii_digit()) => (
            most,
            Some(format!(
                "at most {MOST_PER_PROCESSOR} threads per processor"
            )),
        ),
        _ if variable.is_empty() => (processors, None),
        _ => (processors, Some("not a number".to_owned())),
    };
    Threads {
        count,
        note: problem.map(|problem| format!("{LIMIT}={variable}: {problem}; {count} are used")),
    }
}

/// Maps `work` over the items, in order, on this many threads including the calling one. If the
/// system cannot start more threads, the available ones do the work.
pub fn map<T: Send, U: Send>(
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
        let read = |variable: &str| {
            let Threads { count, note } = limited(Some(variable.to_owned()), 8);
            (count, note.is_some())
        };
        for (variable, count) in [("1", 1), ("3", 3), ("32", 32), ("0", 8), ("", 8)] {
            assert_eq!(read(variable), (count, false), "{variable:?}");
        }
        let huge = "99999999999999999999999";
        for (variable, count) in [("33", 32), ("5000", 32), (huge, 32), ("two", 8), ("-1", 8)] {
            assert_eq!(read(variable), (count, true), "{variable:?}");
        }
        assert_eq!(
            limited(None, 8),
            Threads {
                count: 8,
                note: None
            }
        );
    }

    #[test]
    fn processes_share_the_processors() {
        // Not bound; bound to one core each; bound to one of two sockets; more processes than cores.
        assert_eq!(own_processors(16, 16, 4), 4);
        assert_eq!(own_processors(1, 16, 4), 1);
        assert_eq!(own_processors(8, 16, 8), 2);
        assert_eq!(own_processors(2, 2, 4), 1);
        assert!(online_processors().is_none_or(|count| count >= 1));
    }

    #[test]
    fn a_panic_comes_back() {
        let work = |item: usize| assert!(item != 3);
        let panicked = catch_unwind(AssertUnwindSafe(|| map(2, (0..4).collect(), work)));
        assert!(panicked.is_err());
    }
}
