//! How an image appears to an eye: what [`flip`](super::flip()) compares.

use std::f32::consts::PI;

use rayon::prelude::*;

use super::color::{
    Color, hunt_lab_from_linear, linear_from_opponent, linear_from_srgb, opponent_from_linear,
};
use super::filter::separable;

/// Pixels per degree of visual angle: 0.7 m from a monitor that is 0.7 m and 3840 pixels wide (the
/// FLIP paper).
const PIXELS_PER_DEGREE: f32 = 0.7 * 3840.0 / 0.7 * (PI / 180.0);
/// Contrast sensitivity of Y, Cx and Cz: two Gaussians `(a, b)` each.
const SENSITIVITY: [[(f32, f32); 2]; 3] = [
    [(1.0, 0.0047), (0.0, 1e-5)],
    [(1.0, 0.0053), (0.0, 1e-5)],
    [(34.1, 0.04), (13.5, 0.025)],
];
/// The largest `b` of [`SENSITIVITY`].
const WIDEST: f32 = 0.04;
/// Width of the edge and point detectors in degrees.
const FEATURE_WIDTH: f32 = 0.082;

/// Colours and features of each pixel.
pub(super) struct Appearance {
    /// Filtered by the contrast sensitivity, in the Hunt-adjusted CIELAB space.
    pub(super) lab: Vec<Color>,
    /// Strength of edges and of points.
    pub(super) features: Vec<[f32; 2]>,
}

impl Appearance {
    pub(super) fn new(display: &[f64], width: usize) -> Self {
        let pixels = display.len() / 3;
        let mut planes = display.chunks(pixels);
        if pixels > 1 && planes.all(|plane| plane.iter().all(|value| *value == plane[0])) {
            // An image of one colour: filters repeat the edge, so all pixels look like a single
            // one.
            let single = Self::new(&[0, 1, 2].map(|c| display[c * pixels]), 1);
            return Self {
                lab: vec![single.lab[0]; pixels],
                features: vec![single.features[0]; pixels],
            };
        }
        let opponent: Vec<Color> = (0..pixels)
            .into_par_iter()
            .map(|i| {
                let value = |c: usize| linear_from_srgb(display[c * pixels + i] as f32);
                opponent_from_linear([value(0), value(1), value(2)])
            })
            .collect();
        let plane = |c: usize| opponent.iter().map(|color| color[c]).collect::<Vec<f32>>();
        let filtered: [Vec<f32>; 3] =
            std::array::from_fn(|c| sensitivity(&plane(c), width, SENSITIVITY[c]));
        let lab = (0..pixels)
            .into_par_iter()
            .map(|i| {
                let rgb = linear_from_opponent([filtered[0][i], filtered[1][i], filtered[2][i]]);
                hunt_lab_from_linear(rgb.map(|x| x.clamp(0.0, 1.0)))
            })
            .collect();
        let grey: Vec<f32> = opponent.iter().map(|c| (c[0] + 16.0) / 116.0).collect();
        Self {
            lab,
            features: features(&grey, width),
        }
    }
}

/// A plane filtered by a contrast sensitivity: two Gaussians with a total weight of 1.
fn sensitivity(plane: &[f32], width: usize, gaussians: [(f32, f32); 2]) -> Vec<f32> {
    let radius = (3.0 * (WIDEST / (2.0 * PI * PI)).sqrt() * PIXELS_PER_DEGREE).ceil() as i32;
    let taps = |b: f32| -> Vec<f32> {
        let degrees = (-radius..=radius).map(|i| i as f32 / PIXELS_PER_DEGREE);
        degrees.map(|x| (-PI * PI * x * x / b).exp()).collect()
    };
    let weighted = gaussians.map(|(a, b)| (a * (PI / b).sqrt(), taps(b)));
    let total: f32 = weighted
        .iter()
        .map(|(weight, taps)| weight * taps.iter().sum::<f32>().powi(2))
        .sum();
    let mut out = vec![0.0; plane.len()];
    for (weight, taps) in weighted.iter().filter(|(weight, _)| *weight > 0.0) {
        // Taps of narrow Gaussians that vanish in single precision are left out.
        let faint = taps.iter().take_while(|tap| **tap < 1e-9).count();
        let taps = &taps[faint..taps.len() - faint];
        let part = separable(plane, width, taps, taps);
        for (out, part) in out.iter_mut().zip(part) {
            *out += weight / total * part;
        }
    }
    out
}

/// Strength of edges and points of a plane of 0 to 1: first and second derivatives of a Gaussian.
fn features(grey: &[f32], width: usize) -> Vec<[f32; 2]> {
    let deviation = 0.5 * FEATURE_WIDTH * PIXELS_PER_DEGREE;
    let radius = (3.0 * deviation).ceil() as i32;
    let taps = |factor: fn(f32) -> f32| -> Vec<f32> {
        let positions = (-radius..=radius).map(|i| i as f32 / deviation);
        let raw: Vec<f32> = positions
            .map(|x| factor(x) * (-x * x / 2.0).exp())
            .collect();
        // Positive and negative taps have a sum of 1 each.
        let weight = |sign: f32| raw.iter().map(|t| (t * sign).max(0.0)).sum::<f32>();
        let (positive, negative) = (weight(1.0), weight(-1.0));
        raw.iter()
            .map(|&t| {
                t / if t > 0.0 {
                    positive
                } else {
                    negative.max(1e-30)
                }
            })
            .collect()
    };
    let blur = taps(|_| 1.0);
    let strength = |derivative: Vec<f32>| -> Vec<f32> {
        let x = separable(grey, width, &derivative, &blur);
        let y = separable(grey, width, &blur, &derivative);
        x.iter()
            .zip(y)
            .map(|(x, y)| (x * x + y * y).sqrt())
            .collect()
    };
    let (edges, points) = (strength(taps(|x| -x)), strength(taps(|x| x * x - 1.0)));
    edges.into_iter().zip(points).map(|(e, p)| [e, p]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn constant(value: f32) -> Vec<f32> {
        vec![value; 3 * 30 * 40]
    }

    #[test]
    fn a_point_is_a_feature() {
        let flat = constant(0.5);
        let mut point = flat.clone();
        for c in 0..3 {
            point[c * 1200 + 15 * 40 + 20] = 1.0;
        }
        let appearance = |hdr: &[f32]| {
            let display: Vec<f64> = hdr.iter().map(|x| f64::from(*x)).collect();
            Appearance::new(&display, 40)
        };
        let (a, b) = (appearance(&flat), appearance(&point));
        let centre = 15 * 40 + 20;
        let [flat, point] = [a.features[centre][1], b.features[centre][1]];
        assert!(flat < 1e-4 && point > 0.01, "{flat} {point}");
        assert!(b.features[0][1] < 1e-4, "no feature far from the point");
    }
}
