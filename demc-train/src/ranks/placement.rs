//! Where the ranks run: their nodes, and the line at the start that says so.

use std::fmt;

use serde::{Deserialize, Serialize};

/// A process among those of its node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NodeShare {
    /// From 0.
    pub index: usize,
    /// At least 1.
    pub count: usize,
}

/// A process without others on its node.
pub(super) const ALONE: NodeShare = NodeShare { index: 0, count: 1 };

/// Where a rank runs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Place {
    /// Name of its node.
    pub(super) node: String,
    /// Its threads.
    pub(super) threads: usize,
    /// Its device.
    pub(super) device: String,
}

/// The places of all ranks, and the number of gradient values.
pub(super) struct Placement<'a>(pub(super) &'a [Place], pub(super) u64);

impl fmt::Display for Placement<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Placement(places, floats) = self;
        let distinct = |of: fn(&Place) -> String| {
            let mut texts: Vec<String> = places.iter().map(of).collect();
            texts.sort();
            texts.dedup();
            texts
        };
        let nodes = distinct(|place| place.node.clone());
        let threads = distinct(|place| place.threads.to_string());
        let devices = distinct(|place| place.device.clone());
        let count = places.len() as f64;
        let bytes = 2.0 * (count - 1.0) / count * *floats as f64 * 4.0;
        write!(
            f,
            "{} ranks on {} node(s) ({}), threads per rank: {}, device: {}, each sends {:.1} MB per step",
            places.len(),
            nodes.len(),
            demc_program::message::short_list(&nodes),
            threads.join(" or "),
            devices.join(", "),
            bytes / 1e6
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_names_what_differs() {
        let place = |node: &str, threads: usize| Place {
            node: node.into(),
            threads,
            device: "flex".into(),
        };
        let places = [place("b", 2), place("a", 2), place("b", 4), place("a", 2)];
        assert_eq!(
            Placement(&places, 1_000_000).to_string(),
            "4 ranks on 2 node(s) (a, b), threads per rank: 2 or 4, device: flex, each sends 6.0 MB per step"
        );
    }
}
