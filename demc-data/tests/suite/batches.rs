//! Batches do not depend on the number of workers, need bounded memory, and report errors.

use std::collections::HashSet;
use std::fs;
use std::sync::Arc;

use crate::support::batches::{small, source, train_scenes};
use crate::support::{identity, layout, scene_channels, write};
use demc_data::image::frame::TEXTURES;
use demc_data::training::cache::{AlbedoFilter, SceneCache};
use demc_data::{
    Augment, Batch, BatchLoader, DataConfig, Error, FEATURES, Frame, Normalizer, PatchSource,
    Scene, Statistics, read_frame,
};
use demc_data::{PositionSpace, Preparation};

fn load(config: &DataConfig, start: u64, count: usize) -> Vec<Batch> {
    let mut loader = BatchLoader::new(source(config), start);
    (0..count)
        .map(|_| loader.next().expect("the sample is sound"))
        .collect()
}

#[test]
fn batches_are_the_same_for_any_number_of_workers() {
    let config = |workers| DataConfig {
        workers,
        augment: Augment::ALL,
        ..small()
    };
    let one = load(&config(1), 0, 15);
    assert_eq!(load(&config(2), 0, 15), one);
    assert_eq!(load(&config(4), 0, 15), one);
}

#[test]
fn a_loader_that_starts_later_continues_the_same_stream() {
    // 10 scenes of 3 x 3 patches: batch 12 ends the first epoch and begins the second.
    assert_eq!(load(&small(), 11, 4), load(&small(), 0, 15)[11..]);
}

#[test]
fn an_epoch_visits_every_patch_once() {
    let config = DataConfig {
        batch_size: 45,
        ..small()
    };
    let source = source(&config);
    assert_eq!(source.patches().len(), 90);
    let epoch = |first: u64| -> HashSet<_> {
        (first..first + 2)
            .flat_map(|n| source.batch(n).expect("the sample is sound").patches)
            .collect()
    };
    assert_eq!((epoch(0).len(), epoch(2).len()), (90, 90));
}

#[test]
fn a_batch_larger_than_an_epoch_takes_from_several() {
    let batch = source(&DataConfig {
        batch_size: 200,
        ..small()
    })
    .batch(0)
    .expect("the sample is sound");
    assert_eq!(
        (batch.size, batch.patches.len(), batch.patch_size),
        (200, 200, 64)
    );
    let patches: HashSet<_> = batch.patches[90..180].iter().collect();
    assert_eq!(patches.len(), 90);
}

#[test]
fn a_patch_holds_the_pixels_of_its_place() {
    holds_the_pixels_of_its_place(&source(&small()));
    let cropped = source(&DataConfig {
        augment: Augment {
            crop: true,
            ..Augment::default()
        },
        ..small()
    });
    holds_the_pixels_of_its_place(&cropped);
    let on_grid: HashSet<_> = cropped.patches().iter().collect();
    let cut = cropped.batch(3).expect("the sample is sound").patches;
    assert!(cut.iter().all(|patch| !on_grid.contains(patch)), "{cut:?}");
}

fn holds_the_pixels_of_its_place(source: &PatchSource) {
    let batch = source.batch(3).expect("the sample is sound");
    let scenes = train_scenes();
    for (b, patch) in batch.patches.iter().enumerate() {
        let frame =
            read_frame(&scenes[patch.scene as usize].path, &layout()).expect("the sample is sound");
        let (y, x) = (63, 17);
        let pixel = (patch.y as usize + y) * frame.width + patch.x as usize + x;
        let size = frame.width * frame.height;
        let index = |channels: usize, channel: usize| ((b * channels + channel) * 64 + y) * 64 + x;
        for channel in 0..FEATURES {
            assert_eq!(
                batch.features[index(FEATURES, channel)],
                frame.features[channel * size + pixel]
            );
        }
        let reference = frame.reference.expect("it is there");
        for channel in 0..3 {
            assert_eq!(
                batch.reference_hdr[index(3, channel)],
                reference[channel * size + pixel]
            );
            let gamma = frame.color[channel * size + pixel].powf(1.0 / 2.2);
            assert_eq!(batch.color[index(3, channel)], gamma);
        }
    }
}

