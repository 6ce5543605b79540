//! Decoded scenes, kept in the precision of their files up to a budget of memory; beyond it the least
//! recently used one goes and is decoded again when it is next wanted. The 97 scenes of 1280x720 of the
//! paper's training set (15 half and 3 float planes) are 3.8 GB: they fit the default budget.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::dataset::size_mismatch;
use crate::frame::{FramePlanes, Presence};
use crate::reference_filter::filter_reference;
use crate::{ChannelLayout, Error, Scene};

/// The scenes of a training run, decoded on demand: colour, features and reference, no mask.
pub struct SceneCache {
    scenes: Vec<Scene>,
    layout: ChannelLayout,
    budget: usize,
    reference_filter: bool,
    /// Held by the thread that decodes a scene: others that want it wait and then find it.
    turns: Vec<Mutex<()>>,
    kept: Mutex<Kept>,
}

/// What a cache has done so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CacheUse {
    /// Scenes in memory.
    pub scenes: usize,
    /// Their size in bytes; never above the budget.
    pub bytes: usize,
    /// Files decoded since the start.
    pub decoded: u64,
}

#[derive(Default)]
struct Kept {
    scenes: HashMap<usize, Entry>,
    bytes: usize,
    decoded: u64,
    clock: u64,
}

struct Entry {
    planes: Arc<FramePlanes>,
    last_use: u64,
}

impl SceneCache {
    /// An empty cache over `scenes` that keeps at most `budget` bytes.
    pub fn new(scenes: Vec<Scene>, layout: ChannelLayout, budget: usize) -> Self {
        let turns = scenes.iter().map(|_| Mutex::default()).collect();
        Self {
            scenes,
            layout,
            budget,
            reference_filter: false,
            turns,
            kept: Mutex::default(),
        }
    }

    /// The same, with references filtered as they are decoded ([`crate::reference_filter`]) if `on`, but those that are denoised already.
    pub fn with_reference_filter(self, on: bool) -> Self {
        Self {
            reference_filter: on,
            ..self
        }
    }

    /// The scenes that it serves.
    pub fn scenes(&self) -> &[Scene] {
        &self.scenes
    }

    /// The planes of the scene at `index`, from memory or from its file. Callers on several threads decode
    /// different scenes at the same time and the same one once.
    ///
    /// # Errors
    /// As [`crate::read_frame`]; also [`Error::SceneSize`]. Nothing is kept, so the next call tries again.
    ///
    /// # Panics
    /// If there is no such scene.
    pub fn get(&self, index: usize) -> Result<Arc<FramePlanes>, Error> {
        let _turn = lock(&self.turns[index]);
        if let Some(planes) = lock(&self.kept).find(index) {
            return Ok(planes);
        }
        let scene = &self.scenes[index];
        let mut planes = FramePlanes::read(
            &scene.path,
            &self.layout,
            Presence::Required,
            Presence::Skip,
        )?;
        if let Some(error) = size_mismatch(scene, planes.width, planes.height) {
            return Err(error);
        }
        if self.reference_filter && scene.ref_denoised.is_none() {
            filter_reference(&mut planes);
        }
        let planes = Arc::new(planes);
        lock(&self.kept).keep(index, &planes, self.budget);
        Ok(planes)
    }

    /// What it holds now and has done so far.
    pub fn usage(&self) -> CacheUse {
        let kept = lock(&self.kept);
        CacheUse {
            scenes: kept.scenes.len(),
            bytes: kept.bytes,
            decoded: kept.decoded,
        }
    }
}

impl Kept {
    fn find(&mut self, index: usize) -> Option<Arc<FramePlanes>> {
        self.clock += 1;
        let entry = self.scenes.get_mut(&index)?;
        entry.last_use = self.clock;
        Some(Arc::clone(&entry.planes))
    }

    /// Makes room first, so that the budget is never exceeded; a scene larger than all of it is not kept.
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
                .map(|(&index, _)| index);
            let oldest = oldest.expect("bytes are counted for entries only");
            let gone = self.scenes.remove(&oldest).expect("it was just found");
            self.bytes -= gone.planes.bytes();
        }
        self.bytes += bytes;
        self.scenes.insert(
            index,
            Entry {
                planes: Arc::clone(planes),
                last_use: self.clock,
            },
        );
    }
}

/// A panic elsewhere leaves nothing half done behind these locks.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
