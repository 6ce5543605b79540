//! Encodes HDR images as JPEG with a logarithmic curve, so that a page can change the exposure.
//!
//! `code = 255 log(1 + 64 x) / log(1 + 64 * 8)` has 28 codes per stop for large 64 x and is linear
//! below. At +3 stops, x = 1/8 is white; at -3 stops, x = 8. At exposure 0, a step between codes is
//! at most 3 of 255 display codes.

use std::borrow::Cow;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use jpeg_encoder::{ColorType, Encoder, EncodingError, SamplingFactor};
use rayon::prelude::*;

/// Largest value of the curve: white at -3 stops.
pub const WHITE: f32 = 8.0;
/// Inverse of the value below which the curve is linear.
pub const TOE: f32 = 64.0;
const QUALITIES: [u8; 8] = [92, 84, 74, 62, 50, 38, 26, 16];
/// Lowest quality with chroma in full resolution.
const FULL_CHROMA: u8 = 84;

/// 8-bit pixels with one or three interleaved values each.
pub struct Pixels {
    pub width: usize,
    pub height: usize,
    pub values: Vec<u8>,
}

pub struct Jpeg {
    pub quality: u8,
    bytes: Vec<u8>,
}

impl Pixels {
    /// Encodes linear HDR with the logarithmic curve.
    ///
    /// # Shapes
    /// `planes` is planar `[3, height, width]`.
    pub fn of_hdr(planes: &[f32], height: usize, width: usize) -> Self {
        let pixels = height * width;
        let mut values = vec![0; 3 * pixels];
        let rows = values.par_chunks_mut(3 * width).enumerate();
        rows.for_each(|(y, row)| {
            for (i, value) in row.iter_mut().enumerate() {
                *value = code(planes[i % 3 * pixels + y * width + i / 3]);
            }
        });
        Self {
            width,
            height,
            values,
        }
    }

    fn color(&self) -> ColorType {
        if self.values.len() == self.width * self.height {
            ColorType::Luma
        } else {
            ColorType::Rgb
        }
    }

    /// A JPEG of the best quality that needs at most `bytes`, or of the worst quality if none does.
    ///
    /// # Errors
    /// An image without pixels.
    pub fn jpeg_within(&self, bytes: usize) -> Result<Jpeg, EncodingError> {
        let best = self.jpeg(QUALITIES[0])?;
        if best.len() <= bytes {
            return Ok(best);
        }
        // Bisection: higher qualities give larger files.
        let (mut low, mut high) = (1, QUALITIES.len() - 1);
        let mut fitting = None;
        while low < high {
            let middle = (low + high) / 2;
            let tried = self.jpeg(QUALITIES[middle])?;
            if tried.len() <= bytes {
                high = middle;
                fitting = Some(tried);
            } else {
                low = middle + 1;
            }
        }
        match fitting.filter(|found| found.quality == QUALITIES[low]) {
            Some(found) => Ok(found),
            None => self.jpeg(QUALITIES[low]),
        }
    }

    /// A JPEG of this quality.
    ///
    /// # Errors
    /// An image without pixels.
    pub fn jpeg(&self, quality: u8) -> Result<Jpeg, EncodingError> {
        let mut bytes = Vec::new();
        let mut encoder = Encoder::new(&mut bytes, quality);
        encoder.set_optimized_huffman_tables(true);
        encoder.set_sampling_factor(match quality {
            FULL_CHROMA.. => SamplingFactor::F_1_1,
            _ => SamplingFactor::F_2_2,
        });
        // Readable EXR files have sides of at most 32768 pixels.
        let side = |pixels: usize| u16::try_from(pixels).unwrap_or(u16::MAX);
        let (width, height) = (side(self.width), side(self.height));
        encoder.encode(&self.values, width, height, self.color())?;
        Ok(Jpeg { quality, bytes })
    }
}

impl Jpeg {
    pub fn len(&self) -> usize {
        self.bytes.len()
    }

    /// The file as a `data:` URL.
    pub fn url(&self) -> String {
        let mut url = "data:image/jpeg;base64,".to_owned();
        STANDARD.encode_string(&self.bytes, &mut url);
        url
    }
}

fn code(x: f32) -> u8 {
    let full = (1.0 + TOE * WHITE).log2();
    ((1.0 + TOE * x.max(0.0)).log2() / full * 255.0)
        .round()
        .min(255.0) as u8
}

/// Planar channels reduced to means of blocks of `side` x `side` pixels; blocks at the edge are
/// smaller.
pub fn reduced(planes: &[f32], height: usize, width: usize, side: usize) -> Cow<'_, [f32]> {
    if side == 1 {
        return planes.into();
    }
    let (rows, columns) = (height.div_ceil(side), width.div_ceil(side));
    let mut out = Vec::with_capacity(planes.len() / (side * side) + 1);
    for plane in planes.chunks(height * width) {
        for block in 0..rows * columns {
            let (y, x) = (block / columns * side, block % columns * side);
            let lines = plane.chunks(width).skip(y).take(side);
            let (sum, count) = lines
                .flat_map(|line| &line[x..(x + side).min(width)])
                .fold((0.0, 0.0), |(sum, n), value| (sum + value, n + 1.0));
            out.push(sum / count);
        }
    }
    out.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_runs_from_black_to_white_in_steps_below_three_display_codes() {
        assert_eq!(
            [code(-1.0), code(0.0), code(WHITE), code(1e9)],
            [0, 0, 255, 255]
        );
        let radiance = |code: f32| ((1.0 + TOE * WHITE).powf(code / 255.0) - 1.0) / TOE;
        let display = |x: f32| x.min(1.0).powf(1.0 / 2.2) * 255.0;
        for i in 0..255_u8 {
            let (x, next) = (radiance(i.into()), radiance(f32::from(i) + 1.0));
            assert_eq!(code(x), i);
            // Below 0.02, the display's curve is too steep for 8 bits.
            if x > 0.02 {
                assert!(display(next) - display(x) < 3.0, "{i}");
            }
        }
    }

    #[test]
    fn a_smaller_budget_gives_a_smaller_file_of_lower_quality() {
        let noise = |i: usize| (i * 2654435761 % 1000) as f32 / 500.0;
        let planes: Vec<f32> = (0..3 * 64 * 64).map(noise).collect();
        let pixels = Pixels::of_hdr(&planes, 64, 64);
        let best = pixels.jpeg_within(usize::MAX).expect("encoded");
        assert_eq!(best.quality, QUALITIES[0]);
        for budget in [best.len() - 1, best.len() / 2, best.len() / 4] {
            let found = pixels.jpeg_within(budget).expect("encoded");
            assert!(found.len() <= budget && found.quality < best.quality);
            let better = QUALITIES.iter().rev().find(|q| **q > found.quality);
            let better = pixels.jpeg(*better.expect("one")).expect("encoded");
            assert!(better.len() > budget, "{} would fit", better.quality);
        }
        let worst = pixels.jpeg_within(1).expect("encoded");
        assert_eq!(worst.quality, QUALITIES[QUALITIES.len() - 1]);
    }

    #[test]
    fn blocks_are_averaged_and_smaller_at_the_edge() {
        let plane = [1.0, 3.0, 5.0, 1.0, 3.0, 7.0, 2.0, 2.0, 9.0];
        assert_eq!(*reduced(&plane, 3, 3, 2), [2.0, 6.0, 2.0, 9.0]);
        assert_eq!(*reduced(&plane, 3, 3, 1), plane);
    }
}
