//! The names of a renderer's channels, and the built-in layouts.

use std::collections::HashSet;
use std::path::Path;

use demc_program::file::{FileError, MAX_CONFIGURATION, read_text};
use demc_program::message::printable;
use serde::{Deserialize, Serialize};

use super::passes::{NamedBuffer, Passes, Triple};
use crate::array_lengths;
use crate::error::Error;

/// The start of a name that stands for any view layer, the same one in all names of a layout.
pub const ANY_LAYER: &str = "*.";

/// The built-in layouts: name and TOML text (`configs/renderers/`).
pub const PRESETS: [(&str, &str); 6] = [
    (
        "demc-exr",
        include_str!("../../../../configs/renderers/demc-exr.toml"),
    ),
    (
        "mitsuba3",
        include_str!("../../../../configs/renderers/mitsuba3.toml"),
    ),
    (
        "pbrt-v4",
        include_str!("../../../../configs/renderers/pbrt-v4.toml"),
    ),
    (
        "cycles",
        include_str!("../../../../configs/renderers/cycles.toml"),
    ),
    (
        "luxcore",
        include_str!("../../../../configs/renderers/luxcore.toml"),
    ),
    (
        "fbksd",
        include_str!("../../../../configs/renderers/fbksd.toml"),
    ),
];

/// What networks take as input.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum InputKind {
    /// Colour and twelve feature channels (Sec. 3.1).
    #[default]
    Demc,
    /// Diffuse and specular light, normal, albedo, depth, and variances: the passes of
    /// [`crate::input::kpcn`].
    Kpcn,
}

impl InputKind {
    /// Whether this is colour and features.
    pub fn is_demc(&self) -> bool {
        *self == Self::Demc
    }
}

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
    /// Alpha of the colour, 0 to 1, which is denoised with it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub alpha: Option<String>,
    /// Names of the passes of the paper's comparison.
    #[serde(default, skip_serializing_if = "Passes::is_empty")]
    pub passes: Passes,
    /// Other names of feature buffers, for files that lack the names above.
    #[serde(default, skip_serializing_if = "Alternatives::is_empty")]
    pub alternatives: Alternatives,
    /// Policies for missing feature buffers.
    #[serde(default)]
    pub missing: MissingPolicies,
    /// What is read for the network. Set by the model, not by the author of a layout.
    #[serde(default, skip_serializing_if = "InputKind::is_demc")]
    pub inputs: InputKind,
}

/// Other names of each feature buffer. If a file has none of a buffer's channels, the first names of
/// which it has a channel take their place.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Alternatives {
    /// For the normal.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub normal: Vec<Triple>,
    /// For the position.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub position: Vec<Triple>,
    /// For the first texture.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub texture1: Vec<Triple>,
    /// For the second texture.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub texture2: Vec<Triple>,
}

impl Alternatives {
    /// Whether no buffer has other names.
    pub fn is_empty(&self) -> bool {
        self.in_order().into_iter().all(|names| names.is_empty())
    }

    /// The names in the order of the network's buffers: normal, position, texture1, texture2.
    pub fn in_order(&self) -> [&[Triple]; 4] {
        [&self.normal, &self.position, &self.texture1, &self.texture2]
    }
}

/// A feature buffer of a layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FeatureBuffer<'a> {
    /// Its name, as in [`crate::image::layout`]: `normal`, `position`, `texture1`, or `texture2`.
    pub name: &'static str,
    /// Its channels, if the layout names any.
    pub channels: Option<&'a Triple>,
    /// What to do if a file lacks it.
    pub missing: Missing,
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

impl MissingPolicies {
    /// The policies in the order of the network's buffers: normal, position, texture1, texture2.
    pub fn in_order(self) -> [Missing; 4] {
        [self.normal, self.position, self.texture1, self.texture2]
    }

