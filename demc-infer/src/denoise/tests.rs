//! Tests with a narrow network on frames with a pattern.

use std::ops::ControlFlow;

use demc_data::Frame;
use demc_model::Variant;

use super::*;
use crate::bundle::testing::{bundle, frame};

/// Largest difference of two images, relative to the largest value of the second.
pub(super) fn difference(image: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(image.len(), expected.len());
    assert!(image.iter().all(|x| x.is_finite()));
    let largest = |values: &mut dyn Iterator<Item = f32>| values.fold(0.0, f32::max);
    let pairs = image.iter().zip(expected);
    largest(&mut pairs.map(|(a, b)| (a - b).abs())) / largest(&mut expected.iter().copied())
}

/// Denoises without a factor on the colour.
pub(super) fn denoise(
    bundle: &Bundle,
    frame: &Frame,
    tiling: &Tiling,
    ensemble: Ensemble,
) -> Result<Denoised, DenoiseError> {
    let options = DenoiseOptions {
        tiling: *tiling,
        ensemble,
        input_scale: Some(1.0),
        ..DenoiseOptions::default()
    };
    bundle.denoise_with(frame, &options, unobserved)
}

#[test]
fn outputs_have_the_size_of_their_inputs() {
    let bundle = bundle(Variant::Demc);
    for (width, height) in [(1, 1), (31, 33), (64, 32), (5, 70)] {
        let out = bundle.denoise(&frame(width, height)).expect("denoised");
        assert_eq!(out.len(), 3 * width * height);
        assert!(out.iter().all(|x| x.is_finite() && *x >= 0.0));
    }
}

#[test]
fn padding_equals_an_image_padded_by_hand() {
    let bundle = bundle(Variant::Demc);
    let small = frame(31, 33);
    let padding = Padding {
        height: 33,
        width: 31,
        unit: DOWNSAMPLING,
    };
    let [color, features] = [&small.color, &small.features].map(|planes| padding.pad(planes));
    let large = Frame::new("large", 32, 64, color, features);
    let expected = padding.crop(&bundle.denoise(&large).expect("large"));
    assert_eq!(bundle.denoise(&small).expect("small"), expected);
}

/// Albedo demodulation equals dividing the input and multiplying the output by hand, also with
/// tiles and test-time augmentation.
#[test]
fn demodulation_equals_a_division_by_hand() {
    let plain = bundle(Variant::Demc);
    let mut demodulating = bundle(Variant::Demc);
    demodulating.meta.normalizer.albedo_demodulation_epsilon = Some(0.07);
    let frame = frame(70, 100);
    let (texture, pixels) = (demc_data::image::frame::TEXTURES, 70 * 100);
    let textures = &frame.features[texture * pixels..(texture + 3) * pixels];
    let divisors: Vec<f32> = textures.iter().map(|t| t.max(0.0) + 0.07).collect();
    let pairs = frame.color.iter().zip(&divisors);
    let mut divided = frame.clone();
    divided.color = pairs.map(|(color, by)| color / by).collect();
    let tiled = Tiling {
        side: Some(64),
        ..Tiling::default()
    };
    for (tiling, ensemble) in [
        (Tiling::default(), Ensemble::One),
        (tiled, Ensemble::One),
        (Tiling::default(), Ensemble::Four),
    ] {
        let denoise = |bundle: &Bundle, frame| {
            let denoised = denoise(bundle, frame, &tiling, ensemble);
            denoised.expect("denoised").color_hdr
        };
        let light = denoise(&plain, &divided);
        let pairs = light.iter().zip(&divisors);
        let expected: Vec<f32> = pairs.map(|(light, by)| light * by).collect();
        let found = denoise(&demodulating, &frame);
        assert!(difference(&found, &expected) < 1e-4);
        assert!(difference(&found, &denoise(&plain, &frame)) > 1e-2);
    }
}

