//! How an output was made. The record stands in its header, and a repeated command compares it with
//! its own options.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

/// Options that change an output, by flag, with their values as text.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Record(BTreeMap<String, String>);

/// Checksums of contents, each with the key of its name and what a message calls other content. Names are
/// for messages alone: one content may have several.
const CONTENTS: [(&str, &str, &str); 3] = [
    ("weights", "--model", "other weights of"),
    ("channels", "--layout", "other channels of"),
    (IMAGE, INPUT, "other content of"),
];
const IMAGE: &str = "image";
const INPUT: &str = "input";

/// The value of a flag that was not given.
const DEFAULT: &str = "the default";

impl Record {
    /// A record of a model, by its name and the checksum of its weights.
    pub fn of_model(name: &str, weights: &str) -> Self {
        let mut record = Self::default();
        record.add("--model", name);
        record.add("weights", weights);
        record
    }

    /// A record of a filter, by its name.
    pub fn of_filter(name: &str) -> Self {
        let mut record = Self::default();
        record.add("--filter", name);
        record
    }

    /// The same record for an image, by the name and the checksum of its file.
    #[must_use]
    pub fn of_image(&self, name: &str, checksum: &str) -> Self {
        let mut record = self.clone();
        record.add(INPUT, name);
        record.add(IMAGE, checksum);
        record
    }

    /// Whether `then` differs in the image's content alone: the file was written again.
    pub fn differs_in_content(&self, then: &Self) -> bool {
        let without = |record: &Self| {
            let mut record = record.clone();
            record.0.remove(IMAGE);
            record
        };
        without(self).differences(&without(then)).is_empty()
            && self.0.get(INPUT) == then.0.get(INPUT)
    }

    /// Adds a flag that was given.
    pub fn add(&mut self, flag: &str, value: impl ToString) {
        self.0.insert(flag.to_owned(), value.to_string());
    }

    /// The text for the header, in ASCII: JSON escapes other characters of paths.
    pub fn text(&self) -> String {
        let text = serde_json::to_string(self).expect("a map of strings");
        let mut ascii = String::with_capacity(text.len());
        for character in text.chars() {
            if character.is_ascii() {
                ascii.push(character);
            } else {
                let mut units = [0; 2];
                for unit in character.encode_utf16(&mut units) {
                    ascii += &format!("\\u{unit:04x}");
                }
            }
        }
        ascii
    }

    /// The record of a header; `None` if the text is no record.
    pub fn parse(text: &str) -> Option<Self> {
        serde_json::from_str(text).ok()
    }

    /// Names the options of `self` that differ from those in `then`; empty if none does.
    pub fn differences(&self, then: &Self) -> String {
        let value = |record: &Self, flag: &str| {
            let value = record.0.get(flag).map(String::as_str);
            value.unwrap_or(DEFAULT).to_owned()
        };
        let flags: BTreeSet<&String> = self.0.keys().chain(then.0.keys()).collect();
        let mut found = Vec::new();
        for flag in flags {
            let content = CONTENTS.iter().find(|(sum, ..)| sum == flag);
            if value(self, flag) == value(then, flag)
                || CONTENTS.iter().any(|(_, name, _)| name == flag)
            {
                continue;
            }
            let name = content.map_or(flag.as_str(), |(_, name, _)| name);
            let (now, before) = (value(self, name), value(then, name));
            found.push(match content {
                Some((.., other)) if now == before => format!("{other} {name} {now}"),
                _ => format!("{name} {before} instead of {now}"),
            });
        }
        found.join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_options_that_differ_are_named() {
        let quality = Record::of_model("quality", "1a");
        let mut layers = Record::of_model("models/quality.safetensors", "1a");
        assert_eq!(quality.differences(&layers), "", "the same weights");
        layers.add("--layers", "Combined_*");
        assert_eq!(
            layers.differences(&quality),
            "--layers the default instead of Combined_*"
        );
        let fast = Record::of_model("fast", "2b");
        assert_eq!(
            layers.differences(&fast),
            "--layers the default instead of Combined_*, --model fast instead of models/quality.safetensors"
        );
        let trained = Record::of_model("quality", "3c");
        assert_eq!(
            quality.differences(&trained),
            "other weights of --model quality"
        );
        let named = Record::of_model("modèle \u{1f600}", "4d");
        assert!(named.text().is_ascii());
        let image = quality.of_image("a.exr", "5e");
        assert_eq!(image.differences(&quality.of_image("b.exr", "5e")), "");
        let other = quality.of_image("b.exr", "6f");
        assert_eq!(image.differences(&other), "input b.exr instead of a.exr");
        assert!(!image.differs_in_content(&other));
        let again = quality.of_image("a.exr", "6f");
        assert_eq!(image.differences(&again), "other content of input a.exr");
        assert!(image.differs_in_content(&again));
        assert!(!image.differs_in_content(&fast.of_image("a.exr", "6f")));
        for record in [layers, named, image] {
            assert_eq!(Record::parse(&record.text()), Some(record));
        }
        assert_eq!(Record::parse("painted by hand"), None);
    }
}