/// With every augmentation enabled, the network's input times the modulation is its colour.
#[test]
fn a_demodulated_batch_times_its_modulation_is_the_plain_one() {
    let config = DataConfig {
        augment: Augment::ALL,
        ..small()
    };
    let normalizer = Normalizer {
        albedo_demodulation_epsilon: Some(0.07),
        ..identity()
    };
    let demodulating = PatchSource::new(&config, train_scenes(), layout(), normalizer, 7);
    let [plain, found] = [source(&config), demodulating.expect("the sample").into()]
        .map(|source| source.batch(1).expect("the sample is sound"));
    assert_eq!(plain.modulation, None);
    let modulation = found.modulation.expect("it is on");
    assert_eq!(modulation.len(), plain.color.len());
    let features = found.features.chunks_exact(FEATURES * 64 * 64);
    let textures = features.flat_map(|patch| &patch[TEXTURES * 64 * 64..(TEXTURES + 3) * 64 * 64]);
    let pixels = plain.color.iter().zip(&found.color);
    for (((plain, found), factor), texture) in pixels.zip(&modulation).zip(textures) {
        assert!(
            (found * factor - plain).abs() <= 1e-5 * plain,
            "{found} {factor} {plain}"
        );
        assert_eq!(*factor, (texture.max(0.0) + 0.07).powf(1.0 / 2.2));
    }
    assert_eq!(found.features, plain.features);
    assert_eq!(found.reference_hdr, plain.reference_hdr);
}

/// The filter sees the scene as in its file. Its output replaces the albedo of the first hit alone.
#[test]
fn a_filtered_albedo_is_that_of_the_batches() {
    let pixels = 64 * 64;
    let source = |scenes: Vec<Scene>, filter: Option<AlbedoFilter>| {
        let config = DataConfig {
            // It pairs pixels of similar albedo.
            augment: Augment {
                noise: false,
                ..Augment::ALL
            },
            position: PositionSpace::Image,
            ..small()
        };
        let source = PatchSource::new(&config, scenes, layout(), identity(), 7).expect("sound");
        match filter {
            Some(filter) => source.with_albedo_filter(filter),
            None => source,
        }
    };
    let frames: Vec<Frame> = train_scenes()
        .iter()
        .map(|scene| read_frame(&scene.path, &layout()).expect("sound"))
        .collect();
    let half: AlbedoFilter = Arc::new(move |found| {
        let size = found.width * found.height;
        let same =
            |frame: &&Frame| (&frame.color, &frame.features) == (&found.color, &found.features);
        assert!(frames.iter().find(same).is_some(), "{}", found.name);
        let albedo = found.features[TEXTURES * size..][..3 * size].iter();
        Ok(Some(albedo.map(|value| value / 2.0).collect()))
    });
    let batch = |filter| source(train_scenes(), filter).batch(1).expect("sound");
    let (plain, kept, found) = (
        batch(None),
        batch(Some(Arc::new(|_: &Frame| Ok(None)))),
        batch(Some(half)),
    );
    assert_eq!(kept, plain);
    let mut expected = plain;
    for patch in expected.features.chunks_exact_mut(FEATURES * pixels) {
        let albedo = patch[TEXTURES * pixels..][..3 * pixels].iter_mut();
        albedo.for_each(|value| *value /= 2.0);
    }
    assert_eq!(found, expected);

    let fails: AlbedoFilter = Arc::new(|_| Err("no memory".into()));
    let scene = train_scenes().remove(0);
    let path = scene.path.display().to_string();
    let error = source(vec![scene], Some(fails))
        .batch(0)
        .expect_err("it fails");
    let cause = std::error::Error::source(&error).expect("what the filter said");
    assert_eq!(
        format!("{error}: {cause}"),
        format!("{path}: albedo filter: no memory")
    );
}

#[test]
fn the_cache_stays_in_its_budget_and_decodes_again() {
    let scenes = train_scenes();
    let all = SceneCache::new(scenes.clone(), layout(), Preparation::default(), usize::MAX);
    for index in 0..scenes.len() {
        all.get(index).expect("the sample is sound");
    }
    let whole = all.usage();
    assert_eq!((whole.scenes, whole.decoded), (10, 10));
    // Half planes stay half: 18 planes of two bytes each, up to three of them of four bytes.
    let pixels = 10 * 224 * 224;
    assert!(
        (pixels * 36..=pixels * 42).contains(&whole.bytes),
        "{} bytes",
        whole.bytes
    );

    let budget = whole.bytes / 3;
    let cache = SceneCache::new(scenes.clone(), layout(), Preparation::default(), budget);
    for turn in 0..30 {
        let index = turn * 7 % 10;
        assert_eq!(
            cache.get(index).expect("sound"),
            all.get(index).expect("sound")
        );
        assert!(cache.usage().bytes <= budget);
    }
    assert_eq!(
        cache.usage().decoded,
        30,
        "the least recently used goes: a round of ten never hits"
    );
    cache.get(29 * 7 % 10).expect("sound");
    assert_eq!(cache.usage().decoded, 30, "the most recent is kept");

    let none = SceneCache::new(scenes, layout(), Preparation::default(), 0);
    none.get(0).expect("sound");
    assert_eq!((none.usage().scenes, none.usage().bytes), (0, 0));
}

