//! Tests in a process of their own, because they count everything that their process allocates.

use std::process::Command;

/// Names the test that runs alone in this process.
const VARIABLE: &str = "DEMC_TEST_ALONE";

/// Runs `check`, the body of the test `name`, in a process without other tests.
///
/// # Panics
/// If `check` fails, with its output.
pub fn run_alone(name: &str, check: impl FnOnce()) {
    if std::env::var(VARIABLE).is_ok_and(|alone| alone == name) {
        return check();
    }
    let program = std::env::current_exe().expect("this program");
    let output = Command::new(program)
        .args(["--exact", name, "--nocapture"])
        .env(VARIABLE, name)
        .output()
        .expect("this program starts");
    let text = String::from_utf8_lossy(&output.stdout);
    print!("{text}{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{name} fails in its own process");
    assert!(
        text.contains("1 passed"),
        "{name} is not the name of a test"
    );
}
