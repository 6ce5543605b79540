//! What is wrong with a `[model]` table.

use super::{Head, MAX_LEVEL, MAX_WIDTH, ModelConfig, Variant};
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
            Variant::Unet => self.of_unet(),
            Variant::UnetDemc | Variant::UnetNosn => ModelConfig {
                width: self.width,
                ..self.of_unet()
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
        let heads: &[Head] = if self.variant.is_unet() {
            &[Head::Grey]
        } else {
            &[Head::Grey, Head::Xavier, Head::Kernel]
        };
        if !heads.contains(&self.head) {
            let names: Vec<&str> = heads.iter().map(|head| head.name()).collect();
            problems.push(format!(
                "model.head = \"{}\": {} has {}",
                self.head.name(),
                self.variant.spec().name,
                names.join(", ")
            ));
        }
        if *self != used {
            let (unused, name) = (self.unused_keys(), self.variant.spec().name);
            problems.push(format!(
                "model: {unused} have no meaning for variant {name}; remove them"
            ));
        }
        problems
    }

    /// The default configuration with these keys of U-Nets.
    fn of_unet(&self) -> Self {
        ModelConfig {
            size: self.size,
            guides: self.guides,
            head: self.head,
            ..ModelConfig::default()
        }
    }

    /// The keys of other variants, for a message.
    fn unused_keys(&self) -> &'static str {
        match self.variant {
            Variant::Kpcn => "reading, levels, head, detail, size, and guides",
            Variant::Unet => "reading, width, levels, and detail",
            Variant::UnetDemc | Variant::UnetNosn => "reading, levels, and detail",
            _ => "size and guides",
        }
    }
}
