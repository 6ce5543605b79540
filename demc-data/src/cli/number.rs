//! Numbers in tables.

/// About six significant digits, in at most eleven characters.
pub fn number(value: f64) -> String {
    match value.abs() {
        0.0 => "0".to_owned(),
        1e-4..1e6 => format!("{value:.5}"),
        _ => format!("{value:.4e}"),
    }
}
