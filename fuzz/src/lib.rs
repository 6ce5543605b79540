//! What the targets share.

/// A panic that the library catches (the `exr` crate gives up on damaged data that way) is no finding, but the hook of
/// `libfuzzer-sys` ends the process before it can be caught. Without a hook, one that nobody catches still ends it.
pub fn allow_caught_panics() {
    std::panic::set_hook(Box::new(|_| {}));
}

/// Errors are one line that names the file.
pub fn check_message(error: &dyn std::error::Error, name: &str) {
    let message = error.to_string();
    assert!(!message.contains('\n'), "{message:?}");
    assert!(message.contains(name), "{message:?}");
}
