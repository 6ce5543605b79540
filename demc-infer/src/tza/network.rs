//! The names of a U-Net's tensors in OIDN, and which network a set of tensors is.

use std::collections::BTreeMap;

use demc_model::unet::{Guides, UNET_LEVELS, UnetSize};
use demc_model::{ModelConfig, Variant, Weight};

use super::WeightSet;

/// The network that has exactly these tensors, under OIDN's names.
pub(super) fn identify(tensors: Vec<Weight>, name: Option<String>) -> Option<WeightSet> {
    let mut found: BTreeMap<String, Weight> = BTreeMap::new();
    for tensor in tensors {
        found.insert(tensor.name.clone(), tensor);
    }
    let networks = UnetSize::ALL
        .into_iter()
        .flat_map(|size| Guides::ALL.map(|guides| (size, guides)));
    let (size, guides) = networks.into_iter().find(|(size, guides)| {
        let specs = specs(*size, *guides);
        let fits = |(theirs, _, shape): &(String, String, Vec<usize>)| {
            found
                .get(theirs)
                .is_some_and(|tensor| tensor.shape == *shape)
        };
        specs.len() == found.len() && specs.iter().all(fits)
    })?;
    let weights = specs(size, guides)
        .into_iter()
        .map(|(theirs, ours, _)| Weight {
            name: ours,
            ..found.remove(&theirs).expect("it fits")
        });
    Some(WeightSet {
        name,
        size,
        guides,
        weights: weights.collect(),
    })
}

/// A network's weights under OIDN's names.
pub(super) fn renamed(weights: Vec<Weight>, size: UnetSize) -> Vec<Weight> {
    let renamed = weights.into_iter().map(|weight| Weight {
        name: their_name(&weight.name, size),
        ..weight
    });
    renamed.collect()
}

/// Their name, our name, and the shape of each tensor.
fn specs(size: UnetSize, guides: Guides) -> Vec<(String, String, Vec<usize>)> {
    let model = ModelConfig {
        variant: Variant::Unet,
        size,
        guides,
        ..ModelConfig::default()
    };
    let specs = model.weight_specs().into_iter();
    let named = specs.map(|spec| (their_name(&spec.name, size), spec.name, spec.shape));
    named.collect()
}

/// OIDN's name of a tensor: `dec_conv3b.weight` for `decoder.1.convs.1.weight`.
fn their_name(ours: &str, size: UnetSize) -> String {
    let parts: Vec<&str> = ours.split('.').collect();
    let index = |part: &str| part.parse::<usize>().expect("an index");
    let letter = |part: &str| ["a", "b"][index(part)];
    let large = matches!(size, UnetSize::Medium | UnetSize::Large);
    let layer = match parts[..] {
        ["encoder", level, "convs", conv, _] if large => {
            format!("enc_conv{}{}", index(level) + 1, letter(conv))
        }
        // The first level has two convolutions, 0 and 1; each of the others has one.
        ["encoder", "0", "convs", conv, _] => format!("enc_conv{conv}"),
        ["encoder", level, "convs", ..] => format!("enc_conv{}", index(level) + 1),
        ["bottom", "convs", conv, _] => format!("enc_conv{}{}", UNET_LEVELS + 1, letter(conv)),
        ["decoder", level, "convs", conv, _] => {
            format!("dec_conv{}{}", UNET_LEVELS - index(level), letter(conv))
        }
        ["head", _] if large => "dec_conv1c".into(),
        ["head", _] => "dec_conv0".into(),
        _ => unreachable!("{ours}: a U-Net has no such tensor"),
    };
    format!("{layer}.{}", parts[parts.len() - 1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_network_is_identified_by_its_tensors() {
        for size in UnetSize::ALL {
            for guides in Guides::ALL {
                let tensors = specs(size, guides)
                    .into_iter()
                    .map(|(name, _, shape)| Weight {
                        data: vec![0.0; shape.iter().product()],
                        name,
                        shape,
                    });
                let mut tensors: Vec<Weight> = tensors.collect();
                let set = identify(tensors.clone(), None).expect("a network");
                assert_eq!((set.size, set.guides), (size, guides));
                assert_eq!(renamed(set.weights, size), tensors);
                tensors.pop();
                assert!(identify(tensors, None).is_none());
            }
        }
    }

    #[test]
    fn names_are_oidns() {
        let names = |size| -> Vec<String> {
            let specs = specs(size, Guides::AlbedoNormal).into_iter();
            specs
                .map(|(theirs, ..)| theirs)
                .filter(|name| name.ends_with("weight"))
                .collect()
        };
        let base = "enc_conv0 enc_conv1 enc_conv2 enc_conv3 enc_conv4 enc_conv5a enc_conv5b dec_conv4a \
                    dec_conv4b dec_conv3a dec_conv3b dec_conv2a dec_conv2b dec_conv1a dec_conv1b dec_conv0";
        let large = "enc_conv1a enc_conv1b enc_conv2a enc_conv2b enc_conv3a enc_conv3b enc_conv4a enc_conv4b \
                     enc_conv5a enc_conv5b dec_conv4a dec_conv4b dec_conv3a dec_conv3b dec_conv2a dec_conv2b \
                     dec_conv1a dec_conv1b dec_conv1c";
        for (size, expected) in [
            (UnetSize::Small, base),
            (UnetSize::Base, base),
            (UnetSize::Medium, large),
            (UnetSize::Large, large),
        ] {
            let expected = expected
                .split_whitespace()
                .map(|layer| format!("{layer}.weight"));
            assert_eq!(names(size), expected.collect::<Vec<_>>());
        }
    }
}