#[test]
fn batches_do_not_depend_on_the_cache() {
    let starved = DataConfig {
        cache_mib: 3,
        workers: 2,
        ..small()
    };
    assert_eq!(load(&starved, 0, 6), load(&small(), 0, 6));
    let source = source(&starved);
    source.batch(0).expect("the sample is sound");
    assert!(source.cache_usage().bytes <= 3 << 20);
}

#[test]
fn threads_that_want_one_scene_decode_it_once() {
    let cache = SceneCache::new(train_scenes(), layout(), Preparation::default(), usize::MAX);
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| cache.get(3).expect("the sample is sound"));
        }
    });
    assert_eq!(cache.usage().decoded, 1);
}

#[test]
fn a_file_damaged_later_is_an_error_of_next_and_not_a_hang() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    write(&path, (64, 64), scene_channels(64, 64));
    let scene = Scene {
        path: path.clone(),
        width: 64,
        height: 64,
        ..train_scenes()[0].clone()
    };
    for workers in [1, 3] {
        let bytes = fs::read(&path).expect("just written");
        fs::write(&path, &bytes[..bytes.len() / 2]).expect("writable");
        let config = DataConfig { workers, ..small() };
        let source = PatchSource::new(&config, vec![scene.clone()], layout(), identity(), 1)
            .expect("one patch");
        let mut loader = BatchLoader::new(Arc::new(source), 0);
        for _ in 0..5 {
            assert!(matches!(loader.next(), Err(Error::Exr { .. })));
        }
        drop(loader);
        fs::write(&path, bytes).expect("writable");
    }
    write(&path, (64, 60), scene_channels(64, 60));
    let source =
        PatchSource::new(&small(), vec![scene], layout(), identity(), 1).expect("one patch");
    let error = source.batch(0).expect_err("it shrank").to_string();
    assert!(
        error.ends_with("is 64x60, but the manifest says 64x64"),
        "{error}"
    );
}

#[test]
fn dropping_a_loader_ends_its_threads() {
    let source = source(&DataConfig {
        workers: 4,
        ..small()
    });
    let mut loader = BatchLoader::new(Arc::clone(&source), 0);
    loader.next().expect("the sample is sound");
    drop(loader);
    assert_eq!(Arc::strong_count(&source), 1);
}

#[test]
fn scenes_smaller_than_a_patch_and_layouts_without_reference_are_refused() {
    let config = DataConfig {
        patch_size: 256,
        ..small()
    };
    let error = PatchSource::new(&config, train_scenes(), layout(), identity(), 1)
        .err()
        .expect("224 < 256");
    assert_eq!(
        error.to_string(),
        "scene col-living-room-2-0: 224x224 pixels hold no patch of 256x256"
    );
    let mut blind = layout();
    blind.reference = None;
    let error = PatchSource::new(&small(), train_scenes(), blind, identity(), 1)
        .err()
        .expect("no reference");
    assert!(error.to_string().contains("names no reference"), "{error}");
}

/// With `position = "image"`, batches and statistics have the image's own origin and unit.
#[test]
fn positions_relative_to_the_image_are_mapped_before_statistics_and_batches() {
    let config = |position| DataConfig {
        position,
        ..small()
    };
    let position = |batch: &Batch| -> Vec<f32> {
        let pixels = batch.patch_size * batch.patch_size;
        let patches = batch.features.chunks_exact(FEATURES * pixels);
        let positions = patches.map(|patch| patch[3 * pixels..6 * pixels].to_vec());
        positions.flatten().collect()
    };
    let [scene, image] = [PositionSpace::Scene, PositionSpace::Image].map(|space| {
        source(&config(space))
            .batch(0)
            .expect("the sample is sound")
    });
    let mapped = position(&image);
    assert_ne!(position(&scene), mapped);
    assert!(mapped.iter().all(|x| (-5.0..=5.0).contains(x)));
    assert_eq!(scene.color, image.color);

    let spread = |space| {
        let scenes = train_scenes();
        let measured = Statistics::measure(&scenes, &layout(), &config(space), 0.001)
            .expect("the sample is sound")
            .normalizer;
        assert_eq!(measured.position, space);
        measured.features.std[3..6]
            .iter()
            .copied()
            .fold(0.0, f32::max)
    };
    // The scenes differ in size; their images do not.
    assert!(spread(PositionSpace::Image) < 2.0 && spread(PositionSpace::Scene) > 2.0);
}
