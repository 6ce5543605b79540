//! A build without MPI: there is no group of ranks.

use super::placement::{ALONE, NodeShare};

/// A group of ranks. None exists in this build.
pub(super) enum Group {}

/// The start of the program as a single rank.
pub struct Launch;

impl Launch {
    /// Starts as a single rank.
    ///
    /// # Errors
    /// Never.
    pub fn start() -> Result<Self, String> {
        Ok(Launch)
    }

    /// This rank and its node, for messages; `None` for a single rank.
    pub fn name(&self) -> Option<String> {
        None
    }

    /// Whether this rank prints.
    pub fn is_first(&self) -> bool {
        true
    }

    /// This rank among those of its node.
    pub fn on_node(&self) -> NodeShare {
        ALONE
    }
}

/// Ends all ranks. A single rank only returns.
pub fn abort(_code: u8) {}

impl Group {
    pub(super) fn world() -> Option<Self> {
        None
    }

    pub(super) fn split(&self, _number: usize) -> Option<Self> {
        match *self {}
    }

    pub(super) fn rank(&self) -> usize {
        match *self {}
    }

    pub(super) fn count(&self) -> usize {
        match *self {}
    }

    pub(super) fn on_node(&self) -> NodeShare {
        match *self {}
    }

    pub(super) fn node(&self, _rank: usize) -> String {
        match *self {}
    }

    pub(super) fn gather_bytes(&self, _own: &[u8]) -> Vec<Vec<u8>> {
        match *self {}
    }

    pub(super) fn gather_floats(&self, _own: &[f32], _counts: &[usize]) -> Vec<f32> {
        match *self {}
    }

    pub(super) fn all_to_all(&self, _sent: &[f32], _to: &[usize], _from: &[usize]) -> Vec<f32> {
        match *self {}
    }
}
