//! Shared by the targets.

use std::path::{Path, PathBuf};

/// Allows panics that the library catches; the `exr` crate panics on some damaged data. The hook of
/// `libfuzzer-sys` would end the process first. Without a hook, an uncaught panic still ends it.
pub fn allow_caught_panics() {
    std::panic::set_hook(Box::new(|_| {}));
}

/// Checks that an error is one line that names the file.
pub fn check_message(error: &dyn std::error::Error, name: &str) {
    let message = error.to_string();
    assert!(!message.contains('\n'), "{message:?}");
    assert!(message.contains(name), "{message:?}");
}

/// A new directory, in memory if available, for targets that write files.
pub fn scratch() -> PathBuf {
    let memory = Path::new("/dev/shm");
    let parent = if memory.is_dir() {
        memory.to_owned()
    } else {
        std::env::temp_dir()
    };
    let dir = parent.join(format!("demc-fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&dir).expect("a writable directory");
    dir
}
