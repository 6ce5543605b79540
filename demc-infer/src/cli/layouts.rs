//! `--layout` and `--layer`: which channels of a file hold the buffers.

use std::cell::RefCell;
use std::path::Path;

use clap::Args;
use demc_data::image::exr::ExrFile;
use demc_data::image::layout::{FeatureBuffer, FileLayout, Missing, MissingPolicies, detect};
use demc_data::{ChannelLayout, Dataset, Error};
use demc_program::checksum::sha256;
use demc_program::exit::UsageError;
use demc_program::message;
use demc_program::output::Outputs;

use super::record::Record;
use crate::Bundle;

/// What a layout file is called in messages about outputs.
pub const LAYOUT: &str = "the channel layout";

/// `--layout`, `--layer`.
#[derive(Args)]
pub struct LayoutFlags {
    /// Channel layout of the images: demc-exr, mitsuba3, pbrt-v4, cycles, luxcore, fbksd, or a TOML file
    /// [default: the model's own if it fits, otherwise the preset that fits]
    #[arg(long, value_name = "PRESET|FILE")]
    layout: Option<String>,
    /// View layer of the images. Needed if there are several
    #[arg(long, value_name = "NAME")]
    layer: Option<String>,
}

/// Chooses the layout of each file.
pub struct Layouts<'a> {
    flags: &'a LayoutFlags,
    /// The layout of `--layout`.
    given: Option<ChannelLayout>,
    /// The choices that were printed.
    said: RefCell<Vec<String>>,
}

impl LayoutFlags {
    /// Protects the file of `--layout` from being replaced.
    pub fn protect(&self, outputs: &mut Outputs) {
        if let Some(layout) = &self.layout {
            outputs.protect(Path::new(layout), LAYOUT);
        }
    }

    /// Reads the layout of `--layout`.
    ///
    /// # Errors
    /// Neither a preset nor a readable layout.
    pub fn read(&self) -> Result<Layouts<'_>, UsageError> {
        let given = self
            .layout
            .as_deref()
            .map(ChannelLayout::resolve)
            .transpose();
        Ok(Layouts {
            flags: self,
            given: given
                .map_err(|error| UsageError(format!("{:#}", anyhow::Error::from(error))))?,
            said: RefCell::default(),
        })
    }
}

impl Layouts<'_> {
    /// Adds the flags to a record, and the channels of a given layout.
    pub fn record(&self, record: &mut Record) {
        let LayoutFlags { layout, layer } = self.flags;
        for (flag, value) in [("--layout", layout), ("--layer", layer)] {
            if let Some(value) = value {
                record.add(flag, value);
            }
        }
        if let Some(given) = &self.given {
            let text = serde_json::to_string(given).expect("a layout is plain data");
            record.add("channels", sha256([text.as_bytes()]));
        }
    }

    /// The layout of `file`, with the names of its view layer. A choice among the presets is
    /// passed to `say`, once for all files.
    ///
    /// # Errors
    /// As [`choose`](Self::choose).
    pub fn of(
        &self,
        file: &ExrFile,
        bundle: &Bundle,
        say: impl FnOnce(&str),
    ) -> Result<ChannelLayout, Error> {
        let (layout, choice) = self.choose(file, bundle)?;
        if let Some(choice) = choice.filter(|choice| !self.said.borrow().contains(choice)) {
            say(&choice);
            self.said.borrow_mut().push(choice);
        }
        Ok(layout)
    }

    /// The layout of `file`, and a description of a choice among the presets.
    ///
    /// # Errors
    /// As [`detect`] and [`ChannelLayout::in_file`].
    pub fn choose(
        &self,
        file: &ExrFile,
        bundle: &Bundle,
    ) -> Result<(ChannelLayout, Option<String>), Error> {
        let mut own = bundle.meta.layout.clone();
        own.missing = own.missing.or(bundle.without_effect());
        let (mut layout, choice) = self.choose_for(file, &own, bundle.missing())?;
        layout.inputs = own.inputs;
        Ok((layout, choice))
    }

    /// The layout of a file whose passes a filter needs: without `--layout`, this project's if it fits.
    ///
    /// # Errors
    /// As [`choose`](Self::choose).
    pub fn of_filtered(&self, file: &ExrFile) -> Result<ChannelLayout, Error> {
        let missing = MissingPolicies {
            position: Missing::Zeros,
            texture2: Missing::CopyTexture1,
            ..MissingPolicies::default()
        };
        let mut own = ChannelLayout::resolve("demc-exr").expect("a preset");
        own.missing = missing;
        Ok(self.choose_for(file, &own, missing)?.0)
    }

    /// As [`choose`](Self::choose), with a layout that is preferred to presets, and policies for what a file
    /// lacks.
    fn choose_for(
        &self,
        file: &ExrFile,
        own: &ChannelLayout,
        missing: MissingPolicies,
    ) -> Result<(ChannelLayout, Option<String>), Error> {
        let layer = self.flags.layer.as_deref();
        if let Some(given) = &self.given {
            let mut layout = given.in_file(file, layer)?.into_owned();
            layout.missing = layout.missing.or(missing);
            return Ok((layout, None));
        }
        if let Ok(own) = own.in_file(file, layer)
            && own.fits(file)
        {
            return Ok((own.into_owned(), None));
        }
        let found = detect(file, missing, layer)?;
        let choice = describe(&found);
        Ok((found.layout, Some(choice)))
    }

    /// The layout of a data set: that of its first file whose scene names none.
    ///
    /// # Errors
    /// As [`Dataset::list`] and [`of`](Self::of).
    pub fn of_dataset(&self, root: &Path, bundle: &Bundle) -> anyhow::Result<ChannelLayout> {
        let scenes = Dataset::list(root)?;
        let first = scenes.iter().find(|scene| scene.layout.is_none());
        let first = first.map(|scene| ExrFile::open(&scene.path));
        Ok(match (&self.given, first) {
            (None, Some(Ok(file))) => self.of(&file, bundle, say)?,
            // Opening the data set names what is wrong with its files.
            (given, _) => ChannelLayout {
                inputs: bundle.meta.layout.inputs,
                ..given.as_ref().unwrap_or(&bundle.meta.layout).clone()
            },
        })
    }
}

/// Prints a choice on stderr.
pub fn say(choice: &str) {
    message::say(format_args!("note: {choice}"));
}

fn describe(found: &FileLayout) -> String {
    let mut text = format!("layout {}", found.preset);
    if let Some(layer) = &found.layer {
        text += &format!(", view layer {layer:?}");
    }
    for FeatureBuffer {
        name,
        channels,
        missing,
    } in found.layout.features()
    {
        if channels.is_none() {
            text += &match missing {
                Missing::CopyTexture1 => format!("; no {name}: texture1 replaces it"),
                _ => format!("; no {name}: zeros replace it"),
            };
        }
    }
    text
}
