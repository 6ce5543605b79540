//! How an output was made. The record stands in its header, and a repeated command compares it with
//! its own options.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

/// Options that change an output, by flag, with their values as text.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Record(BTreeMap<String, String>);

/// The key of the model's checksum. The model's name is for messages alone: one model may have several.
const WEIGHTS: &str = "weights";
const MODEL: &str = "--model";

/// The value of a flag that was not given.
const DEFAULT: &str = "the default";

impl Record {
    /// A record of a model, by its name and the checksum of its weights.
    pub fn of_model(name: &str, weights: &str) -> Self {
        let mut record = Self::default();
        record.add(MODEL, name);
        record.add(WEIGHTS, weights);
        record
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
            let (now, before) = (value(self, flag), value(then, flag));
            match flag.as_str() {
                MODEL => {}
                WEIGHTS if now != before => {
                    let (now, before) = (value(self, MODEL), value(then, MODEL));
                    found.push(if now == before {
                        format!("other weights of {MODEL} {now}")
                    } else {
                        format!("{MODEL} {before} instead of {now}")
                    });
                }
                _ if now != before => found.push(format!("{flag} {before} instead of {now}")),
                _ => {}
            }
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
        for record in [layers, named] {
            assert_eq!(Record::parse(&record.text()), Some(record));
        }
        assert_eq!(Record::parse("painted by hand"), None);
    }
}
