//! Sums of vectors over all ranks, in the order of [`PairwiseSum`].

use std::ops::Range;

use super::Reduce;
use super::group::Group;
use super::tree::{self, Block, PairwiseSum};

impl Reduce {
    /// Sums vectors over all `terms` terms of all ranks in the order of [`PairwiseSum`]. `blocks` are
    /// the sums of this rank's share of the terms.
    ///
    /// # Shapes
    /// All sums have the same length, which is that of the result.
    pub(super) fn sum_blocks(
        &self,
        blocks: Vec<Block<Vec<f32>>>,
        terms: usize,
    ) -> Option<Vec<f32>> {
        match &self.group {
            None => {
                let mut sum = PairwiseSum::default();
                blocks.into_iter().for_each(|block| sum.push(block, add));
                sum.total(add)
            }
            Some(group) => self.timed(|| exchanged(self, group, blocks, terms)),
        }
    }
}

fn add(mut left: Vec<f32>, right: Vec<f32>) -> Vec<f32> {
    for (left, right) in left.iter_mut().zip(right) {
        *left += right;
    }
    left
}

/// Every rank gets a slice of all blocks of all ranks, sums it, and sends its sum to all.
fn exchanged(
    reduce: &Reduce,
    group: &Group,
    blocks: Vec<Block<Vec<f32>>>,
    terms: usize,
) -> Option<Vec<f32>> {
    let length = blocks.first()?.sum.len();
    let slices: Vec<Range<usize>> = (0..reduce.count())
        .map(|rank| reduce.share_of(rank, length))
        .collect();
    let own = reduce.share(length);
    let mut sent = Vec::with_capacity(length * blocks.len());
    for slice in &slices {
        for block in &blocks {
            sent.extend_from_slice(&block.sum[slice.clone()]);
        }
    }
    let shapes: Vec<Vec<Block<()>>> = (0..reduce.count())
        .map(|rank| tree::blocks_of(reduce.share_of(rank, terms)))
        .collect();
    let to: Vec<usize> = slices.iter().map(|s| s.len() * blocks.len()).collect();
    let from: Vec<usize> = shapes.iter().map(|s| s.len() * own.len()).collect();
    drop(blocks);
    let received = group.all_to_all(&sent, &to, &from);
    let mut sum = PairwiseSum::default();
    let mut rest = received.as_slice();
    for shape in shapes.into_iter().flatten() {
        let (values, after) = rest.split_at(own.len());
        rest = after;
        let block = Block {
            first: shape.first,
            terms: shape.terms,
            sum: values.to_vec(),
        };
        sum.push(block, add);
    }
    let total = sum.total(add)?;
    let counts: Vec<usize> = slices.iter().map(Range::len).collect();
    Some(group.gather_floats(&total, &counts))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_rank_sums_its_blocks() {
        let reduce = Reduce::default();
        let block = |first: usize, value: f32| Block {
            first,
            terms: 1,
            sum: vec![value],
        };
        let blocks = vec![block(0, 1.0), block(1, 2.0), block(2, 4.0)];
        assert_eq!(reduce.sum_blocks(blocks, 3), Some(vec![7.0]));
    }
}
