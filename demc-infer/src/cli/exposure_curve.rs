//! The exposure of a sequence over its frames, smooth enough that a factor from it does not flicker.
//!
//! Few frames are measured. More are measured where neighbouring measurements differ, so that a fade or a cut
//! between them is found. A single bright frame, such as a flash, is left out, and so are frames that are
//! nearly black. The curve is linear between the
//! measured frames, and changes by at most [`MOST_PER_FRAME`]. It depends on the whole sequence alone, not on
//! the frames that one worker of a farm denoises.

use std::collections::BTreeMap;

/// Largest change from a frame to the next one, in stops (ours: a shot fades over 11 stops within a second).
const MOST_PER_FRAME: f64 = 0.5;
/// Number of frames that are measured at first.
const FIRST: usize = 9;
/// Largest number of frames that are measured.
const MOST: usize = 48;
/// Difference of neighbouring measurements above which a frame between them is measured, in stops.
const FINE: f64 = 0.5;

/// Stops below the upper quartile of the measurements from which on a frame counts as black (ours: no factor
/// makes such a frame visible beside the others).
const BLACK: f64 = 14.0;

/// Exposure by frame, in stops.
#[derive(Debug)]
pub struct ExposureCurve {
    /// Frame number and exposure, by frame.
    nodes: Vec<(f64, f64)>,
}

impl ExposureCurve {
    /// Measures frames with these numbers, which are in order. `measure` gets the index of a frame and returns
    /// its exposure in stops, or `None` for an unreadable or black one.
    pub fn measure(numbers: &[u64], mut measure: impl FnMut(usize) -> Option<f64>) -> Self {
        let mut found: BTreeMap<usize, Option<f64>> = BTreeMap::new();
        let last = numbers.len().saturating_sub(1);
        for part in 0..FIRST.min(numbers.len()) {
            let index = part * last / (FIRST.min(numbers.len()) - 1).max(1);
            found.entry(index).or_insert_with(|| measure(index));
        }
        forget_black(&mut found);
        while found.len() < MOST
            && let Some(index) = coarsest(&found)
        {
            let stops = measure(index);
            found.insert(index, stops);
            forget_black(&mut found);
        }
        let known: Vec<(f64, f64)> = found
            .into_iter()
            .filter_map(|(index, stops)| Some((numbers[index] as f64, stops?)))
            .collect();
        Self {
            nodes: without_flashes(&known),
        }
    }

    /// The exposure at a frame; `None` if no frame was measured.
    pub fn at(&self, frame: u64) -> Option<f64> {
        let frame = frame as f64;
        let own = self.linear(frame)?;
        let slack = |node: &(f64, f64)| MOST_PER_FRAME * (frame - node.0).abs();
        let reached = self.nodes.iter().map(|node| node.1 + slack(node));
        let kept = self.nodes.iter().map(|node| node.1 - slack(node));
        // The largest curve below and the smallest one above that change slowly enough.
        Some((reached.fold(own, f64::min) + kept.fold(own, f64::max)) / 2.0)
    }

    fn linear(&self, frame: f64) -> Option<f64> {
        let after = self.nodes.partition_point(|node| node.0 < frame);
        let right = self.nodes.get(after).or(self.nodes.last())?;
        let left = self.nodes[..after].last().unwrap_or(right);
        let length = right.0 - left.0;
        if length <= 0.0 {
            return Some(right.1);
        }
        let share = ((frame - left.0) / length).clamp(0.0, 1.0);
        Some(left.1 + share * (right.1 - left.1))
    }
}

/// Makes measurements far below the others `None`, as those of black frames are.
fn forget_black(found: &mut BTreeMap<usize, Option<f64>>) {
    let mut stops: Vec<f64> = found.values().copied().flatten().collect();
    stops.sort_by(f64::total_cmp);
    // The brightest may be flashes and fireflies.
    let Some(bright) = stops.get(stops.len() * 3 / 4).copied() else {
        return;
    };
    for stops in found.values_mut() {
        stops.take_if(|stops| *stops < bright - BLACK);
    }
}

