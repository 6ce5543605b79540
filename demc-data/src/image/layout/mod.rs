//! The mapping from a renderer's channels to the network's planes. Swapped buffers are a common
//! silent failure, so a layout is always explicit: a preset or a TOML file lists the names. A
//! buffer that a renderer lacks has a stated policy. The training's layout is stored with the
//! weights; [`detect`] finds the preset that fits another file.
//!
//! ```toml
//! color    = ["R", "G", "B"]
//! normal   = ["normal.X", "normal.Y", "normal.Z"]
//! position = ["position.X", "position.Y", "position.Z"]
//! texture1 = ["albedo.R", "albedo.G", "albedo.B"]
//!
//! # `*.` at the start of all names stands for a view layer: "*.Combined.R".
//! [alternatives]              # other names, for files without the names above
//! normal = [["nn.X", "nn.Y", "nn.Z"]]
//!
//! [passes]                    # for NFOR and KPCN only
//! depth = "depth.Z"
//! half_buffers = ["half1.", "half2."]
//!
//! [missing]                   # "error" (default) or "zeros"; for texture2 also "copy-texture1"
//! texture2 = "copy-texture1"
//! ```

mod channels;
mod detect;
mod passes;
#[cfg(test)]
mod tests;

pub use channels::{
    ANY_LAYER, Alternatives, ChannelLayout, FeatureBuffer, InputKind, Missing, MissingPolicies,
    PRESETS,
};
pub use detect::{FileLayout, detect};
pub use passes::{NamedBuffer, Passes, Triple};
