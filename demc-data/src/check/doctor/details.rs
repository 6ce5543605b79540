//! Details of an image at fixed and moved places: what noise and edges are compared by.

use crate::check::noise::log_luminance;
use crate::image::frame::Frame;

/// Farthest shift that is tried, in pixels.
pub(super) const FARTHEST: usize = 8;
/// Radius of the mean that is taken from an image.
const RADIUS: usize = 2;
/// Border that moved places do not leave.
const BORDER: usize = FARTHEST + RADIUS;
/// Largest number of compared pixels; of larger images, every few rows count.
const MAX_PIXELS: usize = 1 << 17;

/// Values of an image that are compared with those of another one.
pub(super) struct Details {
    width: usize,
    height: usize,
    values: Vec<f64>,
}

impl Details {
    /// Log luminance without the mean of 5x5 pixels; `None` of a black image.
    pub(super) fn of(image: &[f32], frame: &Frame) -> Option<Self> {
        Some(Self::without_mean(&log_luminance(image)?, frame))
    }

    /// Values without the mean of 5x5 pixels.
    pub(super) fn without_mean(image: &[f64], frame: &Frame) -> Self {
        let Frame { width, height, .. } = *frame;
        let mut values = vec![0.0; image.len()];
        for y in RADIUS..height.saturating_sub(RADIUS) {
            for x in RADIUS..width.saturating_sub(RADIUS) {
                let rows = (y - RADIUS..=y + RADIUS).map(|row| row * width + x - RADIUS);
                let sum: f64 = rows
                    .flat_map(|start| &image[start..=start + 2 * RADIUS])
                    .sum();
                values[y * width + x] = image[y * width + x] - sum / 25.0;
            }
        }
        Self {
            width,
            height,
            values,
        }
    }

    /// The length of the gradient of some planes, up to a largest value.
    pub(super) fn edges(planes: &[Vec<f64>], most: f64, frame: &Frame) -> Self {
        let Frame { width, height, .. } = *frame;
        let mut values = vec![0.0; width * height];
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                let i = y * width + x;
                let lengths = planes.iter().map(|plane| {
                    let across = plane[i + 1] - plane[i - 1];
                    let down = plane[i + width] - plane[i - width];
                    across.hypot(down)
                });
                values[i] = lengths.sum::<f64>().min(most);
            }
        }
        Self {
            width,
            height,
            values,
        }
    }

    /// The image mirrored left to right, and top to bottom.
    pub(super) fn mirrored(&self, across: bool, down: bool) -> Self {
        let (width, height) = (self.width, self.height);
        let place = |i: usize, length: usize, is_mirrored: bool| {
            if is_mirrored { length - 1 - i } else { i }
        };
        let values = (0..width * height).map(|i| {
            let (x, y) = (i % width, i / width);
            self.values[place(y, height, down) * width + place(x, width, across)]
        });
        Self {
            width,
            height,
            values: values.collect(),
        }
    }

    /// The values at a distance from the border, moved by `shift`.
    fn moved(&self, shift: (isize, isize)) -> impl Iterator<Item = f64> {
        let columns = BORDER..self.width.saturating_sub(BORDER).max(BORDER);
        let rows = BORDER..self.height.saturating_sub(BORDER).max(BORDER);
        let step = (columns.len() * rows.len()).div_ceil(MAX_PIXELS).max(1);
        let start = columns.start.wrapping_add_signed(shift.0);
        let rows = rows.step_by(step).map(move |y| {
            let y = y.wrapping_add_signed(shift.1);
            &self.values[y * self.width + start..][..columns.len()]
        });
        rows.flatten().copied()
    }

    /// Number of compared pixels.
    pub(super) fn count(&self) -> usize {
        self.moved((0, 0)).count()
    }

    pub(super) fn variance(&self) -> f64 {
        self.covariance(self, (0, 0))
    }

    /// Mean product with another image, of which the pixel at `shift` is taken.
    pub(super) fn covariance(&self, other: &Self, shift: (isize, isize)) -> f64 {
        let pairs = self.moved((0, 0)).zip(other.moved(shift));
        mean(pairs.map(|(a, b)| a * b))
    }

    /// Pearson's correlation with another image, of which the pixel at `shift` is taken; 0 for a constant.
    pub(super) fn correlation(&self, other: &Self, shift: (isize, isize)) -> f64 {
        let [a, b] = [mean(self.moved((0, 0))), mean(other.moved(shift))];
        let spread = |values: &Self, shift, mean_of: f64| {
            mean(values.moved(shift).map(|x| (x - mean_of).powi(2)))
        };
        let scale = (spread(self, (0, 0), a) * spread(other, shift, b)).sqrt();
        if scale > 0.0 {
            (self.covariance(other, shift) - a * b) / scale
        } else {
            0.0
        }
    }

    /// The median over blocks of 16x16 pixels of the mean square.
    pub(super) fn median_square(&self) -> f64 {
        self.median_of_blocks(|sums| Some(sums.squares / (BLOCK * BLOCK) as f64))
    }

    /// The correlation of a value with those beside and below it, the median over blocks that are not
    /// flat: 0 for noise.
    pub(super) fn neighbours(&self) -> f64 {
        self.median_of_blocks(|sums| {
            (sums.squares > FLAT).then(|| sums.products / (2.0 * sums.squares))
        })
    }

    fn median_of_blocks(&self, value: impl Fn(BlockSums) -> Option<f64>) -> f64 {
        let (columns, rows) = (self.width / BLOCK, self.height / BLOCK);
        let blocks = (0..rows * columns).map(|i| self.sums([i / columns, i % columns]));
        let mut values: Vec<f64> = blocks.filter_map(value).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    }

    fn sums(&self, [row, column]: [usize; 2]) -> BlockSums {
        let mut sums = BlockSums::default();
        let at =
            |y: usize, x: usize| self.values[(row * BLOCK + y) * self.width + column * BLOCK + x];
        for y in 0..BLOCK {
            for x in 0..BLOCK {
                sums.squares += at(y, x).powi(2);
                if x + 1 < BLOCK {
                    sums.products += at(y, x) * at(y, x + 1);
                }
                if y + 1 < BLOCK {
                    sums.products += at(y, x) * at(y + 1, x);
                }
            }
        }
        sums
    }
}

/// Side of a block in pixels.
const BLOCK: usize = 16;
/// Sum of squares up to which a block is flat.
const FLAT: f64 = 1e-9;

/// Sums over a block of pixels.
#[derive(Default)]
struct BlockSums {
    squares: f64,
    /// Of each value with that beside it, and with that below it.
    products: f64,
}

/// All shifts that are tried.
pub(super) fn shifts() -> impl Iterator<Item = (isize, isize)> {
    let reach = FARTHEST as isize;
    (-reach..=reach).flat_map(move |y| (-reach..=reach).map(move |x| (x, y)))
}

pub(super) fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0_usize), |(sum, n), x| (sum + x, n + 1));
    sum / count.max(1) as f64
}
