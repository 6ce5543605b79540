//! Tests of layouts.

use super::*;

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
        error.contains("maya") && error.contains("demc-exr, mitsuba3, pbrt-v4, cycles, fbksd"),
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
fn unknown_keys_are_refused_with_their_line() {
    let error = message(&format!("{MINIMAL}albedo3 = [\"a\", \"b\", \"c\"]"));
    assert!(
        error.contains("line 6") && error.contains("albedo3"),
        "{error}"
    );
    assert!(!error.contains('\n'), "{error}");
}
