//! What is wrong with a `[model]` table.

use super::{MAX_LEVEL, MAX_WIDTH, ModelConfig, Variant};
use crate::unet_size::{Guides, UnetSize};

impl ModelConfig {
    /// Every problem of the values, as one line each that begins with the key.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if !(1..=MAX_WIDTH).contains(&self.width) {
            let width = self.width;
            problems.push(format!(
                "model.width = {width}: must be from 1 to {MAX_WIDTH}"
            ));
        }
        let valid = 1..=MAX_LEVEL;
        if !self.levels.iter().all(|factor| valid.contains(factor)) {
            let levels = self.levels;
            problems.push(format!(
                "model.levels = {levels:?}: each must be from 1 to {MAX_LEVEL}"
            ));
        }
        let used = match self.variant {
            Variant::Kpcn => ModelConfig {
                width: self.width,
                ..ModelConfig::default()
            },
            Variant::Unet => ModelConfig {
                size: self.size,
                guides: self.guides,
                ..ModelConfig::default()
            },
            _ => ModelConfig {
                size: UnetSize::default(),
                guides: Guides::default(),
                ..*self
            },
        };
        let used = ModelConfig {
            variant: self.variant,
            ..used
        };
        if *self != used {
            let (unused, name) = (self.unused_keys(), self.variant.spec().name);
            problems.push(format!(
                "model: {unused} have no meaning for variant {name}; remove them"
            ));
        }
        problems
    }

    /// The keys of other variants, for a message.
    fn unused_keys(&self) -> &'static str {
        match self.variant {
            Variant::Kpcn => "reading, levels, head, detail, size, and guides",
            Variant::Unet => "reading, width, levels, head, and detail",
            _ => "size and guides",
        }
    }
}
