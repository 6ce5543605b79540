//! The data of a run: the scenes of each split, and the statistics of the training scenes.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, ensure};
use demc_data::check::content;
use demc_data::image::exr::ExrFile;
use demc_data::image::frame::{FramePlanes, Presence};
use demc_data::image::layout::Passes;
use demc_data::{
    BatchLoader, ChannelLayout, DataConfig, Dataset, Dropout, Normalizer, PatchSource, Ranges,
    Scene, Split, Statistics,
};
use demc_infer::Bundle;
use demc_infer::bundle::{BundleMeta, locate};
use demc_model::ModelConfig;
use demc_program::checksum::sha256_of;
use demc_program::message::short_list;
use demc_program::output::Outputs;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::config::Config;
use crate::ranks::NodeShare;

/// The scenes and statistics of a run.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct TrainingData {
    /// Channels of the files.
    pub layout: ChannelLayout,
    /// Training scenes.
    pub train: Vec<Scene>,
    /// Scenes of the training split that are held out by base scene; may be empty.
    pub validation: Vec<Scene>,
    /// The test split; may be empty.
    pub test: Vec<Scene>,
    /// Gamma, and the statistics of [`Self::train`].
    pub normalizer: Normalizer,
    /// Ranges of [`Self::train`], and of the scenes that initial weights were trained on.
    pub ranges: Ranges,
    /// The licence of the initial weights, if they come from another program.
    pub license: Option<String>,
    /// Which buffers training drops, so that files may lack them.
    pub dropout: Dropout,
    /// SHA-256 of each scene's file, by the scene's name.
    pub checksums: BTreeMap<String, String>,
    /// Suspicious signs in the scenes, one line each.
    pub warnings: Vec<String>,
    /// Number of negative values of colour and reference, which are clamped to 0.
    pub clamped: u64,
}

fn checksums<'a>(
    scenes: impl Iterator<Item = &'a Scene>,
) -> Result<BTreeMap<String, String>, demc_data::Error> {
    scenes
        .map(|scene| Ok((scene.name.clone(), sha256_of(&scene.path)?)))
        .collect()
}

/// What a data set contains.
pub struct DataContents {
    /// The SHA-256 of each scene's file, by the scene's name.
    pub checksums: BTreeMap<String, String>,
    /// What a run's numbers depend on. There is a line for each scene in the manifest's order, with its own
    /// channel layout if it has one. The data set's layout follows if it is not the default.
    pub text: String,
}

impl DataContents {
    /// The contents of the data set in `root`, read with `layout`, a preset or a file.
    ///
    /// # Errors
    /// A layout, manifest, or file that cannot be read.
    pub fn of(root: &Path, layout: &str) -> Result<Self, demc_data::Error> {
        let scenes = Dataset::list(root)?;
        let checksums = checksums(scenes.iter())?;
        let of_set = ChannelLayout::resolve(layout)?;
        let is_default = of_set == ChannelLayout::resolve(&DataConfig::default().layout)?;
        let of_set = (!is_default).then(|| format!("{}\n", json!(of_set)));
        let lines = scenes.iter().map(|scene| {
            let Scene {
                name,
                split,
                base,
                repeat,
                layout,
                ..
            } = scene;
            let layout = layout.as_ref().map(|layout| format!("  {}", json!(layout)));
            let layout = layout.unwrap_or_default();
            format!(
                "{}  {name}  {split}  {base}  {repeat}{layout}\n",
                checksums[name]
            )
        });
        Ok(Self {
            text: lines.chain(of_set).collect(),
            checksums,
        })
    }
}

/// A warning for each group of scenes with equal files.
fn copies(checksums: &BTreeMap<String, String>) -> Vec<String> {
    let mut scenes: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (name, sum) in checksums {
        scenes.entry(sum).or_default().push(name);
    }
    let groups = scenes.values().filter(|names| names.len() > 1);
    groups
        .map(|names| format!("copies of one image: {}", short_list(names)))
        .collect()
}

/// Protects the configuration `files` and what a run of `config` reads: data set, channel layout,
/// initial weights.
///
/// # Errors
/// No data set.
pub fn protect_inputs(
    outputs: &mut Outputs,
    files: &[PathBuf],
    config: &Config,
) -> Result<(), demc_data::Error> {
    for file in files {
        outputs.protect(file, "the configuration");
    }
    outputs.protect(Path::new(&config.data.layout), "the channel layout");
    for file in config
        .train
        .init
        .iter()
        .flat_map(|init| locate::files(init))
    {
        outputs.protect(&file, "the initial weights");
    }
    demc_data::Dataset::protect(&config.data.root, outputs)?;
    Ok(())
}

/// The batches of a `share` of each step from `step` on, in steps of `per_step` batches.
pub fn share_loader(
    source: Arc<PatchSource>,
    share: Range<usize>,
    per_step: usize,
    step: u64,
) -> BatchLoader {
    let (first, own) = (share.start as u64, share.len() as u64);
    let number = move |n: u64| n / own * per_step as u64 + first + n % own;
    BatchLoader::of_numbers(source, step * own, number)
}