#[test]
fn two_runs_give_the_same_bits() {
    let (bundle, frame) = (bundle(Variant::Semc), frame(40, 40));
    let once = bundle.denoise(&frame).expect("once");
    assert_eq!(once, bundle.denoise(&frame).expect("twice"));
}

#[test]
fn the_variant_without_fusion_has_no_detail_map() {
    let frame = frame(33, 20);
    let map = |variant| bundle(variant).detail_map(&frame).expect("detail map");
    assert_eq!(map(Variant::Demc).map(|m| m.len()), Some(3 * 33 * 20));
    assert_eq!(map(Variant::DemcNosn), None);
}

#[test]
fn buffers_that_do_not_fit_are_named() {
    let mut frame = frame(4, 4);
    frame.features.pop();
    let error = bundle(Variant::Demc)
        .denoise(&frame)
        .expect_err("short")
        .to_string();
    assert!(
        error.ends_with("features holds 191 values; 4x4 pixels need 192"),
        "{error}"
    );
}

/// Tiles give the whole image up to float32 rounding. Sizes are odd, so that padding and tiles
/// interact.
#[test]
fn tiles_with_the_exact_halo_are_the_whole_image() {
    for variant in [Variant::Demc, Variant::DemcNosn, Variant::Semc] {
        let bundle = bundle(variant);
        let frame = frame(490, 450);
        let whole = bundle.denoise(&frame).expect("whole");
        for side in [128, 224] {
            let tiling = Tiling {
                side: Some(side),
                ..Tiling::default()
            };
            let tiled = denoise(&bundle, &frame, &tiling, Ensemble::One).expect("tiled");
            assert!(tiled.tiles.count() >= 6 && tiled.seam_error.is_none());
            let difference = difference(&tiled.color_hdr, &whole);
            assert!(difference <= 2e-6, "{variant:?} {side}: {difference}");
        }
    }
}

#[test]
fn a_smaller_halo_is_measured_and_is_worse() {
    let bundle = bundle(Variant::Demc);
    let frame = frame(640, 520);
    let error = |halo| {
        let tiling = Tiling {
            halo,
            side: Some(256),
            ..Tiling::default()
        };
        let denoised = denoise(&bundle, &frame, &tiling, Ensemble::One).expect("tiled");
        denoised.seam_error.expect("it is not exact")
    };
    let (none, some, most) = (error(0), error(64), error(160));
    assert!(none.windows > 1 && none.relmse > some.relmse && some.relmse > most.relmse);
    assert!(none.largest > 1e-3, "{none:?}");
    assert!(
        most.largest > 0.0 && most.largest < none.largest,
        "{most:?}"
    );
}

#[test]
fn little_memory_makes_tiles_and_too_little_an_error() {
    let bundle = bundle(Variant::Demc);
    let frame = frame(700, 500);
    let within = |memory| {
        let tiling = Tiling {
            memory: Some(memory),
            ..Tiling::default()
        };
        denoise(&bundle, &frame, &tiling, Ensemble::One)
    };
    let whole = within(u64::MAX).expect("no limit");
    assert_eq!(whole.tiles.count(), 1);
    let (height, width) = whole.tiles.largest();
    let limit = bundle.pass_bytes(height, width) - 1;
    let tiled = within(limit).expect("tiles fit");
    let (height, width) = tiled.tiles.largest();
    assert!(tiled.tiles.count() > 1 && bundle.pass_bytes(height, width) <= limit);
    let error = within(1000).expect_err("a thousand bytes").to_string();
    assert_eq!(error, "pattern");
}

