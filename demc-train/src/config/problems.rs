//! The values of a table that are out of range.

use std::fmt::Debug;

/// Upper bound of step counts: a larger number is a typing error. The paper's run has 250,000
/// steps.
pub(super) const MAX_STEPS: u64 = 1_000_000_000;

/// Collects the problems of one table, one line each.
pub(super) struct TableProblems {
    table: &'static str,
    found: Vec<String>,
}

impl TableProblems {
    pub(super) fn of(table: &'static str) -> Self {
        TableProblems {
            table,
            found: Vec::new(),
        }
    }

    /// Adds `table.key = value: must be allowed` unless `holds`.
    pub(super) fn require(&mut self, holds: bool, key: &str, value: &dyn Debug, allowed: &str) {
        if !holds {
            let table = self.table;
            self.found
                .push(format!("{table}.{key} = {value:?}: must be {allowed}"));
        }
    }

    /// Requires an integer from 1 to `most`.
    pub(super) fn require_count(&mut self, key: &str, value: u64, most: u64) {
        let holds = (1..=most).contains(&value);
        self.require(holds, key, &value, &format!("from 1 to {most}"));
    }

    pub(super) fn into_lines(self) -> Vec<String> {
        self.found
    }
}
