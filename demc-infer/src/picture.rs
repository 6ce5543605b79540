//! 8-bit pictures for people: HDR images tone mapped by `clip(x, 0, 1)^(1 / 2.2)`, side by side and
//! stacked.

use std::io;
use std::path::Path;

use demc_data::Frame;
use demc_model::metrics::DISPLAY_GAMMA;
use demc_program::file::{FileError, write_whole};
use serde::{Deserialize, Serialize};

/// Pixels between two pictures of a strip.
const GAP: usize = 4;
const GAP_RGB: [u8; 3] = [255; 3];
/// Share of a detail map's values that are not clipped, so that a few bright pixels do not darken
/// the rest.
const DETAIL_QUANTILE: f64 = 0.995;

/// An 8-bit RGB picture.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Picture {
    width: usize,
    height: usize,
    /// Interleaved, row by row.
    rgb: Vec<[u8; 3]>,
}

impl Picture {
    /// A linear HDR image, tone mapped by `clip(x, 0, 1)^(1 / 2.2)`.
    ///
    /// # Shapes
    /// Planar `[3, height, width]`.
    ///
    /// # Panics
    /// If `planes` has another length.
    pub fn from_hdr(planes: &[f32], height: usize, width: usize) -> Self {
        Self::from_planes(planes, height, width, |x| {
            x.clamp(0.0, 1.0).powf(1.0 / DISPLAY_GAMMA)
        })
    }

    /// A detail map (Fig. 2 e), which has no unit: linear from 0 to the 99.5th percentile of its
    /// values.
    ///
    /// # Shapes
    /// Planar `[3, height, width]`, not negative.
    ///
    /// # Panics
    /// If `planes` has another length.
    pub fn from_detail_map(planes: &[f32], height: usize, width: usize) -> Self {
        let mut sorted = planes.to_vec();
        sorted.sort_by(f32::total_cmp);
        let last = sorted.len().saturating_sub(1) as f64;
        let white = sorted
            .get((last * DETAIL_QUANTILE).round() as usize)
            .copied()
            .filter(|white| *white > 0.0)
            .unwrap_or(1.0);
        Self::from_planes(planes, height, width, |x| (x / white).clamp(0.0, 1.0))
    }

    fn from_planes(
        planes: &[f32],
        height: usize,
        width: usize,
        display: impl Fn(f32) -> f32,
    ) -> Self {
        let pixels = height * width;
        assert_eq!(planes.len(), 3 * pixels, "three planes of {width}x{height}");
        let byte = |x: f32| (display(x) * 255.0).round() as u8;
        let rgb = (0..pixels)
            .map(|i| [0, 1, 2].map(|channel| byte(planes[channel * pixels + i])))
            .collect();
        Self { width, height, rgb }
    }

    /// Width and height in pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// A strip `noisy | detail map | denoised | reference` of a frame; absent images are left out.
    ///
    /// # Shapes
    /// `detail_map` and `denoised` are planar `[3, H, W]` of the frame's size.
    ///
    /// # Panics
    /// If a length differs.
    pub fn strip(frame: &Frame, detail_map: Option<&[f32]>, denoised: &[f32]) -> Self {
        let Frame { width, height, .. } = *frame;
        let hdr = |planes: &[f32]| Self::from_hdr(planes, height, width);
        let detail_map = detail_map.map(|map| Self::from_detail_map(map, height, width));
        let reference = frame.reference.as_deref().map(hdr);
        let parts = [
            Some(hdr(&frame.color)),
            detail_map,
            Some(hdr(denoised)),
            reference,
        ];
        Self::beside(&parts.into_iter().flatten().collect::<Vec<_>>())
    }

    /// Pictures from left to right with a thin white gap; smaller ones are filled up with white.
    pub fn beside(pictures: &[Picture]) -> Self {
        let transposed: Vec<_> = pictures.iter().map(Self::transposed).collect();
        Self::above(&transposed).transposed()
    }

    /// Pictures from top to bottom with a thin white gap; narrower ones are filled up with white.
    pub fn above(pictures: &[Picture]) -> Self {
        let width = pictures.iter().map(|p| p.width).max().unwrap_or(0);
        let mut rgb = Vec::new();
        for (i, picture) in pictures.iter().enumerate() {
            if i > 0 {
                rgb.resize(rgb.len() + GAP * width, GAP_RGB);
            }
            for row in picture.rgb.chunks_exact(picture.width) {
                rgb.extend_from_slice(row);
                rgb.resize(rgb.len() + width - picture.width, GAP_RGB);
            }
        }
        let height = rgb.len() / width.max(1);
        Self { width, height, rgb }
    }

    fn transposed(&self) -> Self {
        let Self { width, height, .. } = *self;
        let rgb = (0..width)
            .flat_map(|x| (0..height).map(move |y| self.rgb[y * width + x]))
            .collect();
        Self {
            width: height,
            height: width,
            rgb,
        }
    }

