//! TZA, the file format of Open Image Denoise's weights, version 2.
//!
//! Little-endian. The file starts with the number 0x41D7, the version in two bytes, and the offset of the
//! table as 64 bits. The table starts with the count of tensors. Each entry has a name after its length, and
//! the number of axes. Then come the axes' lengths, a letter for each (`oihw` or `x`), the type (`h` for half,
//! `f` for float), and the offset of the values. The values start at multiples of 64 bytes.

use demc_model::Weight;
use half::f16;
use thiserror::Error;

use crate::Precision;

/// The first bytes of a file: the number, and version 2.0.
pub(super) const START: [u8; 4] = [0xD7, 0x41, 2, 0];

/// Bytes before the first tensor.
const HEADER: usize = 12;

/// The values of a tensor start at multiples of this many bytes.
const ALIGNMENT: usize = 64;

/// Most tensors of a file: the largest known network has 34.
const MOST_TENSORS: u32 = 200;

/// Most values of all tensors together, 64 MiB of floats: the largest known network has 3.8 million. Tensors
/// may share bytes, so the length of a file is no limit.
const MOST_VALUES: u64 = 1 << 24;

/// Why bytes are no TZA file.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum TzaError {
    /// The start is another.
    #[error("it does not start as a TZA file of version 2")]
    Start,
    /// The file ends within a part.
    #[error("it ends within {part}")]
    Short { part: String },
    /// A number of the table is impossible.
    #[error("{what}")]
    Table { what: String },
}

/// The tensors of the file that `bytes` start with, in its order.
///
/// # Errors
/// [`TzaError`]; an infinite or undefined value is one, too.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<Weight>, TzaError> {
    if !bytes.starts_with(&START) {
        return Err(TzaError::Start);
    }
    let mut start = Reader { bytes, at: 4 };
    let table = u64::from_le_bytes(start.take("the header")?);
    let at = usize::try_from(table).unwrap_or(usize::MAX);
    let mut table = Reader { bytes, at };
    let count = u32::from_le_bytes(table.take("the table")?);
    if !(1..=MOST_TENSORS).contains(&count) {
        let what = format!("it has {count} tensors; expected 1 to {MOST_TENSORS}");
        return Err(TzaError::Table { what });
    }
    let mut values = 0;
    let tensors = (0..count).map(|_| {
        let tensor = tensor(bytes, &mut table, MOST_VALUES - values)?;
        values += tensor.data.len() as u64;
        Ok(tensor)
    });
    tensors.collect()
}

/// Reads an entry of the table, and its values, at most `most`.
fn tensor(bytes: &[u8], table: &mut Reader, most: u64) -> Result<Weight, TzaError> {
    let part = "the table";
    let length = u16::from_le_bytes(table.take(part)?);
    let name = table.slice(usize::from(length), part)?;
    let is_name = |byte: &u8| byte.is_ascii_alphanumeric() || b"._".contains(byte);
    if name.is_empty() || !name.iter().all(is_name) {
        let what = "a tensor has no name of letters, digits, points, and underlines".into();
        return Err(TzaError::Table { what });
    }
    let name = String::from_utf8_lossy(name).into_owned();
    let wrong = |what: String| TzaError::Table {
        what: format!("{name}: {what}"),
    };
    let [axes] = table.take(part)?;
    let expected: &[u8] = match axes {
        1 => b"x",
        4 => b"oihw",
        _ => return Err(wrong(format!("{axes} axes; expected 1 or 4"))),
    };
    let mut shape = Vec::new();
    for _ in 0..axes {
        shape.push(u32::from_le_bytes(table.take(part)?));
    }
    let layout = table.slice(usize::from(axes), part)?;
    if layout != expected {
        return Err(wrong("its axes are not `x` or `oihw`".into()));
    }
    let [kind] = table.take(part)?;
    let offset = u64::from_le_bytes(table.take(part)?);
    let values = shape.iter().try_fold(1u64, |product, length| {
        product.checked_mul(u64::from(*length))
    });
    let Some(values) = values.filter(|values| (1..=most).contains(values)) else {
        let what =
            format!("with the shape {shape:?}, all tensors have 0 or over {MOST_VALUES} values");
        return Err(wrong(what));
    };
    let at = usize::try_from(offset).unwrap_or(usize::MAX);
    let mut place = Reader { bytes, at };
    let count = values as usize;
    let part = format!("the values of {name}");
    let data: Vec<f32> = match kind {
        b'h' => {
            let pairs = place.slice(2 * count, &part)?.chunks_exact(2);
            pairs
                .map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32())
                .collect()
        }
        b'f' => {
            let words = place.slice(4 * count, &part)?.chunks_exact(4);
            words
                .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
                .collect()
        }
        _ => return Err(wrong(format!("type {kind}; expected half or float"))),
    };
    if !data.iter().all(|value| value.is_finite()) {
        return Err(wrong("a value is not finite".into()));
    }
    let shape = shape.into_iter().map(|length| length as usize).collect();
    Ok(Weight { name, shape, data })
}

/// A place in a file.
struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    fn slice(&mut self, length: usize, part: &str) -> Result<&'a [u8], TzaError> {
        let end = self.at.checked_add(length);
        let found = end.and_then(|end| self.bytes.get(self.at..end));
        let found = found.ok_or_else(|| TzaError::Short { part: part.into() })?;
        self.at += length;
        Ok(found)
    }

    fn take<const N: usize>(&mut self, part: &str) -> Result<[u8; N], TzaError> {
        let slice = self.slice(N, part)?;
        Ok(slice.try_into().expect("N bytes"))
    }
}

