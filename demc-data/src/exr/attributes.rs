//! Attributes of a header in the order of their names, as OpenEXR's own library writes them. The `exr` crate writes those that
//! it does not know in the random order of a hash map: the same image would give other bytes every time.

use std::io::{Seek, SeekFrom, Write};

use ::exr::error::Error as ExrError;
use ::exr::meta::Headers;
use ::exr::meta::header::Header;

use super::blocks::invalid;

/// Magic number and version.
const BEFORE: u64 = 8;

/// Writes the headers of a finished file again, in order: they are as long as they were.
pub(super) fn sort<W: Write + Seek>(writer: &mut W, headers: &Headers) -> Result<(), ExrError> {
    writer.seek(SeekFrom::Start(BEFORE))?;
    for header in headers {
        writer.write_all(&sorted(header)?)?;
    }
    writer.seek(SeekFrom::End(0))?;
    Ok(())
}

fn sorted(header: &Header) -> Result<Vec<u8>, ExrError> {
    let mut bytes = Vec::new();
    header.write(&mut bytes)?;
    // Without the zero at the end.
    let mut rest = &bytes[..bytes.len() - 1];
    let mut attributes = Vec::new();
    while !rest.is_empty() {
        let length = length(rest).filter(|&length| length <= rest.len());
        let length = length.ok_or_else(|| invalid("an attribute cannot be written".to_owned()))?;
        let (attribute, others) = rest.split_at(length);
        attributes.push(attribute);
        rest = others;
    }
    attributes.sort_unstable();
    let mut sorted = attributes.concat();
    sorted.push(0);
    Ok(sorted)
}

/// The length of the attribute at the beginning: name, zero, type, zero, size of the value in four bytes, value.
fn length(bytes: &[u8]) -> Option<usize> {
    let mut zeros = (0..bytes.len()).filter(|&i| bytes[i] == 0);
    let start = zeros.nth(1)? + 1;
    let size = bytes.get(start..start + 4)?.try_into().ok()?;
    Some(start + 4 + usize::try_from(i32::from_le_bytes(size)).ok()?)
}
