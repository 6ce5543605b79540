//! `--frames`: the chosen frames of sequences, as lists, ranges and steps.

use std::ops::RangeInclusive;
use std::str::FromStr;

/// Largest number of frames of a range with a step.
const MAX_STEPPED: u64 = 1_000_000;

/// Largest number of gaps that a message names.
const MAX_GAPS: usize = 20;

/// Consecutive frames.
type Run = RangeInclusive<u64>;

/// Frame numbers: `7`, `1-240`, `20-40x2` (every second one), or several of these with commas.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frames {
    /// By number, without overlaps.
    runs: Vec<Run>,
}

impl FromStr for Frames {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut runs = Vec::new();
        for part in text.split(',') {
            add_part(part, &mut runs).map_err(|why| format!("`{part}`: {why}"))?;
        }
        Ok(Self::new(runs))
    }
}

/// Adds the frames of `N`, `FIRST-LAST` or `FIRST-LASTxSTEP` to `runs`.
fn add_part(part: &str, runs: &mut Vec<Run>) -> Result<(), String> {
    let number = |text: &str| {
        text.parse::<u64>()
            .map_err(|_| "expected N, FIRST-LAST or FIRST-LASTxSTEP".to_owned())
    };
    let Some((first, rest)) = part.split_once('-') else {
        let only = number(part)?;
        runs.push(only..=only);
        return Ok(());
    };
    let (last, step) = rest.split_once('x').unwrap_or((rest, "1"));
    let (first, last, step) = (number(first)?, number(last)?, number(step)?);
    if first > last {
        return Err(format!("{first} is after {last}"));
    }
    match step {
        0 => return Err("a step is at least 1".into()),
        1 => runs.push(first..=last),
        _ if (last - first) / step >= MAX_STEPPED => {
            return Err(format!(
                "more than {MAX_STEPPED} frames; use a range without a step"
            ));
        }
        _ => {
            let steps = 0..=(last - first) / step;
            runs.extend(steps.map(|i| first + i * step).map(|frame| frame..=frame));
        }
    }
    Ok(())
}

impl Frames {
    /// The frames of `runs`, which may overlap.
    fn new(mut runs: Vec<Run>) -> Self {
        runs.sort_by_key(|run| *run.start());
        let mut merged: Vec<Run> = Vec::with_capacity(runs.len());
        for run in runs {
            match merged.last_mut() {
                Some(before) if *run.start() <= before.end().saturating_add(1) => {
                    *before = *before.start()..=*before.end().max(run.end());
                }
                _ => merged.push(run),
            }
        }
        Self { runs: merged }
    }

    /// All frames from `first` to `last`.
    pub fn between(first: u64, last: u64) -> Self {
        Self {
            runs: vec![first..=last],
        }
    }

    /// Whether `frame` is chosen.
    pub fn contains(&self, frame: u64) -> bool {
        let after = self.runs.partition_point(|run| *run.start() <= frame);
        after > 0 && self.runs[after - 1].contains(&frame)
    }

    /// These frames up to `last`.
    pub fn up_to(&self, last: u64) -> Self {
        let cut = self
            .runs
            .iter()
            .map(|run| *run.start()..=*run.end().min(&last));
        Self {
            runs: cut.filter(|run| !run.is_empty()).collect(),
        }
    }

    /// The chosen frames that are not in `found`, which is in order.
    pub fn without(&self, found: &[u64]) -> Self {
        let mut runs = Vec::new();
        for run in &self.runs {
            let from = found.partition_point(|number| number < run.start());
            let mut next = Some(*run.start());
            for number in found[from..]
                .iter()
                .take_while(|number| run.contains(number))
            {
                let start = next.unwrap_or(u64::MAX);
                if *number > start {
                    runs.push(start..=number - 1);
                }
                next = number.checked_add(1);
            }
            runs.extend(
                next.filter(|next| next <= run.end())
                    .map(|next| next..=*run.end()),
            );
        }
        Self { runs }
    }

    /// Their number.
    pub fn count(&self) -> u64 {
        let lengths = self.runs.iter().map(|run| run.end() - run.start());
        lengths.fold(0, |sum, length| {
            sum.saturating_add(length).saturating_add(1)
        })
    }

    /// As `1-2, 5`, with 20 parts at most.
    pub fn describe(&self) -> String {
        let part = |run: &Run| {
            if run.start() == run.end() {
                run.start().to_string()
            } else {
                format!("{}-{}", run.start(), run.end())
            }
        };
        let parts: Vec<String> = self.runs.iter().take(MAX_GAPS).map(part).collect();
        let more = if self.runs.len() > MAX_GAPS {
            ", ..."
        } else {
            ""
        };
        parts.join(", ") + more
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(text: &str) -> Frames {
        text.parse().expect("frames")
    }

    #[test]
    fn frames_are_lists_ranges_and_steps() {
        let chosen = frames("1-10,15,20-40x2");
        let listed: Vec<u64> = (0..60).filter(|frame| chosen.contains(*frame)).collect();
        let expected = (1..=10).chain([15]).chain((20..=40).step_by(2));
        assert_eq!(listed, expected.collect::<Vec<_>>());
        assert_eq!(chosen.count(), 22);
        assert_eq!(frames("7"), frames("7-7"));
        assert_eq!(frames("5-6,1-4,3-5,5"), frames("1-6"));
        assert_eq!(frames("1-6x1"), frames("1-6"));
        assert_eq!(frames("1-4x2"), frames("1,3"));
        assert_eq!(frames("0-18446744073709551615").count(), u64::MAX);
    }

    #[test]
    fn wrong_frames_are_named() {
        let wrong = [
            "",
            "a",
            "5-",
            "9-3",
            "1-2-3",
            "-4",
            "1,",
            "1-9x0",
            "1-9x",
            "3x2",
            "1 - 2",
            "1-9999999999x2",
        ];
        for text in wrong {
            assert!(text.parse::<Frames>().is_err(), "{text}");
        }
        let error = "1-4,9-3".parse::<Frames>().expect_err("9 is after 3");
        assert_eq!(error, "`9-3`: 9 is after 3");
    }

    #[test]
    fn gaps_are_counted() {
        let found = [3, 4, 7];
        let missing = |text: &str| frames(text).without(&found).describe();
        assert_eq!(missing("3-7"), "5-6");
        assert_eq!(missing("1-9"), "1-2, 5-6, 8-9");
        assert_eq!(missing("1-7x2"), "1, 5");
        assert_eq!(missing("3,4"), "");
        assert_eq!(frames("1-9,12").up_to(7).without(&found).count(), 4);
        let last = [u64::MAX - 1, u64::MAX];
        let end = Frames::between(u64::MAX - 2, u64::MAX);
        assert_eq!(end.without(&last).describe(), format!("{}", u64::MAX - 2));
        assert_eq!(frames("1-99x2").describe().matches(',').count(), MAX_GAPS);
    }
}
