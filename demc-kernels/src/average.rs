//! A moving average of weights, in one pass.

use crate::Isa;
use crate::simd::{self, Leaf, Simd};
use crate::tasks::{self, TASK};

/// Moves `average` towards `live` by `share` of the way: `average += share * (live - average)`.
///
/// Each operation is rounded once, so all paths give the same bits.
///
/// # Shapes
/// Both slices have the same length.
///
/// # Panics
/// If the lengths differ.
pub fn update(isa: Isa, average: &mut [f32], live: &[f32], share: f32) {
    assert_eq!(average.len(), live.len(), "average and values of one size");
    let pieces = average.chunks_mut(TASK).zip(live.chunks(TASK));
    tasks::each(pieces, |(average, live)| {
        let leaf = UpdateAverage {
            average,
            live,
            share,
        };
        // SAFETY: the leaf accesses memory through slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });
}

struct UpdateAverage<'a> {
    average: &'a mut [f32],
    live: &'a [f32],
    share: f32,
}

impl Leaf for UpdateAverage<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        for (average, live) in self.average.iter_mut().zip(self.live) {
            *average += self.share * (live - *average);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_within, bits, pattern, same_on_any_number_of_threads};

    #[test]
    fn average_moves_by_its_share() {
        for isa in Isa::available() {
            for size in [0, 1, 7, 33, TASK + 5] {
                let size = if cfg!(miri) { size.min(33) } else { size };
                let (mut average, live) = (pattern(size, 1), pattern(size, 2));
                let expected: Vec<f64> = average
                    .iter()
                    .zip(&live)
                    .map(|(a, l)| f64::from(*a) + 0.25 * (f64::from(*l) - f64::from(*a)))
                    .collect();
                update(isa, &mut average, &live, 0.25);
                assert_within(&format!("{isa}, {size} values"), &average, &expected, 1e-6);
            }
        }
    }

    #[test]
    fn a_share_of_one_gives_the_value_and_zero_changes_nothing() {
        let (before, live) = (pattern(40, 1), vec![2.0; 40]);
        let mut average = vec![1.0; 40];
        update(Isa::current(), &mut average, &live, 1.0);
        assert_eq!(average, live);
        let mut average = before.clone();
        update(Isa::current(), &mut average, &live, 0.0);
        assert_eq!(average, before);
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes minutes")]
    fn bits_depend_neither_on_the_path_nor_on_the_threads() {
        let work = |isa| {
            let mut average = pattern(3 * TASK + 5, 1);
            update(isa, &mut average, &pattern(3 * TASK + 5, 2), 0.001);
            bits(&average)
        };
        for isa in Isa::available() {
            assert!(work(isa) == work(Isa::Portable), "{isa}");
            same_on_any_number_of_threads(|| work(isa));
        }
    }
}
