//! A cache of decoded scenes, in the precision of their files, with a memory budget. Beyond the
//! budget, the least recently used scene is dropped and decoded again when needed. The 97 scenes of
//! 1280x720 of the paper's training set (15 half and 3 float planes) take 3.8 GB, which the default
//! budget holds.

use std::collections::HashMap;
use std::error::Error as StdError;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::dataset::{Scene, size_mismatch};
use crate::error::Error;
use crate::image::frame::{Frame, FramePlanes, Presence, TEXTURES, frame_of};
use crate::image::layout::ChannelLayout;
use crate::image::plane::Plane;
use crate::input::preparation::Preparation;

/// Returns the filtered albedo of the first hit, planar `[3, H, W]`, or `None` to keep that of the
/// frame.
pub type AlbedoFilter =
    Arc<dyn Fn(&Frame) -> Result<Option<Vec<f32>>, Box<dyn StdError + Send + Sync>> + Send + Sync>;

/// The scenes of a training run, decoded on demand and prepared: colour, features and reference, no
/// mask.
pub struct SceneCache {
    scenes: Vec<Scene>,
    layout: ChannelLayout,
    preparation: Preparation,
    albedo_filter: Option<AlbedoFilter>,
    budget: usize,
    turns: Vec<Mutex<()>>,
    kept: Mutex<CachedScenes>,
}

/// Counters of a cache.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CacheUsage {
    /// Scenes in memory.
    pub scenes: usize,
    /// Their size in bytes; at most the budget.
    pub bytes: usize,
    /// Number of files decoded so far.
    pub decoded: u64,
}

#[derive(Default)]
struct CachedScenes {
    scenes: HashMap<usize, CachedScene>,
    bytes: usize,
    decoded: u64,
    clock: u64,
}

struct CachedScene {
    planes: Arc<FramePlanes>,
    last_use: u64,
}

impl SceneCache {
    /// An empty cache over `scenes` that holds at most `budget` bytes.
    pub fn new(
        scenes: Vec<Scene>,
        layout: ChannelLayout,
        preparation: Preparation,
        budget: usize,
    ) -> Self {
        let turns = scenes.iter().map(|_| Mutex::default()).collect();
        Self {
            scenes,
            layout,
            preparation,
            albedo_filter: None,
            budget,
            turns,
            kept: Mutex::default(),
        }
    }

    /// The same cache, whose scenes have the albedo that `filter` returns.
    pub fn with_albedo_filter(mut self, filter: AlbedoFilter) -> Self {
        self.albedo_filter = Some(filter);
        self
    }

    /// The scenes of this cache.
    pub fn scenes(&self) -> &[Scene] {
        &self.scenes
    }

    /// The planes of the scene at `index`, from memory or from its file. Threads decode different
    /// scenes in parallel and the same scene once.
    ///
    /// # Errors
    /// As [`crate::image::frame::read_frame`]; also [`Error::SceneSize`] and [`Error::AlbedoFilter`]. A failed
    /// scene is not cached, so the next call tries again.
    ///
    /// # Panics
    /// If `index` is out of range.
    pub fn get(&self, index: usize) -> Result<Arc<FramePlanes>, Error> {
        let _turn = lock(&self.turns[index]);
        if let Some(planes) = lock(&self.kept).find(index) {
            return Ok(planes);
        }
        let scene = &self.scenes[index];
        let mut planes = FramePlanes::read(
            &scene.path,
            scene.layout(&self.layout),
            Presence::Required,
            Presence::Skip,
        )?;
        if let Some(error) = size_mismatch(scene, planes.width, planes.height) {
            return Err(error);
        }
        if let Some(filter) = &self.albedo_filter {
            filter_albedo(&mut planes, &scene.path, filter)?;
        }
        planes.exposure_scale = self.preparation.apply(&mut planes);
        let planes = Arc::new(planes);
        lock(&self.kept).keep(index, &planes, self.budget);
        Ok(planes)
    }

    /// The current counters.
    pub fn usage(&self) -> CacheUsage {
        let kept = lock(&self.kept);
        CacheUsage {
            scenes: kept.scenes.len(),
            bytes: kept.bytes,
            decoded: kept.decoded,
        }
    }
}

impl CachedScenes {
    fn find(&mut self, index: usize) -> Option<Arc<FramePlanes>> {
        self.clock += 1;
        let entry = self.scenes.get_mut(&index)?;
        entry.last_use = self.clock;
        Some(Arc::clone(&entry.planes))
    }

    /// Makes room first, so that the budget is never exceeded. A scene larger than the budget is
    /// not cached.
    fn keep(&mut self, index: usize, planes: &Arc<FramePlanes>, budget: usize) {
        self.decoded += 1;
        let bytes = planes.bytes();
        if bytes > budget {
            return;
        }
        while self.bytes + bytes > budget {
            let oldest = self
                .scenes
                .iter()
                .min_by_key(|(_, entry)| entry.last_use)
                .map(|(&index, _)| index)
                .expect("bytes are counted for entries only");
            let gone = self.scenes.remove(&oldest).expect("it was just found");
            self.bytes -= gone.planes.bytes();
        }
        self.bytes += bytes;
        self.scenes.insert(
            index,
            CachedScene {
                planes: Arc::clone(planes),
                last_use: self.clock,
            },
        );
    }
}

fn filter_albedo(
    planes: &mut FramePlanes,
    path: &Path,
    filter: &AlbedoFilter,
) -> Result<(), Error> {
    let input = FramePlanes {
        color: planes.color.clone(),
        features: planes.features.clone(),
        reference: None,
        mask: None,
        alpha: None,
        passes: None,
        reference_passes: None,
        ..*planes
    };
    let filtered = filter(&frame_of(input, path)?)
        .map_err(|source| Error::AlbedoFilter {
            path: path.to_owned(),
            source,
        })?
        .unwrap_or_default();
    let albedo = planes.features[TEXTURES..].iter_mut();
    for (plane, filtered) in albedo.zip(filtered.chunks_exact(planes.width * planes.height)) {
        *plane = Plane::Float(filtered.to_vec());
    }
    Ok(())
}

/// A panic cannot leave inconsistent state behind these locks.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
