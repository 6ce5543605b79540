//! Batches: the same for any number of workers, in bounded memory, with errors that arrive.

mod support;

use std::collections::HashSet;
use std::fs;
use std::sync::Arc;

use demc_data::cache::SceneCache;
use demc_data::{
    Augment, Batch, BatchLoader, Border, DataConfig, Dataset, Error, FEATURES, PatchSource, Scene,
    Split, read_frame,
};
use support::{identity, layout, sample, scene_channels, write};

fn train_scenes() -> Vec<Scene> {
    Dataset::open(&sample(), &layout())
        .and_then(|set| set.split(Split::Train))
        .expect("the sample is sound")
}

fn small() -> DataConfig {
    DataConfig {
        patch_size: 64,
        stride: 80,
        batch_size: 7,
        ..DataConfig::default()
    }
}

fn source(config: &DataConfig) -> Arc<PatchSource> {
    let source = PatchSource::new(config, train_scenes(), layout(), identity(), 7);
    Arc::new(source.expect("the sample is large enough"))
}

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
        augment: Augment {
            flip: true,
            transpose: true,
            rgb: true,
            exposure: true,
            axes: true,
            crop: true,
            noise: true,
        },
        ..small()
    };
    let one = load(&config(1), 0, 15);
    assert_eq!(load(&config(2), 0, 15), one);
    assert_eq!(load(&config(4), 0, 15), one);
}

#[test]
fn a_loader_that_starts_later_goes_on_in_the_same_stream() {
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
    assert_eq!((batch.size, batch.patches.len()), (200, 200));
    let patches: HashSet<_> = batch.patches[90..180].iter().collect();
    assert_eq!(patches.len(), 90);
}

/// On the grid and off it.
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
        let at = |channels: usize, channel: usize| ((b * channels + channel) * 64 + y) * 64 + x;
        for channel in 0..FEATURES {
            assert_eq!(
                batch.features_z[at(FEATURES, channel)],
                frame.features[channel * size + pixel]
            );
        }
        let reference = frame.reference.expect("it is there");
        for channel in 0..3 {
            assert_eq!(
                batch.reference_hdr[at(3, channel)],
                reference[channel * size + pixel]
            );
            let gamma = frame.color[channel * size + pixel].powf(1.0 / 2.2);
            assert_eq!(batch.color_gamma[at(3, channel)], gamma);
        }
    }
}

/// Colour and second texture move among the pixels of a patch; what it shows does not.
#[test]
fn noise_changes_colour_and_second_texture_only() {
    let batch = |noise| {
        let augment = Augment {
            noise,
            ..Augment::default()
        };
        let source = source(&DataConfig { augment, ..small() });
        source.batch(0).expect("the sample is sound")
    };
    let (plain, varied) = (batch(false), batch(true));
    assert_eq!(varied.patches, plain.patches);
    assert_eq!(varied.reference_hdr, plain.reference_hdr);
    let pixels = 64 * 64;
    let same = |a: &[f32], b: &[f32]| a.iter().zip(b).filter(|(a, b)| a == b).count();
    let features = varied
        .features_z
        .chunks(pixels)
        .zip(plain.features_z.chunks(pixels));
    for (plane, (varied, plain)) in features.enumerate() {
        if plane % FEATURES < 9 {
            assert_eq!(varied, plain, "plane {plane}");
        }
    }
    let share =
        same(&varied.color_gamma, &plain.color_gamma) as f32 / plain.color_gamma.len() as f32;
    assert!(share < 0.6, "{share} of the colour is what it was");
    assert_ne!(varied.features_z, plain.features_z);
}

#[test]
fn augmentation_turns_all_buffers_of_a_patch_alike() {
    let plain = source(&small()).batch(0).expect("the sample is sound");
    let turned = source(&DataConfig {
        augment: Augment {
            flip: true,
            ..Augment::default()
        },
        ..small()
    });
    let turned = turned.batch(0).expect("the sample is sound");
    assert_eq!(turned.patches, plain.patches);
    let corner = |batch: &Batch, b: usize, y: usize, x: usize| {
        let at = |plane: usize| (plane * 64 + y) * 64 + x;
        (
            batch.color_gamma[at(b * 3 + 1)],
            batch.features_z[at(b * FEATURES + 4)],
            batch.reference_hdr[at(b * 3)],
        )
    };
    let mut corners = HashSet::new();
    for b in 0..plain.size {
        let places = [(0, 0), (0, 63), (63, 0), (63, 63)];
        let from = places
            .iter()
            .position(|&(y, x)| corner(&plain, b, y, x) == corner(&turned, b, 0, 0));
        corners.insert(from.expect("the upper left corner comes from a corner"));
    }
    assert!(
        corners.len() > 1,
        "seven patches, four orientations: {corners:?}"
    );
}

