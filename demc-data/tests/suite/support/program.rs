//! The program `demc-data` as a user runs it.

use std::process::{Command, Output};

/// Its path; there is none without the feature `cli`.
const PROGRAM: Option<&str> = option_env!("CARGO_BIN_EXE_demc-data");

/// Runs the program.
pub fn demc_data(args: &[&str]) -> Output {
    let program = PROGRAM.expect("the feature cli");
    Command::new(program)
        .args(args)
        .output()
        .expect("the binary starts")
}

/// The output of a run that succeeds.
pub fn stdout(args: &[&str]) -> String {
    let output = demc_data(args);
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).expect("text")
}

/// The message of a run that ends with this status.
pub fn refusal(args: &[&str], status: i32) -> String {
    let output = demc_data(args);
    let message = String::from_utf8(output.stderr).expect("text");
    assert_eq!(output.status.code(), Some(status), "{message}");
    assert!(message.starts_with("error: "), "{message}");
    message
}
