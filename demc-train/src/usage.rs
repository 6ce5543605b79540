//! A command line that cannot be carried out.

/// Wrong options or arguments: exit code 2. The message names them.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);
