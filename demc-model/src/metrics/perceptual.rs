//! SSIM (Wang et al. 2004) and PSNR, on `clip(x, 0, 1)^(1 / 2.2)` with a data range of 1.

use multiversion::multiversion;
use rayon::prelude::*;

use super::filter::add;
use super::image::Image;

/// Side of SSIM's Gaussian window in pixels.
pub const SSIM_WINDOW: usize = 11;

/// Standard deviation of SSIM's Gaussian window in pixels.
const SSIM_SIGMA: f64 = 1.5;

/// `ssim` of an image, -1 to 1; `None` for an image smaller than the 11 x 11 window.
///
/// # Panics
/// If the sizes differ.
pub fn ssim(candidate: &Image, reference: &Image) -> Option<f64> {
    candidate.assert_size_of(reference);
    let (height, width) = reference.size();
    if height < SSIM_WINDOW || width < SSIM_WINDOW {
        return None;
    }
    let pixels = height * width;
    let channels = candidate
        .display()
        .chunks(pixels)
        .zip(reference.display().chunks(pixels));
    let sum: f64 = channels.map(|(c, r)| ssim_plane(c, r, width)).sum();
    Some(sum / 3.0)
}

/// `psnr` in dB; `None` for images with equal display values, where it is infinite.
///
/// # Panics
/// If the sizes differ.
pub fn psnr(candidate: &Image, reference: &Image) -> Option<f64> {
    candidate.assert_size_of(reference);
    let rows = candidate
        .display()
        .par_chunks(candidate.size().1)
        .zip(reference.display().par_chunks(candidate.size().1));
    let squares = |(c, r): (&[f64], &[f64])| c.iter().zip(r).map(|(c, r)| (c - r).powi(2)).sum();
    // Summed in order, so that the result does not depend on the number of threads.
    let row_sums: Vec<f64> = rows.map(squares).collect();
    let sum: f64 = row_sums.iter().sum();
    (sum > 0.0).then(|| -10.0 * (sum / reference.display().len() as f64).log10())
}

/// Number of moments that SSIM averages over a window: x, y, x^2, y^2 and xy.
const MOMENTS: usize = 5;

/// Mean of one channel over all windows inside the image. It works row by row and stores no plane.
fn ssim_plane(x: &[f64], y: &[f64], width: usize) -> f64 {
    let taps = gaussian();
    let rows = x.len() / width + 1 - SSIM_WINDOW;
    let inner = width + 1 - SSIM_WINDOW;
    let buffers = || {
        let moments = |len: usize| [(); MOMENTS].map(|()| vec![0.0; len]);
        (moments(width), moments(inner))
    };
    let row_sums: Vec<f64> = (0..rows)
        .into_par_iter()
        .map_init(buffers, |(down, across), row| {
            down.iter_mut().for_each(|moment| moment.fill(0.0));
            for (k, &tap) in taps.iter().enumerate() {
                let line = (row + k) * width..(row + k + 1) * width;
                add_moments(down, &x[line.clone()], &y[line], tap);
            }
            for (across, down) in across.iter_mut().zip(&*down) {
                across.fill(0.0);
                for (k, &tap) in taps.iter().enumerate() {
                    add(across, &down[k..k + inner], tap);
                }
            }
            ssim_row(across)
        })
        .collect();
    // Summed in order, so that the result does not depend on the number of threads.
    row_sums.iter().sum::<f64>() / (rows * inner) as f64
}

#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn add_moments(sums: &mut [Vec<f64>; MOMENTS], x: &[f64], y: &[f64], tap: f64) {
    let [mean_x, mean_y, xx, yy, xy] = sums;
    let means = mean_x.iter_mut().zip(mean_y);
    let squares = xx.iter_mut().zip(yy).zip(xy);
    for (((mx, my), ((xx, yy), xy)), (&x, &y)) in means.zip(squares).zip(x.iter().zip(y)) {
        let (tx, ty) = (tap * x, tap * y);
        *mx += tx;
        *my += ty;
        *xx += tx * x;
        *yy += ty * y;
        *xy += tx * y;
    }
}

#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
fn ssim_row([mean_x, mean_y, xx, yy, xy]: &[Vec<f64>; MOMENTS]) -> f64 {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let window = |i: usize| {
        let (mx, my) = (mean_x[i], mean_y[i]);
        let (vx, vy, cov) = (xx[i] - mx * mx, yy[i] - my * my, xy[i] - mx * my);
        ((2.0 * mx * my + C1) * (2.0 * cov + C2)) / ((mx * mx + my * my + C1) * (vx + vy + C2))
    };
    (0..mean_x.len()).map(window).sum()
}

/// SSIM's window along one axis; its sum is 1.
pub(crate) fn gaussian() -> [f64; SSIM_WINDOW] {
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
        let value = |x, y| ssim(x, y).expect("larger than the window");
        assert!((value(&a, &a) - 1.0).abs() < 1e-12);
        let (ab, ba) = (value(&a, &b), value(&b, &a));
        assert!(ab < 0.5 && (ab - ba).abs() < 1e-12);
    }

    #[test]
    fn ssim_of_two_constants_is_the_luminance_term() {
        let gamma = |x: f64| x.powf(1.0 / 2.2);
        let (x, y) = (gamma(0.25), gamma(0.5));
        let expected = (2.0 * x * y + 1e-4) / (x * x + y * y + 1e-4);
        let (a, b) = ([0.25; 3 * 11 * 11], [0.5; 3 * 11 * 11]);
        let found = ssim(&image(&a, 11, 11), &image(&b, 11, 11)).expect("one window");
        // DISPLAY_GAMMA is 2.2 in float32.
        assert!((found - expected).abs() < 1e-7, "{found} {expected}");
    }

    #[test]
    fn ssim_is_undefined_for_an_image_smaller_than_its_window() {
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
