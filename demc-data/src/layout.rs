//! The mapping from a renderer's channels to the network's planes. Swapped buffers are a common
//! silent failure, so a layout is always explicit: a preset or a TOML file lists the names. A
//! buffer that a renderer lacks has a stated policy. The layout is stored with the weights.
//!
//! ```toml
//! color    = ["R", "G", "B"]
//! normal   = ["normal.X", "normal.Y", "normal.Z"]
//! position = ["position.X", "position.Y", "position.Z"]
//! texture1 = ["albedo.R", "albedo.G", "albedo.B"]
//!
//! [missing]                   # "error" (default) or "zeros"; for texture2 also "copy-texture1"
//! texture2 = "copy-texture1"
//! ```

use std::collections::HashSet;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::Error;

/// The built-in layouts: name and TOML text (`configs/renderers/`).
pub const PRESETS: [(&str, &str); 5] = [
    (
        "demc-exr",
        include_str!("../../configs/renderers/demc-exr.toml"),
    ),
    (
        "mitsuba3",
        include_str!("../../configs/renderers/mitsuba3.toml"),
    ),
    (
        "pbrt-v4",
        include_str!("../../configs/renderers/pbrt-v4.toml"),
    ),
    (
        "cycles",
        include_str!("../../configs/renderers/cycles.toml"),
    ),
    ("fbksd", include_str!("../../configs/renderers/fbksd.toml")),
];

/// The names of a buffer's three channels, in the order xyz or RGB.
pub type Triple = [String; 3];

/// The channel names of a renderer's files.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelLayout {
    /// Noisy colour: linear HDR radiance.
    pub color: Triple,
    /// Shading normal at the first vertex, world space, not encoded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub normal: Option<Triple>,
    /// Position of the first vertex, world space.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position: Option<Triple>,
    /// Texture (albedo) at the first vertex.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub texture1: Option<Triple>,
    /// Texture at the second vertex.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub texture2: Option<Triple>,
    /// Reference colour, for training and evaluation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference: Option<Triple>,
    /// Share of a pixel's camera rays that hit a surface, from 0 to 1. Statistics exclude pixels
    /// without a hit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask: Option<String>,
    /// Policies for missing feature buffers.
    #[serde(default)]
    pub missing: MissingPolicies,
}

/// The replacement for each missing feature buffer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MissingPolicies {
    /// For the normal.
    pub normal: Missing,
    /// For the position.
    pub position: Missing,
    /// For the first texture.
    pub texture1: Missing,
    /// For the second texture.
    pub texture2: Missing,
}

/// The replacement for a missing buffer.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Missing {
    /// No replacement: the file is refused.
    #[default]
    Error,
    /// Zeros.
    Zeros,
    /// The first texture (for `texture2` only).
    CopyTexture1,
}

impl ChannelLayout {
    /// The layout with this name: a preset, or the TOML file at this path.
    ///
    /// # Errors
    /// [`Error::Layout`], naming the presets if `name` is neither, or the line and key of a
    /// mistake.
    pub fn resolve(name: &str) -> Result<Self, Error> {
        let text = match PRESETS.iter().find(|(preset, _)| *preset == name) {
            Some((_, text)) => (*text).to_owned(),
            None if Path::new(name).is_file() => {
                std::fs::read_to_string(name).map_err(|source| Error::Read {
                    path: name.into(),
                    source,
                })?
            }
            None => {
                let presets: Vec<&str> = PRESETS.iter().map(|(preset, _)| *preset).collect();
                return Err(mistake(
                    name,
                    format!("neither a preset ({}) nor a file", presets.join(", ")),
                ));
            }
        };
        Self::from_toml(name, &text)
    }

    /// Parses and checks a layout; errors refer to it as `name`.
    ///
    /// # Errors
    /// [`Error::Layout`].
    pub fn from_toml(name: &str, text: &str) -> Result<Self, Error> {
        let layout: Self =
            toml::from_str(text).map_err(|error| mistake(name, one_line(&error, text)))?;
        match layout.validate() {
            problems if problems.is_empty() => Ok(layout),
            problems => Err(mistake(name, problems.join("; "))),
        }
    }

    /// The four feature buffers in the network's order, each with its policy: normal, position,
    /// texture1, texture2.
    pub fn features(&self) -> [(&'static str, Option<&Triple>, Missing); 4] {
        [
            ("normal", self.normal.as_ref(), self.missing.normal),
            ("position", self.position.as_ref(), self.missing.position),
            ("texture1", self.texture1.as_ref(), self.missing.texture1),
            ("texture2", self.texture2.as_ref(), self.missing.texture2),
        ]
    }

    /// All problems of this layout, one phrase each.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        for (buffer, names, missing) in self.features() {
            if names.is_none() && missing == Missing::Error {
                problems.push(format!(
                    "{buffer} names no channels: name them or set missing.{buffer}"
                ));
            }
            if missing == Missing::CopyTexture1 && buffer != "texture2" {
                problems.push(format!(
                    "missing.{buffer} cannot be \"copy-texture1\": only texture2 can"
                ));
            }
        }
        let mut seen = HashSet::new();
        let features = self
            .features()
            .into_iter()
            .filter_map(|(_, names, _)| names);
        let all = features
            .chain([&self.color])
            .chain(&self.reference)
            .flatten()
            .chain(&self.mask);
        for name in all {
            if !seen.insert(name) {
                problems.push(format!("channel {name:?} is named twice"));
            }
            if name.contains(char::is_control) {
                problems.push(format!("channel {name:?} contains a control character"));
            }
        }
        problems
    }
}

fn mistake(name: &str, detail: String) -> Error {
    Error::Layout {
        name: name.to_owned(),
        detail,
    }
}

fn one_line(error: &toml::de::Error, text: &str) -> String {
    let message = error.message().trim_end().replace('\n', ", ");
    // A key may contain terminal control codes.
    let message = message.replace(char::is_control, "\u{fffd}");
    match error.span() {
        Some(span) => {
            let line = text[..span.start.min(text.len())].lines().count().max(1);
            format!("line {line}: {message}")
        }
        None => message,
    }
}

#[cfg(test)]
mod tests {
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
}
