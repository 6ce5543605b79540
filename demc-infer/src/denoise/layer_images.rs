//! Layers of a network without kernels: each is denoised as an image of its own, with the same
//! features, its own exposure, and its own light.
//!
//! Where the noisy layers add up to the noisy colour, the denoised ones are then scaled, so that they
//! add up to the denoised image.

use demc_model::config::COLOR_CHANNELS;
use rayon::prelude::*;

use super::input::FrameInput;
use super::layers::Layer;
use super::light;
use super::progress::{DenoiseObserver, of_pass};
use crate::error::DenoiseError;
use crate::tiles::Tiles;

/// Noisy layers add up to the colour if their sum differs from it by at most this share of it.
const SUM_TOLERANCE: f64 = 1e-3;

/// The layers of an image, and their indices in it.
#[derive(Debug, Clone, Copy, PartialEq)]
enum LayerImage {
    /// Red, green, and blue: their names differ only in the last part.
    Color([usize; COLOR_CHANNELS]),
    /// Any other layer, which is repeated three times.
    Grey(usize),
}

/// Layers as images.
pub(super) struct LayerImages<'a> {
    layers: &'a [Layer],
    images: Vec<LayerImage>,
}

impl<'a> LayerImages<'a> {
    pub(super) fn new(layers: &'a [Layer]) -> Self {
        let images = images_of(layers);
        LayerImages { layers, images }
    }

    /// Number of passes for these images and the colour.
    pub(super) fn passes(&self) -> usize {
        1 + self.images.len()
    }

    /// Denoises one image after the other, as `input` does the colour. A grey image of one value stays.
    ///
    /// # Shapes
    /// Returns planar `[layers, H, W]`.
    pub(super) fn denoise(
        &self,
        input: &FrameInput,
        tiles: &Tiles,
        restores_light: bool,
        observer: &mut DenoiseObserver,
    ) -> Result<Vec<f32>, DenoiseError> {
        let (bundle, frame) = (input.bundle, input.frame);
        let [height, width] = [frame.height, frame.width];
        let pixels = height * width;
        let mut denoised = vec![0.0; self.layers.len() * pixels];
        for (index, image) in self.images.iter().enumerate() {
            if let LayerImage::Grey(layer) = *image {
                let samples = &self.layers[layer].samples;
                // The network would change alpha without edges a little.
                if samples.iter().all(|sample| *sample == samples[0]) {
                    denoised[layer * pixels..][..pixels].copy_from_slice(samples);
                    continue;
                }
            }
            let indices = match *image {
                LayerImage::Color(indices) => indices,
                LayerImage::Grey(index) => [index; COLOR_CHANNELS],
            };
            let noisy = indices.map(|index| self.layers[index].samples.as_slice());
            let noisy = noisy.concat();
            let input = FrameInput {
                color: &noisy,
                scale: bundle.input_scale(bundle.exposure(&noisy, height, width)),
                demodulate: matches!(image, LayerImage::Color(_)),
                ..input.clone()
            };
            let mut observer = of_pass(observer, [1 + index, self.passes()]);
            let mut planes = input.denoise(tiles, &mut observer)?;
            if restores_light {
                let factors = light::factors(&noisy, &planes, height, width);
                light::multiply(&mut planes, &factors);
            }
            match *image {
                LayerImage::Color(indices) => {
                    for (index, plane) in indices.into_iter().zip(planes.chunks_exact(pixels)) {
                        denoised[index * pixels..][..pixels].copy_from_slice(plane);
                    }
                }
                LayerImage::Grey(index) => {
                    let targets = denoised[index * pixels..][..pixels].par_iter_mut();
                    targets.enumerate().for_each(|(pixel, target)| {
                        let channels = (0..COLOR_CHANNELS).map(|c| planes[c * pixels + pixel]);
                        *target = channels.sum::<f32>() / COLOR_CHANNELS as f32;
                    });
                }
            }
        }
        Ok(denoised)
    }

    /// Scales denoised layers, so that those of colour add up to the denoised image, if the noisy ones add up
    /// to the noisy colour.
    ///
    /// # Shapes
    /// `planes` `[layers, H, W]`; `noisy` and `denoised` `[3, H, W]`.
    pub(super) fn scale(&self, planes: &mut [f32], noisy: &[f32], denoised: &[f32]) {
        let pixels = noisy.len() / COLOR_CHANNELS;
        if self.colors().next().is_none() || !self.add_up_to(noisy) {
            return;
        }
        let mut ratios = self.sum(pixels, |index| &planes[index * pixels..][..pixels]);
        let pairs = ratios.par_iter_mut().zip(denoised);
        pairs.for_each(|(sum, denoised)| {
            // A tiny sum overflows the ratio.
            let ratio = *denoised / *sum;
            let is_valid = *sum > 0.0 && ratio.is_finite();
            *sum = if is_valid { ratio } else { 1.0 };
        });
        for (index, ratios) in self.colors().flat_map(|indices| {
            let ratios = ratios.chunks_exact(pixels);
            indices.into_iter().zip(ratios)
        }) {
            light::multiply(&mut planes[index * pixels..][..pixels], ratios);
        }
    }

