//! Compression methods, named as in OpenEXR's tools.

use std::fmt;
use std::str::FromStr;

use ::exr::prelude::Compression as Method;

/// A compression that this crate can write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Compression {
    /// None.
    None,
    /// Runs of equal bytes.
    Rle,
    /// Deflate, one line at a time.
    Zips,
    /// Deflate, 16 lines at a time.
    Zip,
    /// Wavelets and Huffman codes, 32 lines at a time; smallest for noisy images.
    Piz,
    /// Deflate of 24 bits: `float` channels lose their last 8.
    Pxr24,
    /// Blocks of 4x4 pixels at a fixed rate: `half` channels lose precision.
    B44,
    /// As B44, with smaller flat blocks.
    B44a,
    /// Lossy cosine transform, 32 lines at a time.
    Dwaa,
    /// As DWAA, 256 lines at a time.
    Dwab,
}

/// A compression of files.
struct KnownMethod {
    name: &'static str,
    /// Our type; `None` for a method that cannot be written.
    ours: Option<Compression>,
    /// The type of the `exr` crate.
    method: Method,
}

impl KnownMethod {
    const fn new(name: &'static str, ours: Option<Compression>, method: Method) -> Self {
        Self { name, ours, method }
    }
}

const TABLE: [KnownMethod; 12] = [
    KnownMethod::new("none", Some(Compression::None), Method::Uncompressed),
    KnownMethod::new("rle", Some(Compression::Rle), Method::RLE),
    KnownMethod::new("zips", Some(Compression::Zips), Method::ZIP1),
    KnownMethod::new("zip", Some(Compression::Zip), Method::ZIP16),
    KnownMethod::new("piz", Some(Compression::Piz), Method::PIZ),
    KnownMethod::new("pxr24", Some(Compression::Pxr24), Method::PXR24),
    KnownMethod::new("b44", Some(Compression::B44), Method::B44),
    KnownMethod::new("b44a", Some(Compression::B44a), Method::B44A),
    KnownMethod::new("dwaa", Some(Compression::Dwaa), Method::DWAA(None)),
    KnownMethod::new("dwab", Some(Compression::Dwab), Method::DWAB(None)),
    KnownMethod::new("htj2k32", None, Method::HTJ2K32),
    KnownMethod::new("htj2k256", None, Method::HTJ2K256),
];

/// An unknown compression name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("unknown compression {0:?}; expected one of {names}", names = Compression::ALL.map(Compression::name).join(", "))]
pub struct UnknownCompression(pub String);

impl Compression {
    /// All compressions.
    pub const ALL: [Self; 10] = [
        Self::None,
        Self::Rle,
        Self::Zips,
        Self::Zip,
        Self::Piz,
        Self::Pxr24,
        Self::B44,
        Self::B44a,
        Self::Dwaa,
        Self::Dwab,
    ];

    /// Its name, such as `zip` or `dwaa`.
    pub fn name(self) -> &'static str {
        let row = TABLE.iter().find(|row| row.ours == Some(self));
        row.map_or("", |row| row.name)
    }

    pub(super) fn method(self) -> Method {
        let row = TABLE.iter().find(|row| row.ours == Some(self));
        row.map_or(Method::ZIP16, |row| row.method)
    }

    /// `None` for a method that cannot be written.
    pub(super) fn of(method: Method) -> Option<Self> {
        row_of(method).and_then(|row| row.ours)
    }
}

pub(super) fn name_of(method: Method) -> &'static str {
    row_of(method).map_or("unknown", |row| row.name)
}

fn row_of(method: Method) -> Option<&'static KnownMethod> {
    // Compares variants only, because a DWA method carries a level.
    let kind = std::mem::discriminant(&method);
    TABLE
        .iter()
        .find(|row| std::mem::discriminant(&row.method) == kind)
}

impl fmt::Display for Compression {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Compression {
    type Err = UnknownCompression;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        let found = Self::ALL.into_iter().find(|known| known.name() == name);
        found.ok_or_else(|| UnknownCompression(name.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_compression_has_a_name_and_a_method_and_comes_back_from_both() {
        for compression in Compression::ALL {
            assert_eq!(compression.name().parse(), Ok(compression));
            assert_eq!(Compression::of(compression.method()), Some(compression));
        }
        assert_eq!(
            Compression::of(Method::DWAA(Some(45.0))),
            Some(Compression::Dwaa)
        );
        assert_eq!(Compression::of(Method::HTJ2K32), None);
        let error = "lzma"
            .parse::<Compression>()
            .expect_err("no such")
            .to_string();
        assert!(error.starts_with(
            "unknown compression \"lzma\"; expected one of none, rle, zips, zip, piz"
        ));
    }
}
