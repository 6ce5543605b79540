//! Tests of the bundle as a whole: round trips, and every kind of invalid file.

use std::collections::HashMap;
use std::fs;

use demc_model::Variant;
use safetensors::tensor::{Dtype, TensorView};

use super::testing::{bundle, without_checksum};
use super::*;

const STYLES: [(Names, Precision); 4] = [
    (Names::Burn, Precision::F32),
    (Names::Torch, Precision::F32),
    (Names::Burn, Precision::F16),
    (Names::Torch, Precision::F16),
];

fn encoded(bundle: &Bundle, names: Names, precision: Precision) -> Vec<u8> {
    encode::encode(bundle, names, precision).expect("bytes")
}

type TensorList = Vec<(String, Dtype, Vec<usize>, Vec<u8>)>;

fn serialized(tensors: &TensorList, header: Option<&str>) -> Vec<u8> {
    let views = tensors.iter().map(|(name, dtype, shape, bytes)| {
        (
            name,
            TensorView::new(*dtype, shape.clone(), bytes).expect("view"),
        )
    });
    let metadata = header.map(|text| HashMap::from([("demc".to_string(), text.to_string())]));
    safetensors::serialize(views, metadata).expect("bytes")
}

fn load_error(tensors: &TensorList, header: Option<&str>) -> String {
    error_of(&serialized(tensors, header))
}

fn error_of(bytes: &[u8]) -> String {
    let dir = tempfile::tempdir().expect("directory");
    let path = dir.path().join("x.safetensors");
    fs::write(&path, bytes).expect("written");
    let error = Bundle::load(&path, &Device::flex()).expect_err("refused");
    let chain: Vec<_> =
        std::iter::successors(Some(&error as &dyn std::error::Error), |e| e.source())
            .map(|e| e.to_string())
            .collect();
    let line = chain.join(": ");
    assert!(!line.contains('\n'), "one line: {line}");
    line.strip_prefix(&format!("{}: ", path.display()))
        .expect("path first")
        .into()
}

fn good() -> (TensorList, String) {
    let bundle = bundle(Variant::Demc);
    let bytes = encoded(&bundle, Names::Burn, Precision::F32);
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).expect("header");
    let entry = header.metadata().as_ref().expect("metadata")["demc"].clone();
    let file = safetensors::SafeTensors::deserialize(&bytes).expect("tensors");
    let tensors = file.tensors().into_iter().map(|(name, view)| {
        (
            name,
            view.dtype(),
            view.shape().to_vec(),
            view.data().to_vec(),
        )
    });
    (tensors.collect(), without_checksum(&entry))
}

#[test]
fn every_naming_and_precision_survives_a_round_trip() {
    for variant in Variant::ALL {
        let bundle = bundle(variant);
        for (names, precision) in STYLES {
            let dir = tempfile::tempdir().expect("directory");
            let path = dir.path().join("x.safetensors");
            bundle
                .export(&path, names, precision)
                .expect("exported and compared");
            let back = Bundle::load(&path, &Device::flex()).expect("loaded");
            assert_eq!(back.meta, bundle.meta);
            if precision == Precision::F32 {
                assert_eq!(back.model.weights(), bundle.model.weights());
            }
        }
    }
}

#[test]
fn f16_halves_the_convolutions_and_leaves_batch_normalisation() {
    let bundle = bundle(Variant::Demc);
    let bytes = encoded(&bundle, Names::Torch, Precision::F16);
    let tensors = safetensors::SafeTensors::deserialize(&bytes).expect("tensors");
    let dtype = |name: &str| tensors.tensor(name).expect(name).dtype();
    assert_eq!(dtype("decoder.head.weight"), Dtype::F16);
    assert_eq!(dtype("fusion.blocks.1.norm.weight"), Dtype::F32);
    assert_eq!(dtype("latent.norm.running_var"), Dtype::F32);
}

#[test]
fn equal_bundles_give_equal_bytes() {
    let bytes = || {
        let bundle = bundle(Variant::Semc);
        encoded(&bundle, Names::Burn, Precision::F16)
    };
    let first = bytes();
    assert!((0..8).all(|_| bytes() == first));
}

#[test]
fn a_file_cut_short_anywhere_is_refused() {
    let bundle = bundle(Variant::Demc);
    let bytes = encoded(&bundle, Names::Burn, Precision::F32);
    for length in [0, 7, 100, bytes.len() / 2, bytes.len() - 1] {
        let error = error_of(&bytes[..length]);
        assert!(
            error.starts_with("cut short, damaged or no safetensors file: "),
            "{error}"
        );
    }
    assert!(error_of(b"v/1\x01 an OpenEXR file, say").starts_with("cut short"));
}

