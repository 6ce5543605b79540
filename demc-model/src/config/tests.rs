use super::*;
use crate::unet::{Guides, UnetSize};

#[test]
fn names_in_configurations_are_those_of_the_tables() {
    for variant in Variant::ALL {
        let name = serde_json::to_value(variant).unwrap();
        assert_eq!(name, variant.spec().name);
    }
    for reading in Reading::ALL {
        let name = serde_json::to_value(reading).unwrap();
        assert_eq!(name, reading.spec().name);
    }
}

#[test]
fn only_variants_with_a_detail_map_have_a_fusion() {
    let has_fusion = Variant::ALL.map(|variant| variant.spec().has_fusion());
    assert_eq!(
        has_fusion,
        [true, false, true, false, false, false, true, false]
    );
    let takes_features = Variant::ALL.map(|variant| variant.spec().takes_features());
    assert_eq!(
        takes_features,
        [true, true, true, false, true, true, true, true]
    );
}

#[test]
fn width_zero_is_a_problem() {
    let config = ModelConfig {
        width: 0,
        ..ModelConfig::default()
    };
    assert_eq!(config.validate().len(), 1);
}

#[test]
fn the_description_lists_levels_other_than_the_papers() {
    let paper = ModelConfig::default();
    assert_eq!(paper.to_string(), "demc, paper reading, width 64");
    let narrow = ModelConfig {
        width: 3,
        levels: [1, 2, 2, 4, 1],
        ..paper
    };
    let expected = "demc, paper reading, width 3, levels of [3, 6, 6, 12, 3]";
    assert_eq!(narrow.to_string(), expected);
}

#[test]
fn keys_of_encoders_are_a_problem_of_kpcn() {
    let kpcn = ModelConfig {
        variant: Variant::Kpcn,
        ..ModelConfig::default()
    };
    assert_eq!(kpcn.validate(), Vec::<String>::new());
    assert_eq!(kpcn.to_string(), "kpcn, width 64");
    let head = Head::Kernel;
    let problems = ModelConfig { head, ..kpcn }.validate();
    assert!(problems.len() == 1 && problems[0].contains("kpcn"));
}

#[test]
fn keys_of_other_variants_are_a_problem_of_a_unet_and_its_own_of_others() {
    let unet = ModelConfig {
        variant: Variant::Unet,
        size: UnetSize::Large,
        guides: Guides::Albedo,
        ..ModelConfig::default()
    };
    assert_eq!(unet.validate(), Vec::<String>::new());
    assert_eq!(unet.to_string(), "unet, large, guides albedo");
    let problems = ModelConfig { width: 32, ..unet }.validate();
    assert!(problems.len() == 1 && problems[0].contains("width"));
    let variant = Variant::Demc;
    let problems = ModelConfig { variant, ..unet }.validate();
    assert!(problems.len() == 1 && problems[0].contains("size and guides"));
}

#[test]
fn a_level_without_channels_is_a_problem() {
    for levels in [[1, 2, 0, 8, 8], [1, 2, 4, 8, 17]] {
        let config = ModelConfig {
            levels,
            ..ModelConfig::default()
        };
        let problems = config.validate();
        assert!(problems.len() == 1 && problems[0].starts_with("model.levels = ["));
    }
}
