//! Batches of training patches. The patch stream concatenates epochs 0, 1, ...; each epoch is a
//! seeded permutation of all patches. Batch n holds patches `n B .. (n + 1) B` of the stream. It
//! depends only on the configuration, the seed and n, so a resumed run continues with the same
//! batches.

use crate::dataset::Scene;
use crate::error::Error;
use crate::image::frame::{FEATURES, FramePlanes, TEXTURES};
use crate::image::layout::{ChannelLayout, InputKind};
use crate::image::plane::Plane;
use crate::input::kpcn::{KpcnInput, LIGHT, light_from_radiance};
use crate::input::transform::Normalizer;
use crate::training::augment::{Augment, Variation};
use crate::training::cache::{AlbedoFilter, CacheUsage, SceneCache};
use crate::training::config::DataConfig;
use crate::training::dropout::{Dropout, drop_buffers};
use crate::training::patch::{EpochOrders, Patch, patches};
use crate::training::resample::resample_noise;

/// Patches in the network's input space, with their references. B patches of P x P pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// Number of patches, B.
    pub size: usize,
    /// Side of a patch in pixels, P.
    pub patch_size: usize,
    /// Noisy colour `[B, 3, P, P]`, gamma space, divided by the modulation. For KPCN, both parts of the
    /// light `[B, 6, P, P]`, as [`KpcnInput::light`].
    pub color: Vec<f32>,
    /// Features `[B, 12, P, P]`, Z-scored; for KPCN [`KpcnInput::features`].
    pub features: Vec<f32>,
    /// Factor on the network's output, `[B, 3, P, P]`, gamma space ([`Normalizer::modulation`]). For
    /// KPCN, the factor on diffuse light, [`KpcnInput::divisor`].
    pub modulation: Option<Vec<f32>>,
    /// Reference colour `[B, 3, P, P]`, linear HDR.
    pub reference_hdr: Vec<f32>,
    /// For KPCN, both parts of the reference `[B, 6, P, P]`, in the network's space.
    pub reference_light: Option<Vec<f32>>,
    /// Position of each patch, before flips and transposes.
    pub patches: Vec<Patch>,
}

impl Batch {
    /// `size` flat patches of `side` x `side` pixels, for measurements of time and memory.
    pub fn grey(inputs: InputKind, size: usize, side: usize) -> Self {
        let patch = Patch {
            scene: 0,
            y: 0,
            x: 0,
        };
        let is_kpcn = !inputs.is_demc();
        let mut batch = Self::zeros(inputs, is_kpcn, vec![patch; size], side);
        let planes = [
            &mut batch.color,
            &mut batch.features,
            &mut batch.reference_hdr,
        ];
        let more = [&mut batch.modulation, &mut batch.reference_light];
        let all = planes.into_iter().chain(more.into_iter().flatten());
        all.for_each(|plane| plane.fill(0.5));
        batch
    }

    /// A place for each draw, in their order.
    fn places(&mut self, draws: Vec<PatchDraw>) -> Vec<PatchBuffers<'_>> {
        let pixels = self.patch_size * self.patch_size;
        let colors = self.color.len() / self.size;
        let color = self.color.chunks_exact_mut(colors);
        let features = self.features.chunks_exact_mut(FEATURES * pixels);
        let reference = self.reference_hdr.chunks_exact_mut(3 * pixels);
        let mut modulation = parts(self.modulation.as_mut(), 3 * pixels);
        let mut reference_light = parts(self.reference_light.as_mut(), LIGHT * pixels);
        let draws = draws.into_iter().zip(color.zip(features.zip(reference)));
        draws
            .map(|(draw, (color, (features, reference)))| PatchBuffers {
                draw,
                color,
                features,
                reference,
                modulation: modulation.next(),
                reference_light: reference_light.next(),
            })
            .collect()
    }

    fn zeros(inputs: InputKind, is_modulated: bool, patches: Vec<Patch>, side: usize) -> Self {
        let planes = |channels: usize| vec![0.0; patches.len() * channels * side * side];
        let colors = if inputs.is_demc() { 3 } else { LIGHT };
        Self {
            size: patches.len(),
            patch_size: side,
            color: planes(colors),
            features: planes(FEATURES),
            modulation: is_modulated.then(|| planes(3)),
            reference_hdr: planes(3),
            reference_light: (!inputs.is_demc()).then(|| planes(LIGHT)),
            patches,
        }
    }
}

/// Computes any batch of a training run, on any thread.
pub struct PatchSource {
    cache: SceneCache,
    patches: Vec<Patch>,
    epoch_orders: EpochOrders,
    normalizer: Normalizer,
    inputs: InputKind,
    patch_size: usize,
    batch_size: usize,
    augment: Augment,
    dropout: Dropout,
    workers: usize,
    seed: u64,
}

