//! Work over the threads: pieces of a fixed size, so that results are the same bits whatever their number.

use rayon::prelude::*;

/// Values of a piece: 64 KiB of float32, long enough to pay for a task and short enough for a core's own cache.
pub(crate) const TASK: usize = 16 * 1024;

/// Whole rows of `row` values in a piece, at least one.
pub(crate) fn rows_per_task(row: usize) -> usize {
    (TASK / row.max(1)).max(1)
}

/// Does `work` on each piece. A single piece runs here, without waking a thread.
pub(crate) fn each<P: Send>(pieces: impl Iterator<Item = P>, work: impl Fn(P) + Sync + Send) {
    map(pieces, work);
}

/// What `work` makes of each piece, in the order of the pieces.
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

/// What tests of several files share.
#[cfg(test)]
pub(crate) mod tests {
    /// `len` values of a pattern between -1 and 1 with mean near 0, another for each `seed`.
    pub(crate) fn pattern(len: usize, seed: u32) -> Vec<f32> {
        let value = |i: usize| {
            let mixed = (i as u32).wrapping_add(seed.wrapping_mul(7919)).wrapping_mul(2_654_435_761);
            f64::from((mixed ^ mixed >> 15).wrapping_mul(2_246_822_519) >> 8) / f64::from(1 << 23) - 1.0
        };
        (0..len).map(|i| value(i) as f32).collect()
    }

    /// Checks that `work` returns the same on one, two and three threads.
    pub(crate) fn same_on_any_number_of_threads<R: PartialEq + Send>(work: impl Fn() -> R + Sync) {
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            pool.expect("threads").install(&work)
        };
        let one = on(1);
        assert!(one == on(2) && one == on(3), "results differ with the threads");
    }

    /// Bits of values, to compare them NaN and all.
    pub(crate) fn bits(values: &[f32]) -> Vec<u32> {
        values.iter().map(|value| value.to_bits()).collect()
    }

    #[track_caller]
    pub(crate) fn assert_close(found: &[f32], expected: &[f64], tolerance: f64, what: &str) {
        assert_eq!(found.len(), expected.len(), "{what}");
        for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
            let off = (f64::from(*found) - expected).abs();
            assert!(off <= tolerance * (1.0 + expected.abs()), "{what}[{i}]: {found}, not {expected}");
        }
    }

    #[test]
    fn pieces_come_back_in_order() {
        let doubled = super::map(0..100, |i| 2 * i);
        assert!(doubled.into_iter().eq((0..200).step_by(2)));
        assert_eq!(super::rows_per_task(1 << 20), 1);
    }
}
