//! A disk that fills at any moment: the error names it, and the run resumes once there is space.
//!
//! Uses a tmpfs in a new mount namespace, which needs `unshare` and permission. Without them the
//! test is skipped, or fails with `DEMC_REQUIRE_TMPFS=1`.
#![cfg(target_os = "linux")]

use std::fs;
use std::path::Path;
use std::process::Command;

use crate::common::{assert_same_run, config, stderr, trained};

/// Trains on a disk of `$SIZE` KiB until it is full, resumes on a larger one, and copies the run to
/// `$OUT`.
const SCRIPT: &str = r#"
set -u
mount -t tmpfs -o size="${SIZE}k" tmpfs "$DISK" || exit 99
"$BINARY" --config "$CONFIG" --run-dir "$DISK/run" --set run.checkpoint_every=1 > "$OUT.log" 2> "$OUT.error"
echo $? > "$OUT.code"
mount -o remount,size=1g "$DISK" || exit 99
"$BINARY" --config "$CONFIG" --run-dir "$DISK/run" --set run.checkpoint_every=1 --resume >> "$OUT.log" || exit 98
cp -r "$DISK/run" "$OUT"
"#;

/// A shell in a new mount namespace.
fn shell(script: &str) -> Command {
    let root =
        fs::metadata("/proc/self").is_ok_and(|own| std::os::unix::fs::MetadataExt::uid(&own) == 0);
    let mut command = Command::new("unshare");
    command.arg(if root { "-m" } else { "-rm" });
    command.args(["sh", "-c", script]);
    command
}

fn may_mount(dir: &Path) -> bool {
    let script = format!("mount -t tmpfs -o size=64k tmpfs '{}'", dir.display());
    shell(&script)
        .output()
        .is_ok_and(|output| output.status.success())
}

#[test]
fn a_run_on_a_full_disk_resumes_once_there_is_space() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let disk = dir.path().join("disk");
    fs::create_dir(&disk).expect("a directory");
    if !may_mount(&disk) {
        assert!(
            std::env::var_os("DEMC_REQUIRE_TMPFS").is_none(),
            "DEMC_REQUIRE_TMPFS=1, but no tmpfs can be mounted"
        );
        println!("skipped: no tmpfs can be mounted here");
        return;
    }
    let config = config(dir.path());
    let whole = dir.path().join("whole");
    trained(&config, &whole, &["--set=run.checkpoint_every=1"]);

    let mut stops = Vec::new();
    for size in [4, 64, 500, 900, 1300, 1700, 2100, 2500, 2900, 3300, 3700] {
        let out = dir.path().join(format!("run-{size}"));
        let output = shell(SCRIPT)
            .env("SIZE", size.to_string())
            .env("DISK", &disk)
            .env("OUT", &out)
            .env("BINARY", env!("CARGO_BIN_EXE_demc-train"))
            .env("CONFIG", &config)
            .output()
            .expect("unshare");
        let read = |ending: &str| {
            let path = out.with_extension(ending);
            fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
        };
        assert!(
            output.status.success(),
            "{size} KiB: {:?}: {}",
            output.status,
            stderr(&output)
        );
        let (code, error) = (read("code"), read("error"));
        if code.trim() != "0" {
            assert_eq!(code.trim(), "1", "{size} KiB: {error}");
            assert_eq!(error.lines().count(), 1, "{size} KiB: {error}");
            assert!(
                error.contains("No space left on device") && error.contains("disk/run"),
                "{size} KiB: {error}"
            );
            let log = read("log");
            let steps = log.lines().filter(|line| line.starts_with("step ")).count();
            stops.push((
                size,
                error.trim().replace(&*disk.to_string_lossy(), ""),
                steps,
            ));
        }
        assert_same_run(&whole, &out, &format!("{size} KiB"));
    }
    for (size, error, _) in &stops {
        println!("{size} KiB: {error}");
    }
    let in_checkpoint =
        |(_, error, _): &&(i32, String, usize)| error.contains("the last intact checkpoint is");
    assert!(stops.len() >= 6, "{stops:?}");
    assert!(stops.iter().any(|stop| in_checkpoint(&stop)), "{stops:?}");
}
