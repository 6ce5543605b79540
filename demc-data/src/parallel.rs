//! Work on many items at once, on threads of its own: those of a pool may be waiting for the thread that asks, as the
//! ones that train do for their loader.

use std::num::NonZero;
use std::panic::resume_unwind;
use std::thread;

/// How many processors there are for this process.
pub(crate) fn processors() -> usize {
    thread::available_parallelism().map_or(1, NonZero::get)
}

/// What `work` makes of each item, in their order, on so many threads; with one, or for one item, on this thread.
pub(crate) fn map<T: Send, U: Send>(
    threads: usize,
    items: Vec<T>,
    work: impl Fn(T) -> U + Sync,
) -> Vec<U> {
    let share = items.len().div_ceil(threads.max(1)).max(1);
    let count = items.len();
    let mut items = items.into_iter();
    let work = &work;
    let mut next = || -> Vec<T> { items.by_ref().take(share).collect() };
    let mine = next();
    thread::scope(|scope| {
        let others: Vec<_> = (share..count)
            .step_by(share)
            .map(|_| {
                let theirs = next();
                scope.spawn(move || theirs.into_iter().map(work).collect::<Vec<U>>())
            })
            .collect();
        let mut done: Vec<U> = mine.into_iter().map(work).collect();
        for other in others {
            done.extend(other.join().unwrap_or_else(|panic| resume_unwind(panic)));
        }
        done
    })
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use super::*;

    #[test]
    fn results_stand_in_the_order_of_the_items() {
        for threads in [0, 1, 2, 3, 7, 100] {
            for count in [0, 1, 2, 3, 10] {
                let tripled = map(threads, (0..count).collect(), |item| 3 * item);
                let expected: Vec<usize> = (0..count).map(|item| 3 * item).collect();
                assert_eq!(tripled, expected, "{threads} threads");
            }
        }
    }

    #[test]
    fn a_panic_comes_back() {
        let work = |item: usize| assert!(item != 3);
        let panicked = catch_unwind(AssertUnwindSafe(|| map(2, (0..4).collect(), work)));
        assert!(panicked.is_err());
    }
}