impl TrainingData {
    /// Opens the data set and reads every scene once, so that an invalid one is found before the
    /// first step. The seed draws the validation scenes.
    ///
    /// # Errors
    /// An invalid layout, manifest or image; a training split without scenes, or whose scenes are
    /// all black or beyond the range of the loss.
    pub fn open(config: &Config) -> anyhow::Result<Self> {
        let DataConfig {
            root,
            layout,
            validation,
            patch_size,
            stride,
            ..
        } = &config.data;
        let mut layout = ChannelLayout::resolve(layout)?;
        layout.inputs = config.inputs();
        if layout.inputs.is_demc() {
            // The network does not read them, so weights and run records do not name them.
            layout.passes = Passes::default();
        }
        let dataset = Dataset::open(root, &layout)?;
        let (train, validation) = dataset.train_validation(*validation, config.train.seed)?;
        let test: Vec<Scene> = dataset
            .scenes
            .iter()
            .filter(|scene| scene.split == Split::Test)
            .cloned()
            .collect();
        let all: Vec<Scene> = train.iter().chain(&validation).cloned().collect();
        // Validation scenes too: another seed may train on them.
        demc_data::training::patch::patches(&all, *patch_size, *stride)?;
        let statistics =
            Statistics::measure(&train, &layout, &config.data, config.loss.relmse_epsilon)
                .context("measuring the training scenes")?;
        let unusable = content::unusable(&statistics.suspicious);
        ensure!(
            unusable.is_empty(),
            "data set {}: no training scene can be learned from: {}; render them again or correct data.layout",
            root.display(),
            unusable.join("; ")
        );
        let (mut clamped, mut suspicious) = (statistics.clamped, statistics.suspicious);
        let present = Presence::IfPresent;
        for scene in validation.iter().chain(&test) {
            // Now, not after days of training.
            let layout = scene.layout(&layout);
            let mut file = ExrFile::open(&scene.path)?;
            let planes = FramePlanes::decode(&mut file, layout, present, present)?;
            clamped += planes.clamped as u64;
            suspicious.push((scene.name.clone(), content::suspicious(&planes, layout)));
        }
        // The files were just read, so the system has them in memory.
        let checksums = checksums(train.iter().chain(&validation).chain(&test))?;
        let mut warnings = content::by_problem(&suspicious);
        warnings.extend(copies(&checksums));
        Ok(TrainingData {
            layout,
            train,
            validation,
            test,
            normalizer: statistics.normalizer,
            license: None,
            ranges: if config.data.augment.axes {
                statistics.ranges.in_any_axes()
            } else {
                statistics.ranges
            },
            dropout: config.data.dropout,
            checksums,
            warnings,
            clamped,
        })
    }

    /// Compares the files on this node with the checksums. The processes of the node share the work.
    ///
    /// # Errors
    /// The first scene that is missing or differs.
    pub fn check_files(&self, node: NodeShare) -> anyhow::Result<()> {
        let scenes = self.train.iter().chain(&self.validation).chain(&self.test);
        for scene in scenes.skip(node.index).step_by(node.count) {
            let found = sha256_of(&scene.path).with_context(|| format!("scene {}", scene.name))?;
            ensure!(
                self.checksums.get(&scene.name) == Some(&found),
                "scene {}: {} differs from the file of rank 0",
                scene.name,
                scene.path.display()
            );
        }
        Ok(())
    }

    /// The source of the training patches, whose albedo is filtered as validation and denoising
    /// filter it. The processes of a node share `data.cache_mib`.
    ///
    /// # Errors
    /// Scenes smaller than a patch.
    pub fn patch_source(
        &self,
        config: &Config,
        node: NodeShare,
        albedo_filter: Option<&Bundle>,
    ) -> Result<PatchSource, demc_data::Error> {
        let mut data = config.data.clone();
        data.cache_mib /= node.count;
        let source = PatchSource::new(
            &data,
            self.train.clone(),
            self.layout.clone(),
            self.normalizer.clone(),
            config.train.seed,
        )?;
        Ok(match albedo_filter.cloned() {
            None => source,
            Some(filter) => {
                source.with_albedo_filter(Arc::new(move |frame| Ok(filter.filtered_albedo(frame)?)))
            }
        })
    }

    /// The description of weights that are trained on this data, at `step`.
    pub fn meta(&self, model: ModelConfig, step: u64) -> BundleMeta {
        let mut layout = self.layout.clone();
        layout.missing = layout.missing.or(self.dropout.missing());
        let meta = BundleMeta::new(model, self.normalizer.clone(), layout, step)
            .with_ranges(self.ranges.clone());
        match &self.license {
            Some(license) => meta.with_license(license),
            None => meta,
        }
    }

    /// `10 training scenes, 2 validation scenes, 4 test scenes`
    pub fn summary(&self) -> String {
        let counts = [
            (&self.train, "training"),
            (&self.validation, "validation"),
            (&self.test, "test"),
        ]
        .map(|(scenes, split)| {
            let plural = if scenes.len() == 1 { "" } else { "s" };
            format!("{} {split} scene{plural}", scenes.len())
        });
        counts.join(", ")
    }
}
