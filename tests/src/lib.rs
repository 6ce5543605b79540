//! Tests across the crates, in `tests/tests/suite`: parity with PyTorch, backends, metrics and exports.
