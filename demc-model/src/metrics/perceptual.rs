//! SSIM (Wang et al. 2004) and PSNR, on `clip(x, 0, 1)^(1 / 2.2)` with a data range of 1.

use rayon::prelude::*;

use super::Image;
use super::filter::{Edge, separable};

/// Side of SSIM's Gaussian window, px.
pub const SSIM_WINDOW: usize = 11;

/// Deviation of SSIM's Gaussian window, px.
const SSIM_SIGMA: f64 = 1.5;

/// `ssim` of an image, -1 to 1; `None` for an image smaller than the 11 x 11 window.
///
/// # Panics
/// Where the sizes differ.
pub fn ssim(candidate: &Image, reference: &Image) -> Option<f64> {
    candidate.assert_size_of(reference);
    let (height, width) = reference.size();
    if height < SSIM_WINDOW || width < SSIM_WINDOW {
        return None;
    }
    let channels = (0..3).into_par_iter();
    let of_channels: Vec<f64> = channels
        .map(|channel| ssim_plane(candidate, reference, channel))
        .collect();
    Some(of_channels.iter().sum::<f64>() / 3.0)
}

/// `psnr` in dB; `None` for images that are displayed alike, which would be infinite.
///
/// # Panics
/// Where the sizes differ.
pub fn psnr(candidate: &Image, reference: &Image) -> Option<f64> {
    candidate.assert_size_of(reference);
    let rows = candidate.display().par_chunks(candidate.size().1);
    let rows = rows.zip(reference.display().par_chunks(candidate.size().1));
    let squares = |(c, r): (&[f64], &[f64])| c.iter().zip(r).map(|(c, r)| (c - r).powi(2)).sum();
    // Added in order: the same number on any number of threads.
    let of_rows: Vec<f64> = rows.map(squares).collect();
    let sum: f64 = of_rows.iter().sum();
    (sum > 0.0).then(|| -10.0 * (sum / reference.display().len() as f64).log10())
}

/// What SSIM needs of one image's channel in all windows that lie inside: Gaussian means of the values and of their squares.
pub(super) struct Moments {
    mean: Vec<f64>,
    square: Vec<f64>,
}

impl Moments {
    /// Of each channel of an image as it is displayed, planar `[3, H, width]`, larger than the window.
    pub(super) fn new(display: &[f64], width: usize) -> Vec<Self> {
        let channels = display.par_chunks(display.len() / 3);
        let moments = channels.map(|plane| Self {
            mean: blur(plane, width),
            square: blur(&product(plane, plane), width),
        });
        moments.collect()
    }
}

/// Mean over all windows that lie inside, of one channel.
fn ssim_plane(candidate: &Image, reference: &Image, channel: usize) -> f64 {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let (height, width) = candidate.size();
    let plane = channel * height * width..(channel + 1) * height * width;
    let display = [candidate, reference].map(|image| &image.display()[plane.clone()]);
    let xy = blur(&product(display[0], display[1]), width);
    let (x, y) = (&candidate.moments()[channel], &reference.moments()[channel]);
    let sum: f64 = (0..xy.len())
        .map(|i| {
            let (mx, my) = (x.mean[i], y.mean[i]);
            let (vx, vy) = (x.square[i] - mx * mx, y.square[i] - my * my);
            let cov = xy[i] - mx * my;
            ((2.0 * mx * my + C1) * (2.0 * cov + C2)) / ((mx * mx + my * my + C1) * (vx + vy + C2))
        })
        .sum();
    sum / xy.len() as f64
}

fn product(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

fn blur(plane: &[f64], width: usize) -> Vec<f64> {
    let taps = gaussian();
    separable(plane, width, &taps, &taps, Edge::Valid)
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

    fn image(hdr: &[f32], height: usize, width: usize) -> Image<'_> {
        Image::new(hdr, height, width).expect("finite")
    }

    #[test]
    fn ssim_of_an_image_with_itself_is_one_and_symmetric_otherwise() {
        let (a, b) = (pattern(3 * 12 * 16, 3), pattern(3 * 12 * 16, 4));
        let (a, b) = (image(&a, 12, 16), image(&b, 12, 16));
        let of = |x, y| ssim(x, y).expect("larger than the window");
        assert!((of(&a, &a) - 1.0).abs() < 1e-12);
        let (ab, ba) = (of(&a, &b), of(&b, &a));
        assert!(ab < 0.5 && (ab - ba).abs() < 1e-12);
    }

    #[test]
    fn ssim_of_two_constants_is_the_luminance_term() {
        let gamma = |x: f64| x.powf(1.0 / 2.2);
        let (x, y) = (gamma(0.25), gamma(0.5));
        let expected = (2.0 * x * y + 1e-4) / (x * x + y * y + 1e-4);
        let (a, b) = ([0.25; 3 * 11 * 11], [0.5; 3 * 11 * 11]);
        let found = ssim(&image(&a, 11, 11), &image(&b, 11, 11)).expect("one window");
        // DISPLAY_GAMMA is a float32 2.2.
        assert!((found - expected).abs() < 1e-7, "{found} {expected}");
    }

    #[test]
    fn ssim_has_no_value_below_its_window() {
        let hdr = [0.5; 3 * 10 * 20];
        let image = image(&hdr, 10, 20);
        assert_eq!(ssim(&image, &image), None);
    }

    #[test]
    fn psnr_of_two_constants_by_hand() {
        let (a, b) = ([1.0; 12], [0.0; 12]);
        let (a, b) = (image(&a, 2, 2), image(&b, 2, 2));
        assert_eq!(psnr(&a, &b), Some(0.0));
        assert_eq!(psnr(&a, &a), None);
    }
}
