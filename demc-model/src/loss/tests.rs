use super::*;
use crate::metrics::{Image, rel_mse_image, ssim};

const SHAPE: [usize; 4] = [2, 3, 4, 5];

fn pattern(phase: usize) -> Vec<f32> {
    (0..SHAPE.iter().product())
        .map(|i| ((i * 37 + phase * 11) % 101) as f32 / 101.0)
        .collect()
}

fn tensor(values: &[f32], device: &Device) -> Tensor<4> {
    Tensor::from_data(TensorData::new(values.to_vec(), SHAPE), device)
}

fn host(losses: Tensor<1>) -> Vec<f32> {
    losses.into_data().try_to_vec().unwrap()
}

const TERMS: [(&str, LossConfig); 4] = {
    let none = LossConfig {
        relmse: 0.0,
        dssim: 0.0,
        smape: 0.0,
        l1: 0.0,
        l1_hdr: 0.0,
        separate: 0.0,
        relmse_epsilon: LOSS_EPSILON,
    };
    [
        (
            "relmse",
            LossConfig {
                relmse: 1.0,
                ..none
            },
        ),
        ("smape", LossConfig { smape: 1.0, ..none }),
        ("l1", LossConfig { l1: 1.0, ..none }),
        (
            "l1_hdr",
            LossConfig {
                l1_hdr: 1.0,
                ..none
            },
        ),
    ]
};

/// One term of each image's loss, computed by a loop in float64.
fn plain(term: &str, out_gamma: &[f32], ref_hdr: &[f32]) -> Vec<f64> {
    let image = out_gamma.len() / SHAPE[0];
    let one = |out: &[f32], reference: &[f32]| -> f64 {
        let out_hdr: Vec<f32> = out.iter().map(|y| y.powf(2.2)).collect();
        let mean = |term: &dyn Fn(f64, f64, f64) -> f64| {
            let values = out.iter().zip(&out_hdr).zip(reference);
            let terms = values.map(|((y, c), r)| term((*y).into(), (*c).into(), (*r).into()));
            terms.sum::<f64>() / out.len() as f64
        };
        match term {
            "relmse" => rel_mse_image(&out_hdr, reference),
            "l1_hdr" => mean(&|_, c, r| (c - r).abs()),
            "smape" => mean(&|_, c, r| (c - r).abs() / (c + r + 0.01)),
            _ => mean(&|y, _, r| (y - r.powf(1.0 / f64::from(2.2f32))).abs()),
        }
    };
    let images = out_gamma.chunks(image).zip(ref_hdr.chunks(image));
    images.map(|(out, reference)| one(out, reference)).collect()
}

#[test]
fn every_term_agrees_with_a_loop_for_each_image() {
    let (out, reference) = (pattern(1), pattern(2));
    for (term, loss) in TERMS {
        for ops in Ops::ALL {
            let device = Device::flex();
            let [a, b] = [&out, &reference].map(|values| tensor(values, &device));
            let found = host(loss.per_image(ops, a, b, 2.2));
            let expected = plain(term, &out, &reference);
            assert_eq!(found.len(), 2);
            for (found, expected) in found.iter().zip(expected) {
                // float32 sums of 60 terms.
                let near = (f64::from(*found) - expected).abs() <= 1e-5 * expected;
                assert!(near, "{term} on {ops}: {found}, not {expected}");
            }
        }
    }
}

#[test]
fn every_gradient_agrees_with_differences() {
    let device = Device::flex().autodiff();
    let (out, reference) = (pattern(1), pattern(2));
    let loss_sum = |loss: LossConfig, out: &[f32]| {
        let [a, b] = [out, &reference[..]].map(|values| tensor(values, &device));
        let sum = loss.per_image(Ops::Kernels, a, b, 2.2).sum();
        f64::from(sum.into_scalar::<f32>())
    };
    for (term, loss) in TERMS {
        let a = tensor(&out, &device).require_grad();
        let b = tensor(&reference, &device);
        let sum = loss.per_image(Ops::Kernels, a.clone(), b, 2.2).sum();
        let gradient: Vec<f32> = a
            .grad(&sum.backward())
            .expect("a leaf")
            .into_data()
            .try_to_vec()
            .unwrap();
        let steepest = gradient.iter().fold(0.0f32, |most, g| most.max(g.abs()));
        for i in [0, 7, 59, 60, 119] {
            let moved = |distance: f32| {
                let mut out = out.clone();
                out[i] += distance;
                loss_sum(loss, &out)
            };
            let slope = (moved(1e-3) - moved(-1e-3)) / 2e-3;
            let near = (slope - f64::from(gradient[i])).abs() < 0.02 * f64::from(steepest);
            assert!(near, "{term}, value {i}: {}, slope {slope}", gradient[i]);
        }
    }
}

