//! Shared by the targets.

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