/// The middle of the neighbouring measurements that differ most; `None` if all are close.
fn coarsest(found: &BTreeMap<usize, Option<f64>>) -> Option<usize> {
    let pairs = found.iter().zip(found.iter().skip(1));
    let gaps = pairs.filter_map(|((a, left), (b, right))| {
        let difference = (left.as_ref()? - right.as_ref()?).abs();
        (difference > FINE && b - a > 1).then_some(((a + b) / 2, difference))
    });
    gaps.max_by(|a, b| a.1.total_cmp(&b.1)).map(|gap| gap.0)
}

/// Each value replaced by the median of it and its neighbours.
fn without_flashes(nodes: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let value = |index: usize| nodes[index.min(nodes.len() - 1)].1;
    let smooth = nodes.iter().enumerate().map(|(index, node)| {
        let mut near = [value(index.saturating_sub(1)), node.1, value(index + 1)];
        near.sort_by(f64::total_cmp);
        (node.0, near[1])
    });
    smooth.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The curve of a sequence from frame 1 on, and the number of measured frames.
    fn curve(stops: &[f64]) -> (ExposureCurve, usize) {
        let numbers: Vec<u64> = (1..=stops.len() as u64).collect();
        let mut count = 0;
        let curve = ExposureCurve::measure(&numbers, |index| {
            count += 1;
            Some(stops[index]).filter(|stops| stops.is_finite())
        });
        (curve, count)
    }

    fn largest_change(curve: &ExposureCurve, frames: u64) -> f64 {
        let changes = (1..frames).map(|frame| {
            let [a, b] = [frame, frame + 1].map(|frame| curve.at(frame).expect("measured"));
            (a - b).abs()
        });
        changes.fold(0.0, f64::max)
    }

    #[test]
    fn a_fade_is_followed_within_half_a_stop() {
        let fade: Vec<f64> = (0..100).map(|i| -11.0 * f64::from(i) / 99.0).collect();
        let (found, count) = curve(&fade);
        assert!(count <= MOST, "{count}");
        for (index, stops) in fade.iter().enumerate() {
            let at = found.at(index as u64 + 1).expect("measured");
            assert!((at - stops).abs() < 0.5, "frame {index}: {at} for {stops}");
        }
    }

    #[test]
    fn a_cut_is_passed_slowly() {
        let cut: Vec<f64> = (0..200).map(|i| if i < 80 { 0.0 } else { 4.0 }).collect();
        let (found, _) = curve(&cut);
        assert!(largest_change(&found, 200) <= MOST_PER_FRAME + 1e-9);
        assert_eq!(found.at(60), Some(0.0));
        assert_eq!(found.at(100), Some(4.0));
        assert!((found.at(80).expect("measured") - 2.0).abs() < 0.6);
    }

    #[test]
    fn a_flash_and_an_unreadable_frame_are_left_out() {
        let mut flash = vec![1.0; 65];
        flash[8] = 9.0;
        let (found, count) = curve(&flash);
        assert!(count > FIRST, "frames around it are measured");
        assert!((1..=65).all(|frame| found.at(frame) == Some(1.0)));
        let mut dark = vec![2.0; 30];
        dark[0] = f64::NAN;
        assert_eq!(curve(&dark).0.at(1), Some(2.0));
        // The last frames are nearly black, the others keep their exposure.
        let mut end = vec![2.0; 40];
        end[36..].fill(-36.0);
        let (found, _) = curve(&end);
        assert!((1..=36).all(|frame| found.at(frame) == Some(2.0)));
        assert_eq!(curve(&[f64::NAN; 3]).0.at(1), None);
        assert_eq!(curve(&[]).0.at(1), None);
        assert_eq!(curve(&[3.0]).0.at(9), Some(3.0));
    }
}
