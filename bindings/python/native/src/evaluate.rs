//! Scores of a data set.

use std::path::{Path, PathBuf};

use demc_data::image::exr::ExrFile;
use demc_data::image::layout::detect;
use demc_data::{ChannelLayout, Dataset, Scene, Split};
use demc_infer::denoise::{DenoiseOptions, unobserved};
use demc_infer::evaluate::FailedImage;
use demc_infer::{Bundle, Ensemble, ImageScore, Report};
use demc_program::message::printable;
use pyo3::prelude::*;

use crate::bundle::PyBundle;
use crate::error::{DemcError, exception};
use crate::work::{self, Caller};

/// Denoises and scores every scene of a split in all metrics. `on_scene` gets the scores of each as
/// JSON. Returns the report as JSON, with the scenes that failed.
#[pyfunction]
pub fn evaluate(
    py: Python<'_>,
    bundle: &PyBundle,
    data: PathBuf,
    split: &str,
    layout: Option<String>,
    passes: &str,
    on_scene: Option<Py<PyAny>>,
) -> PyResult<String> {
    let split = match split {
        "train" => Split::Train,
        "test" => Split::Test,
        _ => return Err(DemcError::new_err("split must be train or test")),
    };
    let options = DenoiseOptions {
        ensemble: passes.parse::<Ensemble>().map_err(exception)?,
        ..DenoiseOptions::default()
    };
    let hear = on_scene.map(|on_scene| {
        move |py: Python<'_>, scores: String| on_scene.call1(py, (scores,)).map(|_| ())
    });
    let bundle = &bundle.0;
    let score = |caller: Caller<String>| -> anyhow::Result<String> {
        let layout = choose_layout(&data, layout.as_deref(), bundle)?;
        let dataset = Dataset::open(&data, &layout)?;
        let (mut images, mut failed) = (Vec::new(), Vec::new());
        for scene in dataset.split(split)? {
            match score_scene(&scene, &layout, bundle, &options) {
                Ok(score) => {
                    let json = serde_json::to_string(&score)?;
                    images.push(score);
                    if caller.call(json).is_break() {
                        break;
                    }
                }
                Err(error) => failed.push(FailedImage {
                    name: scene.name.clone(),
                    error: printable(&format!("{error:#}")),
                }),
            }
        }
        let report = Report {
            failed,
            ..Report::new(images)
        };
        Ok(serde_json::to_string(&report)?)
    };
    work::run(py, score, hear)?.map_err(exception)
}

/// The layout of a data set: the given one, or the one that fits its first file.
fn choose_layout(
    data: &Path,
    given: Option<&str>,
    bundle: &Bundle,
) -> anyhow::Result<ChannelLayout> {
    if let Some(name) = given {
        return Ok(ChannelLayout::resolve(name)?);
    }
    let own = &bundle.meta.layout;
    let scenes = Dataset::list(data)?;
    // Opening the data set names what is wrong with its files.
    let Some(Ok(file)) = scenes.first().map(|scene| ExrFile::open(&scene.path)) else {
        return Ok(own.clone());
    };
    match own.in_file(&file, None) {
        Ok(own) if own.fits(&file) => Ok(own.into_owned()),
        _ => Ok(detect(&file, bundle.missing(), None)?.layout),
    }
}

fn score_scene(
    scene: &Scene,
    layout: &ChannelLayout,
    bundle: &Bundle,
    options: &DenoiseOptions,
) -> anyhow::Result<ImageScore> {
    let mut frame = demc_data::read_frame(&scene.path, layout)?;
    frame.name.clone_from(&scene.name);
    let denoised = bundle.denoise_with(&frame, options, unobserved)?.color_hdr;
    let residual = scene.ref_residual_relmse;
    Ok(ImageScore::full(&frame, &denoised, &[], residual)?.with_base(&scene.base))
}
