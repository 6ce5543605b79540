//! The model that is part of every program of this crate.

use super::{BundleError, BundleFile};

/// The model, described in `models/README.md`.
const MODEL: &[u8] = include_bytes!("../../../models/demc.safetensors");

impl BundleFile {
    /// Its name in messages and in `demc-infer inspect`.
    pub const BUNDLED: &str = "the bundled model";

    /// The bundled model, which is inside the program.
    ///
    /// # Errors
    /// A build with a damaged model.
    pub fn bundled() -> Result<Self, BundleError> {
        Self::parse(Self::BUNDLED.into(), MODEL)
    }
}
