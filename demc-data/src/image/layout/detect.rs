//! The layout of one file: the names of its view layer, or the preset that fits it.

use std::borrow::Cow;
use std::io::{Read, Seek};

use demc_program::message::list;

use super::channels::{ANY_LAYER, Alternatives, ChannelLayout, Missing, MissingPolicies, PRESETS};
use super::passes::Triple;
use crate::error::Error;
use crate::image::exr::ExrFile;

/// A preset that fits a file.
#[derive(Debug, Clone, PartialEq)]
pub struct FileLayout {
    /// The preset's name.
    pub preset: &'static str,
    /// The view layer, for a preset whose names start with `*.`.
    pub layer: Option<String>,
    /// The names in the file. A feature buffer that the file lacks has none.
    pub layout: ChannelLayout,
}

impl FileLayout {
    /// The feature buffers that the file lacks.
    pub fn absent(&self) -> Vec<&'static str> {
        self.layout
            .features()
            .iter()
            .filter(|feature| feature.channels.is_none())
            .map(|feature| feature.name)
            .collect()
    }
}

impl ChannelLayout {
    /// This layout with the names of one file: a view layer's name in place of `*`, and alternatives
    /// in place of names that the file lacks.
    ///
    /// `layer` chooses among several view layers.
    ///
    /// # Errors
    /// [`Error::Layout`] for a view layer that does not exist, and for several without a choice.
    /// [`Error::MissingChannels`] if no view layer has the colour.
    pub fn in_file<R: Read + Seek>(
        &self,
        file: &ExrFile<R>,
        layer: Option<&str>,
    ) -> Result<Cow<'_, Self>, Error> {
        if !self.has_any_layer() {
            return match layer {
                None if self.alternatives.is_empty() => Ok(Cow::Borrowed(self)),
                None => Ok(Cow::Owned(self.clone().named_as_in(file))),
                Some(layer) => Err(problem(
                    file,
                    format!("view layer {layer:?}: the names of the layout have no `*` for it"),
                )),
            };
        }
        let layers = self.layers(file);
        match (layer, &layers[..]) {
            (Some(layer), all) if all.iter().any(|found| found == layer) => {
                Ok(Cow::Owned(self.with_layer(layer).named_as_in(file)))
            }
            (None, [layer]) => Ok(Cow::Owned(self.with_layer(layer).named_as_in(file))),
            (_, []) => Err(file
                .require(&self.color.each_ref().map(String::as_str))
                .expect_err("a name with `*` is in no file")),
            (Some(layer), all) => Err(problem(
                file,
                format!("no view layer {layer:?}; there is {}", list(all)),
            )),
            (None, all) => Err(problem(
                file,
                format!("view layers {}: choose one", list(all)),
            )),
        }
    }

    /// Whether a file has all channels of this layout that it must have for denoising. The layout has
    /// the names of the file ([`in_file`](Self::in_file)).
    pub fn fits<R: Read + Seek>(&self, file: &ExrFile<R>) -> bool {
        found_and_lacking(file, self, self.missing).1.is_empty()
    }

    fn names_mut(&mut self) -> impl Iterator<Item = &mut String> {
        let features = [
            &mut self.normal,
            &mut self.position,
            &mut self.texture1,
            &mut self.texture2,
        ];
        let others = [
            &mut self.alternatives.normal,
            &mut self.alternatives.position,
            &mut self.alternatives.texture1,
            &mut self.alternatives.texture2,
        ];
        features
            .into_iter()
            .chain([&mut self.reference])
            .flatten()
            .chain([&mut self.color])
            .chain(others.into_iter().flatten())
            .flatten()
            .chain(&mut self.mask)
            .chain(&mut self.alpha)
            .chain(self.passes.names_mut())
    }

    fn has_any_layer(&self) -> bool {
        self.color[0].starts_with(ANY_LAYER)
    }

    /// The view layers whose colour the file has.
    fn layers<R: Read + Seek>(&self, file: &ExrFile<R>) -> Vec<String> {
        if !self.has_any_layer() {
            return Vec::new();
        }
        let color = self
            .color
            .each_ref()
            .map(|name| name.strip_prefix('*').unwrap_or(name));
        let channels = file.channels().iter();
        let layers = channels.filter_map(|channel| channel.name.strip_suffix(color[0]));
        let is_whole = |layer: &&str| {
            let mut names = color.iter().map(|name| format!("{layer}{name}"));
            names.all(|name| file.channel(&name).is_some())
        };
        layers.filter(is_whole).map(str::to_owned).collect()
    }

    /// The view layers of a file that may fit, or only `layer` if it is given; `[None]` if the names
    /// need none. `None` if no view layer can fit.
    fn layers_to_try<R: Read + Seek>(
        &self,
        file: &ExrFile<R>,
        layer: Option<&str>,
    ) -> Result<Option<Vec<Option<String>>>, Error> {
        let found = self.layers(file);
        Ok(match (self.has_any_layer(), layer) {
            (true, Some(layer)) => {
                if !found.is_empty() && !found.iter().any(|name| name == layer) {
                    let found = list(&found);
                    let detail = format!("no view layer {layer:?}; there is {found}");
                    return Err(problem(file, detail));
                }
                Some(vec![Some(layer.to_owned())])
            }
            (true, None) if !found.is_empty() => Some(found.into_iter().map(Some).collect()),
            (_, None) => Some(vec![None]),
            (false, Some(_)) => None,
        })
    }

    /// This layout with alternatives in place of names that the file lacks, and without the others.
    fn named_as_in<R: Read + Seek>(mut self, file: &ExrFile<R>) -> Self {
        let Alternatives {
            normal,
            position,
            texture1,
            texture2,
        } = std::mem::take(&mut self.alternatives);
        // One channel of three counts: the other two are a mistake, not a missing buffer.
        let is_in_file = |names: &Triple| names.iter().any(|name| file.channel(name).is_some());
        for (names, others) in [
            (&mut self.normal, normal),
            (&mut self.position, position),
            (&mut self.texture1, texture1),
            (&mut self.texture2, texture2),
        ] {
            if let Some(names) = names
                && !is_in_file(names)
                && let Some(other) = others.into_iter().find(is_in_file)
            {
                *names = other;
            }
        }
        self
    }

    fn with_layer(&self, layer: &str) -> Self {
        let mut layout = self.clone();
        for name in layout.names_mut() {
            if let Some(rest) = name.strip_prefix(ANY_LAYER) {
                *name = format!("{layer}.{rest}");
            }
        }
        layout
    }
}