    /// The bytes of a PNG file. The file states its gamma of 1/2.2 for correct display.
    ///
    /// # Errors
    /// The picture has no pixels, or is too large for PNG.
    pub fn to_png(&self) -> Result<Vec<u8>, png::EncodingError> {
        self.to_png_with(&[])
    }

    /// As [`to_png`](Self::to_png), with texts by keyword.
    fn to_png_with(&self, texts: &[(&str, &str)]) -> Result<Vec<u8>, png::EncodingError> {
        let mut bytes = Vec::new();
        let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
        let mut encoder = png::Encoder::new(&mut bytes, side(self.width), side(self.height));
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_gamma(png::ScaledFloat::new(1.0 / DISPLAY_GAMMA));
        for (keyword, text) in texts {
            encoder.add_text_chunk((*keyword).to_owned(), (*text).to_owned())?;
        }
        let mut writer = encoder.write_header()?;
        writer.write_image_data(self.rgb.as_flattened())?;
        writer.finish()?;
        Ok(bytes)
    }

    /// Writes a PNG file atomically.
    ///
    /// # Errors
    /// As [`to_png`](Self::to_png), or the path cannot be written.
    pub fn write_png(&self, path: &Path) -> Result<(), FileError> {
        self.write_png_with(path, &[])
    }

    /// As [`write_png`](Self::write_png), with texts by keyword.
    pub(crate) fn write_png_with(
        &self,
        path: &Path,
        texts: &[(&str, &str)],
    ) -> Result<(), FileError> {
        write_whole(path, |file| {
            let bytes = self.to_png_with(texts).map_err(io::Error::other)?;
            io::Write::write_all(file, &bytes)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(height: usize, width: usize, value: f32) -> Picture {
        Picture::from_hdr(&vec![value; 3 * height * width], height, width)
    }

    #[test]
    fn tone_mapping_clips_and_raises_to_1_over_2_2() {
        let planes = [0.0, 0.25, 1.0, 7.0, -1.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let picture = Picture::from_hdr(&planes, 1, 4);
        // 255 * 0.25^(1/2.2) = 135.79, 255 * 0.5^(1/2.2) = 186.08.
        assert_eq!(
            picture.rgb,
            [[0, 0, 0], [136, 186, 0], [255, 0, 0], [255, 0, 0]]
        );
    }

    #[test]
    fn a_detail_map_is_scaled_by_its_own_values() {
        let mut planes = vec![2.0; 3 * 100];
        planes[0] = 1000.0;
        planes[1] = 1.0;
        let picture = Picture::from_detail_map(&planes, 10, 10);
        assert_eq!(picture.rgb[0][0], 255, "an outlier is clipped");
        assert_eq!(picture.rgb[1][0], 128);
        let dead = Picture::from_detail_map(&[0.0; 12], 2, 2);
        assert!(dead.rgb.iter().all(|pixel| *pixel == [0; 3]));
    }

    #[test]
    fn beside_and_above_add_sizes_and_a_gap() {
        let (a, b) = (grey(4, 6, 0.0), grey(4, 3, 1.0));
        let strip = Picture::beside(&[a.clone(), b]);
        assert_eq!(strip.size(), (6 + GAP + 3, 4));
        assert_eq!(strip.rgb[5], [0; 3]);
        assert_eq!(strip.rgb[6], GAP_RGB);
        let rows = Picture::above(&[strip.clone(), a]);
        assert_eq!(rows.size(), (13, 4 + GAP + 4));
        assert_eq!(&rows.rgb[..13 * 4], strip.rgb);
    }

    #[test]
    fn a_strip_leaves_out_absent_images() {
        let mut frame = crate::bundle::testing::frame(5, 3);
        let denoised = frame.color.clone();
        let width = |parts: usize| (5 * parts + GAP * (parts - 1), 3);
        assert_eq!(Picture::strip(&frame, None, &denoised).size(), width(2));
        frame.reference = Some(denoised.clone());
        assert_eq!(
            Picture::strip(&frame, Some(&denoised), &denoised).size(),
            width(4)
        );
    }

    #[test]
    fn a_png_survives_a_round_trip() {
        let picture = Picture::beside(&[grey(5, 7, 0.3), grey(5, 2, 0.9)]);
        let bytes = picture.to_png().expect("encoded");
        let mut reader = png::Decoder::new(io::Cursor::new(bytes))
            .read_info()
            .expect("header");
        let mut back = vec![0; reader.output_buffer_size().expect("small")];
        let info = reader.next_frame(&mut back).expect("pixels");
        assert_eq!((info.width as usize, info.height as usize), picture.size());
        assert_eq!(back, picture.rgb.as_flattened());
    }
}
