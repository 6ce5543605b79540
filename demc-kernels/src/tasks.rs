//! Distribution of work over threads. Pieces have a fixed size, so results have the same bits for
//! any number of threads.

use rayon::prelude::*;

use crate::Isa;

/// Values per piece: 64 KiB of float32. This pays for a task and fits a core's own cache.
pub(crate) const TASK: usize = 16 * 1024;

/// Number of whole rows of `row` values in a piece, at least one.
pub(crate) fn rows_per_task(row: usize) -> usize {
    (TASK / row.max(1)).max(1)
}

/// The path for plain passes over memory, which give the same bits on each path. Vectors of 256
/// bits are faster than those of 512 there: BatchNorm's backward pass over 17 MB maps ran at 38
/// against 26 GB/s (EPYC, Zen 4).
pub(crate) fn streaming(isa: Isa) -> Isa {
    if isa == Isa::Avx512 { Isa::Avx2 } else { isa }
}

/// Starts this number of threads for all kernels of the process. Without it, rayon starts them at the
/// first use, as many as `RAYON_NUM_THREADS` asks for.
///
/// # Errors
/// The threads run already, or the system cannot start them.
pub fn start_threads(count: usize) -> Result<(), rayon::ThreadPoolBuildError> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(count);
    pool.build_global()
}

/// Runs `work`, such as a whole training run, on one of the kernels' threads. From another thread,
/// every kernel hands its work over and waits. These two wake-ups per kernel cost a tenth of a
/// training step at C = 16.
pub fn within_pool<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    rayon::scope(|_| work())
}

/// Runs `work` on each piece. A single piece runs on the calling thread.
pub(crate) fn each<P: Send>(pieces: impl Iterator<Item = P>, work: impl Fn(P) + Sync + Send) {
    map(pieces, work);
}

pub(crate) fn map<P: Send, R: Send>(
    pieces: impl Iterator<Item = P>,
    work: impl Fn(P) -> R + Sync + Send,
) -> Vec<R> {
    let pieces: Vec<P> = pieces.collect();
    if pieces.len() <= 1 {
        return pieces.into_iter().map(work).collect();
    }
    pieces.into_par_iter().map(work).collect()
}

#[cfg(test)]
mod tests {
    #[test]
    fn pieces_come_back_in_order() {
        let doubled = super::map(0..100, |i| 2 * i);
        assert!(doubled.into_iter().eq((0..200).step_by(2)));
        assert_eq!(super::rows_per_task(1 << 20), 1);
    }
}