    fn colors(&self) -> impl Iterator<Item = [usize; COLOR_CHANNELS]> {
        self.images.iter().filter_map(|image| match image {
            LayerImage::Color(indices) => Some(*indices),
            LayerImage::Grey(_) => None,
        })
    }

    fn add_up_to(&self, noisy: &[f32]) -> bool {
        let pixels = noisy.len() / COLOR_CHANNELS;
        let sum = self.sum(pixels, |index| &self.layers[index].samples);
        let pairs = sum.iter().zip(noisy);
        let difference: f64 = pairs
            .map(|(sum, noisy)| f64::from((sum - noisy).abs()))
            .sum();
        let light: f64 = noisy.iter().map(|noisy| f64::from(noisy.abs())).sum();
        difference <= SUM_TOLERANCE * light
    }

    /// The sum of the images of colour, whose planes `plane` returns.
    ///
    /// # Shapes
    /// Returns `[3, H, W]`.
    fn sum<'b>(&self, pixels: usize, plane: impl Fn(usize) -> &'b [f32]) -> Vec<f32> {
        let mut sums = vec![0.0; COLOR_CHANNELS * pixels];
        for indices in self.colors() {
            for (sums, index) in sums.chunks_exact_mut(pixels).zip(indices) {
                let values = sums.par_iter_mut().zip(plane(index));
                values.for_each(|(sum, value)| *sum += value);
            }
        }
        sums
    }
}

/// The images in the order of their first layers.
fn images_of(layers: &[Layer]) -> Vec<LayerImage> {
    let mut images = Vec::new();
    let mut taken = vec![false; layers.len()];
    for index in 0..layers.len() {
        if taken[index] {
            continue;
        }
        let others = (0..COLOR_CHANNELS).map(|color| {
            let mut free = (index..layers.len()).filter(|other| !taken[*other]);
            free.find(|other| {
                let other = &layers[*other];
                other.color() == Some(color) && other.group() == layers[index].group()
            })
        });
        let found: Vec<usize> = others.flatten().collect();
        let image = match found[..] {
            [red, green, blue] if found.contains(&index) => LayerImage::Color([red, green, blue]),
            _ => LayerImage::Grey(index),
        };
        match image {
            LayerImage::Color(indices) => indices.into_iter().for_each(|i| taken[i] = true),
            LayerImage::Grey(index) => taken[index] = true,
        }
        images.push(image);
    }
    images
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layers(names: &[&str]) -> Vec<Layer> {
        let layers = names.iter().map(|name| Layer {
            name: (*name).into(),
            samples: vec![1.0, 2.0],
        });
        layers.collect()
    }

    #[test]
    fn three_colours_of_one_name_are_an_image() {
        let names = [
            "key.B", "A", "key.G", "rim.r", "key.R", "rim.G", "rim.b", "R", "B", "G", "key.r",
            "fill.R", "fill.G", "fill.A",
        ];
        let expected = [
            LayerImage::Color([4, 2, 0]),
            LayerImage::Grey(1),
            LayerImage::Color([3, 5, 6]),
            LayerImage::Color([7, 9, 8]),
            LayerImage::Grey(10),
            LayerImage::Grey(11),
            LayerImage::Grey(12),
            LayerImage::Grey(13),
        ];
        assert_eq!(images_of(&layers(&names)), expected);
    }

    #[test]
    fn ratios_are_1_where_the_sum_has_no_light() {
        let layers = layers(&["key.R", "key.G", "key.B"]);
        let images = LayerImages::new(&layers);
        let noisy = [1.0, 2.0, 1.0, 2.0, 1.0, 2.0];
        let tiny = f32::MIN_POSITIVE / 4.0;
        let planes = [tiny, 0.5, 0.0, 2.0, 4.0, 8.0];
        let mut scaled = planes;
        images.scale(&mut scaled, &noisy, &[100.0, 1.0, 3.0, 1.0, 1.0, 0.0]);
        assert_eq!(scaled, [tiny, 1.0, 0.0, 1.0, 1.0, 0.0]);
        // The noisy layers are not the colour.
        let mut kept = planes;
        images.scale(&mut kept, &noisy.map(|x| 1.01 * x), &[1.0; 6]);
        assert_eq!(kept, planes);
    }
}
