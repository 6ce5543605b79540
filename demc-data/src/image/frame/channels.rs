//! Which channels of a file hold the buffers of a frame.

use std::io::{Read, Seek};
use std::path::Path;

use super::buffers::{FEATURES, POSITIONS, Presence, TEXTURES};
use super::light::{PASSES, REFERENCE_PASSES, pass_channels};
use crate::error::Error;
use crate::image::channel::Window;
use crate::image::exr::ExrFile;
use crate::image::layout::{ChannelLayout, InputKind, Missing, Triple};

/// The channels of a frame; `None` stands for zeros.
pub(super) struct FrameChannels<'a> {
    pub(super) color: Vec<Option<&'a str>>,
    pub(super) features: Vec<Option<&'a str>>,
    pub(super) reference: Option<Vec<Option<&'a str>>>,
    pub(super) mask: Vec<Option<&'a str>>,
    pub(super) alpha: Vec<Option<&'a str>>,
    /// For KPCN.
    pub(super) passes: Vec<String>,
    pub(super) reference_passes: Vec<String>,
}

impl<'a> FrameChannels<'a> {
    pub(super) fn new<R: Read + Seek>(
        file: &ExrFile<R>,
        layout: &'a ChannelLayout,
        reference: Presence,
        mask: Presence,
    ) -> Result<Self, Error> {
        let is_present = |names: &[String]| names.iter().any(|name| file.channel(name).is_some());
        let read = |presence: Presence, names: &[String]| match presence {
            Presence::Skip => false,
            Presence::IfPresent => is_present(names),
            Presence::Required => true,
        };
        let mut features: Vec<Option<&str>> = Vec::with_capacity(FEATURES);
        for buffer in layout.features() {
            match (buffer.channels, buffer.missing) {
                // If one of the three channels is present, the buffer counts as present, and the
                // other channels are missing.
                (Some(names), policy) if policy == Missing::Error || is_present(names) => {
                    features.extend(slots(names))
                }
                (None, Missing::Error) => {
                    let detail = format!("{} names no channels and has no policy", buffer.name);
                    return Err(Error::Layout {
                        name: "in use".to_owned(),
                        detail,
                    });
                }
                (_, Missing::CopyTexture1) => features.extend_from_within(6..9),
                _ => features.extend([None; 3]),
            }
        }
        let reference = layout
            .reference
            .as_ref()
            .filter(|names| read(reference, &names[..]));
        let single = |name: &'a Option<String>, presence| {
            name.iter()
                .filter(move |name| read(presence, std::slice::from_ref(name)))
                .map(|name| Some(name.as_str()))
                .collect()
        };
        // Files of renderers differ in whether they have an alpha channel.
        let alpha = match mask {
            Presence::Skip => Presence::Skip,
            _ => Presence::IfPresent,
        };
        let passes = |passes: &[(&str, usize)]| -> Result<Vec<String>, Error> {
            let contents = passes.iter().map(|pass| pass.0);
            match layout.inputs {
                InputKind::Demc => Ok(Vec::new()),
                InputKind::Kpcn => Ok(pass_channels(file, layout, contents)?.concat()),
            }
        };
        let wanted = Self {
            passes: passes(&PASSES)?,
            reference_passes: match &reference {
                Some(_) => passes(&REFERENCE_PASSES)?,
                None => Vec::new(),
            },
            color: slots(&layout.color),
            features,
            reference: reference.map(slots),
            mask: single(&layout.mask, mask),
            alpha: single(&layout.alpha, alpha),
        };
        file.require(&wanted.names())?;
        Ok(wanted)
    }

    /// The channels to decode, in the order of the fields; a copied texture appears twice.
    pub(super) fn names(&self) -> Vec<&str> {
        let radiance_and_features = self.color.iter().chain(&self.features);
        radiance_and_features
            .chain(self.reference.iter().flatten())
            .chain(&self.mask)
            .chain(&self.alpha)
            .copied()
            .flatten()
            .chain(self.passes.iter().map(String::as_str))
            .chain(self.reference_passes.iter().map(String::as_str))
            .collect()
    }

    /// Index of the first position channel in [`names`](Self::names).
    pub(super) fn first_position(&self) -> Option<usize> {
        let position = self.features.get(POSITIONS..TEXTURES)?;
        let before = self.color.iter().chain(&self.features[..POSITIONS]);
        position[0].map(|_| before.flatten().count())
    }

    pub(super) fn window<R: Read + Seek>(
        &self,
        path: &Path,
        file: &ExrFile<R>,
    ) -> Result<Window, Error> {
        let names = self.names();
        let mut channels = names.iter().filter_map(|name| file.channel(name));
        let first = channels.next().expect("colour is always in the plan");
        match channels.find(|channel| channel.window != first.window) {
            None => Ok(first.window),
            Some(other) => Err(Error::Sizes {
                path: path.to_owned(),
                a: first.name.clone(),
                a_window: first.window.to_string(),
                b: other.name.clone(),
                b_window: other.window.to_string(),
            }),
        }
    }
}

fn slots(names: &Triple) -> Vec<Option<&str>> {
    names.iter().map(|name| Some(name.as_str())).collect()
}