struct PatchDraw {
    patch: Patch,
    variation: Variation,
    /// Which of normal, position, texture1 and texture2 are dropped.
    dropped: [bool; 4],
}

/// One patch and its part of the batch's buffers.
struct PatchBuffers<'a> {
    draw: PatchDraw,
    color: &'a mut [f32],
    features: &'a mut [f32],
    reference: &'a mut [f32],
    modulation: Option<&'a mut [f32]>,
    reference_light: Option<&'a mut [f32]>,
}

/// The parts of a buffer that belong to the patches, of `count` values each; none of a missing buffer.
fn parts(buffer: Option<&mut Vec<f32>>, count: usize) -> impl Iterator<Item = &mut [f32]> {
    buffer
        .into_iter()
        .flat_map(move |all| all.chunks_exact_mut(count))
}

impl PatchSource {
    /// A source over the training `scenes`, which need a reference each. `normalizer` holds their
    /// statistics; `config` must be valid.
    ///
    /// # Errors
    /// [`Error::SceneTooSmall`]; [`Error::Layout`] if `layout` names no reference.
    ///
    /// # Panics
    /// If there are no scenes; [`crate::dataset::Dataset::split`] always returns at least one.
    pub fn new(
        config: &DataConfig,
        scenes: Vec<Scene>,
        layout: ChannelLayout,
        normalizer: Normalizer,
        seed: u64,
    ) -> Result<Self, Error> {
        if layout.reference.is_none() {
            let detail = "names no reference, which training needs".to_owned();
            return Err(Error::Layout {
                name: config.layout.clone(),
                detail,
            });
        }
        assert!(!scenes.is_empty(), "training needs at least one scene");
        let patches = patches(&scenes, config.patch_size, config.stride)?;
        Ok(Self {
            inputs: layout.inputs,
            cache: SceneCache::new(
                scenes,
                layout,
                config.preparation(),
                config.cache_mib.saturating_mul(1 << 20),
            ),
            epoch_orders: EpochOrders::new(patches.len(), seed),
            patches,
            normalizer,
            patch_size: config.patch_size,
            batch_size: config.batch_size,
            augment: config.augment,
            dropout: config.dropout,
            workers: config.workers,
            seed,
        })
    }

    /// The same source, whose scenes have the albedo that `filter` returns.
    pub fn with_albedo_filter(mut self, filter: AlbedoFilter) -> Self {
        self.cache = self.cache.with_albedo_filter(filter);
        self
    }

    /// The patches of one epoch, in grid order.
    pub fn patches(&self) -> &[Patch] {
        &self.patches
    }

    /// The scenes that [`Patch::scene`] refers to.
    pub fn scenes(&self) -> &[Scene] {
        self.cache.scenes()
    }

    /// Number of threads that a loader should run.
    pub fn workers(&self) -> usize {
        self.workers
    }

    /// Usage of the scene cache.
    pub fn cache_usage(&self) -> CacheUsage {
        self.cache.usage()
    }

    /// Batch `n` of the run.
    ///
    /// # Errors
    /// As [`SceneCache::get`], for any scene of the batch.
    pub fn batch(&self, n: u64) -> Result<Batch, Error> {
        let draws = self.draws(n);
        let inputs = self.inputs;
        let epsilon = self.normalizer.albedo_demodulation_epsilon;
        let is_modulated = epsilon.is_some() || !inputs.is_demc();
        let patches = draws.iter().map(|draw| draw.patch).collect();
        let mut batch = Batch::zeros(inputs, is_modulated, patches, self.patch_size);
        let mut places = batch.places(draws);
        // Scene by scene: with a cache smaller than the data, each scene is decoded once per batch.
        places.sort_by_key(|place| place.draw.patch.scene);
        for places in places.chunk_by_mut(|a, b| a.draw.patch.scene == b.draw.patch.scene) {
            let planes = self.cache.get(places[0].draw.patch.scene as usize)?;
            for place in places {
                match inputs {
                    InputKind::Demc => self.cut(&planes, place),
                    InputKind::Kpcn => self.cut_light(&planes, place),
                }
            }
        }
        Ok(batch)
    }

    fn draws(&self, n: u64) -> Vec<PatchDraw> {
        let count = self.patches.len() as u64;
        let mut epoch = n * self.batch_size as u64 / count;
        let mut position = n * self.batch_size as u64 % count;
        let mut draws = Vec::with_capacity(self.batch_size);
        while draws.len() < self.batch_size {
            let order = self.epoch_orders.get(epoch);
            for &index in order
                .iter()
                .skip(position as usize)
                .take(self.batch_size - draws.len())
            {
                let variation = self.augment.draw(self.seed, epoch, position);
                let patch = self.patches[index as usize];
                let scene = &self.cache.scenes()[patch.scene as usize];
                draws.push(PatchDraw {
                    patch: variation.place(patch, (scene.height, scene.width), self.patch_size),
                    variation,
                    dropped: self.dropout.draw(self.seed, epoch, position),
                });
                position += 1;
            }
            (epoch, position) = (epoch + 1, 0);
        }
        draws
    }

