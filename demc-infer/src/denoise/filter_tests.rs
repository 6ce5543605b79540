//! Tests of the albedo filter with narrow networks on frames with a pattern.

use demc_data::image::frame::TEXTURES;
use demc_data::{Frame, PositionSpace};
use demc_model::Variant;

use super::tests::{denoise, difference};
use super::*;
use crate::bundle::testing::{filtered, frame};

fn model() -> Bundle {
    let mut bundle = filtered(Variant::Demc, Variant::DemcNosn);
    bundle.meta.normalizer.albedo_demodulation_epsilon = Some(0.07);
    bundle
}

fn albedo(frame: &mut Frame) -> &mut [f32] {
    let pixels = frame.width * frame.height;
    &mut frame.features[TEXTURES * pixels..][..3 * pixels]
}

/// The frame after the filter by hand: padded, with the filter's image of the albedo as albedo.
fn filtered_by_hand(bundle: &Bundle, original: &Frame) -> Frame {
    let padding = Padding {
        height: original.height,
        width: original.width,
        unit: DOWNSAMPLING,
    };
    let mut padded = Frame::new(
        original.name.clone(),
        padding.padded_width(),
        padding.padded_height(),
        padding.pad(&original.color),
        padding.pad(&original.features),
    );
    let mut noisy = padded.clone();
    noisy.color = albedo(&mut padded)
        .iter()
        .map(|x| x.clamp(0.0, 1.0))
        .collect();
    let filter = bundle.albedo_filter.as_ref().expect("a filter");
    let image = denoise(filter, &noisy, &Tiling::default(), Ensemble::One)
        .expect("denoised")
        .color_hdr;
    let pixels = padded.width * padded.height;
    for (i, (value, filtered)) in albedo(&mut padded).iter_mut().zip(image).enumerate() {
        let has_surface = (0..3).any(|channel| noisy.color[channel * pixels + i % pixels] > 0.0);
        *value = if has_surface { filtered.min(1.0) } else { 0.0 };
    }
    padded
}

/// The whole path equals one by hand: for colour, alpha and the detail map, with and without padding,
/// with test-time augmentation.
#[test]
fn the_filters_image_replaces_the_albedo() {
    let bundle = model();
    let plain = Bundle {
        albedo_filter: None,
        ..bundle.clone()
    };
    for (width, height) in [(64, 96), (50, 70)] {
        let mut original = frame(width, height);
        albedo(&mut original)[0] = 9.0;
        albedo(&mut original)[1] = -9.0;
        for channel in 0..3 {
            // Pixel 2 has no surface.
            albedo(&mut original)[channel * width * height + 2] = 0.0;
        }
        let alpha = |size: usize| (0..size).map(|i| (i % 7) as f32 / 7.0).collect();
        original.alpha = Some(alpha(width * height));
        let by_hand = filtered_by_hand(&bundle, &original);
        let padding = Padding {
            height,
            width,
            unit: DOWNSAMPLING,
        };
        let filter = bundle.albedo_filter.as_ref().expect("a filter");
        let alone = filter.filtered_albedo(&original).expect("filtered");
        let expected = padding.crop(albedo(&mut by_hand.clone()));
        assert_eq!(alone.expect("not constant"), expected, "{width}x{height}");
        for ensemble in [Ensemble::One, Ensemble::Four] {
            let image = |bundle: &Bundle, frame: &Frame| {
                denoise(bundle, frame, &Tiling::default(), ensemble).expect("denoised")
            };
            let found = image(&bundle, &original);
            let expected = padding.crop(&image(&plain, &by_hand).color_hdr);
            assert_eq!(found.color_hdr, expected, "{width}x{height}");
            let without = image(&plain, &original);
            assert!(difference(&found.color_hdr, &without.color_hdr) > 1e-3);
            assert_ne!(found.alpha, without.alpha);
        }
        let map = |bundle: &Bundle, frame: &Frame| {
            bundle.detail_map(frame).expect("a map").expect("fusion")
        };
        assert_eq!(
            map(&bundle, &original),
            padding.crop(&map(&plain, &by_hand))
        );
    }
}

#[test]
fn tiles_of_both_networks_are_the_whole_image() {
    let bundle = model();
    let frame = frame(490, 450);
    let whole = bundle.denoise(&frame).expect("whole");
    let tiling = Tiling {
        side: Some(224),
        ..Tiling::default()
    };
    let tiled = denoise(&bundle, &frame, &tiling, Ensemble::One).expect("tiled");
    assert!(tiled.tiles.count() >= 4);
    let difference = difference(&tiled.color_hdr, &whole);
    assert!(difference <= 4e-6, "{difference}");
}

#[test]
fn the_graph_of_an_image_is_denoising() {
    let bundle = model();
    for (width, height) in [(64, 96), (50, 70)] {
        let frame = frame(width, height);
        let denoised = denoise(&bundle, &frame, &Tiling::default(), Ensemble::One);
        let graph = bundle.run_graph(&frame).expect("denoised");
        assert_eq!(denoised.expect("denoised").color_hdr, graph);
    }
}

/// A file that lacks the albedo has zeros, and its image is that of the network alone.
#[test]
fn a_constant_albedo_is_not_filtered() {
    let bundle = model();
    let plain = Bundle {
        albedo_filter: None,
        ..bundle.clone()
    };
    for value in [0.0, 0.5] {
        let mut flat = frame(40, 40);
        albedo(&mut flat).fill(value);
        let [with, without] = [&bundle, &plain].map(|b| b.denoise(&flat).expect("denoised"));
        assert_eq!(with, without);
        let filter = bundle.albedo_filter.as_ref().expect("a filter");
        assert_eq!(filter.filtered_albedo(&flat).expect("constant"), None);
    }
}

/// Both networks take positions relative to the image, of any origin and unit.
#[test]
fn the_filter_takes_the_positions_of_the_network() {
    let mut bundle = model();
    let filter = bundle.albedo_filter.as_mut().expect("a filter");
    filter.meta.normalizer.position = PositionSpace::Image;
    bundle.meta.normalizer.position = PositionSpace::Image;
    let original = frame(100, 70);
    let expected = bundle.denoise(&original).expect("denoised");
    let mut moved = original.clone();
    for x in &mut moved.features[3 * 7000..6 * 7000] {
        *x = *x * 1024.0 + 64.0;
    }
    let found = bundle.denoise(&moved).expect("denoised");
    assert!(difference(&found, &expected) < 1e-3);
}
