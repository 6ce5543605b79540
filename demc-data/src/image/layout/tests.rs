//! Tests of layouts.

use std::path::Path;

use super::channels::*;
use super::detect::*;
use super::passes::Triple;
use crate::image::exr::ExrFile;

const MINIMAL: &str = r#"
    color = ["R", "G", "B"]
    normal = ["n.X", "n.Y", "n.Z"]
    position = ["p.X", "p.Y", "p.Z"]
    texture1 = ["a.R", "a.G", "a.B"]
"#;

fn message(text: &str) -> String {
    ChannelLayout::from_toml("test.toml", text)
        .expect_err("a mistake")
        .to_string()
}

#[test]
fn every_preset_resolves_and_survives_json() {
    for (name, _) in PRESETS {
        let layout = ChannelLayout::resolve(name).expect(name);
        let json = serde_json::to_string(&layout).expect("layouts are plain data");
        assert_eq!(
            serde_json::from_str::<ChannelLayout>(&json).expect(name),
            layout
        );
    }
}

#[test]
fn the_default_preset_is_the_data_sets_layout() {
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    assert_eq!(layout.color, ["R", "G", "B"]);
    assert_eq!(layout.texture2.expect("named")[2], "albedo2.B");
    assert_eq!(layout.reference.expect("named")[0], "ref.R");
    assert_eq!(layout.mask.as_deref(), Some("mask.A"));
    assert_eq!(layout.missing, MissingPolicies::default());
}

#[test]
fn every_preset_can_be_trained_with() {
    for (name, _) in PRESETS {
        let layout = ChannelLayout::resolve(name).expect(name);
        assert_eq!(
            layout.reference.expect(name),
            ["ref.R", "ref.G", "ref.B"],
            "{name}"
        );
        assert_eq!(layout.mask.is_some(), name == "demc-exr", "{name}");
    }
}

#[test]
fn an_unknown_name_lists_the_presets() {
    let error = ChannelLayout::resolve("maya")
        .expect_err("no such preset")
        .to_string();
    assert!(
        error.contains("maya")
            && error.contains("demc-exr, mitsuba3, pbrt-v4, cycles, luxcore, fbksd"),
        "{error}"
    );
}

#[test]
fn a_buffer_without_names_needs_a_policy() {
    assert!(message(MINIMAL).contains("texture2 names no channels"));
    let stated = format!("{MINIMAL}\n[missing]\ntexture2 = \"copy-texture1\"");
    let layout = ChannelLayout::from_toml("test.toml", &stated).expect("complete");
    assert_eq!(layout.missing.texture2, Missing::CopyTexture1);
}

#[test]
fn all_problems_are_named_at_once() {
    let text = MINIMAL.replace("n.Z", "p.X") + "[missing]\nposition = \"copy-texture1\"";
    let error = message(&text);
    for part in [
        "\"p.X\" is named twice",
        "missing.position",
        "texture2 names no channels",
    ] {
        assert!(error.contains(part), "{part} is not in: {error}");
    }
}

#[test]
fn lists_that_are_too_long_are_refused() {
    let text = PRESETS[0].1;
    for (from, to, message) in [
        (
            "[\"R\", \"G\", \"B\"]",
            "[\"R\", \"G\", \"B\", \"Z\"]",
            "color has 4 values instead of 3",
        ),
        (
            "[\"half1.\", \"half2.\"]",
            "[\"half1.\", \"half2.\", \"half3.\"]",
            "passes.half_buffers has 3 values instead of 2",
        ),
    ] {
        let changed = text.replacen(from, to, 1);
        assert_ne!(changed, text);
        let error = ChannelLayout::from_toml("own.toml", &changed).unwrap_err();
        assert!(error.to_string().contains(message), "{error}");
    }
}

#[test]
fn unknown_keys_are_refused_with_their_line() {
    let error = message(&format!("{MINIMAL}albedo3 = [\"a\", \"b\", \"c\"]"));
    assert!(
        error.contains("line 5") && error.contains("albedo3"),
        "{error}"
    );
    assert!(!error.contains('\n'), "{error}");
}

/// An EXR file with these channels, 2x2 pixels, in one part per entry.
fn file(directory: &Path, parts: &[(&str, &[&str])]) -> ExrFile {
    use exr::prelude::*;
    let path = directory.join("file.exr");
    let layers: Vec<_> = parts
        .iter()
        .map(|(part, names)| {
            let channels = names
                .iter()
                .map(|name| AnyChannel::new(*name, FlatSamples::F32(vec![0.5; 4])));
            let mut attributes = LayerAttributes::named(*part);
            if part.is_empty() {
                attributes.layer_name = None;
            }
            Layer::new(
                (2, 2),
                attributes,
                Encoding::FAST_LOSSLESS,
                AnyChannels::sort(channels.collect()),
            )
        })
        .collect();
    let window = IntegerBounds::from_dimensions((2, 2));
    let image = Image::from_layers(ImageAttributes::new(window), layers);
    image.write().to_file(&path).expect("written");
    ExrFile::open(&path).expect("an EXR file")
}

