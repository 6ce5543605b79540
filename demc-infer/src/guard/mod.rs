//! What stands between a network and images that it was not made for: a refusal where the result would be nonsense
//! ([`Bundle::check_statistics`]), warnings where it is likely to be poor ([`Bundle::warnings`]).
//!
//! A renderer that hands over another buffer than the one asked for gives no error: normals in camera space, normals packed
//! into 0 to 1, normal and albedo swapped, another exposure. Each of these has a mark of its own, which is looked for first
//! (`geometry`); what remains is compared with what the training scenes were like (`drift`). Whether the output has the
//! input's energy can be told without a reference, since the noisy input is right in the mean (`energy`).

mod drift;
mod energy;
mod geometry;
mod statistics;

use std::fmt;

use demc_data::{Frame, Summary};

use crate::Bundle;
use crate::denoise::{DenoiseError, check_sizes};

pub use energy::EnergyBias;
pub use statistics::FARTHEST_RMS;

/// Something about an image that the network was not made for: what was found, and what it likely comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct Warning {
    /// The buffer or channel.
    pub what: String,
    /// What was measured, in numbers.
    pub found: String,
    /// The likely cause.
    pub cause: &'static str,
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { what, found, cause } = self;
        write!(f, "{what}: {found}; {cause}")
    }
}

impl Bundle {
    /// What about `frame` is unlike anything that the network was trained on; empty for an image like those.
    ///
    /// # Errors
    /// Buffers that do not fit the frame's size.
    pub fn warnings(&self, frame: &Frame) -> Result<Vec<Warning>, DenoiseError> {
        check_sizes(frame)?;
        let mut warnings = geometry::warnings(frame);
        // A buffer whose mistake is known drifts, too: once is enough.
        if let Some(ranges) = &self.meta.ranges {
            let known: Vec<String> = warnings.iter().map(|w| w.what.clone()).collect();
            let drift = drift::warnings(&Summary::of(frame), ranges);
            let named = |warning: &Warning| known.iter().any(|what| warning.what.contains(what));
            warnings.extend(drift.into_iter().filter(|warning| !named(warning)));
        }
        Ok(warnings)
    }
}