#[test]
fn foreign_files_and_other_formats_are_refused() {
    let (tensors, header) = good();
    assert!(load_error(&tensors, None).contains("no DEMC bundle"));
    let newer = header.replacen("\"format\":1", "\"format\":2", 1);
    assert_eq!(
        load_error(&tensors, Some(&newer)),
        "bundle format 2; this build reads format 1"
    );
    let broken = header.replacen("\"variant\"", "\"varient\"", 1);
    assert!(
        load_error(&tensors, Some(&broken))
            .starts_with("header entry `demc`: unknown field `varient`")
    );
}

#[test]
fn statistics_that_divide_by_zero_are_refused() {
    let (tensors, header) = good();
    let zero = header.replacen("\"std\":[0.3", "\"std\":[0.0", 1);
    let error = load_error(&tensors, Some(&zero));
    assert!(
        error.contains("normalizer.features: normal.x: mean 0, std 0"),
        "{error}"
    );
}

#[test]
fn a_file_that_differs_from_its_checksum_is_refused() {
    let bytes = encoded(&bundle(Variant::Demc), Names::Torch, Precision::F16);
    let mut damaged = bytes.clone();
    let last = damaged.len() - 1;
    damaged[last] ^= 1;
    assert!(error_of(&damaged).starts_with("damaged: its checksum differs"));
    let text = String::from_utf8_lossy(&bytes[8..]).into_owned();
    let place = 8 + text.find("sha256").expect("a checksum");
    let mut renamed = bytes.clone();
    renamed[place] ^= 1;
    assert_eq!(
        error_of(&renamed),
        "header entry `demc`: unknown key `rha256`"
    );
    let path = Path::new("memory");
    assert!(BundleFile::parse(path.into(), &bytes).is_ok());
}

#[test]
fn a_tensor_that_does_not_fit_is_named() {
    let (mut tensors, header) = good();
    let head = tensors
        .iter()
        .position(|t| t.0 == "decoder.head.bias")
        .expect("head");

    let mut missing = tensors.clone();
    missing.remove(head);
    assert_eq!(
        load_error(&missing, Some(&header)),
        "weight decoder.head.bias is missing"
    );

    let mut extra = tensors.clone();
    extra.push(("decoder.tail".into(), Dtype::F32, vec![1], vec![0; 4]));
    let error = load_error(&extra, Some(&header));
    assert!(
        error.contains("weight decoder.tail is not part of this network"),
        "{error}"
    );

    let mut misshaped = tensors.clone();
    misshaped[head].2 = vec![3, 1];
    let error = load_error(&misshaped, Some(&header));
    assert_eq!(
        error,
        "weight decoder.head.bias: expected shape [3], found [3, 1]"
    );

    let mut nan = tensors.clone();
    nan[head].3[..4].copy_from_slice(&f32::NAN.to_le_bytes());
    assert_eq!(
        load_error(&nan, Some(&header)),
        "tensor decoder.head.bias: NaN among its values"
    );

    tensors[head].1 = Dtype::I32;
    assert_eq!(
        load_error(&tensors, Some(&header)),
        "tensor decoder.head.bias: type I32; expected F32 or F16"
    );
}

#[test]
fn names_with_line_breaks_do_not_break_messages() {
    let (mut tensors, header) = good();
    tensors.push(("a\n\u{1b}[2Jb".into(), Dtype::I32, vec![1], vec![0; 4]));
    assert_eq!(
        load_error(&tensors, Some(&header)),
        "tensor a\\n\\u{1b}[2Jb: type I32; expected F32 or F16"
    );
    let odd = header.replacen("\"variant\"", "\"var\\niant\"", 1);
    let error = load_error(&tensors, Some(&odd));
    assert!(
        error.starts_with("header entry `demc`: unknown field `var\\niant`"),
        "{error}"
    );
}

#[test]
fn the_bundled_models_load_by_name() {
    for model in Bundled::ALL {
        let file = BundleFile::read(model.name().as_ref()).expect("a bundled model");
        assert_eq!(file.path, Path::new(model.name()));
        file.into_bundle(&Device::flex()).expect("all tensors");
    }
    let error = BundleFile::read("./fast".as_ref()).expect_err("a file");
    assert!(matches!(error, BundleError::Read { .. }), "{error}");
}

/// Without demodulation the first edition wrote 0, or no such key.
#[test]
fn a_file_of_the_first_edition_loads() {
    let (tensors, header) = good();
    for (text, expected) in [
        ("\"demodulate\":0.07,", Some(0.07)),
        ("\"demodulate\":0.0,", None),
        ("", None),
    ] {
        let old = header.replacen("\"gamma\":2.2,", &format!("\"gamma\":2.2,{text}"), 1);
        let dir = tempfile::tempdir().expect("directory");
        let path = dir.path().join("old.safetensors");
        fs::write(&path, serialized(&tensors, Some(&old))).expect("written");
        let bundle = Bundle::load(&path, &Device::flex()).expect("all tensors");
        let found = bundle.meta.normalizer.albedo_demodulation_epsilon;
        assert_eq!(found, expected, "{text}");
    }
}
