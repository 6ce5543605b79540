//! The channels that the methods of the paper's comparison need beside the network's: NFOR (Bitterli
//! et al. 2016) half buffers, variances, and depth; KPCN (Bako et al. 2017) also the diffuse and the
//! specular part of the colour. All are optional.

use std::io::{Read, Seek};

use serde::{Deserialize, Serialize};

use crate::image::exr::ExrFile;

/// The names of a buffer's three channels, in the order xyz or RGB.
pub type Triple = [String; 3];

/// Names of the passes of the paper's comparison (`[passes]` of a layout).
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Passes {
    /// Distance of the first vertex from the camera, 0 without a hit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<String>,
    /// The part of the colour that the diffuse lobe of the first vertex scatters or that is emitted there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub diffuse: Option<Triple>,
    /// The other part of the colour.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub specular: Option<Triple>,
    /// The diffuse part of the reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reference_diffuse: Option<Triple>,
    /// The specular part of the reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reference_specular: Option<Triple>,
    /// Starts of the names of two half buffers of colour, normal, texture1, and depth: each is the
    /// mean of one half of a pixel's samples.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub half_buffers: Option<[String; 2]>,
    /// Start of the names of the variances: of colour, normal, texture1, depth, diffuse, and specular.
    /// Each is the variance of the mean: that of the samples, divided by their number.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub variance: Option<String>,
}

/// A buffer of a layout: what it is, in the words of the layout's keys, and its channels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NamedBuffer {
    /// `color`, `half buffer 1 of normal`, or `variance of depth`.
    pub content: String,
    /// Its channels.
    pub channels: Vec<String>,
}

impl Passes {
    /// Whether no pass is named.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// The parts of colour and reference.
    pub(super) fn parts(&self) -> [(&'static str, Option<&Triple>); 4] {
        [
            ("diffuse", self.diffuse.as_ref()),
            ("specular", self.specular.as_ref()),
            ("reference_diffuse", self.reference_diffuse.as_ref()),
            ("reference_specular", self.reference_specular.as_ref()),
        ]
    }

    /// The half buffers and variances of `buffers`, which are those of the whole layout.
    pub(super) fn derived(&self, buffers: &[NamedBuffer]) -> Vec<NamedBuffer> {
        let halved = ["color", "normal", "texture1", "depth"].as_slice();
        let varied = [
            "color", "normal", "texture1", "depth", "diffuse", "specular",
        ]
        .as_slice();
        let starts = self.half_buffers.iter().flatten();
        let halves = ["half buffer 1", "half buffer 2"].into_iter().zip(starts);
        halves
            .map(|(content, start)| (content, start, halved))
            .chain(
                self.variance
                    .iter()
                    .map(|start| ("variance", start, varied)),
            )
            .flat_map(|(content, start, of)| prefixed(buffers, content, start, of))
            .collect()
    }

    /// The names of channels, without half buffers and variances, to change them.
    pub(super) fn names_mut(&mut self) -> impl Iterator<Item = &mut String> {
        let parts = [
            &mut self.diffuse,
            &mut self.specular,
            &mut self.reference_diffuse,
            &mut self.reference_specular,
        ];
        parts.into_iter().flatten().flatten().chain(&mut self.depth)
    }

    /// Forgets the passes of which a file has no channel.
    pub(crate) fn forget_absent<R: Read + Seek>(&mut self, file: &ExrFile<R>) {
        let is_absent = |name: &str| file.channel(name).is_none();
        let starts_none = |start: &String| {
            let mut channels = file.channels().iter();
            !channels.any(|channel| channel.name.starts_with(start.as_str()))
        };
        // Two parts make a whole, so one alone is incomplete.
        for parts in [
            [&mut self.diffuse, &mut self.specular],
            [&mut self.reference_diffuse, &mut self.reference_specular],
        ] {
            let names = || parts.iter().filter_map(|part| part.as_ref()).flatten();
            if names().all(|name| is_absent(name)) {
                parts.into_iter().for_each(|part| *part = None);
            }
        }
        let starts = self.half_buffers.iter().flatten().chain(&self.variance);
        let is_derived = |name: &String| {
            let mut starts = starts.clone();
            starts.any(|start| !is_absent(&format!("{start}{name}")))
        };
        if let Some(depth) = &self.depth
            && is_absent(depth)
            && !is_derived(depth)
        {
            self.depth = None;
        }
        self.half_buffers
            .take_if(|starts| starts.iter().all(starts_none));
        self.variance.take_if(|start| starts_none(start));
    }
}

/// The buffers whose content is in `of`, with `start` before their names.
fn prefixed(buffers: &[NamedBuffer], content: &str, start: &str, of: &[&str]) -> Vec<NamedBuffer> {
    let wanted = buffers
        .iter()
        .filter(|buffer| of.contains(&buffer.content.as_str()));
    wanted
        .map(|buffer| NamedBuffer {
            content: format!("{content} of {}", buffer.content),
            channels: buffer
                .channels
                .iter()
                .map(|name| format!("{start}{name}"))
                .collect(),
        })
        .collect()
}