#[test]
fn every_tile_is_announced() {
    let tiling = Tiling {
        side: Some(32),
        ..Tiling::default()
    };
    let mut heard = Vec::new();
    let bundle = bundle(Variant::ColorOnly);
    let frame = frame(64, 40);
    let options = DenoiseOptions {
        tiling,
        ..DenoiseOptions::default()
    };
    let denoised = bundle.denoise_with(&frame, &options, |progress| {
        heard.push(progress);
        ControlFlow::Continue(())
    });
    assert!(denoised.is_ok());
    let mut tiles: Vec<usize> = heard.iter().map(|progress| progress.tile).collect();
    tiles.dedup();
    assert_eq!(tiles, [0, 1, 2, 3]);
    assert!(heard.iter().all(|progress| progress.tiles == 4));
    let shares: Vec<f64> = heard.iter().map(|progress| progress.share).collect();
    assert!(shares.is_sorted() && shares[0] == 0.0, "{shares:?}");
    assert!(shares[shares.len() - 1] > 0.99, "{shares:?}");
}

#[test]
fn the_observer_can_stop_the_work_at_every_call() {
    let bundle = bundle(Variant::ColorOnly);
    let frame = frame(64, 40);
    let options = DenoiseOptions {
        ensemble: Ensemble::Four,
        ..DenoiseOptions::default()
    };
    let stop_at = |last: usize| {
        let mut calls = 0;
        let done = bundle.denoise_with(&frame, &options, |_| {
            calls += 1;
            if calls == last {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        });
        (done, calls)
    };
    let (done, calls) = stop_at(usize::MAX);
    assert!(done.is_ok() && calls > 4, "{calls}");
    for last in 1..=calls {
        let (done, calls) = stop_at(last);
        assert_eq!(calls, last);
        let error = done.expect_err("cancelled").to_string();
        assert_eq!(error, "pattern: cancelled");
    }
}

/// Eight passes give the same image for a transposed input, up to the order of sums; one pass does
/// not.
#[test]
fn an_ensemble_does_not_mind_how_an_image_is_held() {
    let bundle = bundle(Variant::Demc);
    let (width, height) = (64, 32);
    let turned = |planes: &[f32], width: usize, height: usize| -> Vec<f32> {
        let planes = planes.chunks_exact(width * height);
        planes
            .flat_map(|plane| {
                (0..width * height).map(move |i| plane[i % height * width + i / height])
            })
            .collect()
    };
    let upright = frame(width, height);
    let [color, features] =
        [&upright.color, &upright.features].map(|planes| turned(planes, width, height));
    let lying = Frame::new("lying", height, width, color, features);
    let changed = |ensemble| {
        let image = |frame: &Frame| {
            let denoised = denoise(&bundle, frame, &Tiling::default(), ensemble);
            denoised.expect("denoised").color_hdr
        };
        difference(&image(&lying), &turned(&image(&upright), width, height))
    };
    let (one, eight) = (changed(Ensemble::One), changed(Ensemble::Eight));
    assert!(one > 1e-3 && eight < 1e-5, "{one}, {eight}");
}

#[test]
fn an_ensemble_of_tiles_is_that_of_the_whole_image() {
    let bundle = bundle(Variant::Demc);
    let frame = frame(490, 250);
    let image = |side| {
        let tiling = Tiling {
            side,
            ..Tiling::default()
        };
        let denoised = denoise(&bundle, &frame, &tiling, Ensemble::Eight);
        let denoised = denoised.expect("denoised");
        (denoised.tiles.count(), denoised.color_hdr)
    };
    let ((one, whole), (some, tiled)) = (image(None), image(Some(128)));
    assert!(one == 1 && some >= 8);
    let difference = difference(&tiled, &whole);
    assert!(difference <= 2e-6, "{difference}");
}

/// Outside the usual range, colour times a factor gives the image times that factor, up to float32
/// rounding. The training range is the exposure of this image alone.
#[test]
fn the_exposure_of_an_unusual_image_does_not_matter() {
    let mut bundle = bundle(Variant::Demc);
    let frame = frame(70, 40);
    let ranges = demc_data::Ranges::of(&[demc_data::FrameSummary::of(&frame)]);
    bundle.meta.ranges = Some(ranges);
    let expected = bundle.denoise(&frame).expect("denoised");
    for factor in [1e-3, 0.3, 1e3] {
        let mut scaled = frame.clone();
        scaled.color.iter_mut().for_each(|x| *x *= factor);
        let mut found = bundle.denoise(&scaled).expect("denoised");
        found.iter_mut().for_each(|x| *x /= factor);
        let difference = difference(&found, &expected);
        assert!(difference < 1e-5, "{factor}: {difference}");
    }
    let options = DenoiseOptions {
        input_scale: Some(4.0),
        ..DenoiseOptions::default()
    };
    let other = bundle.denoise_with(&frame, &options, unobserved);
    assert!(difference(&other.expect("denoised").color_hdr, &expected) > 1e-3);
}

#[test]
fn restored_light_is_that_of_the_noisy_image_and_an_option_wins() {
    let mut bundle = bundle(Variant::Demc);
    let frame = frame(90, 70);
    let light = |image: &[f32]| image.iter().map(|x| f64::from(*x)).sum::<f64>();
    let run = |bundle: &Bundle, restore_light| {
        let options = DenoiseOptions {
            restore_light,
            ..DenoiseOptions::default()
        };
        let denoised = bundle.denoise_with(&frame, &options, unobserved);
        denoised.expect("denoised").color_hdr
    };
    let plain = run(&bundle, None);
    let restored = run(&bundle, Some(true));
    let missing = |image: &[f32]| (light(image) - light(&frame.color)).abs();
    assert!(missing(&restored) < missing(&plain) - 1.0);
    bundle.meta.normalizer.restore_light = true;
    assert!(run(&bundle, None) == restored);
    assert!(run(&bundle, Some(false)) == plain);
}

#[test]
fn a_black_image_stays_finite_and_has_scale_one() {
    let mut bundle = bundle(Variant::Demc);
    let mut frame = frame(40, 40);
    let ranges = demc_data::Ranges::of(&[demc_data::FrameSummary::of(&frame)]);
    bundle.meta.ranges = Some(ranges);
    let exposure = demc_data::input::ranges::exposure(&frame.color);
    assert_eq!(bundle.input_scale(exposure), 1.0);
    assert_eq!(bundle.input_scale(1.9 * exposure), 1.0);
    assert_eq!(bundle.input_scale(0.0), 1.0);
    assert_eq!(bundle.input_scale(1e-300), MAX_INPUT_SCALE);
    frame.color.fill(0.0);
    assert!(bundle.denoise(&frame).is_ok());
}

/// A bundle whose positions are relative to the image takes any origin and unit, in tiles, too.
#[test]
fn positions_of_any_origin_and_unit_give_the_same_image() {
    let mut bundle = bundle(Variant::Demc);
    bundle.meta.normalizer.position = demc_data::PositionSpace::Image;
    let original = frame(100, 70);
    let expected = bundle.denoise(&original).expect("denoised");
    let pixels = 100 * 70;
    for (factor, offset) in [(1024.0, 0.0), (1.0, 64.0), (1e-3, 1.0)] {
        let mut moved = original.clone();
        for x in &mut moved.features[3 * pixels..6 * pixels] {
            *x = *x * factor + offset;
        }
        let tiling = Tiling {
            side: Some(64),
            ..Tiling::default()
        };
        let found = denoise(&bundle, &moved, &tiling, Ensemble::One).expect("denoised");
        let difference = difference(&found.color_hdr, &expected);
        assert!(difference < 1e-3, "{factor} {offset}: {difference}");
    }
}

#[test]
fn albedo_above_one_counts_as_one() {
    let mut bundle = bundle(Variant::Demc);
    bundle.meta.normalizer.albedo_demodulation_epsilon = Some(0.07);
    let mut bright = frame(40, 40);
    let first = demc_data::image::frame::TEXTURES * 40 * 40;
    bright.features[first] = 90.0;
    let mut white = bright.clone();
    white.features[first] = 1.0;
    let image = |frame| bundle.denoise(frame).expect("denoised");
    assert_eq!(image(&bright), image(&white));
}
