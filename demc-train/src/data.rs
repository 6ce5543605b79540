//! The data of a run: the scenes of each split and the statistics of those that are trained on.

use anyhow::Context;
use demc_data::{
    ChannelLayout, DataConfig, Dataset, Normalizer, Ranges, Scene, Split, Statistics, read_frame,
};
use demc_infer::bundle::BundleMeta;
use demc_model::ModelConfig;

/// A data set, opened, split and measured.
#[derive(Debug)]
pub struct Data {
    /// What is in the files.
    pub layout: ChannelLayout,
    /// Scenes that are trained on.
    pub train: Vec<Scene>,
    /// Scenes of the training split that are held out by base scene; may be empty.
    pub validation: Vec<Scene>,
    /// The test split; may be empty.
    pub test: Vec<Scene>,
    /// Gamma and the statistics of [`Self::train`].
    pub normalizer: Normalizer,
    /// What each of [`Self::train`] was like, and what the weights that the run began with had seen before.
    pub ranges: Ranges,
    /// Negative values of colour and reference that count as 0.
    pub clamped: u64,
}

impl Data {
    /// Opens the data set that `config` names and reads every scene once, so that a bad one is found before the first
    /// step; `seed` draws the validation scenes.
    ///
    /// # Errors
    /// A layout, manifest or image that cannot be used, or a training split without scenes.
    pub fn open(config: &DataConfig, seed: u64) -> anyhow::Result<Self> {
        let layout = ChannelLayout::resolve(&config.layout)?;
        let dataset = Dataset::open(&config.root, &layout)?;
        let (train, validation) = dataset.train_validation(config.validation, seed)?;
        let test: Vec<Scene> = dataset
            .scenes
            .iter()
            .filter(|scene| scene.split == Split::Test)
            .cloned()
            .collect();
        let all: Vec<Scene> = train.iter().chain(&validation).cloned().collect();
        // Also those that this seed happens to hold out: another may not.
        demc_data::patch::patches(&all, config.patch_size, config.stride, config.border)?;
        let statistics = Statistics::measure(&train, &layout, config.gamma, config.demodulate)
            .context("measuring the training scenes")?;
        let mut clamped = statistics.clamped;
        for scene in validation.iter().chain(&test) {
            // Now, not when a run of days comes to its table.
            clamped += read_frame(&scene.path, &layout)?.clamped as u64;
        }
        Ok(Data {
            layout,
            train,
            validation,
            test,
            normalizer: statistics.normalizer,
            ranges: match config.augment.axes {
                true => statistics.ranges.in_any_axes(),
                false => statistics.ranges,
            },
            clamped,
        })
    }

    /// What belongs to weights of a network that is trained on this, at `step`.
    pub fn meta(&self, model: ModelConfig, step: u64) -> BundleMeta {
        BundleMeta::new(model, self.normalizer.clone(), self.layout.clone(), step)
            .with_ranges(self.ranges.clone())
    }

    /// `10 training scenes, 2 for validation, 4 for testing`.
    pub fn summary(&self) -> String {
        let [train, validation, test] = [&self.train, &self.validation, &self.test].map(Vec::len);
        format!("{train} scenes to train on, {validation} to validate, {test} to test")
    }
}
