//! Sums over micro-batches in a fixed order, whatever rank computed them.
//!
//! Floating-point sums depend on their order. Here, two neighbouring blocks of the same size are added
//! as soon as both are there, like the carries of a binary counter: for 4 terms, `(0 + 1) + (2 + 3)`.
//! What remains at the end is added from left to right.

use std::ops::Range;

/// The sum of consecutive terms.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block<T> {
    /// Index of its first term, a multiple of `terms`.
    pub first: usize,
    /// Number of terms, a power of 2.
    pub terms: usize,
    /// Their sum.
    pub sum: T,
}

/// A sum that is under way.
#[derive(Clone, Debug)]
pub struct PairwiseSum<T> {
    blocks: Vec<Block<T>>,
}

impl<T> Default for PairwiseSum<T> {
    fn default() -> Self {
        PairwiseSum { blocks: Vec::new() }
    }
}

impl<T> PairwiseSum<T> {
    /// Adds the block after the last one.
    pub fn push(&mut self, mut block: Block<T>, add: impl Fn(T, T) -> T) {
        while let Some(before) = self.blocks.pop_if(|before| {
            before.terms == block.terms && before.first.is_multiple_of(2 * before.terms)
        }) {
            block = Block {
                first: before.first,
                terms: 2 * before.terms,
                sum: add(before.sum, block.sum),
            };
        }
        self.blocks.push(block);
    }

    /// The blocks so far.
    pub fn into_blocks(self) -> Vec<Block<T>> {
        self.blocks
    }

    /// The whole sum; `None` without a term.
    pub fn total(self, add: impl Fn(T, T) -> T) -> Option<T> {
        self.blocks.into_iter().map(|block| block.sum).reduce(add)
    }
}

/// The blocks of the terms in `share`, which depend on the share alone.
pub fn blocks_of(share: Range<usize>) -> Vec<Block<()>> {
    let mut sum = PairwiseSum::default();
    for first in share {
        let term = Block {
            first,
            terms: 1,
            sum: (),
        };
        sum.push(term, |(), ()| ());
    }
    sum.into_blocks()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn add(left: String, right: String) -> String {
        format!("({left}+{right})")
    }

    /// The blocks of a share, with the order of their sums as text.
    fn blocks(share: Range<usize>) -> Vec<Block<String>> {
        let mut sum = PairwiseSum::default();
        for first in share {
            let term = Block {
                first,
                terms: 1,
                sum: first.to_string(),
            };
            sum.push(term, add);
        }
        sum.into_blocks()
    }

    /// The order in which `ranks` ranks add `terms` terms.
    fn order(terms: usize, ranks: usize) -> String {
        let mut sum = PairwiseSum::default();
        for rank in 0..ranks {
            let share = rank * terms / ranks..(rank + 1) * terms / ranks;
            let found = blocks(share.clone());
            let shape = |block: &Block<String>| (block.first, block.terms);
            let shapes = blocks_of(share).into_iter().map(|b| (b.first, b.terms));
            assert!(shapes.eq(found.iter().map(shape)));
            found.into_iter().for_each(|block| sum.push(block, add));
        }
        sum.total(add).expect("terms")
    }

    #[test]
    fn neighbours_of_one_size_are_added_first() {
        assert_eq!(order(1, 1), "0");
        assert_eq!(order(3, 1), "((0+1)+2)");
        assert_eq!(order(4, 1), "((0+1)+(2+3))");
        assert_eq!(order(6, 1), "(((0+1)+(2+3))+(4+5))");
    }

    #[test]
    fn the_number_of_ranks_does_not_change_the_order() {
        for terms in 1..40 {
            for ranks in 1..=terms {
                assert_eq!(order(terms, ranks), order(terms, 1), "{terms}, {ranks}");
            }
        }
    }
}