/// The preset that fits a file. The file may lack the feature buffers that have a policy in
/// `missing` or in the preset.
///
/// # Errors
/// [`Error::Layout`]: no preset fits (it names the nearest one and what that lacks), several fit
/// equally well, or the view layer does not exist.
pub fn detect<R: Read + Seek>(
    file: &ExrFile<R>,
    missing: MissingPolicies,
    layer: Option<&str>,
) -> Result<FileLayout, Error> {
    let mut fits: Vec<FileLayout> = Vec::new();
    let mut nearest: Option<NearestPreset> = None;
    for (preset, text) in PRESETS {
        let pattern = ChannelLayout::from_toml(preset, text).expect("presets are valid");
        let missing = missing.or(pattern.missing);
        let Some(layers) = pattern.layers_to_try(file, layer)? else {
            continue;
        };
        for layer in layers {
            let of_layer = match &layer {
                Some(layer) => pattern.with_layer(layer),
                None => pattern.clone(),
            };
            let layout = of_layer.named_as_in(file);
            let (found, lacking) = found_and_lacking(file, &layout, missing);
            if lacking.is_empty() {
                fits.push(FileLayout {
                    preset,
                    layer,
                    layout: without_absent(file, layout, missing),
                });
            } else if nearest.as_ref().is_none_or(|nearest| found > nearest.found) {
                nearest = Some(NearestPreset {
                    preset,
                    found,
                    lacking,
                });
            }
        }
    }
    if let Some(layer) = layer
        && fits.is_empty()
        && !has_view_layers(file)
    {
        let detail = format!("view layer {layer:?}: the file has no view layers; omit the name");
        return Err(problem(file, detail));
    }
    let buffers = |fit: &FileLayout| 4 - fit.absent().len();
    let most = fits.iter().map(buffers).max();
    fits.retain(|fit| Some(buffers(fit)) == most);
    fits.dedup_by(|a, b| a.layout == b.layout);
    if fits.len() == 1 {
        return Ok(fits.remove(0));
    }
    if fits.len() > 1 {
        let name = |fit: &FileLayout| match &fit.layer {
            Some(layer) => format!("{} with view layer {layer:?}", fit.preset),
            None => fit.preset.to_owned(),
        };
        let names = list(&fits.iter().map(name).collect::<Vec<_>>());
        let detail = format!("several presets fit equally well: {names}; choose one");
        return Err(problem(file, detail));
    }
    Err(problem(
        file,
        match nearest.filter(|nearest| nearest.found > 0) {
            Some(NearestPreset {
                preset, lacking, ..
            }) => {
                let lacking = list(&lacking);
                format!("no preset fits; the nearest, {preset}, lacks {lacking}")
            }
            None => {
                let channels = file.channels().iter().map(|channel| channel.name.clone());
                let names = list(&channels.collect::<Vec<_>>());
                format!("no preset has any of its channels: {names}")
            }
        },
    ))
}

