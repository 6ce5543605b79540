//! Gives a denoised image the light of the noisy one.
//!
//! The noisy image is right in the mean. The network's image is too dark where it is uncertain: RelMSE
//! (Eq. 5) is least there. With d = noisy - denoised, the
//! light that is missing around a pixel is given back per colour, most of it to bright pixels:
//!
//! - Means over a Gaussian of 12 pixels: m of d, w of denoised^1.5.
//! - v: the variance of m, from d^2. The correction is scaled by max(0, 1 - v / m^2), so noise alone
//!   changes nothing, and a single bright sample little.
//! - The factor on a pixel is 1 + (m / w) denoised^0.5, limited to 0.8 to 1.25.
//!
//! The same is then done with the means of the whole image. Means are taken over blocks of 4x4 pixels;
//! m / w is interpolated between their centres. The result does not depend on tiles or threads.

use demc_model::config::COLOR_CHANNELS;
use rayon::prelude::*;

/// Height and width of a block in pixels.
const BLOCK: usize = 4;
/// Standard deviation of the Gaussian, and its largest distance, in blocks.
const DEVIATION: f64 = 3.0;
const RADIUS: usize = 9;
/// Limits of a factor.
const FACTORS: [f32; 2] = [0.8, 1.25];
/// Weights below this are no light.
const DARK: f64 = 1e-30;

/// The factors on `denoised`, planar as it is.
///
/// # Shapes
/// `noisy` and `denoised` `[3, height, width]` in linear radiance. Negative noisy values count as 0.
///
/// # Panics
/// If a length is another.
pub(super) fn factors(noisy: &[f32], denoised: &[f32], height: usize, width: usize) -> Vec<f32> {
    let pixels = height * width;
    let sizes = [noisy.len(), denoised.len()];
    assert_eq!(sizes, [COLOR_CHANNELS * pixels; 2], "planes of the image");
    let mut factors = vec![1.0; denoised.len()];
    if pixels == 0 {
        return factors;
    }
    let planes = noisy.par_chunks(pixels).zip(denoised.par_chunks(pixels));
    factors
        .par_chunks_mut(pixels)
        .zip(planes)
        .for_each(|(factors, (noisy, denoised))| {
            around(noisy, denoised, width, factors);
            overall(noisy, denoised, width, factors);
        });
    factors
}

/// Multiplies an image by factors.
pub(super) fn multiply(image: &mut [f32], factors: &[f32]) {
    let values = image.par_iter_mut().zip(factors);
    values.for_each(|(value, factor)| *value *= factor);
}

/// Sets the factors of one plane from the means around each pixel.
fn around(noisy: &[f32], denoised: &[f32], width: usize, factors: &mut [f32]) {
    let height = noisy.len() / width;
    let grid = [height.div_ceil(BLOCK), width.div_ceil(BLOCK)];
    let mut blocks = vec![Sums::default(); grid[0] * grid[1]];
    let rows_of_blocks = blocks.par_chunks_mut(grid[1]).enumerate();
    rows_of_blocks.for_each(|(row, blocks)| {
        let pixels = row * BLOCK * width..((row + 1) * BLOCK).min(height) * width;
        let lines = noisy[pixels.clone()].chunks(width);
        for (noisy, denoised) in lines.zip(denoised[pixels].chunks(width)) {
            let pieces = noisy.chunks(BLOCK).zip(denoised.chunks(BLOCK));
            for ((noisy, denoised), block) in pieces.zip(&mut *blocks) {
                block.add_all(noisy, denoised);
            }
        }
    });
    let ratios: Vec<f32> = blurred(&blocks, grid).par_iter().map(Sums::ratio).collect();
    let rows = factors
        .par_chunks_mut(width)
        .zip(denoised.par_chunks(width));
    rows.enumerate().for_each(|(y, (factors, denoised))| {
        let lines = Neighbours::of(y, grid[0]);
        let [top, bottom] = lines.blocks.map(|row| &ratios[row * grid[1]..][..grid[1]]);
        for (x, (factor, &value)) in factors.iter_mut().zip(denoised).enumerate() {
            let columns = Neighbours::of(x, grid[1]);
            let [left, right] = columns.blocks;
            let mix = |row: &[f32]| row[left] + (row[right] - row[left]) * columns.share;
            let ratio = mix(top) + (mix(bottom) - mix(top)) * lines.share;
            *factor = limited(ratio, value);
        }
    });
}

