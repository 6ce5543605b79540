//! Tests a report in Chromium with `report_browser.py`.
//!
//! `DEMC_PYTHON` names a Python with playwright, `DEMC_CHROMIUM` a Chromium (default: `chromium` on
//! the path). Without `DEMC_PYTHON` the test prints that it is skipped; with
//! `DEMC_REQUIRE_CHROMIUM=1` it fails.

use std::io::Write;
use std::path::Path;
use std::process::Command;

use crate::arguments;
use crate::common::{demc_infer, run_directory, sample, sample_image};

#[test]
fn a_report_works_in_a_browser() {
    let Some(python) = std::env::var_os("DEMC_PYTHON") else {
        assert!(
            std::env::var("DEMC_REQUIRE_CHROMIUM").as_deref() != Ok("1"),
            "DEMC_REQUIRE_CHROMIUM=1, but DEMC_PYTHON is not set"
        );
        // The test harness would hide the output of `println!`.
        writeln!(std::io::stderr(), "skipped: DEMC_PYTHON is not set").expect("stderr");
        return;
    };
    let run = run_directory();
    let others = run.path().join("others");
    let images = [
        "col-classroom-1",
        "col-dining-room-1",
        "gen-room-test-1",
        "gen-table-test-1",
    ]
    .map(|name| sample_image(&format!("{name}.exr")).into_os_string());
    let mut list = arguments!["denoise", "-o", others].to_vec();
    list.extend(images);
    demc_infer(list).success();
    let file = run.path().join("report.html");
    let baseline = format!("</script><b>\"other\"={}", others.display());
    demc_infer(arguments![
        "report",
        "--model",
        run.path(),
        "--data",
        sample(),
        "--baseline",
        baseline,
        "-o",
        file
    ])
    .success();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/suite/report_browser.py");
    let output = Command::new(&python)
        .arg(script)
        .arg(&file)
        .output()
        .expect("DEMC_PYTHON runs");
    assert!(
        output.status.success(),
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
}
