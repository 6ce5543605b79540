//! The records of outputs: which options and which input made them.

use std::path::Path;

use demc_program::checksum::sha256_of;

use super::Arguments;
use super::work::Method;
use crate::Ensemble;
use crate::cli::exposure::{InputScale, SequenceScales};
use crate::cli::inputs::place;
use crate::cli::layouts::Layouts;
use crate::cli::record::Record;

/// Names of an input's path in its record, with the file's: enough to tell `shot1/v2/beauty/a.exr` from
/// `shot2/v2/beauty/a.exr`, and the same on computers that mount the project elsewhere.
const NAMES: usize = 4;

/// The last names of a path.
fn shown(path: &Path) -> String {
    let names: Vec<_> = path
        .iter()
        .filter(|name| *name != "/")
        .map(|name| name.to_string_lossy())
        .collect();
    names[names.len().saturating_sub(NAMES)..].join("/")
}

impl Arguments {
    /// The options that change an output.
    pub(super) fn record(&self, method: &Method, layouts: &Layouts) -> anyhow::Result<Record> {
        let mut record = method.record(&self.model)?;
        layouts.record(&mut record);
        self.layers.record(&mut record);
        self.output_flags.record(&mut record);
        for (flag, is_set) in [("--repair", self.repair), ("--detail-map", self.detail_map)] {
            if is_set {
                record.add(flag, "on");
            }
        }
        if let Some(factor) = self.input_scale.choice.factor() {
            record.add("--input-scale", factor);
        }
        if self.ensemble.passes != Ensemble::One {
            record.add("--ensemble", self.ensemble.passes.count());
        }
        if let Some(restore) = self.light.restore_light {
            record.add("--restore-light", if restore { "on" } else { "off" });
        }
        self.tiling.record(&mut record);
        Ok(record)
    }

    /// The record of an image: the options, its file, and its sequence, if that decides its factor.
    pub(super) fn image_record(
        &self,
        options: &Record,
        input: &Path,
        scales: &SequenceScales,
    ) -> anyhow::Result<Record> {
        let (directory, name) = place(input);
        let name = shown(&directory.join(name));
        let mut record = options.of_image(&name, &sha256_of(input)?);
        if self.input_scale.choice == InputScale::Auto
            && let Some(sequence) = scales.sequence(input)
        {
            record.add("sequence", sequence);
        }
        Ok(record)
    }
}
