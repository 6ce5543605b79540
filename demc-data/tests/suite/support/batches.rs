//! Batches of the sample.

use std::sync::Arc;

use demc_data::{Augment, Batch, DataConfig, Dataset, PatchSource, Scene, Split};

use super::{identity, layout, sample};

/// The sample's training scenes.
pub fn train_scenes() -> Vec<Scene> {
    Dataset::open(&sample(), &layout())
        .and_then(|set| set.split(Split::Train))
        .expect("the sample is sound")
}

/// Batches of seven small patches.
pub fn small() -> DataConfig {
    DataConfig {
        patch_size: 64,
        stride: 80,
        batch_size: 7,
        ..DataConfig::default()
    }
}

/// The source of these batches.
pub fn source(config: &DataConfig) -> Arc<PatchSource> {
    let source = PatchSource::new(config, train_scenes(), layout(), identity(), 7);
    Arc::new(source.expect("the sample is large enough"))
}

/// The first batch, with these augmentations.
pub fn first_batch(augment: Augment) -> Batch {
    let source = source(&DataConfig { augment, ..small() });
    source.batch(0).expect("the sample is sound")
}
