//! Tests of the albedo filter in the file.

use std::fs;

use demc_model::Variant;
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;

use super::testing::{bundle, filtered, without_checksum};
use super::*;

const STYLES: [(Names, Precision); 4] = [
    (Names::Burn, Precision::F32),
    (Names::Torch, Precision::F32),
    (Names::Burn, Precision::F16),
    (Names::Torch, Precision::F16),
];

fn flex() -> Device {
    Device::flex()
}

/// The header entry of a file.
/// The header entry without its checksum.
fn entry(bytes: &[u8]) -> serde_json::Value {
    let (_, header) = SafeTensors::read_metadata(bytes).expect("a header");
    let entry = &header.metadata().as_ref().expect("metadata")["demc"];
    serde_json::from_str(&without_checksum(entry)).expect("JSON")
}

/// The error of a file with a changed header entry and without the tensor `without`.
fn refusal(bytes: &[u8], without: &str, change: impl Fn(&mut serde_json::Value)) -> String {
    let mut header = entry(bytes);
    change(&mut header);
    let tensors = SafeTensors::deserialize(bytes).expect("tensors");
    let kept = tensors
        .tensors()
        .into_iter()
        .filter(|(name, _)| name != without);
    let metadata = std::collections::HashMap::from([("demc".into(), header.to_string())]);
    let bytes = safetensors::serialize(kept, Some(metadata)).expect("bytes");
    let error = BundleFile::parse("x".into(), &bytes)
        .and_then(|file| file.into_bundle(&flex()))
        .expect_err("refused");
    let source = std::error::Error::source(&error).map(|source| format!(": {source}"));
    format!("{error}{}", source.unwrap_or_default())
}

#[test]
fn a_filter_survives_a_round_trip_with_every_naming_and_precision() {
    for variant in Variant::with_encoders() {
        let bundle = filtered(variant, Variant::Semc);
        let filter = bundle.albedo_filter.as_ref().expect("a filter");
        for (names, precision) in STYLES {
            let dir = tempfile::tempdir().expect("directory");
            let path = dir.path().join("x.safetensors");
            let exported = bundle.export(&path, names, precision);
            exported.expect("exported and compared");
            let back = Bundle::load(&path, &flex()).expect("loaded");
            let found = back.albedo_filter.as_ref().expect("a filter");
            assert_eq!((&back.meta, &found.meta), (&bundle.meta, &filter.meta));
            assert!(found.albedo_filter.is_none());
            if precision == Precision::F32 {
                assert_eq!(back.model.weights(), bundle.model.weights());
                assert_eq!(found.model.weights(), filter.model.weights());
            }
            let bytes = |bundle: &Bundle| bundle.to_bytes(names, precision).expect("bytes");
            assert!(bytes(&back) == fs::read(&path).expect("the file"));
            let listed = SafeTensors::deserialize(&bytes(&back))
                .expect("tensors")
                .len();
            assert_eq!(bundle.tensors(names).len(), listed);
        }
    }
}

/// A file with a filter is that of the network alone, plus one key and the filter's tensors.
#[test]
fn the_network_is_written_as_without_a_filter() {
    let [plain, whole] = [
        bundle(Variant::Demc),
        filtered(Variant::Demc, Variant::Demc),
    ]
    .map(|bundle| {
        bundle
            .to_bytes(Names::Torch, Precision::F16)
            .expect("bytes")
    });
    let mut header = entry(&whole);
    let filter = header
        .as_object_mut()
        .and_then(|keys| keys.remove("albedo_filter"));
    assert_eq!(header, entry(&plain));
    let filter = filter.expect("the filter's entry");
    assert_eq!(filter["step"], 77);
    assert!(filter.get("names").is_none() && filter.get("albedo_filter").is_none());
    let [plain, whole] =
        [&plain, &whole].map(|bytes| SafeTensors::deserialize(bytes).expect("tensors"));
    assert_eq!(whole.len(), 2 * plain.len());
    for (name, view) in plain.tensors() {
        assert_eq!(
            whole.tensor(&name).expect("the same name").data(),
            view.data()
        );
        let twin = whole
            .tensor(&format!("albedo_filter.{name}"))
            .expect("the filter's");
        assert_eq!((twin.dtype(), twin.shape()), (view.dtype(), view.shape()));
    }
    let head = whole
        .tensor("albedo_filter.decoder.head.weight")
        .expect("the head");
    assert_eq!(head.dtype(), Dtype::F16);
}

