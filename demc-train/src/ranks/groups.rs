//! Groups of ranks that work on different tasks at the same time.

use anyhow::anyhow;
use demc_program::message::silence;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::Reduce;

impl Reduce {
    /// Deals out `tasks` to groups of ranks: as large as the number of tasks allows, of a size that
    /// `fits`. A group ends when `work` returns a value. Returns the first such value on every rank.
    ///
    /// Rank 0 of each group prints.
    ///
    /// # Errors
    /// Those of `work`.
    pub fn in_groups<T, S: Serialize + DeserializeOwned>(
        &self,
        tasks: &[T],
        fits: impl Fn(usize) -> bool,
        mut work: impl FnMut(&Reduce, &T) -> anyhow::Result<Option<S>>,
    ) -> anyhow::Result<Option<S>> {
        let most = (self.count() / tasks.len().max(1)).max(1);
        let size = (1..=most).rev().find(|size| fits(*size)).unwrap_or(1);
        let groups = self.count() / size;
        let (group, number) = self.split(size);
        silence(!group.is_first());
        // Ranks that are too few for a group wait.
        let first = if number < groups { number } else { tasks.len() };
        let mut found = None;
        for task in tasks.iter().skip(first).step_by(groups) {
            found = work(&group, task).map_err(|error| {
                // The other groups do not know of an error.
                if groups == 1 {
                    error
                } else {
                    anyhow!("{error:#}")
                }
            })?;
            if found.is_some() {
                break;
            }
        }
        let found = self.gather(Ok(found))?.into_iter().flatten().next();
        silence(!self.is_first());
        Ok(found)
    }
}
