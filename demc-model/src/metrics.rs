//! RelMSE (Eq. 5) and SSIM (Wang et al. 2004) of images.
//!
//! "RelMSE" and "SSIM" mean many things in this field. `relmse` here is the paper's: it **sums** over the three
//! channels and averages over pixels, in linear HDR. `ssim` is taken on `clip(x, 0, 1)^(1 / 2.2)` with a data range of
//! 1, over the windows that lie fully inside, and averaged over the channels (ours: the paper does not state it).

/// Epsilon of Eq. 5.
pub const LOSS_EPSILON: f32 = 0.001;

/// Gamma of the tone mapping that SSIM and pictures use; the paper's Eq. 4.
pub const DISPLAY_GAMMA: f32 = 2.2;

/// Side of SSIM's Gaussian window, px.
pub const SSIM_WINDOW: usize = 11;

/// Deviation of SSIM's Gaussian window, px.
const SSIM_SIGMA: f64 = 1.5;

/// `relmse` of an image (Eq. 5, epsilon 0.001), in float64.
///
/// # Shapes
/// Two planar `[3, H, W]` in linear HDR.
///
/// # Panics
/// Where the lengths differ or are not three planes.
pub fn rel_mse_image(candidate_hdr: &[f32], reference_hdr: &[f32]) -> f64 {
    assert_eq!(
        candidate_hdr.len(),
        reference_hdr.len(),
        "images of one size"
    );
    assert_eq!(reference_hdr.len() % 3, 0, "three planes");
    let sum: f64 = candidate_hdr
        .iter()
        .zip(reference_hdr)
        .map(|(&c, &r)| {
            let (c, r) = (f64::from(c), f64::from(r));
            (c - r).powi(2) / (r * r + f64::from(LOSS_EPSILON))
        })
        .sum();
    sum / (reference_hdr.len() / 3) as f64
}

/// `ssim` of an image, -1 to 1; `None` for an image smaller than the 11 x 11 window.
///
/// # Shapes
/// Two planar `[3, height, width]` in linear HDR.
///
/// # Panics
/// Where the lengths are others.
pub fn ssim(
    candidate_hdr: &[f32],
    reference_hdr: &[f32],
    height: usize,
    width: usize,
) -> Option<f64> {
    assert_eq!(
        candidate_hdr.len(),
        3 * height * width,
        "three planes of {height} x {width}"
    );
    assert_eq!(
        reference_hdr.len(),
        3 * height * width,
        "three planes of {height} x {width}"
    );
    if height < SSIM_WINDOW || width < SSIM_WINDOW {
        return None;
    }
    let pixels = height * width;
    let channels = candidate_hdr
        .chunks(pixels)
        .zip(reference_hdr.chunks(pixels));
    Some(
        channels
            .map(|(c, r)| ssim_plane(&display(c), &display(r), width))
            .sum::<f64>()
            / 3.0,
    )
}

/// `clip(x, 0, 1)^(1 / 2.2)`.
fn display(plane_hdr: &[f32]) -> Vec<f64> {
    plane_hdr
        .iter()
        .map(|&x| f64::from(x.clamp(0.0, 1.0)).powf(1.0 / f64::from(DISPLAY_GAMMA)))
        .collect()
}

/// Mean over all windows that lie inside, of one channel.
fn ssim_plane(x: &[f64], y: &[f64], width: usize) -> f64 {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect::<Vec<_>>();
    let blur = |plane: &[f64]| blur_valid(plane, width);
    let (mean_x, mean_y) = (blur(x), blur(y));
    let (xx, yy, xy) = (
        blur(&product(x, x)),
        blur(&product(y, y)),
        blur(&product(x, y)),
    );
    let sum: f64 = (0..mean_x.len())
        .map(|i| {
            let (mx, my) = (mean_x[i], mean_y[i]);
            let (vx, vy, cov) = (xx[i] - mx * mx, yy[i] - my * my, xy[i] - mx * my);
            ((2.0 * mx * my + C1) * (2.0 * cov + C2)) / ((mx * mx + my * my + C1) * (vx + vy + C2))
        })
        .sum();
    sum / mean_x.len() as f64
}

/// Gaussian blur, separable, of the pixels whose window lies inside: `[H, W]` to `[H - 10, W - 10]`.
fn blur_valid(plane: &[f64], width: usize) -> Vec<f64> {
    let taps = gaussian();
    let inner = width - SSIM_WINDOW + 1;
    let rows: Vec<f64> = plane
        .chunks(width)
        .flat_map(|row| {
            row.windows(SSIM_WINDOW)
                .map(|w| w.iter().zip(taps).map(|(v, t)| v * t).sum())
        })
        .collect();
    let height = plane.len() / width - SSIM_WINDOW + 1;
    (0..height * inner)
        .map(|i| {
            taps.iter()
                .enumerate()
                .map(|(k, t)| t * rows[i + k * inner])
                .sum()
        })
        .collect()
}

fn gaussian() -> [f64; SSIM_WINDOW] {
    let centre = (SSIM_WINDOW / 2) as f64;
    let raw: [f64; SSIM_WINDOW] = std::array::from_fn(|i| {
        (-(i as f64 - centre).powi(2) / (2.0 * SSIM_SIGMA * SSIM_SIGMA)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|tap| tap / sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(len: usize, seed: u32) -> Vec<f32> {
        let mut state = seed;
        (0..len)
            .map(|_| {
                state = state.wrapping_mul(1664525).wrapping_add(1013904223);
                (state >> 8) as f32 / (1 << 24) as f32
            })
            .collect()
    }

    #[test]
    fn rel_mse_sums_over_channels_and_divides_by_pixels() {
        // Two pixels; errors of 1 against references of 1: six terms of 1 / 1.001 over two pixels.
        let (candidate, reference) = ([2.0; 6], [1.0; 6]);
        let expected = 3.0 / 1.001;
        assert!((rel_mse_image(&candidate, &reference) - expected).abs() < 1e-6);
    }

    #[test]
    fn black_image_scores_nearly_three() {
        assert!((rel_mse_image(&[0.0; 12], &[10.0; 12]) - 3.0).abs() < 1e-4);
    }

    #[test]
    fn ssim_of_an_image_with_itself_is_one_and_symmetric_otherwise() {
        let (a, b) = (pattern(3 * 12 * 16, 3), pattern(3 * 12 * 16, 4));
        assert!((ssim(&a, &a, 12, 16).unwrap() - 1.0).abs() < 1e-12);
        let (ab, ba) = (ssim(&a, &b, 12, 16).unwrap(), ssim(&b, &a, 12, 16).unwrap());
        assert!(ab < 0.5 && (ab - ba).abs() < 1e-12);
    }

    #[test]
    fn ssim_of_two_constants_is_the_luminance_term() {
        let gamma = |x: f64| x.powf(1.0 / 2.2);
        let (x, y) = (gamma(0.25), gamma(0.5));
        let expected = (2.0 * x * y + 1e-4) / (x * x + y * y + 1e-4);
        let found = ssim(&[0.25; 3 * 11 * 11], &[0.5; 3 * 11 * 11], 11, 11).unwrap();
        // DISPLAY_GAMMA is a float32 2.2.
        assert!((found - expected).abs() < 1e-7, "{found} {expected}");
    }

    #[test]
    fn ssim_has_no_value_below_its_window() {
        assert_eq!(ssim(&[0.5; 3 * 10 * 20], &[0.5; 3 * 10 * 20], 10, 20), None);
    }
}
