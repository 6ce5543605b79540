//! The models that are inside the program.

use std::path::Path;

/// A model for 1 to 256 samples per pixel that is inside the program. `models/README.md` describes
/// them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Bundled {
    /// The smaller error.
    #[default]
    Quality,
    /// Less than half the time.
    Fast,
}

impl Bundled {
    /// All bundled models.
    pub const ALL: [Self; 2] = [Self::Quality, Self::Fast];

    /// Its name, where a program or function takes a model.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Quality => "quality",
            Self::Fast => "fast",
        }
    }

    /// The bundled model that `path` names.
    pub fn named(path: &Path) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|model| path.as_os_str() == model.name())
    }

    /// The bytes of its file.
    pub const fn bytes(self) -> &'static [u8] {
        match self {
            Self::Quality => include_bytes!("../../../models/quality.safetensors"),
            Self::Fast => include_bytes!("../../../models/fast.safetensors"),
        }
    }
}