const RGB: [&str; 3] = ["R", "G", "B"];

/// The channels of `layout`'s buffers except `without`, with a view layer in place of `*`.
fn names(preset: &str, without: &[&str], layers: &[&str]) -> Vec<String> {
    let layout = ChannelLayout::resolve(preset).expect("a preset");
    let names: Vec<String> = layout
        .features()
        .into_iter()
        .filter(|feature| !without.contains(&feature.name))
        .filter_map(|feature| feature.channels)
        .chain([&layout.color])
        .flatten()
        .cloned()
        .collect();
    let layers = layers.iter();
    layers
        .flat_map(|layer| names.iter().map(move |name| name.replacen('*', layer, 1)))
        .collect()
}

fn detected(channels: &[String], layer: Option<&str>) -> Result<FileLayout, String> {
    let directory = tempfile::tempdir().expect("a directory");
    let channels: Vec<&str> = channels.iter().map(String::as_str).collect();
    let file = file(directory.path(), &[("", &channels)]);
    let missing = MissingPolicies {
        position: Missing::Zeros,
        texture2: Missing::CopyTexture1,
        ..MissingPolicies::default()
    };
    let found = detect(&file, missing, layer);
    found.map_err(|error| {
        let error = error.to_string();
        assert!(!error.contains('\n'), "{error}");
        error
    })
}

#[test]
fn each_preset_is_found_by_its_channels() {
    for (preset, _) in PRESETS {
        let found = detected(&names(preset, &[], &["View Layer.1"]), None).expect(preset);
        assert_eq!(found.preset, preset);
        let layer = (preset == "cycles").then_some("View Layer.1");
        assert_eq!(found.layer.as_deref(), layer, "{preset}");
    }
}

/// The channels of Mitsuba's colour and albedo, and these buffers of three channels.
fn mitsuba(buffers: &[&str]) -> Vec<String> {
    let buffers = buffers
        .iter()
        .flat_map(|buffer| ["X", "Y", "Z"].map(|axis| format!("{buffer}.{axis}")));
    let albedo = RGB.map(|channel| format!("albedo.{channel}"));
    buffers.chain(albedo).chain(RGB.map(String::from)).collect()
}

#[test]
fn the_names_in_mitsubas_manual_are_found() {
    for (normal, position) in [
        ("nn", "pos"),
        ("normals", "pos"),
        ("normal", "pos"),
        ("nn", "position"),
    ] {
        let found = detected(&mitsuba(&[normal, position]), None).expect(normal);
        assert_eq!(found.preset, "mitsuba3");
        let first = |names: Option<Triple>| names.expect("found")[0].clone();
        assert_eq!(first(found.layout.normal), format!("{normal}.X"));
        assert_eq!(first(found.layout.position), format!("{position}.X"));
    }
}

#[test]
fn alternatives_are_whole_names_and_come_after_the_layouts_own() {
    let found = detected(
        &mitsuba(&["nn", "normal", "normals", "position", "pos"]),
        None,
    );
    let layout = found.expect("its own names").layout;
    assert_eq!(layout.normal.expect("found")[0], "normal.X");
    assert_eq!(layout.position.expect("found")[0], "position.X");
    assert!(layout.alternatives.is_empty());
    let error = detected(&mitsuba(&["nnn", "pos"]), None).expect_err("another name");
    assert!(error.contains("mitsuba3, lacks normal.X"), "{error}");
    let mut part = mitsuba(&["nn", "pos"]);
    part.retain(|name| name != "nn.Y");
    let error = detected(&part, None).expect_err("one of three");
    assert!(error.ends_with("mitsuba3, lacks nn.Y"), "{error}");
}

#[test]
fn alternatives_need_names_and_name_no_channel_twice() {
    let error = message(&format!(
        "{MINIMAL}\n[alternatives]\nnormal = [[\"p.X\", \"b\", \"c\"]]\ntexture2 = [[\"d\", \"e\", \"f\"]]"
    ));
    for part in [
        "\"p.X\" is named twice",
        "alternatives.texture2 needs texture2",
    ] {
        assert!(error.contains(part), "{part} is not in: {error}");
    }
}

