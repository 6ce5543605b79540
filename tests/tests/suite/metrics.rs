//! Compares every metric with another implementation on the sample's renders;
//! `metrics/make_expected.py` names the implementations.

use std::collections::BTreeMap;
use std::path::Path;

use demc_data::{ChannelLayout, read_frame};
use demc_model::metrics::{Image, METRICS};

/// Relative tolerance. Formulas in float64 agree to rounding. RelMSE uses the float32 epsilon 0.001
/// of the loss (relative error 5e-8), and the gamma is the float32 2.2 (2e-8). FLIP is single
/// precision on both sides, with a different order of sums.
fn tolerance(metric: &str) -> f64 {
    match metric {
        "flip" => 1e-4,
        "relmse" | "relmse-trimmed" | "ssim" | "psnr" => 1e-7,
        _ => 1e-9,
    }
}

#[test]
fn metrics_agree_with_other_implementations() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let text = std::fs::read(root.join("metrics/expected.json")).expect("fixture");
    let expected: BTreeMap<String, BTreeMap<String, BTreeMap<String, f64>>> =
        serde_json::from_slice(&text).expect("JSON");
    assert_eq!(expected.len(), 4, "the sample's test scenes");
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    for (scene, candidates) in &expected {
        let path = root.join(format!("../data/sample/test/{scene}.exr"));
        let frame = read_frame(&path, &layout).expect("a scene");
        let reference = frame.reference.as_deref().expect("a reference");
        let moved: Vec<f32> = reference
            .chunks(frame.width)
            .flat_map(|row| (0..row.len()).map(|x| row[(x + row.len() - 1) % row.len()] * 1.1))
            .collect();
        let image = |hdr| Image::new(hdr, frame.height, frame.width).expect("finite");
        let r = image(reference);
        for (name, expected) in candidates {
            let c = match name.as_str() {
                "noisy" => image(&frame.color),
                "moved" => image(&moved),
                other => panic!("candidate {other}"),
            };
            assert_eq!(expected.len(), METRICS.len(), "all metrics");
            for metric in METRICS {
                let (found, wanted) = ((metric.measure)(&c, &r), expected[metric.name]);
                let found = found.expect("a value");
                assert!(
                    (found - wanted).abs() <= tolerance(metric.name) * wanted.abs(),
                    "{scene}, {name}, {}: {found}, elsewhere {wanted}",
                    metric.name
                );
            }
        }
    }
}