/// Multiplies the factors of one plane by those from the means of the whole image.
fn overall(noisy: &[f32], denoised: &[f32], width: usize, factors: &mut [f32]) {
    // In a fixed order, so that threads change no bit.
    let lines: Vec<Sums> = noisy
        .par_chunks(width)
        .zip(denoised.par_chunks(width))
        .zip(factors.par_chunks(width))
        .map(|((noisy, denoised), factors)| {
            let mut sums = Sums::default();
            for ((noisy, denoised), factor) in noisy.iter().zip(denoised).zip(factors) {
                sums.add(*noisy, denoised * factor);
            }
            sums
        })
        .collect();
    let mut sums = Sums::default();
    lines
        .iter()
        .for_each(|line| sums.add_scaled(line, 1.0, 1.0));
    let ratio = sums.ratio();
    let values = factors.par_iter_mut().zip(denoised);
    values.for_each(|(factor, denoised)| *factor *= limited(ratio, denoised * *factor));
}

/// The factor on a pixel.
fn limited(ratio: f32, denoised: f32) -> f32 {
    let [low, high] = FACTORS;
    (1.0 + ratio * denoised.sqrt()).clamp(low, high)
}

/// The two blocks whose centres are around a pixel's centre.
struct Neighbours {
    blocks: [usize; 2],
    /// The share of the second.
    share: f32,
}

impl Neighbours {
    fn of(pixel: usize, blocks: usize) -> Self {
        let position = ((pixel as f32 + 0.5) / BLOCK as f32 - 0.5).clamp(0.0, (blocks - 1) as f32);
        let first = position as usize;
        Self {
            blocks: [first, (first + 1).min(blocks - 1)],
            share: position - first as f32,
        }
    }
}

/// Sums over pixels.
#[derive(Clone, Copy, Default)]
struct Sums {
    pixels: f64,
    /// Of the missing light.
    missing: f64,
    /// Of its square, with squared weights.
    squares: f64,
    /// Of the denoised image to the power of 1.5.
    weights: f64,
}

impl Sums {
    fn add(&mut self, noisy: f32, denoised: f32) {
        let missing = f64::from(noisy.max(0.0) - denoised);
        self.pixels += 1.0;
        self.missing += missing;
        self.squares += missing * missing;
        self.weights += f64::from(denoised * denoised.sqrt());
    }

    fn add_all(&mut self, noisy: &[f32], denoised: &[f32]) {
        for (noisy, denoised) in noisy.iter().zip(denoised) {
            self.add(*noisy, *denoised);
        }
    }

    fn add_scaled(&mut self, other: &Sums, weight: f64, square: f64) {
        self.pixels += other.pixels * weight;
        self.missing += other.missing * weight;
        self.squares += other.squares * square;
        self.weights += other.weights * weight;
    }

    /// The missing light per weight, less what noise explains.
    fn ratio(&self) -> f32 {
        let missing = self.missing * self.missing;
        if self.weights <= DARK * self.pixels || missing <= self.squares {
            return 0.0;
        }
        ((1.0 - self.squares / missing) * self.missing / self.weights) as f32
    }
}

