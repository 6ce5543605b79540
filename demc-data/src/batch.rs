//! Batches of training patches. The patch stream is epoch 0, epoch 1, ... end to end, each epoch a seeded
//! permutation of all patches; batch n is patches `n B .. (n + 1) B` of it. So a batch depends on the
//! configuration, the seed and n only, and a resumed run goes on where it stopped.

use crate::augment::{Augment, Variation};
use crate::cache::{CacheUse, SceneCache};
use crate::frame::{FEATURES, FramePlanes, TEXTURES};
use crate::patch::{Patch, epoch_order, patches};
use crate::plane::Plane;
use crate::resample::resample_noise;
use crate::{ChannelLayout, DataConfig, Error, Normalizer, Scene};

/// Patches in the network's input space, with their references. B patches of P x P pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// B.
    pub size: usize,
    /// Noisy colour `[B, 3, P, P]`, gamma space, divided by the modulation.
    pub color_gamma: Vec<f32>,
    /// Features `[B, 12, P, P]`, Z-scored.
    pub features_z: Vec<f32>,
    /// What the network's output is multiplied by, `[B, 3, P, P]`, gamma space ([`Normalizer::modulation`]).
    pub modulation: Option<Vec<f32>>,
    /// Reference colour `[B, 3, P, P]`, linear HDR.
    pub reference_hdr: Vec<f32>,
    /// Where each patch was cut, before it was turned.
    pub patches: Vec<Patch>,
}

/// Makes any batch of a training run, from any thread.
pub struct PatchSource {
    cache: SceneCache,
    patches: Vec<Patch>,
    normalizer: Normalizer,
    patch_size: usize,
    batch_size: usize,
    augment: Augment,
    workers: usize,
    seed: u64,
}

/// One place in the patch stream.
struct Draw {
    patch: Patch,
    variation: Variation,
}

/// One patch's share of a batch's buffers.
struct Place<'a> {
    draw: Draw,
    color: &'a mut [f32],
    features: &'a mut [f32],
    reference: &'a mut [f32],
    modulation: Option<&'a mut [f32]>,
}

impl PatchSource {
    /// A source over the training `scenes`, which have a reference each. `normalizer` holds their statistics;
    /// `config` must be valid.
    ///
    /// # Errors
    /// [`Error::SceneTooSmall`]; [`Error::Layout`] if `layout` names no reference.
    ///
    /// # Panics
    /// If there are no scenes: [`crate::Dataset::split`] never returns none.
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
        let patches = patches(&scenes, config.patch_size, config.stride, config.border)?;
        Ok(Self {
            cache: SceneCache::new(scenes, layout, config.cache_mib.saturating_mul(1 << 20))
                .with_reference_filter(config.reference_filter),
            patches,
            normalizer,
            patch_size: config.patch_size,
            batch_size: config.batch_size,
            augment: config.augment,
            workers: config.workers,
            seed,
        })
    }

    /// The patches of one epoch, in grid order.
    pub fn patches(&self) -> &[Patch] {
        &self.patches
    }

    /// The scenes that [`Patch::scene`] counts.
    pub fn scenes(&self) -> &[Scene] {
        self.cache.scenes()
    }

    /// How many threads a loader should run.
    pub fn workers(&self) -> usize {
        self.workers
    }

    /// What the scene cache holds.
    pub fn cache_usage(&self) -> CacheUse {
        self.cache.usage()
    }

    /// Batch `n` of the run.
    ///
    /// # Errors
    /// As [`SceneCache::get`], for a scene that it needs.
    pub fn batch(&self, n: u64) -> Result<Batch, Error> {
        let draws = self.draws(n);
        let pixels = self.patch_size * self.patch_size;
        let mut batch = Batch {
            size: draws.len(),
            color_gamma: vec![0.0; draws.len() * 3 * pixels],
            features_z: vec![0.0; draws.len() * FEATURES * pixels],
            modulation: (self.normalizer.demodulate > 0.0)
                .then(|| vec![0.0; draws.len() * 3 * pixels]),
            reference_hdr: vec![0.0; draws.len() * 3 * pixels],
            patches: draws.iter().map(|draw| draw.patch).collect(),
        };
        let color = batch.color_gamma.chunks_exact_mut(3 * pixels);
        let features = batch.features_z.chunks_exact_mut(FEATURES * pixels);
        let reference = batch.reference_hdr.chunks_exact_mut(3 * pixels);
        let modulation = batch.modulation.iter_mut();
        let mut modulation = modulation.flat_map(|all| all.chunks_exact_mut(3 * pixels));
        let mut places: Vec<Place> = draws
            .into_iter()
            .zip(color.zip(features.zip(reference)))
            .map(|(draw, (color, (features, reference)))| Place {
                draw,
                color,
                features,
                reference,
                modulation: modulation.next(),
            })
            .collect();
        // Scene by scene: with a cache smaller than the data, each scene is decoded once a batch.
        places.sort_by_key(|place| place.draw.patch.scene);
        for places in places.chunk_by_mut(|a, b| a.draw.patch.scene == b.draw.patch.scene) {
            let planes = self.cache.get(places[0].draw.patch.scene as usize)?;
            for place in places {
                self.cut(&planes, place);
            }
        }
        Ok(batch)
    }

    /// Where batch `n` is cut, in the order of the stream.
    fn draws(&self, n: u64) -> Vec<Draw> {
        let count = self.patches.len() as u64;
        let mut epoch = n * self.batch_size as u64 / count;
        let mut position = n * self.batch_size as u64 % count;
        let mut draws = Vec::with_capacity(self.batch_size);
        while draws.len() < self.batch_size {
            let order = epoch_order(self.patches.len(), self.seed, epoch);
            for &index in order
                .iter()
                .skip(position as usize)
                .take(self.batch_size - draws.len())
            {
                let variation = self.augment.draw(self.seed, epoch, position);
                let patch = self.patches[index as usize];
                let scene = &self.cache.scenes()[patch.scene as usize];
                draws.push(Draw {
                    patch: variation.place(patch, (scene.height, scene.width), self.patch_size),
                    variation,
                });
                position += 1;
            }
            (epoch, position) = (epoch + 1, 0);
        }
        draws
    }

    /// Cuts one patch, varies it and takes it to the network's space.
    fn cut(&self, from: &FramePlanes, place: &mut Place<'_>) {
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
                .for_each(|value| *value *= variation.exposure);
        }
        let modulation = self.normalizer.modulation(place.features);
        self.normalizer
            .color_gamma_from_hdr(place.color, modulation.as_deref());
        if let (Some(out), Some(modulation)) = (&mut place.modulation, &modulation) {
            out.copy_from_slice(modulation);
        }
        self.normalizer.features_z_from_raw(place.features);
    }
}

/// Which planes become the channels `order`, of three that begin at `first`.
fn three(first: usize, order: [usize; 3]) -> [usize; 3] {
    order.map(|channel| first + channel)
}

/// Which planes become the features: normals and positions in the order of the axes, textures in that of red, green and blue.
fn feature_order(variation: Variation) -> Vec<usize> {
    let Variation { axes, rgb, .. } = variation;
    let orders = [(0, axes), (3, axes), (TEXTURES, rgb), (TEXTURES + 3, rgb)];
    orders
        .into_iter()
        .flat_map(|(first, order)| three(first, order))
        .collect()
}

/// Turns axes of normals and positions round.
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
