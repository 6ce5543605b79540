//! A moving average of weights, in one pass.

use crate::Isa;
use crate::simd::{self, Leaf, Simd};
use crate::tasks::{self, TASK};

/// Moves `average` towards `live` by `share` of the way: `average += share * (live - average)`.
///
/// Each operation is rounded once: the same bits on every path.
///
/// # Shapes
/// Both slices have one length.
///
/// # Panics
/// Where the lengths differ.
pub fn towards(isa: Isa, average: &mut [f32], live: &[f32], share: f32) {
    assert_eq!(average.len(), live.len(), "average and values of one size");
    let pieces = average.chunks_mut(TASK).zip(live.chunks(TASK));
    tasks::each(pieces, |(average, live)| {
        let leaf = Towards {
            average,
            live,
            share,
        };
        // SAFETY: the leaf has slices only.
        unsafe { simd::run(tasks::streaming(isa), leaf) }
    });
}

struct Towards<'a> {
    average: &'a mut [f32],
    live: &'a [f32],
    share: f32,
}

impl Leaf for Towards<'_> {
    type Out = ();

    /// A plain loop, which the compiler vectorises for the path.
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
    fn average_goes_its_share_of_the_way() {
        for isa in Isa::available() {
            for size in [0, 1, 7, 33, TASK + 5] {
                let size = if cfg!(miri) { size.min(33) } else { size };
                let (mut average, live) = (pattern(size, 1), pattern(size, 2));
                let expected: Vec<f64> = average
                    .iter()
                    .zip(&live)
                    .map(|(a, l)| f64::from(*a) + 0.25 * (f64::from(*l) - f64::from(*a)))
                    .collect();
                towards(isa, &mut average, &live, 0.25);
                assert_within(&format!("{isa}, {size} values"), &average, &expected, 1e-6);
            }
        }
    }

    #[test]
    fn all_of_the_way_is_the_value_and_none_changes_nothing() {
        let (before, live) = (pattern(40, 1), vec![2.0; 40]);
        let mut average = vec![1.0; 40];
        towards(Isa::current(), &mut average, &live, 1.0);
        assert_eq!(average, live);
        let mut average = before.clone();
        towards(Isa::current(), &mut average, &live, 0.0);
        assert_eq!(average, before);
    }

    #[test]
    #[cfg_attr(miri, ignore = "minutes long")]
    fn bits_depend_neither_on_the_path_nor_on_the_threads() {
        let work = |isa| {
            let mut average = pattern(3 * TASK + 5, 1);
            towards(isa, &mut average, &pattern(3 * TASK + 5, 2), 0.001);
            bits(&average)
        };
        for isa in Isa::available() {
            assert!(work(isa) == work(Isa::Portable), "{isa}");
            same_on_any_number_of_threads(|| work(isa));
        }
    }
}
