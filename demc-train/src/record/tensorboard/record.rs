//! TFRecord framing: length, checksum of the length, data, checksum of the data. The only importer
//! of `crc32c`.

/// `data` framed as one record.
pub fn framed(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    [
        &length[..],
        &masked_crc(&length).to_le_bytes(),
        data,
        &masked_crc(data).to_le_bytes(),
    ]
    .concat()
}

/// CRC-32C masked as in LevelDB: rotated and offset, so that data may contain checksums itself.
fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data)
        .rotate_right(15)
        .wrapping_add(0xa282_ead8)
}

/// The data of all records of a file.
///
/// # Panics
/// If a record is incomplete or a checksum is wrong.
#[cfg(test)]
pub fn unframed(mut file: &[u8]) -> Vec<Vec<u8>> {
    let mut records = Vec::new();
    while !file.is_empty() {
        let length = u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
        let (data, checked) = (&file[12..12 + length], &file[12 + length..16 + length]);
        assert_eq!(file[8..12], masked_crc(&file[..8]).to_le_bytes());
        assert_eq!(checked, masked_crc(data).to_le_bytes());
        records.push(data.to_vec());
        file = &file[16 + length..];
    }
    records
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_equal_those_of_tensorflow_and_of_the_rfc() {
        // A record written by TensorFlow: `Event(file_version="CRC test, one two")`.
        assert_eq!(masked_crc(b"\x1a\x11CRC test, one two"), 0x5794_d08a);
        // RFC 3720, B.4: 32 bytes of zeros.
        let unmasked = masked_crc(&[0; 32])
            .wrapping_sub(0xa282_ead8)
            .rotate_left(15);
        assert_eq!(unmasked, 0x8a91_36aa);
    }

    #[test]
    fn unframing_returns_the_data() {
        let data = [vec![], vec![7], (0..=255).collect::<Vec<u8>>()];
        let file: Vec<u8> = data.iter().flat_map(|data| framed(data)).collect();
        assert_eq!(file.len(), 3 * 16 + 257);
        assert_eq!(unframed(&file), data);
    }
}
