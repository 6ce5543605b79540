//! Tests of the graph without a runtime; `tests/tests/suite/onnx_live.rs` runs it in one.

use std::collections::HashSet;

use demc_model::{Head, Variant};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::proto::{FLOAT16, GraphProto, NodeProto};
use super::*;
use crate::bundle::testing::{bundle, filtered};

fn graph(variant: Variant, precision: Precision) -> GraphProto {
    graph_of(&bundle(variant), precision)
}

fn graph_of(bundle: &Bundle, precision: Precision) -> GraphProto {
    let model = bundle.onnx(precision).expect("a graph");
    model.graph.expect("there is one")
}

/// The bundle with kernel heads, in its albedo filter too.
fn with_kernels(bundle: &Bundle) -> Bundle {
    let mut bundle = bundle.clone();
    bundle.meta.model.head = Head::Kernel;
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let device = burn::tensor::Device::flex();
    bundle.model = bundle.meta.model.init(&mut rng, [0.5; 3], &device);
    bundle.albedo_filter = bundle
        .albedo_filter
        .map(|filter| Box::new(with_kernels(&filter)));
    bundle
}

fn count(graph: &GraphProto, op: &str) -> usize {
    graph.node.iter().filter(|node| node.op_type == op).count()
}

#[test]
fn every_value_is_defined_once_and_before_its_use() {
    for variant in Variant::ALL {
        for precision in [Precision::F32, Precision::F16] {
            let mut graphs = vec![graph(variant, precision)];
            if !variant.spec().encoders.is_empty() {
                let filtered = filtered(variant, Variant::Demc);
                graphs.push(graph_of(&filtered, precision));
                graphs.push(graph_of(&with_kernels(&filtered), precision));
            }
            for graph in graphs {
                let mut known: HashSet<&str> =
                    graph.input.iter().map(|v| v.name.as_str()).collect();
                for constant in &graph.initializer {
                    assert!(known.insert(&constant.name), "{} twice", constant.name);
                }
                for NodeProto { input, output, .. } in &graph.node {
                    for name in input {
                        // Resize has an empty input.
                        let is_known = name.is_empty() || known.contains(name.as_str());
                        assert!(is_known, "{name} is not defined yet");
                    }
                    assert!(known.insert(&output[0]), "{} twice", output[0]);
                }
                assert!(known.contains(OUTPUT));
                let taken: HashSet<&String> = graph.node.iter().flat_map(|n| &n.input).collect();
                for constant in &graph.initializer {
                    assert!(taken.contains(&constant.name), "{} unused", constant.name);
                }
            }
        }
    }
}

/// DEMC in the released reading: 4 blocks, 2 + 2 + 3 + 3 + 3 convolutions per encoder, the latent,
/// 5 skip fusions, the head.
#[test]
fn the_graph_has_the_networks_layers_and_no_normalisation() {
    let graph = graph(Variant::Demc, Precision::F32);
    assert_eq!(count(&graph, "Conv"), 4 + 13 + 13 + 1 + 5 + 1);
    assert_eq!(count(&graph, "ConvTranspose"), 5);
    // The feature encoder's last level has nothing below it.
    assert_eq!(count(&graph, "MaxPool"), 4 + 5);
    assert_eq!(count(&graph, "Concat"), 5);
    assert_eq!(count(&graph, "BatchNormalization"), 0);
    assert_eq!(count(&graph, "Cast"), 0);
}

/// The filter's values have a prefix; the main network's keep their names and their number.
#[test]
fn a_filter_is_the_first_part_of_the_graph() {
    let plain = graph(Variant::Demc, Precision::F32);
    let whole = graph_of(&filtered(Variant::Demc, Variant::Semc), Precision::F32);
    let filter = graph(Variant::Semc, Precision::F32);
    let names = |graph: &GraphProto| -> Vec<String> {
        let nodes = graph.node.iter().map(|node| node.name.clone());
        nodes
            .filter(|name| !name.starts_with("albedo_filter."))
            .collect()
    };
    assert_eq!(names(&whole), names(&plain));
    let layers = count(&plain, "Conv") + count(&filter, "Conv");
    assert_eq!(count(&whole, "Conv"), layers);
    let own = whole
        .node
        .iter()
        .filter(|n| n.name.starts_with("albedo_filter."));
    let first = own.clone().count();
    assert!(whole.node[..first].iter().eq(own));
}

#[test]
fn f16_halves_the_kernels_and_nothing_else() {
    let [full, half] =
        [Precision::F32, Precision::F16].map(|precision| graph(Variant::Demc, precision));
    let bytes = |graph: &GraphProto, dims: usize| -> usize {
        let kernels = graph.initializer.iter();
        kernels
            .filter(|t| (t.dims.len() == dims) && !t.name.ends_with(".scale"))
            .filter(|t| !t.name.starts_with("features_"))
            .map(|t| t.raw_data.len())
            .sum()
    };
    assert_eq!(2 * bytes(&half, 4), bytes(&full, 4));
    assert_eq!(bytes(&half, 1), bytes(&full, 1));
    let halves = half.initializer.iter().filter(|t| t.data_type == FLOAT16);
    assert_eq!(halves.count(), count(&half, "Cast"));
}

#[test]
fn equal_bundles_give_equal_bytes() {
    let bytes = || {
        let model = bundle(Variant::Semc).onnx(Precision::F16).expect("a graph");
        model.encode_to_vec()
    };
    assert_eq!(bytes(), bytes());
}

#[test]
fn a_weight_beyond_f16_is_named_and_nothing_is_written() {
    let mut bundle = bundle(Variant::Demc);
    let mut weights = bundle.model.weights();
    weights[0].data[0] = 1e6;
    let name = weights[0].name.clone();
    let mut weights = demc_model::Weights::new(weights);
    let device = burn::tensor::Device::flex();
    bundle.model = bundle.meta.model.load(&mut weights, &device).expect("fits");
    let folder = tempfile::tempdir().expect("directory");
    let path = folder.path().join("x.onnx");
    let error = bundle.export_onnx(&path, Precision::F16).expect_err("f16");
    assert!(error.to_string().contains(&name), "{error}");
    assert!(!path.exists());
    bundle.export_onnx(&path, Precision::F32).expect("f32");
    assert!(path.exists());
}

#[test]
fn a_network_beyond_two_gibibytes_is_refused_before_it_is_built() {
    let mut config = bundle(Variant::Demc).meta.model;
    config.width = 64;
    assert!(check_size(config.parameter_count(), Precision::F32).is_ok());
    config.width = 256;
    let error = check_size(config.parameter_count(), Precision::F32).expect_err("2.7 GB");
    assert!(error.to_string().contains("export with f16"), "{error}");
    assert!(check_size(config.parameter_count(), Precision::F16).is_ok());
}
