//! Arrays of a TOML file that are longer than their type, or stand for a table. The parser reads as many
//! values as the type has and drops the others silently.

use serde::Serialize;
use toml::{Table, Value};

/// The first array of `written` that `read`, the value read from it, holds with fewer values or as a
/// table: its key, and both lengths.
///
/// # Errors
/// Such an array.
pub fn check(written: &Table, read: &impl Serialize) -> Result<(), String> {
    let read = Table::try_from(read).map_err(|error| error.to_string())?;
    tables(written, &read, "")
}

fn tables(written: &Table, read: &Table, prefix: &str) -> Result<(), String> {
    for (key, value) in written {
        if let Some(read) = read.get(key) {
            values(value, read, &format!("{prefix}{key}"))?;
        }
    }
    Ok(())
}

fn values(written: &Value, read: &Value, key: &str) -> Result<(), String> {
    match (written, read) {
        (Value::Table(written), Value::Table(read)) => tables(written, read, &format!("{key}.")),
        (Value::Array(_), Value::Table(_)) => Err(format!("{key} is a table, not a list")),
        (Value::Array(written), Value::Array(read)) if written.len() > read.len() => Err(format!(
            "{key} has {} values instead of {}",
            written.len(),
            read.len()
        )),
        (Value::Array(written), Value::Array(read)) => written
            .iter()
            .zip(read)
            .try_for_each(|(written, read)| values(written, read, key)),
        _ => Ok(()),
    }
}
