//! Training patches and their order: a grid over every scene (Sec. 4.2: 128 x 128 at stride 80),
//! shuffled again each epoch. A patch is an index, not a file.

use std::sync::{Arc, Mutex, PoisonError};

use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

use crate::dataset::Scene;
use crate::error::Error;
use crate::seed::{RandomStream, generator};

/// A square of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Patch {
    /// Index of the scene in the list that the patches are made from.
    pub scene: u32,
    /// Top edge, in pixels.
    pub y: u32,
    /// Left edge, in pixels.
    pub x: u32,
}

/// All patches of `scenes`: scene by scene, row by row, and those of a scene as often as it repeats.
/// Where the grid leaves pixels over, a last column and row of patches at the edge covers them (ours: the
/// paper is silent).
///
/// # Errors
/// [`Error::SceneTooSmall`], naming the first scene that holds no patch.
///
/// # Panics
/// If `size` or `stride` is 0.
pub fn patches(scenes: &[Scene], size: usize, stride: usize) -> Result<Vec<Patch>, Error> {
    let mut patches = Vec::new();
    for (index, scene) in scenes.iter().enumerate() {
        let rows = origins(scene.height, size, stride);
        let columns = origins(scene.width, size, stride);
        if rows.is_empty() || columns.is_empty() {
            let (width, height) = (scene.width, scene.height);
            return Err(Error::SceneTooSmall {
                scene: scene.name.clone(),
                width,
                height,
                patch: size,
            });
        }
        for _ in 0..scene.repeat.get() {
            for &y in &rows {
                patches.extend(columns.iter().map(|&x| Patch {
                    scene: index as u32,
                    y,
                    x,
                }));
            }
        }
    }
    Ok(patches)
}

/// Start positions of patches of `size` along an edge of `length` pixels; empty if no patch fits.
fn origins(length: usize, size: usize, stride: usize) -> Vec<u32> {
    assert!(
        size > 0 && stride > 0,
        "patch size {size} and stride {stride} must be positive"
    );
    let Some(last) = length.checked_sub(size) else {
        return Vec::new();
    };
    let mut origins: Vec<u32> = (0..=last)
        .step_by(stride)
        .map(|origin| origin as u32)
        .collect();
    if last % stride != 0 {
        origins.push(last as u32);
    }
    origins
}

/// The order in which an epoch visits `count` patches: a permutation of `0..count` that depends
/// only on `seed` and `epoch`.
pub fn epoch_order(count: usize, seed: u64, epoch: u64) -> Vec<u32> {
    let mut order: Vec<u32> = (0..count as u32).collect();
    order.shuffle(&mut generator(RandomStream::Shuffle, seed, epoch, 0));
    order
}

/// The orders of a run's epochs. The latest order is cached, because every batch of an epoch uses
/// it and a shuffle takes time proportional to the number of patches.
pub(crate) struct EpochOrders {
    count: usize,
    seed: u64,
    latest: Mutex<Option<(u64, Arc<[u32]>)>>,
}

impl EpochOrders {
    pub(crate) fn new(count: usize, seed: u64) -> Self {
        Self {
            count,
            seed,
            latest: Mutex::default(),
        }
    }

    /// [`epoch_order`] of `epoch`. Threads that need a new epoch at the same time shuffle it once.
    pub(crate) fn get(&self, epoch: u64) -> Arc<[u32]> {
        // A single assignment replaces the value, so a panic leaves it consistent.
        let mut latest = self.latest.lock().unwrap_or_else(PoisonError::into_inner);
        match &*latest {
            Some((known, order)) if *known == epoch => Arc::clone(order),
            _ => {
                let order: Arc<[u32]> = epoch_order(self.count, self.seed, epoch).into();
                *latest = Some((epoch, Arc::clone(&order)));
                order
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::num::NonZero;

    use super::*;
    use crate::dataset::Split;

    fn scene(name: &str, width: usize, height: usize) -> Scene {
        Scene {
            name: name.to_owned(),
            split: Split::Train,
            base: name.to_owned(),
            path: "none.exr".into(),
            width,
            height,
            ref_residual_relmse: None,
            repeat: NonZero::<u8>::MIN,
            layout: None,
            other: serde_json::Map::new(),
        }
    }

    #[test]
    fn the_last_patch_reaches_the_edge() {
        assert_eq!(origins(300, 128, 80), [0, 80, 160, 172]);
    }

    #[test]
    fn a_grid_that_fits_exactly_is_not_doubled_at_the_edge() {
        assert_eq!(origins(288, 128, 80), [0, 80, 160]);
        assert_eq!(origins(128, 128, 80), [0]);
    }

    #[test]
    fn patches_cover_every_pixel() {
        for length in 128..420 {
            let mut covered = vec![false; length];
            for origin in origins(length, 128, 80) {
                covered[origin as usize..][..128].fill(true);
            }
            assert!(covered.into_iter().all(|pixel| pixel), "length {length}");
        }
    }

    #[test]
    fn a_hd_scene_has_16_by_9_patches() {
        let patches = patches(&[scene("a", 1280, 720)], 128, 80).expect("large enough");
        assert_eq!(patches.len(), 16 * 9);
        assert_eq!(
            patches[143],
            Patch {
                scene: 0,
                y: 592,
                x: 1152
            }
        );
    }

    #[test]
    fn a_repeated_scene_has_its_patches_as_often() {
        let mut scenes = [scene("few", 256, 128), scene("many", 128, 128)];
        scenes[1].repeat = NonZero::new(3).expect("not 0");
        let patches = patches(&scenes, 128, 128).expect("large enough");
        let drawn: Vec<u32> = patches.iter().map(|patch| patch.scene).collect();
        assert_eq!(drawn, [0, 0, 1, 1, 1]);
        assert!(patches[2..].iter().all(|patch| *patch == patches[2]));
    }

    #[test]
    fn a_scene_smaller_than_a_patch_is_named() {
        let scenes = [scene("large", 200, 200), scene("narrow", 127, 500)];
        let error = patches(&scenes, 128, 80)
            .expect_err("too small")
            .to_string();
        assert_eq!(
            error,
            "scene narrow: 127x500 pixels hold no patch of 128x128"
        );
    }

    #[test]
    fn an_epoch_visits_every_patch_once_in_its_own_order() {
        let order = epoch_order(90, 7, 3);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, (0..90).collect::<Vec<u32>>());
        assert_eq!(order, epoch_order(90, 7, 3));
        assert_ne!(order, epoch_order(90, 7, 4));
        assert_ne!(order, epoch_order(90, 8, 3));
    }

    #[test]
    fn a_kept_order_is_that_of_its_epoch_on_any_thread() {
        let orders = EpochOrders::new(90, 7);
        std::thread::scope(|scope| {
            for first in 0..4 {
                let orders = &orders;
                scope.spawn(move || {
                    for epoch in [first, 0, 1, 1, 0] {
                        assert_eq!(orders.get(epoch)[..], epoch_order(90, 7, epoch));
                    }
                });
            }
        });
        assert!(Arc::ptr_eq(&orders.get(5), &orders.get(5)));
    }
}
