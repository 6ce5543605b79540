//! All pictures of one scene, encoded.

use std::collections::BTreeMap;

use demc_data::Frame;
use jpeg_encoder::EncodingError;
use rayon::prelude::*;
use serde::Serialize;

use super::codec::{Jpeg, Pixels, reduced};
use super::error_map::ErrorMap;
use super::{BUDGET, ReportError};
use crate::denoise::DenoiseError;
use crate::evaluate::{image_of, reference_of};

/// Quality of the patches, which are small and looked at closely.
const PATCH_QUALITY: u8 = 95;
/// Quality of the thumbnails.
const THUMBNAIL_QUALITY: u8 = 80;
/// Longest side of a thumbnail, px.
const THUMBNAIL: usize = 144;
/// Shares of a scene's bytes: a clean picture, an error map, and the noisy picture, which compresses worst and comes last, so
/// that it has what the others leave.
const CLEAN: usize = 2;
const ERRORS: usize = 1;
const NOISY: usize = 4;

/// A scene's images, planar `[3, H, W]` in linear HDR.
pub struct Views<'a> {
    /// Noisy image and reference.
    pub frame: &'a Frame,
    /// The network's output.
    pub denoised: &'a [f32],
    /// Other programs' outputs by name.
    pub baselines: &'a [(&'a str, &'a [f32])],
}

/// `data:` addresses by name.
type Urls = BTreeMap<String, String>;

/// What the page decodes when the scene is chosen.
#[derive(Serialize)]
pub struct Pictures {
    pictures: Urls,
    errors: Urls,
    patches: [Inset; 2],
}

/// A part of the scene, pixel by pixel.
#[derive(Serialize)]
struct Inset {
    kind: &'static str,
    x: usize,
    y: usize,
    width: usize,
    height: usize,
    /// Of the denoised image in it.
    relmse: f64,
    pictures: Urls,
    errors: Urls,
}

/// A scene's pictures, and what is needed of them before it is chosen.
pub struct Encoded {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) pictures: Pictures,
    pub(super) thumbnail: String,
    /// Side of the blocks of pixels whose mean error is shown.
    pub(super) block: usize,
    /// Worst and best quality of the pictures.
    pub(super) quality: [u8; 2],
}