#[test]
fn a_filter_that_does_not_fit_is_named() {
    let bundle = filtered(Variant::Demc, Variant::Semc);
    let bytes = bundle.to_bytes(Names::Burn, Precision::F32).expect("bytes");
    let none = |_: &mut serde_json::Value| ();
    assert_eq!(
        refusal(&bytes, "albedo_filter.decoder.head.bias", none),
        "x: weight albedo_filter.decoder.head.bias is missing"
    );
    let error = refusal(&bytes, "", |entry| {
        entry["albedo_filter"]["model"]["width"] = 3.into();
    });
    assert!(
        error.starts_with("x: weight albedo_filter.fusion.blocks.0.conv.weight: expected"),
        "{error}"
    );
    let error = refusal(&bytes, "", |entry| {
        entry.as_object_mut().expect("keys").remove("albedo_filter");
    });
    assert!(
        error.contains("albedo_filter.") && error.contains("not part of this network"),
        "{error}"
    );
    let error = refusal(&bytes, "", |entry| {
        entry["albedo_filter"]["normalizer"]["features"]["std"][0] = 0.into();
    });
    assert_eq!(
        error,
        "x: header entry `demc`: albedo_filter: normalizer.features: normal.x: mean 0, std 0"
    );
    let error = refusal(&bytes, "", |entry| {
        let own = entry["albedo_filter"].clone();
        entry["albedo_filter"]["albedo_filter"] = own;
    });
    assert_eq!(
        error,
        "x: header entry `demc`: albedo_filter: has a filter of its own"
    );
    let error = refusal(&bytes, "", |entry| {
        entry["albedo_filter"]["normalizer"]["position"] = "image".into();
    });
    assert!(
        error.ends_with("train the filter with \"scene\""),
        "{error}"
    );
    let error = refusal(&bytes, "", |entry| {
        entry["albedo_filter"]["format"] = 2.into()
    });
    assert_eq!(error, "x: bundle format 2; this build reads format 1");
}

#[test]
fn a_weight_of_the_filter_beyond_f16_is_named() {
    let mut bundle = filtered(Variant::Demc, Variant::Semc);
    let filter = bundle.albedo_filter.as_mut().expect("a filter");
    let mut weights = filter.model.weights();
    weights[0].data[0] = 1e6;
    let name = format!("albedo_filter.{}", weights[0].name);
    let model = filter.meta.model.load(&mut Weights::new(weights), &flex());
    filter.model = model.expect("fits");
    let error = bundle
        .to_bytes(Names::Burn, Precision::F16)
        .expect_err("f16");
    assert!(error.to_string().contains(&name), "{error}");
}

/// A model with a filter gives its filter, never a filter of a filter.
#[test]
fn a_model_or_its_filter_becomes_the_filter() {
    let donor = filtered(Variant::DemcNosn, Variant::Semc);
    let mut plain = bundle(Variant::Demc);
    plain.set_albedo_filter(donor.clone()).expect("fits");
    let taken = |bundle: &Bundle| {
        bundle
            .albedo_filter
            .as_ref()
            .expect("a filter")
            .meta
            .clone()
    };
    assert_eq!(taken(&plain), taken(&donor));
    plain
        .set_albedo_filter(bundle(Variant::DemcNosn))
        .expect("fits");
    assert_eq!(taken(&plain), donor.meta);

    let mut other = bundle(Variant::Demc);
    other.meta.normalizer.position = demc_data::PositionSpace::Image;
    let error = plain
        .set_albedo_filter(other.clone())
        .expect_err("other positions");
    assert_eq!(
        error.to_string(),
        "the albedo filter was trained with data.position = \"image\", the network with \"scene\"; \
         train the filter with \"scene\""
    );
    // The variant without features takes no positions.
    let free = other.set_albedo_filter(bundle(Variant::ColorOnly));
    assert!(free.is_ok());
}

/// PyTorch users save one network or both, with or without the header.
#[test]
fn an_import_keeps_the_filter_of_the_model_or_takes_that_of_the_file() {
    let dir = tempfile::tempdir().expect("directory");
    let path = |name: &str| dir.path().join(name);
    let own = filtered(Variant::Demc, Variant::Semc);
    own.save(&path("own"), Names::Torch, Precision::F32)
        .expect("saved");
    bundle(Variant::Demc)
        .save(&path("plain"), Names::Torch, Precision::F32)
        .expect("saved");
    let mut trained = own.clone();
    let filter = trained.albedo_filter.as_mut().expect("a filter");
    let mut weights = filter.model.weights();
    weights[0].data[0] += 1.0;
    let model = filter.meta.model.load(&mut Weights::new(weights), &flex());
    filter.model = model.expect("fits");
    trained
        .save(&path("both"), Names::Torch, Precision::F32)
        .expect("saved");

    let import = |file: &str, like: Option<&str>| {
        let like = like.map(|like| BundleFile::read(&path(like)).expect("a model"));
        let file = BundleFile::import(&path(file), like)?;
        file.into_bundle(&flex())
    };
    let filter = |bundle: Bundle| bundle.albedo_filter.expect("a filter").model.weights();
    let weights = |bundle: &Bundle| filter(bundle.clone());
    // Only the network's tensors: the filter of --like.
    assert_eq!(
        filter(import("plain", Some("own")).expect("imported")),
        weights(&own)
    );
    // Both: those of the file.
    assert_eq!(
        filter(import("both", Some("own")).expect("imported")),
        weights(&trained)
    );
    assert_eq!(
        filter(import("both", None).expect("imported")),
        weights(&trained)
    );
    let error = import("both", Some("plain"))
        .expect_err("no filter there")
        .to_string();
    assert!(
        error.contains("not part of this network: albedo_filter."),
        "{error}"
    );
}
