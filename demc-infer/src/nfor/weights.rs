//! Weights of NL-means: distances between patches, with the noise of both patches subtracted
//! (Rousselle et al. 2012, Eq. 4 and 5).

use std::ops::Range;

use multiversion::multiversion;

use super::planes::{Planes, TILE, Tile};

/// Largest radius of a patch.
pub(super) const MAX_PATCH: usize = 3;
/// Pixels of a tile.
pub(super) const TILE_PIXELS: usize = TILE * TILE;
/// Side of a tile with the patches of its pixels.
const SIDE: usize = TILE + 2 * MAX_PATCH;
/// Keeps distances finite where there is no noise (Rousselle et al. 2012).
const EPSILON: f32 = 1e-10;
/// Largest distance of two pixels of a channel, so that a bright sample does not hide the rest of a patch.
const MAX_DISTANCE: f32 = 1e4;
/// Weights of larger exponents count as 0 (ours; 4e-18).
const MAX_EXPONENT: f32 = 40.0;

/// What the weights are made from.
pub(super) struct Guide<'a> {
    pub(super) image: &'a Planes,
    /// Variance of the guide's samples, not negative.
    pub(super) variance: &'a Planes,
    /// Radius of a patch, at most [`MAX_PATCH`].
    pub(super) patch: usize,
}

/// A neighbour of a pixel: its place minus that of the pixel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shift {
    pub(super) dy: isize,
    pub(super) dx: isize,
}

/// The neighbours in a window, row by row.
pub(super) fn shifts(radius: usize) -> impl Iterator<Item = Shift> {
    let radius = radius as isize;
    (-radius..=radius).flat_map(move |dy| (-radius..=radius).map(move |dx| Shift { dy, dx }))
}

/// The places from `start - grow` to `start + TILE + grow` that are inside of an axis of this length, and
/// whose neighbours are inside, too.
pub(super) fn inside(start: usize, grow: usize, shift: isize, length: usize) -> Range<isize> {
    let (start, grow, length) = (start as isize, grow as isize, length as isize);
    let first = (start - grow).max(0).max(-shift);
    let end = (start + TILE as isize + grow)
        .min(length)
        .min(length - shift);
    first..end.max(first)
}

/// Intermediate results of distances.
pub(super) struct Scratch {
    /// Distances of pixels, summed over channels.
    pixels: Vec<f32>,
    /// Their sums over the rows of patches.
    rows: Vec<f32>,
}

impl Scratch {
    pub(super) fn new() -> Self {
        Self {
            pixels: vec![0.0; SIDE * SIDE],
            rows: vec![0.0; SIDE * TILE],
        }
    }
}

impl Guide<'_> {
    /// The distances of all pixels of a tile from their neighbours, which are not negative. They are
    /// infinite where pixel or neighbour are outside of the image. A patch at the edge has the pixels
    /// that are inside.
    ///
    /// # Shapes
    /// `distances` is `[TILE, TILE]`.
    pub(super) fn distances(
        &self,
        tile: Tile,
        shift: Shift,
        scratch: &mut Scratch,
        distances: &mut [f32],
    ) {
        let (height, width) = (self.image.height, self.image.width);
        let patch = self.patch;
        let rows = inside(tile.y, patch, shift.dy, height);
        let columns = inside(tile.x, patch, shift.dx, width);
        scratch.pixels.fill(0.0);
        let count = (columns.end - columns.start) as usize;
        if count > 0 {
            for channel in 0..self.image.channels() {
                let area = Area {
                    first_row: rows.start as usize,
                    rows: (rows.end - rows.start) as usize,
                    first_column: columns.start as usize,
                    columns: count,
                    // Of the first pixel in the scratch.
                    offset: (rows.start + patch as isize - tile.y as isize) as usize * SIDE
                        + (columns.start + patch as isize - tile.x as isize) as usize,
                    shift: shift.dy * width as isize + shift.dx,
                    width,
                };
                let (image, variance) = (self.image.plane(channel), self.variance.plane(channel));
                add_distances(&area, image, variance, &mut scratch.pixels);
            }
        }
        sum_patches(patch, &scratch.pixels, &mut scratch.rows, distances);
        let share = |start: usize, shift: isize, range: &Range<isize>, length: usize| {
            shares(start, shift, patch, range, length)
        };
        let of_columns = share(tile.x, shift.dx, &columns, width);
        let of_rows = share(tile.y, shift.dy, &rows, height);
        let of_channels = 1.0 / self.image.channels() as f32;
        for (distances, of_row) in distances.chunks_exact_mut(TILE).zip(of_rows) {
            for (distance, of_column) in distances.iter_mut().zip(of_columns) {
                // Infinite shares mark places outside, but 0 times infinity is NaN.
                let scale = of_row * of_column * of_channels;
                *distance = if scale.is_finite() {
                    (*distance * scale).max(0.0)
                } else {
                    f32::INFINITY
                };
            }
        }
    }
}

/// For each pixel of a tile, one divided by the number of its patch's places along one axis that are in
/// `range`. Infinite where pixel or neighbour are outside.
fn shares(
    start: usize,
    shift: isize,
    patch: usize,
    range: &Range<isize>,
    length: usize,
) -> [f32; TILE] {
    let own = inside(start, 0, shift, length);
    std::array::from_fn(|i| {
        let place = (start + i) as isize;
        if !own.contains(&place) {
            return f32::INFINITY;
        }
        let patch = patch as isize;
        let count = (place + patch + 1).min(range.end) - (place - patch).max(range.start);
        1.0 / count as f32
    })
}

