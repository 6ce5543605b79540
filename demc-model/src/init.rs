//! Initial weights as pure functions (Sec. 4.2): Xavier, the bilinear deconvolution, the identity
//! skip fusion.
//!
//! The host initialises the weights from the caller's generator, in the fixed order of the modules.
//! So a seed gives the same network on every device.

use rand::{Rng, RngExt};

/// Factor of the Xavier weights of a grey head. Ours: with 0.1 no output starts below zero.
pub const GREY_HEAD_SCALE: f32 = 0.1;

/// Initial bias of an open detail map. Ours: the output of its convolution has a standard deviation
/// of about 1.
pub const OPEN_BIAS: f32 = 1.0;

/// Initialisation of one tensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    /// Zero: biases; the shift and the running mean of a batch normalisation.
    Zeros,
    /// One: the scale and the running variance of a batch normalisation.
    Ones,
    /// Xavier uniform (Glorot and Bengio 2010) times a factor: convolutions.
    Xavier(f32),
    /// The bilinear up-sampling kernel at `w[j, j]`, zero elsewhere: deconvolutions.
    Bilinear,
    /// `[I I I]` (Eq. 3): the skip fusion starts as the sum of its inputs.
    IdentitySum,
    /// `[I 0]`: a fusion that starts as its first input.
    IdentityFirst,
    /// Three given values: the bias of a grey head or of an open detail map.
    Color([f32; 3]),
}

impl Init {
    /// The values of a tensor of this shape, row-major.
    ///
    /// # Shapes
    /// `[out, in, h, w]` for `Xavier` and both identities, `[in, out, 4, 4]` for `Bilinear`, `[3]`
    /// for `Color`.
    ///
    /// # Panics
    /// If the shape does not fit, which is a bug of the module that asks.
    pub fn values(self, shape: &[usize], rng: &mut impl Rng) -> Vec<f32> {
        let len = shape.iter().product();
        match self {
            Init::Zeros => vec![0.0; len],
            Init::Ones => vec![1.0; len],
            Init::Xavier(scale) => xavier(shape, scale, rng),
            Init::Bilinear => bilinear(shape),
            Init::IdentitySum => {
                let [out, input, ..] = four(shape);
                assert_eq!(
                    input % out,
                    0,
                    "a skip fusion has a multiple of its outputs as inputs"
                );
                identity_blocks(shape, input / out)
            }
            Init::IdentityFirst => identity_blocks(shape, 1),
            Init::Color(values) => {
                assert_eq!(shape, [3], "a colour has three channels");
                values.to_vec()
            }
        }
    }
}

/// Uniform in +-`scale` * sqrt(6 / (fan_in + fan_out)).
fn xavier(shape: &[usize], scale: f32, rng: &mut impl Rng) -> Vec<f32> {
    let [out, input, height, width] = four(shape);
    let fan_sum = (input + out) * height * width;
    let bound = (6.0 / fan_sum as f32).sqrt();
    (0..shape.iter().product())
        .map(|_| scale * bound * (2.0 * rng.random::<f32>() - 1.0))
        .collect()
}

/// The outer product of [.25 .75 .75 .25] on the diagonal, zero elsewhere. The scheme is that of
/// hdrcnn.
fn bilinear(shape: &[usize]) -> Vec<f32> {
    const TAPS: [f32; 4] = [0.25, 0.75, 0.75, 0.25];
    let [input, out, height, width] = four(shape);
    assert_eq!([height, width], [4, 4], "a bilinear deconvolution is 4x4");
    let mut weight = vec![0.0; input * out * 16];
    for j in 0..input.min(out) {
        let kernel = &mut weight[(j * out + j) * 16..][..16];
        for (k, value) in kernel.iter_mut().enumerate() {
            *value = TAPS[k / 4] * TAPS[k % 4];
        }
    }
    weight
}

/// `[I I ... 0]`: so many identity blocks side by side (Eq. 3), zero elsewhere.
fn identity_blocks(shape: &[usize], blocks: usize) -> Vec<f32> {
    let [out, input, height, width] = four(shape);
    assert_eq!([height, width], [1, 1], "a skip fusion is 1x1");
    let mut weight = vec![0.0; out * input];
    for row in 0..out {
        for block in 0..blocks {
            weight[row * input + block * out + row] = 1.0;
        }
    }
    weight
}

fn four(shape: &[usize]) -> [usize; 4] {
    shape
        .try_into()
        .expect("convolution weights have four axes")
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn xavier_fills_its_range_and_stays_inside() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let weights = Init::Xavier(1.0).values(&[32, 16, 3, 3], &mut rng);
        let bound = (6.0f32 / (48.0 * 9.0)).sqrt();
        let largest = weights.iter().fold(0.0f32, |m, w| m.max(w.abs()));
        assert!(largest <= bound && largest > 0.99 * bound);
        let mean: f32 = weights.iter().sum::<f32>() / weights.len() as f32;
        // The mean of 4608 uniform values has a deviation of bound / sqrt(3 * 4608) = 0.0085 bound.
        // The tolerance is 5 deviations.
        assert!(mean.abs() < 0.043 * bound, "mean {mean}");
    }

    #[test]
    fn the_first_input_of_a_fusion_may_count_alone() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let weights = Init::IdentityFirst.values(&[2, 3, 1, 1], &mut rng);
        assert_eq!(weights, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
    }

    #[test]
    fn bilinear_kernel_sums_to_four_and_stays_on_the_diagonal() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let weights = Init::Bilinear.values(&[3, 2, 4, 4], &mut rng);
        for (block, kernel) in weights.chunks(16).enumerate() {
            let (input, out) = (block / 2, block % 2);
            let expected = if input == out { 4.0 } else { 0.0 };
            assert_eq!(kernel.iter().sum::<f32>(), expected);
        }
        assert_eq!(weights[0], 0.0625);
        assert_eq!(weights[5], 0.5625);
    }

    #[test]
    fn identity_sum_is_a_row_of_identities() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let weights = Init::IdentitySum.values(&[2, 6, 1, 1], &mut rng);
        assert_eq!(weights, [1., 0., 1., 0., 1., 0., 0., 1., 0., 1., 0., 1.]);
    }
}
