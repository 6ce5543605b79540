//! Encodes all pictures of one scene.

use std::collections::BTreeMap;

use demc_data::Frame;
use jpeg_encoder::EncodingError;
use rayon::prelude::*;
use serde::Serialize;

use super::codec::{Jpeg, Pixels, reduced};
use super::error_map::{ErrorMap, ErrorPatch};
use crate::denoise::DenoiseError;
use crate::evaluate::{image_of, reference_of};

/// Bytes of all pictures before base64, which adds a third. The page stays below 20 MB.
const BUDGET: usize = 14_000_000;

/// Why a report cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// A picture cannot be encoded.
    #[error("{name}: its pictures cannot be encoded")]
    Encoding {
        /// The image.
        name: String,
        /// The encoder's error.
        source: jpeg_encoder::EncodingError,
    },
    /// The reference is missing, or an image cannot be compared with it.
    #[error(transparent)]
    Images(#[from] DenoiseError),
    /// The numbers cannot be written as JSON.
    #[error("cannot encode the report's JSON")]
    Json(#[from] serde_json::Error),
}

/// JPEG quality of the patches, which are shown enlarged.
const PATCH_QUALITY: u8 = 95;
/// JPEG quality of the thumbnails.
const THUMBNAIL_QUALITY: u8 = 80;
/// Longest side of a thumbnail in pixels.
const THUMBNAIL: usize = 144;
/// Shares of a scene's bytes for a clean picture, an error map and the noisy picture. The noisy
/// picture compresses worst. It comes last and gets the remaining bytes.
const CLEAN: usize = 2;
const ERRORS: usize = 1;
const NOISY: usize = 4;

/// A scene's images, planar `[3, H, W]` in linear HDR.
pub struct SceneImages<'a> {
    /// Noisy image and reference.
    pub frame: &'a Frame,
    /// The network's output.
    pub denoised: &'a [f32],
    /// Baseline images by name.
    pub baselines: &'a [(&'a str, &'a [f32])],
}

type Urls = BTreeMap<String, String>;

/// The pictures that the page decodes when the scene is selected.
#[derive(Serialize)]
pub struct Pictures {
    pictures: Urls,
    errors: Urls,
    patches: [Inset; 2],
}

#[derive(Serialize)]
struct Inset {
    kind: &'static str,
    x: usize,
    y: usize,
    width: usize,
    height: usize,
    /// RelMSE of the denoised image in this part.
    relmse: f64,
    pictures: Urls,
    errors: Urls,
}

/// A scene's pictures, and the data that the page needs before the scene is selected.
pub struct EncodedScene {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) pictures: Pictures,
    pub(super) thumbnail: String,
    /// Side of the blocks of pixels whose mean error is shown.
    pub(super) block: usize,
    /// Worst and best quality of the pictures.
    pub(super) quality: [u8; 2],
}

impl SceneImages<'_> {
    fn candidates(&self) -> Vec<(&str, &[f32])> {
        let first = [("noisy", self.frame.color.as_slice())];
        let last = [("denoised", self.denoised)];
        let baselines = self.baselines.iter().copied();
        first.into_iter().chain(baselines).chain(last).collect()
    }

    /// Encodes all pictures within this scene's share of a page of `scenes` scenes.
    ///
    /// # Errors
    /// The reference is missing, a value is not finite, or an image is too large for JPEG.
    pub fn encode(&self, scenes: usize) -> Result<EncodedScene, ReportError> {
        let reference = reference_of(self.frame)?;
        let maps: Vec<(&str, ErrorMap)> = self
            .candidates()
            .into_par_iter()
            .map(|(name, planes)| {
                let candidate = image_of(self.frame, name, planes)?;
                Ok((name, ErrorMap::new(&candidate, &reference)))
            })
            .collect::<Result<_, DenoiseError>>()?;
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
    ) -> Result<EncodedScene, EncodingError> {
        let Frame { width, height, .. } = *self.frame;
        let candidates = self.candidates();
        let (_, denoised_map) = maps.last().expect("the denoised image is last");
        let all: Vec<(&str, &[f32])> = candidates
            .iter()
            .copied()
            .chain([("reference", reference_hdr)])
            .collect();

        let [worst, median] = denoised_map.worst_and_median();
        let inset = |kind, patch: ErrorPatch| -> Result<Inset, EncodingError> {
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
        let patch_bytes: usize = patches.iter().map(Inset::bytes).sum();

        let shares = CLEAN * (all.len() - 1) + ERRORS * maps.len() + NOISY;
        let mut bytes = ByteBudget {
            left: budget.saturating_sub(patch_bytes),
            shares,
            quality: [u8::MAX, 0],
        };
        let hdr = |(name, planes): &(&str, &[f32])| {
            let pixels = Pixels::of_hdr(planes, height, width);
            ((*name).to_owned(), pixels)
        };
        let error = |(name, map): &(&str, ErrorMap)| ((*name).to_owned(), map.pixels());
        // The noisy picture is first in the list.
        let mut pictures = bytes.encode(all[1..].iter().map(hdr).collect(), CLEAN)?;
        let errors = bytes.encode(maps.iter().map(error).collect(), ERRORS)?;
        pictures.extend(bytes.encode(vec![hdr(&all[0])], NOISY)?);

        let side = width.max(height).div_ceil(THUMBNAIL);
        let small = reduced(self.denoised, height, width, side);
        let thumbnail = Pixels::of_hdr(&small, height.div_ceil(side), width.div_ceil(side));
        Ok(EncodedScene {
            width,
            height,
            pictures: Pictures {
                pictures,
                errors,
                patches,
            },
            thumbnail: thumbnail.jpeg(THUMBNAIL_QUALITY)?.url(),
            block: denoised_map.block(),
            quality: bytes.quality,
        })
    }
}

impl Inset {
    fn bytes(&self) -> usize {
        let urls = self.pictures.values().chain(self.errors.values());
        urls.map(|url| url.len() * 3 / 4).sum()
    }
}

/// Distributes a scene's bytes over its pictures.
struct ByteBudget {
    left: usize,
    shares: usize,
    /// Worst and best quality so far.
    quality: [u8; 2],
}

impl ByteBudget {
    /// Encodes pictures as JPEG, each with this number of shares.
    fn encode(
        &mut self,
        pictures: Vec<(String, Pixels)>,
        shares: usize,
    ) -> Result<Urls, EncodingError> {
        let budget = self.left * shares / self.shares.max(1);
        self.shares -= shares * pictures.len();
        let encoded: Vec<(String, Jpeg)> = pictures
            .into_par_iter()
            .map(|(name, pixels)| Ok((name, pixels.jpeg_within(budget)?)))
            .collect::<Result<_, EncodingError>>()?;
        for (_, jpeg) in &encoded {
            self.left = self.left.saturating_sub(jpeg.len());
            let [worst, best] = self.quality;
            self.quality = [worst.min(jpeg.quality), best.max(jpeg.quality)];
        }
        let urls = encoded.into_iter().map(|(name, jpeg)| (name, jpeg.url()));
        Ok(urls.collect())
    }
}