/// Gaussian sums around each block.
fn blurred(blocks: &[Sums], [rows, columns]: [usize; 2]) -> Vec<Sums> {
    let kernel: [f64; RADIUS + 1] =
        std::array::from_fn(|distance| (-0.5 * (distance as f64 / DEVIATION).powi(2)).exp());
    let sum = |at: usize, count: usize, of: &dyn Fn(usize) -> Sums| {
        let mut sums = Sums::default();
        for other in at.saturating_sub(RADIUS)..(at + RADIUS + 1).min(count) {
            let weight = kernel[at.abs_diff(other)];
            sums.add_scaled(&of(other), weight, weight * weight);
        }
        sums
    };
    let all = 0..rows * columns;
    let across: Vec<Sums> = (all.clone().into_par_iter())
        .map(|i| {
            let row = i / columns * columns;
            sum(i % columns, columns, &|column| blocks[row + column])
        })
        .collect();
    all.into_par_iter()
        .map(|i| {
            let column = i % columns;
            sum(i / columns, rows, &|row| across[row * columns + column])
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [50, 71];

    /// Values from 0 to 1 that look random.
    fn random(count: usize, seed: u32) -> Vec<f32> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        (0..count).map(|_| next()).collect()
    }

    fn image(seed: u32) -> Vec<f32> {
        random(COLOR_CHANNELS * SIZE[0] * SIZE[1], seed)
    }

    fn of(noisy: &[f32], denoised: &[f32]) -> Vec<f32> {
        factors(noisy, denoised, SIZE[0], SIZE[1])
    }

    fn sum(values: impl Iterator<Item = f32>) -> f64 {
        values.map(f64::from).sum()
    }

    #[test]
    fn equal_images_stay() {
        let image = image(1);
        assert!(of(&image, &image).iter().all(|factor| *factor == 1.0));
    }

    #[test]
    fn missing_light_comes_back_per_colour() {
        let pixels = SIZE[0] * SIZE[1];
        let clean: Vec<f32> = image(1).iter().map(|value| 0.2 + value).collect();
        let noise = random(clean.len(), 2);
        let noisy: Vec<f32> = (clean.iter().zip(&noise))
            .map(|(value, noise)| value * 2.0 * noise)
            .collect();
        let losses = [0.9, 1.0, 1.08];
        let denoised: Vec<f32> = (clean.iter().enumerate())
            .map(|(i, value)| value * losses[i / pixels])
            .collect();
        let factors = of(&noisy, &denoised);
        for (color, loss) in losses.into_iter().enumerate() {
            let plane = color * pixels..(color + 1) * pixels;
            let found = sum(
                (denoised[plane.clone()].iter().zip(&factors[plane.clone()])).map(|(a, b)| a * b),
            );
            let light = sum(noisy[plane].iter().copied());
            assert!(
                (found / light - 1.0).abs() < 0.01,
                "{loss}: {found} of {light}"
            );
        }
    }

    #[test]
    fn one_bright_sample_changes_nothing() {
        let denoised = vec![0.3; COLOR_CHANNELS * SIZE[0] * SIZE[1]];
        let mut noisy = denoised.clone();
        noisy[20 * SIZE[1] + 30] = 1e6;
        assert!(of(&noisy, &denoised).iter().all(|factor| *factor == 1.0));
    }

    #[test]
    fn exposure_does_not_matter_and_factors_are_limited() {
        let (noisy, denoised) = (image(3), image(4));
        let expected = of(&noisy, &denoised);
        let [low, high] = FACTORS.map(|factor| factor * factor);
        assert!(expected.iter().all(|factor| (low..=high).contains(factor)));
        for scale in [1e-4, 1e4] {
            let [noisy, denoised] = [&noisy, &denoised]
                .map(|image| -> Vec<f32> { image.iter().map(|x| x * scale).collect() });
            for (found, expected) in of(&noisy, &denoised).iter().zip(&expected) {
                assert!(
                    (found - expected).abs() < 1e-5,
                    "{scale}: {found} is not {expected}"
                );
            }
        }
    }

    #[test]
    fn black_and_tiny_images_have_factors_of_1() {
        let black = vec![0.0; COLOR_CHANNELS];
        assert_eq!(factors(&black, &black, 1, 1), [1.0; COLOR_CHANNELS]);
        let bright = vec![1.0; COLOR_CHANNELS * SIZE[0] * SIZE[1]];
        let black = vec![0.0; bright.len()];
        assert!(of(&bright, &black).iter().all(|factor| *factor == 1.0));
        assert_eq!(factors(&[], &[], 0, 5), Vec::<f32>::new());
    }

    /// The definition, with plain loops over pixels instead of blocks.
    #[test]
    fn blocks_approximate_the_gaussian_of_12_pixels() {
        let [height, width] = SIZE;
        let (noisy, denoised) = (image(5), image(6));
        let found = {
            let mut plane = vec![1.0; height * width];
            around(
                &noisy[..height * width],
                &denoised[..height * width],
                width,
                &mut plane,
            );
            plane
        };
        for [y, x] in [[0usize, 0usize], [25, 30], [49, 70], [13, 2]] {
            let mut sums = Sums::default();
            for v in 0..height {
                for u in 0..width {
                    let square = (y.abs_diff(v).pow(2) + x.abs_diff(u).pow(2)) as f64;
                    let weight: f64 = (-0.5 * square / 144.0).exp();
                    let mut pixel = Sums::default();
                    pixel.add(noisy[v * width + u], denoised[v * width + u]);
                    sums.add_scaled(&pixel, weight, weight * weight);
                }
            }
            let expected = limited(sums.ratio(), denoised[y * width + x]);
            let found = found[y * width + x];
            assert!((found - expected).abs() < 0.01, "{found} is not {expected}");
        }
    }
}
