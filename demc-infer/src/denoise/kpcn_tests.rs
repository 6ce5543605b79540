//! KPCN on frames with a pattern.

use demc_data::input::kpcn::KpcnInput;
use demc_model::Variant;

use super::tests::{denoise, difference};
use super::*;
use crate::bundle::testing::{bundle, frame};

/// Light that is flat in the network's space stays as it is; the albedo's detail comes back.
#[test]
fn flat_light_keeps_the_detail_of_the_albedo() {
    let bundle = bundle(Variant::Kpcn);
    let mut frame = frame(70, 40);
    let pixels = 70 * 40;
    let mut passes = frame.passes.take().expect("a pattern");
    let divisor = KpcnInput::new(&passes, &frame.features, 1.0).divisor;
    for (value, divisor) in passes.iter_mut().zip(&divisor) {
        *value = 0.8 * divisor;
    }
    passes[3 * pixels..6 * pixels].fill(0.3);
    let expected: Vec<f32> = divisor.iter().map(|divisor| 0.8 * divisor + 0.3).collect();
    frame.passes = Some(passes);
    for scale in [1.0, 4.0] {
        let options = DenoiseOptions {
            input_scale: Some(scale),
            ..DenoiseOptions::default()
        };
        let found = bundle.denoise_with(&frame, &options, unobserved);
        let difference = difference(&found.expect("denoised").color_hdr, &expected);
        assert!(difference < 1e-5, "{difference}");
    }
}

#[test]
fn tiles_are_the_whole_image_and_an_ensemble_is_another() {
    let bundle = bundle(Variant::Kpcn);
    let frame = frame(250, 90);
    let whole = denoise(&bundle, &frame, &Tiling::default(), Ensemble::One).expect("whole");
    // The reach is 29 pixels.
    let tiling = Tiling {
        side: Some(64),
        halo: 32,
        ..Tiling::default()
    };
    let tiled = denoise(&bundle, &frame, &tiling, Ensemble::One).expect("tiled");
    assert!(tiled.tiles.count() > 4);
    assert!(difference(&tiled.color_hdr, &whole.color_hdr) < 1e-5);
    let four = denoise(&bundle, &frame, &Tiling::default(), Ensemble::Four).expect("denoised");
    assert!(difference(&four.color_hdr, &whole.color_hdr) > 1e-4);
}

#[test]
fn what_it_cannot_do_is_refused_or_left_alone() {
    let bundle = bundle(Variant::Kpcn);
    let mut frame = frame(40, 40);
    frame.alpha = Some((0..1600).map(|i| (i % 7) as f32 / 7.0).collect());
    let denoised = denoise(&bundle, &frame, &Tiling::default(), Ensemble::One);
    assert_eq!(denoised.expect("denoised").alpha, None);
    let layer = Layer {
        name: "key.R".into(),
        samples: vec![0.5; 1600],
    };
    let options = DenoiseOptions {
        layers: vec![layer],
        ..DenoiseOptions::default()
    };
    let layers = bundle.denoise_with(&frame, &options, unobserved);
    assert!(matches!(layers, Err(DenoiseError::Layers { .. })));
    let mut filtered = crate::bundle::testing::bundle(Variant::Demc);
    assert!(filtered.set_albedo_filter(bundle.clone()).is_err());
    frame.passes = None;
    let error = bundle.denoise(&frame).expect_err("no passes").to_string();
    assert!(error.contains("no passes"), "{error}");
}