    /// Cuts one patch, augments it and converts it to the network's input space.
    fn cut(&self, from: &FramePlanes, place: &mut PatchBuffers<'_>) {
        let reference = from.reference.as_ref().expect("it is read as required");
        let (patch, size) = (place.draw.patch, self.patch_size);
        let variation = place.draw.variation;
        let rgb = variation.rgb;
        for (planes, out, order) in [
            (&from.color[..], &mut *place.color, rgb.to_vec()),
            (&from.features, place.features, feature_order(variation)),
            (reference, place.reference, rgb.to_vec()),
        ] {
            let planes = order.iter().map(|plane| &planes[*plane]);
            cut_planes(planes, from.width, patch, size, out);
            variation.turn(out, size);
        }
        mirror(place.features, variation.mirrored, size * size);
        if let Some(seed) = variation.noise {
            resample_noise(place.color, place.features, place.reference, size, seed);
        }
        for radiance in [&mut place.color, &mut place.reference] {
            radiance
                .iter_mut()
                .for_each(|value| *value *= variation.exposure * from.exposure_scale);
        }
        drop_buffers(place.features, place.draw.dropped);
        let modulation = self.normalizer.modulation(place.features);
        self.normalizer.compress(place.color, modulation.as_deref());
        if let (Some(out), Some(modulation)) = (&mut place.modulation, &modulation) {
            out.copy_from_slice(modulation);
        }
        self.normalizer.features_z_from_raw(place.features);
    }

    /// As [`cut`](Self::cut), for KPCN: flips, transposes, and exposures only.
    fn cut_light(&self, from: &FramePlanes, place: &mut PatchBuffers<'_>) {
        let (patch, size) = (place.draw.patch, self.patch_size);
        let variation = place.draw.variation;
        let scale = variation.exposure * from.exposure_scale;
        let cut = |planes: &[Plane]| {
            let mut out = vec![0.0; planes.len() * size * size];
            cut_planes(planes.iter(), from.width, patch, size, &mut out);
            variation.turn(&mut out, size);
            out
        };
        let required = "it is read as required";
        let passes = cut(from.passes.as_ref().expect(required));
        let input = KpcnInput::new(&passes, &cut(&from.features), scale);
        place.color.copy_from_slice(&input.light);
        place.features.copy_from_slice(&input.features);
        let reference = cut(from.reference.as_ref().expect(required));
        for (out, radiance) in place.reference.iter_mut().zip(reference) {
            *out = scale * radiance;
        }
        let mut light = cut(from.reference_passes.as_ref().expect(required));
        light_from_radiance(&mut light, &input.divisor, scale);
        for (out, planes) in [
            (&mut place.modulation, &input.divisor),
            (&mut place.reference_light, &light),
        ] {
            out.as_mut()
                .expect("a batch of KPCN")
                .copy_from_slice(planes);
        }
    }
}

fn three(first: usize, order: [usize; 3]) -> [usize; 3] {
    order.map(|channel| first + channel)
}

/// Indices of the planes that become the features. Normals and positions follow the order of axes;
/// textures follow the order of red, green and blue.
fn feature_order(variation: Variation) -> Vec<usize> {
    let Variation { axes, rgb, .. } = variation;
    let orders = [(0, axes), (3, axes), (TEXTURES, rgb), (TEXTURES + 3, rgb)];
    orders
        .into_iter()
        .flat_map(|(first, order)| three(first, order))
        .collect()
}

fn mirror(features: &mut [f32], mirrored: [bool; 3], pixels: usize) {
    let vectors = features[..TEXTURES * pixels].chunks_exact_mut(pixels);
    for (plane, mirrored) in vectors.zip(mirrored.into_iter().cycle()) {
        if mirrored {
            plane.iter_mut().for_each(|value| *value = -*value);
        }
    }
}

/// Copies a patch of every plane to `out`, `[planes, size, size]`.
fn cut_planes<'a>(
    planes: impl Iterator<Item = &'a Plane>,
    width: usize,
    patch: Patch,
    size: usize,
    out: &mut [f32],
) {
    let origin = patch.y as usize * width + patch.x as usize;
    for (plane, out) in planes.zip(out.chunks_exact_mut(size * size)) {
        for (row, out) in out.chunks_exact_mut(size).enumerate() {
            plane.copy_to(origin + row * width, out);
        }
    }
}