#[test]
fn position_and_second_texture_may_be_absent_but_not_in_part() {
    let without = ["position", "texture2"];
    let mut channels = names("demc-exr", &without, &[""]);
    let found = detected(&channels, None).expect("color, normal, texture1");
    assert_eq!(
        (found.preset, found.absent()),
        ("demc-exr", without.to_vec())
    );
    channels.push("position.X".into());
    let error = detected(&channels, None).expect_err("one of three");
    assert!(
        error.ends_with("the nearest, demc-exr, lacks position.Y, position.Z"),
        "{error}"
    );
}

#[test]
fn a_refusal_names_the_nearest_preset_and_what_it_lacks() {
    let channels = names("cycles", &["texture1"], &["ViewLayer"]);
    let error = detected(&channels, None).expect_err("no albedo");
    assert!(
        error.ends_with(
            "no preset fits; the nearest, cycles, lacks ViewLayer.Denoising Albedo.R, \
             ViewLayer.Denoising Albedo.G, ViewLayer.Denoising Albedo.B"
        ),
        "{error}"
    );
    let channels = ["ch00", "ch01"].map(String::from);
    let error = detected(&channels, None).expect_err("no name is known");
    assert!(
        error.ends_with("no preset has any of its channels: ch00, ch01"),
        "{error}"
    );
}

#[test]
fn two_presets_that_fit_equally_well_are_refused() {
    let mut channels = names("demc-exr", &[], &[""]);
    channels.extend(names("fbksd", &[], &[""]));
    let error = detected(&channels, None).expect_err("two fit");
    assert!(
        error.ends_with("several presets fit equally well: demc-exr, fbksd; choose one"),
        "{error}"
    );
}

#[test]
fn one_of_several_view_layers_is_chosen_by_name() {
    let channels = names("cycles", &[], &["Near", "Far"]);
    let error = detected(&channels, None).expect_err("two layers");
    assert!(error.contains("cycles with view layer \"Near\""), "{error}");
    let found = detected(&channels, Some("Near")).expect("one of them");
    assert_eq!(found.layout.color[0], "Near.Combined.R");
    let error = detected(&channels, Some("Sky")).expect_err("neither");
    assert!(
        error.contains("no view layer \"Sky\"; there is") && error.contains("Near"),
        "{error}"
    );
}

#[test]
fn one_part_per_pass_is_read_like_one_part() {
    let directory = tempfile::tempdir().expect("a directory");
    let xyz = ["X", "Y", "Z"];
    let parts: [(&str, &[&str]); 4] = [
        ("ViewLayer.Combined", &RGB),
        ("ViewLayer.Normal", &xyz),
        ("ViewLayer.Position", &xyz),
        ("ViewLayer.Denoising Albedo", &RGB),
    ];
    let file = file(directory.path(), &parts);
    let found = detect(&file, MissingPolicies::default(), None).expect("cycles");
    assert_eq!(found.layer.as_deref(), Some("ViewLayer"));
    assert_eq!(found.layout.missing.texture2, Missing::CopyTexture1);
}

#[test]
fn half_buffers_and_variances_are_named_by_their_start() {
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let channels = |content: &str| {
        let buffers = layout.buffers();
        let found = buffers.iter().find(|buffer| buffer.content == content);
        found
            .unwrap_or_else(|| panic!("{content}: {buffers:?}"))
            .channels
            .clone()
    };
    assert_eq!(
        channels("half buffer 2 of color"),
        ["half2.R", "half2.G", "half2.B"]
    );
    assert_eq!(channels("half buffer 1 of depth"), ["half1.depth.Z"]);
    assert_eq!(channels("variance of texture1")[1], "variance.albedo1.G");
    assert_eq!(channels("variance of specular")[2], "variance.specular.B");
    assert_eq!(channels("reference_diffuse")[0], "ref.diffuse.R");
    // color, 4 features, reference, 4 parts, mask, depth, 2 * 4 half buffers, and 6 variances.
    assert_eq!(layout.buffers().len(), 26);
}

#[test]
fn a_pass_may_have_no_name_of_another_buffer() {
    let passes = "[passes]\ndepth = \"R\"\nhalf_buffers = [\"a.\", \"a.\"]\n";
    let text = message(&format!(
        "{MINIMAL}\nmissing.texture2 = \"zeros\"\n{passes}"
    ));
    for words in [
        "channel \"R\" is named twice",
        "channel \"a.n.X\" is named twice",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let text = message(&format!(
        "{MINIMAL}\nmissing.texture2 = \"zeros\"\n[passes]\ndeep = 1\n"
    ));
    assert!(text.contains("unknown field `deep`"), "{text}");
}
