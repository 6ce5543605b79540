//! SHA-256 checksums in hexadecimal digits, as `sha256sum` prints them.

use std::fmt::Write as _;
use std::io::{self, Read};
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::file::{FileError, open_regular};

/// Bytes that are read at once.
const PIECE: usize = 1 << 20;

/// The SHA-256 of these parts, one after the other: 64 hexadecimal digits.
pub fn sha256<'a>(parts: impl IntoIterator<Item = &'a [u8]>) -> String {
    let mut sum = Sha256::new();
    for part in parts {
        sum.update(part);
    }
    digits(sum)
}

/// The SHA-256 of a file: 64 hexadecimal digits.
///
/// # Errors
/// [`FileError::Read`] for a file that cannot be read or is not a regular file.
pub fn sha256_of(path: &Path) -> Result<String, FileError> {
    let read = || -> io::Result<String> {
        let mut file = open_regular(path)?;
        let (mut sum, mut piece) = (Sha256::new(), vec![0; PIECE]);
        loop {
            match file.read(&mut piece)? {
                0 => return Ok(digits(sum)),
                read => sum.update(&piece[..read]),
            }
        }
    };
    read().map_err(|source| FileError::Read {
        path: path.to_owned(),
        source,
    })
}

fn digits(sum: Sha256) -> String {
    let bytes = sum.finalize();
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_and_its_parts_have_the_checksum_of_sha256sum() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(file.path(), "7").expect("written");
        // printf 7 | sha256sum
        let expected = "7902699be42c8a8e46fbbb4501726517e86b22c56a189f7625a6da49081b2451";
        assert_eq!(sha256_of(file.path()).expect("read"), expected);
        assert_eq!(sha256([&b""[..], b"7"]), expected);
        for path in ["/nowhere/at/all", "/dev/zero"] {
            assert!(sha256_of(Path::new(path)).is_err());
        }
    }
}
