//! Pictures of test scenes: what each variant and each baseline makes of them (Fig. 9), and the detail
//! map (Fig. 2 e).

use std::path::PathBuf;

use anyhow::{Context, ensure};
use burn::tensor::Device;
use demc_data::{ChannelLayout, Dataset, Scene, Split, read_frame};
use demc_infer::{Bundle, Picture};

use super::baselines::Images;
use super::spec::AblationSpec;
use crate::record::progress::say;

/// The picture of a scene.
fn path(spec: &AblationSpec, scene: &str) -> PathBuf {
    spec.dir.join(format!("{scene}.png"))
}

/// All pictures that [`write`] makes.
pub(super) fn files(spec: &AblationSpec) -> Vec<PathBuf> {
    let names = spec.pictures.iter();
    names.map(|scene| path(spec, scene)).collect()
}

/// Writes a picture of each scene of the list that lacks one. From left to right there are the
/// baselines, each variant from the first seed after its detail map, and the reference.
///
/// # Errors
/// A scene that is not in the test split; a run whose weights are gone; a file that cannot be written.
pub(super) fn write(spec: &AblationSpec) -> anyhow::Result<()> {
    let missing = || {
        spec.pictures
            .iter()
            .filter(|scene| !path(spec, scene).exists())
    };
    if missing().next().is_none() {
        return Ok(());
    }
    let data = &spec.variants[0].config.data;
    let layout = ChannelLayout::resolve(&data.layout)?;
    let scenes = Dataset::open(&data.root, &layout)?.split(Split::Test)?;
    for name in missing() {
        let scene = scenes.iter().find(|scene| scene.name == *name);
        let scene = scene.with_context(|| format!("pictures: {name} is not in the test split"))?;
        let path = path(spec, name);
        picture(spec, scene, &layout)?
            .write_png(&path)
            .with_context(|| path.display().to_string())?;
        say(path.display());
    }
    Ok(())
}

fn picture(spec: &AblationSpec, scene: &Scene, layout: &ChannelLayout) -> anyhow::Result<Picture> {
    let frame = read_frame(&scene.path, scene.layout(layout))?;
    let (height, width) = (frame.height, frame.width);
    let hdr = |planes: &[f32]| Picture::from_hdr(planes, height, width);
    let mut parts = Vec::new();
    for baseline in &spec.baselines {
        let images = Images::new(baseline);
        if images.exists() {
            parts.push(hdr(&images.image(scene, &frame, layout)?));
        }
    }
    for variant in &spec.variants {
        let config = spec.run(variant, spec.seeds[0]);
        let bundle = Bundle::load(config.run_dir(), &Device::flex())?;
        let frame = read_frame(&scene.path, scene.layout(&bundle.meta.layout))?;
        if let Some(map) = bundle.detail_map(&frame)? {
            parts.push(Picture::from_detail_map(&map, height, width));
        }
        parts.push(hdr(&bundle.denoise(&frame)?));
    }
    let reference = frame.reference.as_deref();
    parts.extend(reference.map(hdr));
    ensure!(!parts.is_empty(), "{}: nothing to show", scene.name);
    Ok(Picture::beside(&parts))
}
