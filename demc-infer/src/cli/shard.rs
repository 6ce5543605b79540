//! `--shard I/N`: one worker's part of the work on a farm.

use std::str::FromStr;

/// Part I of N, from 1/N to N/N. `bindings/python/demc/torch/shard.py` deals out in the same way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// From 1 to `count`.
    index: usize,
    count: usize,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |text: &str| text.parse::<usize>().ok();
        let parts = text.split_once('/');
        match parts.map(|(index, count)| (number(index), number(count))) {
            Some((Some(index), Some(count))) if (1..=count).contains(&index) => {
                Ok(Self { index, count })
            }
            _ => Err("expected I/N with I from 1 to N, such as 1/4".into()),
        }
    }
}

impl Shard {
    /// Whether this is shard 1, which reports what concerns all.
    pub fn is_first(self) -> bool {
        self.index == 1
    }

    /// Keeps this shard's items: with all items sorted by name, the `I`th and every `N`th after it.
    /// The order stays.
    pub fn keep<T, Name: Ord>(self, items: &mut Vec<T>, name: impl Fn(&T) -> Name) {
        let mut by_name: Vec<usize> = (0..items.len()).collect();
        by_name.sort_by_key(|item| name(&items[*item]));
        let mut is_own = vec![false; items.len()];
        let own = by_name.into_iter().skip(self.index - 1).step_by(self.count);
        own.for_each(|item| is_own[item] = true);
        let mut kept = is_own.into_iter();
        items.retain(|_| kept.next().unwrap_or(false));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shard_counts_from_1() {
        for wrong in [
            "0/4", "5/4", "0/0", "x", "1", "1/", "/4", "-1/4", "1/4/4", "1.5/4", "",
        ] {
            let error = wrong.parse::<Shard>().expect_err(wrong);
            assert_eq!(error, "expected I/N with I from 1 to N, such as 1/4");
        }
        assert!("1/4".parse::<Shard>().is_ok_and(Shard::is_first));
        assert!("4/4".parse::<Shard>().is_ok_and(|shard| !shard.is_first()));
    }

    #[test]
    fn shards_share_out_the_items_by_name() {
        let of = |text: &str| {
            let mut items = vec!["d", "b", "a", "c", "e"];
            let shard: Shard = text.parse().expect("a shard");
            shard.keep(&mut items, |item| *item);
            items
        };
        assert_eq!(of("1/2"), ["a", "c", "e"]);
        assert_eq!(of("2/2"), ["d", "b"]);
        assert_eq!(of("1/1"), ["d", "b", "a", "c", "e"]);
        assert_eq!(of("7/7"), [""; 0]);
    }
}
