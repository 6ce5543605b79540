//! Event files of an interrupted and resumed run, read by the `tensorboard` package.
//!
//! Needs a Python interpreter with `tensorboard` (without TensorFlow), named by `DEMC_PYTHON`.
//! Without one the test is skipped, or fails with `DEMC_REQUIRE_TENSORBOARD=1`.

use std::fmt::Write as _;
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output};

use demc_train::record::tensorboard::EventFile;
use serde_json::{Value, json};

/// Reads a directory of event files and prints its contents.
const READER: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/tests/suite/tensorboard_read.py"
);
/// Markdown with characters that need care.
const CONFIG: &str = "## Größe\n\n```toml\nwidth = 64\n```\n";

#[test]
fn tensorboard_reads_a_resumed_run_like_an_uninterrupted_one() {
    let python = match python_with_tensorboard() {
        Ok(python) => python,
        Err(reason) => {
            assert!(
                std::env::var("DEMC_REQUIRE_TENSORBOARD").as_deref() != Ok("1"),
                "DEMC_REQUIRE_TENSORBOARD=1, but {reason}"
            );
            // Not `println!`, which the test harness swallows.
            writeln!(std::io::stderr(), "skipped: {reason}").expect("stderr can be written");
            return;
        }
    };
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run/tensorboard");
    let early = png(5, 3);
    let late = png(4, 7);
    write_until_the_crash(&run, &early).expect("the first session is written");
    tear_the_last_record(&run);
    write_from_the_checkpoint(&run, &late).expect("the second session is written");

    let read = read(&python, &run);
    let expected = json!({
        "scalars": {
            "loss": [[1, 0.5], [2, 1.0], [3, 1.5], [4, 2.0], [5, 105.0], [6, 106.0], [7, "nan"], [8, "inf"]],
            "lr": [[1, 0.25], [2, 0.25], [3, 0.25], [4, 0.25], [5, 0.125], [6, 0.125], [7, 0.125], [8, 0.125]],
            // The value of step 6 is dropped: the resumed run has none.
            "valid/relmse": [[4, 0.0]],
        },
        "images": { "strip": [[4, 5, 3, hex(&early)], [8, 4, 7, hex(&late)]] },
        "text": { "config": [[0, CONFIG]] },
    });
    assert_eq!(read["classic"], expected);
    assert_eq!(read["plugin"], expected);
}

fn write_until_the_crash(run: &Path, strip: &[u8]) -> anyhow::Result<()> {
    let mut events = EventFile::open(run, 0)?;
    events.text(0, "config", CONFIG)?;
    for step in 1..=6 {
        events.scalars(step, &[("loss", 0.5 * step as f64), ("lr", 0.25)])?;
    }
    for step in [4, 6] {
        events.scalars(step, &[("valid/relmse", step as f64 - 4.0)])?;
        events.image(step, "strip", 5, 3, strip)?;
    }
    Ok(())
}

/// Appends an incomplete record, as after a crash.
fn tear_the_last_record(run: &Path) {
    let mut files = fs::read_dir(run).expect("a directory");
    let file = files.next().expect("a file").expect("its entry").path();
    let bytes = fs::read(&file).expect("an event file");
    let torn = &bytes[..20];
    let file = OpenOptions::new().append(true).open(&file);
    let written = file.and_then(|mut file| file.write_all(torn));
    written.expect("an event file that can be written");
}

/// Writes steps five to eight, with values that differ from the first session.
fn write_from_the_checkpoint(run: &Path, strip: &[u8]) -> anyhow::Result<()> {
    let mut events = EventFile::open(run, 4)?;
    for (step, loss) in [(5, 105.0), (6, 106.0), (7, f64::NAN), (8, f64::INFINITY)] {
        events.scalars(step, &[("loss", loss), ("lr", 0.125)])?;
    }
    events.image(8, "strip", 4, 7, strip)
}

fn png(width: u32, height: u32) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, width, height);
    encoder.set_color(png::ColorType::Rgb);
    let pixels: Vec<u8> = (0..3 * width * height).map(|i| i as u8).collect();
    let mut writer = encoder.write_header().expect("a header");
    writer.write_image_data(&pixels).expect("as many pixels");
    writer.finish().expect("memory is never full");
    file
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").expect("memory is never full");
        text
    })
}

fn read(python: &str, run: &Path) -> Value {
    let output =
        run_python(python, [READER.as_ref(), run.as_os_str()]).expect("Python, which ran before");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    serde_json::from_slice(&output.stdout).expect("JSON")
}

fn python_with_tensorboard() -> Result<String, String> {
    let python = std::env::var("DEMC_PYTHON").map_err(|_| "DEMC_PYTHON is not set".to_string())?;
    let output = run_python(&python, ["-c".as_ref(), "import tensorboard".as_ref()])
        .map_err(|error| format!("{python} does not run: {error}"))?;
    let stderr = String::from_utf8_lossy(&output.stderr);
    let last = stderr.lines().last().unwrap_or_default();
    if output.status.success() {
        Ok(python)
    } else {
        Err(format!(
            "{python} cannot import tensorboard (pip install tensorboard): {last}"
        ))
    }
}

fn run_python<const N: usize>(
    python: &str,
    arguments: [&std::ffi::OsStr; N],
) -> std::io::Result<Output> {
    Command::new(python).args(arguments).output()
}