/// A file of these tensors, in their order.
pub(super) fn write(tensors: &[Weight], precision: Precision) -> Vec<u8> {
    let mut bytes = START.to_vec();
    bytes.resize(HEADER, 0);
    let mut table = (tensors.len() as u32).to_le_bytes().to_vec();
    for Weight { name, shape, data } in tensors {
        bytes.resize(bytes.len().next_multiple_of(ALIGNMENT), 0);
        let offset = bytes.len() as u64;
        for value in data {
            match precision {
                Precision::F32 => bytes.extend(value.to_le_bytes()),
                Precision::F16 => bytes.extend(f16::from_f32(*value).to_le_bytes()),
            }
        }
        table.extend((name.len() as u16).to_le_bytes());
        table.extend(name.as_bytes());
        table.push(shape.len() as u8);
        for length in shape {
            table.extend((*length as u32).to_le_bytes());
        }
        table.extend(if shape.len() == 1 { &b"x"[..] } else { b"oihw" });
        table.push(match precision {
            Precision::F32 => b'f',
            Precision::F16 => b'h',
        });
        table.extend(offset.to_le_bytes());
    }
    bytes.resize(bytes.len().next_multiple_of(ALIGNMENT), 0);
    let offset = bytes.len() as u64;
    bytes[4..HEADER].copy_from_slice(&offset.to_le_bytes());
    bytes.extend(table);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tensors() -> Vec<Weight> {
        let weight = |name: &str, shape: &[usize]| Weight {
            name: name.into(),
            shape: shape.into(),
            data: (0..shape.iter().product())
                .map(|i: usize| i as f32 * 0.25 - 3.0)
                .collect(),
        };
        vec![
            weight("enc_conv0.weight", &[2, 3, 3, 3]),
            weight("enc_conv0.bias", &[2]),
        ]
    }

    #[test]
    fn tensors_come_back() {
        for precision in [Precision::F32, Precision::F16] {
            let bytes = write(&tensors(), precision);
            assert_eq!(read(&bytes).expect("its own"), tensors());
            let table = u64::from_le_bytes(bytes[4..12].try_into().expect("8 bytes"));
            assert_eq!(table % 64, 0);
        }
    }

    /// A file that ends anywhere, and one with any byte changed, gives an error or tensors.
    #[test]
    fn damaged_files_are_refused() {
        let bytes = write(&tensors(), Precision::F16);
        for length in 0..bytes.len() {
            assert!(read(&bytes[..length]).is_err(), "{length} bytes");
        }
        for at in 0..bytes.len() {
            for value in [0, 1, 0x7F, 0xFF] {
                let mut bytes = bytes.clone();
                bytes[at] = value;
                let _ = read(&bytes);
            }
        }
    }

    /// Many tensors may share the same bytes, so that a small file asks for much memory.
    #[test]
    fn the_sum_of_all_values_is_limited() {
        let mut bytes = START.to_vec();
        bytes.extend(64_u64.to_le_bytes());
        bytes.resize(64, 0);
        bytes.extend(200_u32.to_le_bytes());
        for _ in 0..200 {
            bytes.extend(1_u16.to_le_bytes());
            bytes.push(b'a');
            bytes.push(1);
            bytes.extend(1_000_000_u32.to_le_bytes());
            bytes.extend(b"xh");
            bytes.extend(8192_u64.to_le_bytes());
        }
        bytes.resize(8192 + 2_000_000, 0);
        let error = read(&bytes).expect_err("200 million values");
        assert_eq!(
            error.to_string(),
            "a: with the shape [1000000], all tensors have 0 or over 16777216 values"
        );
    }

    #[test]
    fn what_is_wrong_is_named() {
        let bytes = write(&tensors(), Precision::F32);
        let table = u64::from_le_bytes(bytes[4..12].try_into().expect("8 bytes")) as usize;
        let with = |at: usize, new: &[u8]| {
            let mut bytes = bytes.clone();
            bytes[at..at + new.len()].copy_from_slice(new);
            read(&bytes).expect_err("wrong").to_string()
        };
        assert_eq!(
            with(0, b"PK"),
            "it does not start as a TZA file of version 2"
        );
        assert_eq!(with(4, &[0xFF; 8]), "it ends within the table");
        assert_eq!(with(table, &[0; 4]), "it has 0 tensors; expected 1 to 200");
        // After the count: a length of two bytes, the name, the number of axes.
        let axes = table + 4 + 2 + "enc_conv0.weight".len();
        assert_eq!(
            with(axes, &[3]),
            "enc_conv0.weight: 3 axes; expected 1 or 4"
        );
        let huge = with(axes + 1, &[0xFF; 4]);
        assert!(huge.starts_with("enc_conv0.weight: with the shape [4294967295, 3, 3, 3],"));
        let short = "it ends within the values of enc_conv0.weight";
        assert_eq!(with(axes + 1, &[0, 0, 1, 0]), short);
        assert_eq!(
            with(64, &f32::NAN.to_le_bytes()),
            "enc_conv0.weight: a value is not finite"
        );
    }
}