    /// These policies, and those of `other` for buffers whose absence is an error here.
    #[must_use]
    pub fn or(self, other: Self) -> Self {
        let or = |own, other| match own {
            Missing::Error => other,
            own => own,
        };
        Self {
            normal: or(self.normal, other.normal),
            position: or(self.position, other.position),
            texture1: or(self.texture1, other.texture1),
            texture2: or(self.texture2, other.texture2),
        }
    }
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
        if let Some(preset) = Self::preset(name) {
            return Ok(preset);
        }
        let path = Path::new(name);
        if !path.is_file() {
            let presets = PRESETS.map(|(preset, _)| preset).join(", ");
            let problem = format!("neither a preset ({presets}) nor a file");
            return Err(mistake(name, problem));
        }
        let text = read_text(path, MAX_CONFIGURATION).map_err(|source| FileError::Read {
            path: name.into(),
            source,
        })?;
        Self::from_toml(name, &text)
    }

    /// The preset of this name.
    pub fn preset(name: &str) -> Option<Self> {
        let (_, text) = PRESETS.iter().find(|(preset, _)| *preset == name)?;
        Some(Self::from_toml(name, text).expect("presets are valid"))
    }

    /// Parses and checks a layout; errors refer to it as `name`.
    ///
    /// # Errors
    /// [`Error::Layout`].
    pub fn from_toml(name: &str, text: &str) -> Result<Self, Error> {
        let layout: Self =
            toml::from_str(text).map_err(|error| mistake(name, one_line(&error, text)))?;
        let written = toml::from_str(text).expect("it was just read");
        array_lengths::check(&written, &layout).map_err(|problem| mistake(name, problem))?;
        match layout.validate() {
            problems if problems.is_empty() => Ok(layout),
            problems => Err(mistake(name, problems.join("; "))),
        }
    }

    /// The four feature buffers in the network's order, each with its policy: normal, position,
    /// texture1, texture2.
    pub fn features(&self) -> [FeatureBuffer<'_>; 4] {
        let buffer = |name, channels, missing| FeatureBuffer {
            name,
            channels,
            missing,
        };
        [
            buffer("normal", self.normal.as_ref(), self.missing.normal),
            buffer("position", self.position.as_ref(), self.missing.position),
            buffer("texture1", self.texture1.as_ref(), self.missing.texture1),
            buffer("texture2", self.texture2.as_ref(), self.missing.texture2),
        ]
    }

    /// All buffers that the layout names, passes included.
    pub fn buffers(&self) -> Vec<NamedBuffer> {
        let buffer = |content: &str, names: &[String]| NamedBuffer {
            content: content.to_owned(),
            channels: names.to_vec(),
        };
        let features = self.features();
        let triples = [("color", Some(&self.color))]
            .into_iter()
            .chain(features.map(|buffer| (buffer.name, buffer.channels)))
            .chain([("reference", self.reference.as_ref())])
            .chain(self.passes.parts());
        let singles = [
            ("mask", &self.mask),
            ("alpha", &self.alpha),
            ("depth", &self.passes.depth),
        ];
        let triples =
            triples.filter_map(|(content, names)| names.map(|names| buffer(content, &names[..])));
        let singles = singles.into_iter().filter_map(|(content, name)| {
            Some(buffer(content, std::slice::from_ref(name.as_ref()?)))
        });
        let mut buffers: Vec<NamedBuffer> = triples.chain(singles).collect();
        buffers.extend(self.passes.derived(&buffers));
        buffers
    }

    /// All problems of this layout, one phrase each.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let features = self.features();
        for FeatureBuffer {
            name,
            channels,
            missing,
        } in features
        {
            if channels.is_none() && missing == Missing::Error {
                problems.push(format!(
                    "{name} names no channels: name them or set missing.{name}"
                ));
            }
            if missing == Missing::CopyTexture1 && name != "texture2" {
                problems.push(format!(
                    "missing.{name} cannot be \"copy-texture1\": only texture2 can"
                ));
            }
        }
        for (FeatureBuffer { name, channels, .. }, others) in
            features.into_iter().zip(self.alternatives.in_order())
        {
            if channels.is_none() && !others.is_empty() {
                problems.push(format!(
                    "alternatives.{name} needs {name}, the names that come first"
                ));
            }
        }
        let mut seen = HashSet::new();
        let buffers = self.buffers();
        let all = buffers
            .iter()
            .flat_map(|buffer| &buffer.channels)
            .chain(self.alternatives.in_order().into_iter().flatten().flatten());
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
    // A key may contain terminal control codes.
    let message = printable(&error.message().trim_end().replace('\n', ", "));
    match error.span() {
        Some(span) => {
            let line = text[..span.start.min(text.len())].lines().count().max(1);
            format!("line {line}: {message}")
        }
        None => message,
    }
}
