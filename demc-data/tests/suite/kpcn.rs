//! The input of KPCN: frames and batches of a file with passes.

use std::fs;
use std::path::Path;

use demc_data::image::plane::Plane;
use demc_data::input::kpcn::{KpcnInput, PASSES, REFERENCE_PASSES, light_from_radiance};
use demc_data::{
    Augment, ChannelLayout, DataConfig, Dataset, Error, InputKind, PatchSource, read_frame,
};
use serde_json::json;

use crate::support::{half, identity, layout, scene_channels, write};

const SIDE: usize = 64;

fn kpcn() -> ChannelLayout {
    ChannelLayout {
        inputs: InputKind::Kpcn,
        ..layout()
    }
}

/// A data set of one scene, in which pass p of pixel i is `p / 8 + i / pixels`. The file lacks the
/// channel `without`.
fn data_set(root: &Path, without: &str) {
    let mut channels = scene_channels(SIDE, SIDE);
    let buffers = kpcn().buffers();
    let passes = PASSES.iter().chain(&REFERENCE_PASSES);
    let names = passes.flat_map(|(content, count)| {
        let buffer = buffers.iter().find(|buffer| buffer.content == *content);
        let names = buffer.expect("the layout names it").channels.clone();
        assert_eq!(names.len(), *count);
        names
    });
    let pixels = SIDE * SIDE;
    channels.extend(names.enumerate().map(|(pass, name)| {
        let samples = (0..pixels).map(|i| pass as f32 / 8.0 + i as f32 / pixels as f32);
        (name, half(samples))
    }));
    channels.retain(|(name, _)| name != without);
    write(&root.join("a.exr"), (SIDE, SIDE), channels);
    let scene = json!({
        "name": "a", "base": "a", "split": "train", "file": "a.exr", "layout": "demc-exr",
        "width": SIDE, "height": SIDE,
    });
    let manifest = json!({ "format": "demc-exr 1", "scenes": [scene] });
    fs::write(root.join("manifest.json"), manifest.to_string()).expect("writable");
}

#[test]
fn a_batch_is_the_conversion_of_the_frame() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    data_set(dir.path(), "");
    let frame = read_frame(&dir.path().join("a.exr"), &kpcn()).expect("sound");
    let passes = frame.passes.expect("the layout asks for them");
    let pixels = SIDE * SIDE;
    let depth = &passes[6 * pixels..7 * pixels];
    assert_eq!(depth.iter().copied().fold(0.0, f32::max), 1.0);
    let exposed = Augment {
        exposure: true,
        ..Augment::default()
    };
    for augment in [Augment::default(), exposed] {
        let config = DataConfig {
            patch_size: SIDE,
            batch_size: 1,
            augment,
            ..DataConfig::default()
        };
        let scenes = Dataset::open(dir.path(), &kpcn()).expect("sound").scenes;
        let source = PatchSource::new(&config, scenes, kpcn(), identity(), 7).expect("large");
        let batch = source.batch(0).expect("sound");
        let reference = frame.reference.as_ref().expect("a reference");
        let scale = batch.reference_hdr[0] / reference[0];
        assert_eq!(scale == 1.0, !augment.exposure);
        let input = KpcnInput::new(&passes, &frame.features, scale);
        assert_eq!(batch.color, input.light);
        assert_eq!(batch.features, input.features);
        assert_eq!(batch.modulation.as_ref(), Some(&input.divisor));
        let light = batch.reference_light.expect("of KPCN");
        // Pass 20 is the red diffuse reference.
        let mut expected: Vec<f32> = (20..26)
            .flat_map(|pass| {
                let samples = (0..pixels).map(|i| pass as f32 / 8.0 + i as f32 / pixels as f32);
                Plane::Half(samples.map(half::f16::from_f32).collect()).to_f32()
            })
            .collect();
        light_from_radiance(&mut expected, &input.divisor, scale);
        assert_eq!(light, expected);
    }
}

#[test]
fn a_flip_moves_all_planes() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    data_set(dir.path(), "");
    let batch = |augment| {
        let config = DataConfig {
            patch_size: SIDE,
            batch_size: 16,
            augment,
            ..DataConfig::default()
        };
        let scenes = Dataset::open(dir.path(), &kpcn()).expect("sound").scenes;
        let source = PatchSource::new(&config, scenes, kpcn(), identity(), 7).expect("large");
        source.batch(0).expect("sound")
    };
    let plain = batch(Augment::default());
    let turned = batch(Augment {
        flip: true,
        transpose: true,
        ..Augment::default()
    });
    assert_ne!(plain.color, turned.color);
    let sorted = |planes: &[f32]| {
        let mut values = planes[..SIDE * SIDE].to_vec();
        values.sort_by(f32::total_cmp);
        values
    };
    let planes = |batch: &demc_data::Batch| {
        let more = [&batch.modulation, &batch.reference_light];
        let more = more.map(|planes| planes.clone().expect("of KPCN"));
        let [divisor, light] = more;
        [batch.color.clone(), batch.features.clone(), divisor, light].map(|all| sorted(&all))
    };
    assert_eq!(planes(&plain), planes(&turned));
}

#[test]
fn a_file_without_a_pass_is_refused_by_name() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    for name in ["variance.depth.Z", "ref.specular.G"] {
        data_set(dir.path(), name);
        let error = Dataset::open(dir.path(), &kpcn()).expect_err("a pass is missing");
        assert!(error.to_string().contains(name), "{error}");
        assert!(Dataset::open(dir.path(), &layout()).is_ok());
    }
    // Denoising needs no reference.
    let frame = read_frame(&dir.path().join("a.exr"), &layout()).expect("sound");
    assert_eq!(frame.passes, None);
    let error = read_frame(&dir.path().join("a.exr"), &kpcn()).expect_err("a reference's part");
    assert!(matches!(error, Error::MissingPasses { .. }), "{error}");
}