/// Colour, both textures and reference by one order and colour and reference by one factor; normals and positions stay.
#[test]
fn rgb_and_exposure_change_what_they_should_alike() {
    let plain = source(&small()).batch(0).expect("the sample is sound");
    let varied = source(&DataConfig {
        augment: Augment {
            rgb: true,
            exposure: true,
            ..Augment::default()
        },
        ..small()
    });
    let varied = varied.batch(0).expect("the sample is sound");
    let pixels = 64 * 64;
    let mut orders = HashSet::new();
    for b in 0..plain.size {
        let planes = |values: &[f32], channels: usize, first: usize, count: usize| {
            let from = (b * channels + first) * pixels;
            values[from..from + count * pixels].to_vec()
        };
        let images = |batch: &Batch| {
            let textures = [6, 9].map(|first| planes(&batch.features_z, FEATURES, first, 3));
            (planes(&batch.reference_hdr, 3, 0, 3), textures)
        };
        let geometry = |batch: &Batch| planes(&batch.features_z, FEATURES, 0, 6);
        assert_eq!(geometry(&plain), geometry(&varied));
        let ((before, textures), (after, varied_textures)) = (images(&plain), images(&varied));
        let sum = |planes: &[f32]| planes.iter().map(|v| f64::from(*v)).sum::<f64>();
        let exposure = sum(&after) / sum(&before);
        assert!((0.5..2.0).contains(&exposure), "{exposure}");
        // Which plane each of the three comes from.
        let order: Vec<usize> = after
            .chunks(pixels)
            .map(|plane| {
                let from = before.chunks(pixels).position(|from| {
                    let mut values = from.iter().zip(plane);
                    values.all(|(a, b)| {
                        (f64::from(*a) * exposure - f64::from(*b)).abs() < 1e-4 * f64::from(a + b)
                    })
                });
                from.expect("it comes from one of them")
            })
            .collect();
        for (before, after) in textures.iter().zip(&varied_textures) {
            for (plane, from) in after.chunks(pixels).zip(&order) {
                assert_eq!(plane, &before[from * pixels..][..pixels]);
            }
        }
        let gamma = |batch: &Batch, plane: usize| planes(&batch.color_gamma, 3, plane, 1);
        for (plane, from) in order.iter().enumerate() {
            for (a, b) in gamma(&plain, *from).iter().zip(gamma(&varied, plane)) {
                let expected = f64::from(*a) * exposure.powf(1.0 / 2.2);
                assert!((f64::from(b) - expected).abs() <= 1e-5 * expected + 1e-9);
            }
        }
        orders.insert(order);
    }
    assert!(orders.len() > 1, "seven patches, six orders: {orders:?}");
}

/// One order and one sign an axis for normals and positions; all else stays.
#[test]
fn axes_are_told_in_other_ways_the_same_for_normals_and_positions() {
    let plain = source(&small()).batch(0).expect("the sample is sound");
    let varied = source(&DataConfig {
        augment: Augment {
            axes: true,
            ..Augment::default()
        },
        ..small()
    });
    let varied = varied.batch(0).expect("the sample is sound");
    assert_eq!(plain.color_gamma, varied.color_gamma);
    assert_eq!(plain.reference_hdr, varied.reference_hdr);
    let pixels = 64 * 64;
    let features = |batch: &Batch| -> Vec<Vec<f32>> {
        let planes = batch.features_z.chunks(pixels);
        planes.map(<[f32]>::to_vec).collect()
    };
    let (before, after) = (features(&plain), features(&varied));
    let (mut ways, mut mirrored) = (HashSet::new(), HashSet::new());
    for (before, after) in before.chunks(FEATURES).zip(after.chunks(FEATURES)) {
        assert_eq!(before[6..], after[6..], "textures");
        // Positions tell the way: where a patch shows one wall, two axes of its normal are alike.
        let sign = |turned| if turned { -1.0 } else { 1.0 };
        let is = |plane: &[f32], of: &[f32], turned: bool| {
            of.iter().zip(plane).all(|(a, b)| a * sign(turned) == *b)
        };
        let way: Vec<(usize, bool)> = (3..6)
            .map(|plane| {
                let all = (0..3).flat_map(|from| [(from, false), (from, true)]);
                let mut all =
                    all.filter(|(from, turned)| is(&after[plane], &before[3 + from], *turned));
                all.next().expect("it is one of the axes")
            })
            .collect();
        for (normal, (from, turned)) in way.iter().enumerate() {
            assert!(is(&after[normal], &before[*from], *turned), "{way:?}");
        }
        mirrored.extend(way.iter().map(|(_, turned)| *turned));
        ways.insert(way);
    }
    assert!(ways.len() > 2, "seven patches, 48 ways: {ways:?}");
    assert_eq!(mirrored.len(), 2);
}

#[test]
fn the_cache_stays_in_its_budget_and_decodes_again() {
    let scenes = train_scenes();
    let all = SceneCache::new(scenes.clone(), layout(), usize::MAX);
    for index in 0..scenes.len() {
        all.get(index).expect("the sample is sound");
    }
    let whole = all.usage();
    assert_eq!((whole.scenes, whole.decoded), (10, 10));
    // Half planes stay half: 18 planes of two bytes, up to three of them of four.
    let pixels = 10 * 224 * 224;
    assert!(
        (pixels * 36..=pixels * 42).contains(&whole.bytes),
        "{} bytes",
        whole.bytes
    );

    let budget = whole.bytes / 3;
    let cache = SceneCache::new(scenes.clone(), layout(), budget);
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

    let none = SceneCache::new(scenes, layout(), 0);
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
fn the_reference_filter_changes_references_and_nothing_else() {
    let filtering = DataConfig {
        reference_filter: true,
        ..small()
    };
    let (plain, filtered) = (load(&small(), 0, 3), load(&filtering, 0, 3));
    for (plain, filtered) in plain.iter().zip(&filtered) {
        assert_ne!(plain.reference_hdr, filtered.reference_hdr);
        let reference_hdr = plain.reference_hdr.clone();
        let same = Batch {
            reference_hdr,
            ..filtered.clone()
        };
        assert_eq!(plain, &same);
    }
}

#[test]
fn threads_that_want_one_scene_decode_it_once() {
    let cache = SceneCache::new(train_scenes(), layout(), usize::MAX);
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| cache.get(3).expect("the sample is sound"));
        }
    });
    assert_eq!(cache.usage().decoded, 1);
}

#[test]
fn a_file_that_breaks_later_is_an_error_of_next_and_not_a_hang() {
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
        border: Border::Drop,
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
