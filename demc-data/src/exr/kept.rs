//! Decoded blocks that will be asked for again.

use std::collections::HashMap;
use std::mem::size_of;

use ::exr::block::UncompressedBlock;

use super::blocks::Place;

/// By part and place.
type Key = (usize, Place);

/// Decoded blocks of some parts, within a limit.
#[derive(Default)]
pub(super) struct Kept {
    /// The parts whose blocks are kept.
    parts: Vec<usize>,
    blocks: HashMap<Key, UncompressedBlock>,
    /// Bytes of all blocks, and the most that they may be.
    bytes: usize,
    limit: usize,
}

impl Kept {
    /// Keeps blocks of these parts from now on.
    pub(super) fn new(parts: Vec<usize>, limit: usize) -> Self {
        Self {
            parts,
            limit,
            ..Self::default()
        }
    }

    /// Keeps blocks of a part, as many as there is room for.
    pub(super) fn keep(&mut self, part: usize, places: &[Place], blocks: Vec<UncompressedBlock>) {
        if !self.parts.contains(&part) {
            return;
        }
        for (place, block) in places.iter().zip(blocks) {
            let bytes = self.bytes.saturating_add(bytes(&block));
            if bytes <= self.limit {
                self.bytes = bytes;
                self.blocks.insert((part, *place), block);
            }
        }
    }

    /// Takes a block out.
    pub(super) fn take(&mut self, part: usize, place: Place) -> Option<UncompressedBlock> {
        let block = self.blocks.remove(&(part, place))?;
        self.bytes -= bytes(&block);
        Some(block)
    }
}

fn bytes(block: &UncompressedBlock) -> usize {
    block.data.len() + size_of::<Key>() + size_of::<UncompressedBlock>()
}