/// Constant images differ only in the luminance term, `2ab / (a^2 + b^2)`. An image mirrored
/// around its mean has the structure term -1.
#[test]
fn dssim_agrees_with_hand_computed_cases() {
    let device = Device::flex();
    let shape = [1, 3, 16, 16];
    let image = |value: &dyn Fn(usize) -> f32| {
        let values: Vec<f32> = (0..3 * 256).map(value).collect();
        Tensor::<4>::from_data(TensorData::new(values, shape), &device)
    };
    let found = |a, b| host(dssim(a, b))[0];
    let flat = found(image(&|_| 0.2), image(&|_| 0.6));
    let level = (2.0 * 0.12 + 1e-4) / (0.04 + 0.36 + 1e-4);
    // Rounding gives a variance of about 1e-7 instead of 0, beside the constant 9e-4.
    assert!((flat - (1.0 - level) / 2.0).abs() < 2e-4, "{flat}");
    // A checkerboard of 0.5 +- 0.3: variance 0.09.
    let board =
        |sign: f32| image(&move |i| 0.5 + sign * if (i / 16 + i) % 2 == 0 { 0.3 } else { -0.3 });
    let opposite = found(board(1.0), board(-1.0));
    let structure = (-2.0 * 0.09 + 9e-4) / (2.0 * 0.09 + 9e-4);
    assert!(
        (opposite - (1.0 - structure) / 2.0).abs() < 2e-4,
        "{opposite}"
    );
    assert!(found(board(1.0), board(1.0)).abs() < 2e-4);
    // Values above 1 are clipped to white.
    assert!(found(image(&|_| 1.0), image(&|_| 7.0)).abs() < 2e-4);
}

/// A wave with noise and values above 1, which are clipped.
#[test]
fn dssim_agrees_with_the_metric() {
    let (height, width) = (24, 37);
    let image = |phase: f32| -> Vec<f32> {
        let values = (0..3 * height * width).map(|i| {
            let noise = (i * 37 + (phase * 11.0) as usize) % 101;
            0.6 + 0.5 * (i as f32 * 0.11 + phase).sin() + 0.004 * noise as f32
        });
        values.collect()
    };
    let device = Device::flex();
    let tensor = |values: &[f32]| {
        Tensor::<4>::from_data(
            TensorData::new(values.to_vec(), [1, 3, height, width]),
            &device,
        )
    };
    let [a, b] = [0.0, 1.0].map(image);
    let found = host(dssim(tensor(&a), tensor(&b)))[0];
    let hdr = |gamma: &[f32]| -> Vec<f32> { gamma.iter().map(|y| y.powf(2.2)).collect() };
    let (a, b) = (hdr(&a), hdr(&b));
    let [a, b] = [&a, &b].map(|hdr| Image::new(hdr, height, width).expect("finite"));
    let expected = (1.0 - ssim(&a, &b).expect("large enough")) / 2.0;
    assert!(expected > 0.1, "{expected}");
    assert!(
        (f64::from(found) - expected).abs() < 1e-5,
        "{found}, not {expected}"
    );
}

#[test]
fn the_loss_of_a_perfect_output_is_zero() {
    let device = Device::flex();
    let out = tensor(&pattern(1), &device);
    let reference = hdr_from_gamma(out.clone(), 2.2);
    for (term, loss) in TERMS {
        let losses = loss.per_image(Ops::Burn, out.clone(), reference.clone(), 2.2);
        assert!(host(losses).iter().all(|loss| *loss < 1e-6), "{term}");
    }
}

/// `2 RelMSE + 3 SMAPE + 0.5 DSSIM` of images larger than SSIM's window.
#[test]
fn weighted_terms_are_added() {
    let device = Device::flex();
    let shape = [1, 3, 16, 16];
    let image = |phase: usize| {
        let values: Vec<f32> = (0..768)
            .map(|i| ((i * 37 + phase) % 101) as f32 / 101.0)
            .collect();
        Tensor::<4>::from_data(TensorData::new(values, shape), &device)
    };
    let loss_of = |loss: LossConfig| host(loss.per_image(Ops::Burn, image(0), image(13), 2.2))[0];
    let [(_, relmse), (_, smape), (_, l1), _] = TERMS;
    let mixed = LossConfig {
        relmse: 2.0,
        smape: 3.0,
        dssim: 0.5,
        ..l1
    };
    let mixed = LossConfig { l1: 0.0, ..mixed };
    let dssim = LossConfig {
        l1: 0.0,
        dssim: 1.0,
        ..l1
    };
    let expected = 2.0 * loss_of(relmse) + 3.0 * loss_of(smape) + 0.5 * loss_of(dssim);
    assert!((loss_of(mixed) - expected).abs() < 1e-5 * expected);
}

#[test]
fn keys_are_those_of_the_configuration() {
    let table = serde_json::to_value(LossConfig::default()).unwrap();
    let mut keys: Vec<&String> = table.as_object().expect("a table").keys().collect();
    let mut expected = [
        "relmse",
        "dssim",
        "smape",
        "l1",
        "l1_hdr",
        "separate",
        "relmse_epsilon",
    ];
    keys.sort_unstable();
    expected.sort_unstable();
    assert_eq!(keys, expected);
    let unknown: Result<LossConfig, _> = serde_json::from_str(r#"{ "ssim": 1.0 }"#);
    assert!(unknown.is_err());
}

#[test]
fn problems_name_their_keys() {
    assert_eq!(LossConfig::default().validate(), Vec::<String>::new());
    let wrong = LossConfig {
        relmse: 0.0,
        smape: -1.0,
        relmse_epsilon: 0.0,
        ..LossConfig::default()
    };
    let problems = wrong.validate();
    assert_eq!(problems.len(), 2, "{problems:?}");
    assert!(problems[0].starts_with("loss.smape = -1.0: "));
    assert!(problems[1].starts_with("loss.relmse_epsilon = 0.0: "));
    let none = LossConfig {
        relmse: 0.0,
        ..LossConfig::default()
    };
    assert!(none.validate()[0].starts_with("loss: at least one of "));
}
