//! Trips across the crates: parity with PyTorch, backends, the README's commands. See `tests/tests/`.
