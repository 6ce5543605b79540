//! Tests across the crates, in `tests/tests/`: parity with PyTorch, backends, metrics and exports.
