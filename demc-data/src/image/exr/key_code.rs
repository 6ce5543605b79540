//! The attribute `keyCode` of scanned film. The `exr` crate (1.74.2) reads its seven numbers and writes six,
//! after which no program can read the file.

use ::exr::meta::attribute::{AttributeValue, KeyCode, Text};
use ::exr::meta::header::Header;

/// The name of the attribute.
const NAME: &str = "keyCode";
/// The name of its type.
const KIND: &str = "keycode";

/// Makes the key codes of a header attributes that are written as they were read.
pub(super) fn keep_whole(header: &mut Header) {
    let attributes = &mut header.own_attributes;
    if let Some(code) = attributes.film_key_code.take() {
        attributes.other.insert(Text::from(NAME), whole(&code));
    }
    let others = attributes.other.values_mut();
    for value in others.chain(header.shared_attributes.other.values_mut()) {
        if let AttributeValue::KeyCode(code) = value {
            *value = whole(code);
        }
    }
}

fn whole(code: &KeyCode) -> AttributeValue {
    let numbers = [
        code.film_manufacturer_code,
        code.film_type,
        code.film_roll_prefix,
        code.count,
        code.perforation_offset,
        code.perforations_per_frame,
        code.perforations_per_count,
    ];
    AttributeValue::Custom {
        kind: Text::from(KIND),
        bytes: numbers.into_iter().flat_map(i32::to_le_bytes).collect(),
    }
}