/// The pixels whose distances are computed.
struct Area {
    first_row: usize,
    rows: usize,
    first_column: usize,
    columns: usize,
    /// Index of the first pixel in the scratch.
    offset: usize,
    /// Index of the neighbour minus that of the pixel.
    shift: isize,
    /// Of the image.
    width: usize,
}

/// Adds the distances of one channel.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn add_distances(area: &Area, image: &[f32], variance: &[f32], pixels: &mut [f32]) {
    for row in 0..area.rows {
        let p = (area.first_row + row) * area.width + area.first_column;
        let q = p.wrapping_add_signed(area.shift);
        let out = &mut pixels[area.offset + row * SIDE..][..area.columns];
        let (of_p, of_q) = (&image[p..][..out.len()], &image[q..][..out.len()]);
        let (noise_p, noise_q) = (&variance[p..][..out.len()], &variance[q..][..out.len()]);
        for i in 0..out.len() {
            let difference = of_p[i] - of_q[i];
            let noise = noise_p[i] + noise_q[i];
            let less = if noise_q[i] < noise_p[i] {
                noise_q[i]
            } else {
                noise_p[i]
            };
            let distance = (difference * difference - noise_p[i] - less) / (noise + EPSILON);
            out[i] += if distance < MAX_DISTANCE {
                distance
            } else {
                MAX_DISTANCE
            };
        }
    }
}

/// Sums distances of pixels over patches. Each sum is added up anew: subtracting what leaves a patch
/// would leave the rounding errors of large distances.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn sum_patches(patch: usize, pixels: &[f32], rows: &mut [f32], sums: &mut [f32]) {
    for (pixels, sums) in pixels.chunks_exact(SIDE).zip(rows.chunks_exact_mut(TILE)) {
        sums.copy_from_slice(&pixels[..TILE]);
        for k in 1..=2 * patch {
            for (sum, pixel) in sums.iter_mut().zip(&pixels[k..][..TILE]) {
                *sum += pixel;
            }
        }
    }
    for (y, sums) in sums.chunks_exact_mut(TILE).enumerate() {
        sums.copy_from_slice(&rows[y * TILE..][..TILE]);
        for k in 1..=2 * patch {
            for (sum, row) in sums.iter_mut().zip(&rows[(y + k) * TILE..][..TILE]) {
                *sum += row;
            }
        }
    }
}

/// The weights for distances: `exp(-distance / k^2)` for the bandwidth k.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
pub(super) fn weights(bandwidth: f32, distances: &[f32], weights: &mut [f32]) {
    let factor = 1.0 / (bandwidth * bandwidth);
    for (weight, distance) in weights.iter_mut().zip(distances) {
        let exponent = distance * factor;
        *weight = if exponent < MAX_EXPONENT {
            exp_of_negative(exponent)
        } else {
            0.0
        };
    }
}

/// `exp(-x)` for x from 0 to 40, to 4e-6 of the value: a polynomial that the compiler vectorises.
#[inline(always)]
fn exp_of_negative(x: f32) -> f32 {
    // Adding 1.5 * 2^23 leaves an integer in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    let power = -x * std::f32::consts::LOG2_E;
    let rounded = power + ROUND;
    let rest = (power - (rounded - ROUND)) * std::f32::consts::LN_2;
    let [c2, c3, c4, c5, c6] = [1.0 / 2.0, 1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0, 1.0 / 720.0];
    let series = c2 + rest * (c3 + rest * (c4 + rest * (c5 + rest * c6)));
    let mantissa = 1.0 + rest * (1.0 + rest * series);
    let exponent = (rounded.to_bits() << 23).wrapping_add(1.0_f32.to_bits());
    f32::from_bits(exponent) * mantissa
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_polynomial_is_the_exponential_function() {
        for i in 0..4000 {
            let x = i as f32 / 100.0;
            let exact = (-f64::from(x)).exp();
            let found = f64::from(exp_of_negative(x));
            assert!((found / exact - 1.0).abs() < 4e-6, "{x}: {found} {exact}");
        }
        let mut found = [0.0; 3];
        weights(0.5, &[0.0, 1.0, f32::INFINITY], &mut found);
        assert_eq!((found[0], found[2]), (1.0, 0.0));
        assert!((found[1] - (-4.0_f32).exp()).abs() < 1e-7);
    }

    #[test]
    fn a_distance_is_the_mean_over_a_patch_that_the_edge_cuts() {
        // One row of three pixels without noise: 0, 1, 3, and a patch of three.
        let image = Planes {
            width: 3,
            height: 1,
            samples: vec![0.0, 1.0, 3.0],
        };
        let variance = Planes {
            samples: vec![0.5, 0.25, 0.25],
            ..image
        };
        let guide = Guide {
            image: &image,
            variance: &variance,
            patch: 1,
        };
        let mut found = vec![0.0; TILE_PIXELS];
        let shift = Shift { dy: 0, dx: 1 };
        guide.distances(Tile { y: 0, x: 0 }, shift, &mut Scratch::new(), &mut found);
        // (1 - 0.5 - 0.25) / 0.75 and (4 - 0.25 - 0.25) / 0.5; the third pixel has no neighbour.
        let mean = (1.0 / 3.0 + 7.0) / 2.0;
        for (found, expected) in found.iter().zip([mean, mean, f32::INFINITY]) {
            assert!(
                *found == expected || (found - expected).abs() < 1e-5,
                "{found} {expected}"
            );
        }
        assert!(found[TILE].is_infinite(), "below the image");
    }
}