impl Views<'_> {
    /// Every image but the reference, by name.
    fn candidates(&self) -> Vec<(&str, &[f32])> {
        let ours = [("noisy", self.frame.color.as_slice())];
        let last = [("denoised", self.denoised)];
        let baselines = self.baselines.iter().copied();
        ours.into_iter().chain(baselines).chain(last).collect()
    }

    /// Encodes everything in this scene's share of a page of so many `scenes`.
    ///
    /// # Errors
    /// No reference, values that are not finite, an image that is too large for JPEG.
    pub fn encode(&self, scenes: usize) -> Result<Encoded, ReportError> {
        let reference = reference_of(self.frame)?;
        let maps = self.candidates().into_par_iter().map(|(name, planes)| {
            let candidate = image_of(self.frame, name, planes)?;
            Ok((name, ErrorMap::new(&candidate, &reference)))
        });
        let maps: Vec<(&str, ErrorMap)> = maps.collect::<Result<_, DenoiseError>>()?;
        let encoded = self.encode_all(reference.hdr(), &maps, BUDGET / scenes.max(1));
        encoded.map_err(|source| ReportError::Encoding {
            name: self.frame.name.clone(),
            source,
        })
    }

    fn encode_all(
        &self,
        reference_hdr: &[f32],
        maps: &[(&str, ErrorMap)],
        budget: usize,
    ) -> Result<Encoded, EncodingError> {
        let Frame { width, height, .. } = *self.frame;
        let candidates = self.candidates();
        let (_, of_denoised) = maps.last().expect("there is the denoised image");
        let all: Vec<(&str, &[f32])> = candidates
            .iter()
            .copied()
            .chain([("reference", reference_hdr)])
            .collect();

        let [worst, median] = of_denoised.worst_and_median();
        let inset = |kind, patch: super::error_map::Patch| -> Result<Inset, EncodingError> {
            let picture = |(name, planes): &(&str, &[f32])| -> Result<_, EncodingError> {
                let part = patch.of_planes(planes, width);
                let pixels = Pixels::of_hdr(&part, patch.height, patch.width);
                Ok(((*name).to_owned(), pixels.jpeg(PATCH_QUALITY)?.url()))
            };
            let error = |(name, map): &(&str, ErrorMap)| -> Result<_, EncodingError> {
                let jpeg = map.crop(&patch).jpeg(PATCH_QUALITY)?;
                Ok(((*name).to_owned(), jpeg.url()))
            };
            Ok(Inset {
                kind,
                x: patch.x,
                y: patch.y,
                width: patch.width,
                height: patch.height,
                relmse: patch.relmse,
                pictures: all.iter().map(picture).collect::<Result<_, _>>()?,
                errors: maps.iter().map(error).collect::<Result<_, _>>()?,
            })
        };
        let patches = [inset("worst", worst)?, inset("median", median)?];
        let of_patches: usize = patches.iter().map(Inset::bytes).sum();

        let shares = CLEAN * (all.len() - 1) + ERRORS * maps.len() + NOISY;
        let mut purse = Purse {
            left: budget.saturating_sub(of_patches),
            shares,
            quality: [u8::MAX, 0],
        };
        let hdr = |(name, planes): &(&str, &[f32])| {
            let pixels = Pixels::of_hdr(planes, height, width);
            ((*name).to_owned(), pixels)
        };
        let error = |(name, map): &(&str, ErrorMap)| ((*name).to_owned(), map.pixels());
        // The noisy picture is first in the list.
        let mut pictures = purse.spend(all[1..].iter().map(hdr).collect(), CLEAN)?;
        let errors = purse.spend(maps.iter().map(error).collect(), ERRORS)?;
        pictures.extend(purse.spend(vec![hdr(&all[0])], NOISY)?);

        let side = width.max(height).div_ceil(THUMBNAIL);
        let small = reduced(self.denoised, height, width, side);
        let thumbnail = Pixels::of_hdr(&small, height.div_ceil(side), width.div_ceil(side));
        Ok(Encoded {
            width,
            height,
            pictures: Pictures {
                pictures,
                errors,
                patches,
            },
            thumbnail: thumbnail.jpeg(THUMBNAIL_QUALITY)?.url(),
            block: of_denoised.block(),
            quality: purse.quality,
        })
    }
}

impl Inset {
    /// Bytes of its pictures before base64.
    fn bytes(&self) -> usize {
        let urls = self.pictures.values().chain(self.errors.values());
        urls.map(|url| url.len() * 3 / 4).sum()
    }
}

/// The bytes that are left for those that still come.
struct Purse {
    left: usize,
    shares: usize,
    quality: [u8; 2],
}

impl Purse {
    /// Pictures of one kind, of so many shares each, as JPEG.
    fn spend(
        &mut self,
        pictures: Vec<(String, Pixels)>,
        shares: usize,
    ) -> Result<Urls, EncodingError> {
        let budget = self.left * shares / self.shares.max(1);
        self.shares -= shares * pictures.len();
        let encoded = pictures
            .into_par_iter()
            .map(|(name, pixels)| Ok((name, pixels.jpeg_within(budget)?)));
        let encoded: Vec<(String, Jpeg)> = encoded.collect::<Result<_, EncodingError>>()?;
        for (_, jpeg) in &encoded {
            self.left = self.left.saturating_sub(jpeg.len());
            let [worst, best] = self.quality;
            self.quality = [worst.min(jpeg.quality), best.max(jpeg.quality)];
        }
        let urls = encoded.into_iter().map(|(name, jpeg)| (name, jpeg.url()));
        Ok(urls.collect())
    }
}
