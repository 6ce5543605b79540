//! Channels as described by a file's header.

use std::fmt;

use serde::Serialize;

/// One channel of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channel {
    /// Its name, as spelled in a layout: `Layer.channel` in a file of several parts. Invalid UTF-8
    /// and control characters become U+FFFD.
    pub name: String,
    /// The type of its samples.
    pub kind: ChannelType,
    /// The name of its part, if the part has one.
    pub layer: Option<String>,
    /// The pixels that it covers.
    pub window: Window,
    pub(crate) part: usize,
    pub(crate) index: usize,
}

/// A sample type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ChannelType {
    /// 16-bit floating point.
    Half,
    /// 32-bit floating point.
    Float,
    /// 32-bit unsigned integer.
    Uint,
}

impl fmt::Display for ChannelType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            ChannelType::Half => "half",
            ChannelType::Float => "float",
            ChannelType::Uint => "uint",
        })
    }
}

/// A rectangle of pixels: an EXR data window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// Left edge, in pixels of the whole picture.
    pub x: i32,
    /// Top edge.
    pub y: i32,
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
}

impl fmt::Display for Window {
    /// `WxH`, or `WxH+X+Y` if the window does not start at the origin.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)?;
        match (self.x, self.y) {
            (0, 0) => Ok(()),
            (x, y) => write!(f, "{x:+}{y:+}"),
        }
    }
}

/// `Layer.channel`. A channel that already starts with its layer's name, as some writers do it,
/// keeps its name.
pub(crate) fn full_name(layer: Option<&str>, channel: &str) -> String {
    match layer {
        Some(layer) if !layer.is_empty() && !channel.starts_with(&format!("{layer}.")) => {
            format!("{layer}.{channel}")
        }
        _ => channel.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_is_named_by_its_layer_once() {
        assert_eq!(full_name(Some("Lamp 0.1"), "R"), "Lamp 0.1.R");
        assert_eq!(full_name(Some("normal"), "normal.X"), "normal.X");
        assert_eq!(full_name(Some(""), "R"), "R");
        assert_eq!(full_name(None, "View.Combined.R"), "View.Combined.R");
    }

    #[test]
    fn a_window_shows_where_it_starts_if_not_at_the_origin() {
        let window = |x, y| {
            Window {
                x,
                y,
                width: 4,
                height: 3,
            }
            .to_string()
        };
        assert_eq!(window(0, 0), "4x3");
        assert_eq!(window(-2, 5), "4x3-2+5");
    }
}