/// Whether a preset finds a view layer in a file.
fn has_view_layers<R: Read + Seek>(file: &ExrFile<R>) -> bool {
    PRESETS.iter().any(|(preset, text)| {
        let pattern = ChannelLayout::from_toml(preset, text).expect("presets are valid");
        !pattern.layers(file).is_empty()
    })
}

/// The preset with the most channels of a file, if none fits.
struct NearestPreset {
    preset: &'static str,
    /// Number of its channels in the file.
    found: usize,
    /// Those that the file lacks.
    lacking: Vec<String>,
}

/// Number of the layout's channels in the file, and those that the file must have but lacks.
fn found_and_lacking<R: Read + Seek>(
    file: &ExrFile<R>,
    layout: &ChannelLayout,
    missing: MissingPolicies,
) -> (usize, Vec<String>) {
    let features = layout
        .features()
        .into_iter()
        .zip(missing.in_order())
        .filter_map(|(feature, policy)| Some((feature.channels?, policy)));
    let (mut found, mut lacking) = (0, Vec::new());
    for (names, policy) in std::iter::once((&layout.color, Missing::Error)).chain(features) {
        let absent: Vec<String> = names
            .iter()
            .filter(|name| file.channel(name).is_none())
            .cloned()
            .collect();
        found += names.len() - absent.len();
        // One channel of three is a mistake, not a missing buffer.
        if policy == Missing::Error || absent.len() < names.len() {
            lacking.extend(absent);
        }
    }
    (found, lacking)
}

/// The layout without the feature buffers and passes that the file lacks, with `missing` for these.
fn without_absent<R: Read + Seek>(
    file: &ExrFile<R>,
    mut layout: ChannelLayout,
    missing: MissingPolicies,
) -> ChannelLayout {
    let is_absent = |names: &mut Triple| file.channel(&names[0]).is_none();
    for names in [
        &mut layout.normal,
        &mut layout.position,
        &mut layout.texture1,
        &mut layout.texture2,
    ] {
        names.take_if(is_absent);
    }
    layout.passes.forget_absent(file);
    layout.missing = missing;
    layout
}

fn problem<R: Read + Seek>(file: &ExrFile<R>, detail: String) -> Error {
    Error::Layout {
        name: format!("of {}", file.path().display()),
        detail,
    }
}
