//! Opens bytes as `metrics.jsonl`, resumes from it, and damages one line.
#![no_main]

use std::fs;
use std::path::PathBuf;
use std::sync::LazyLock;

use demc_fuzz::scratch;
use demc_train::record::metrics_log::{self, MetricsLine, MetricsLog, StoredLines, read_lines};
use libfuzzer_sys::fuzz_target;
use serde::Deserialize;
use serde_json::Value;

static LOG: LazyLock<PathBuf> = LazyLock::new(|| scratch().join("metrics.jsonl"));

/// The key that every line has.
#[derive(Debug, Deserialize, PartialEq)]
struct Step {
    step: u64,
}

fuzz_target!(|bytes: &[u8]| {
    let StoredLines { lines, damaged } = read_lines::<Step>(bytes);
    let complete = bytes.iter().filter(|byte| **byte == b'\n').count();
    assert_eq!(lines.len() + damaged.len(), complete);
    assert!(damaged.is_sorted() && damaged.iter().all(|number| (1..=complete).contains(number)));
    one_damaged_line(&lines);

    let last = lines.iter().map(|(_, line)| line.step).max().unwrap_or(0);
    let middle = lines.get(lines.len() / 2).map_or(0, |(_, line)| line.step);
    for step in [0, middle, last] {
        resume(bytes, &lines, &damaged, step);
    }
});

/// A damaged line between intact ones costs that line alone.
fn one_damaged_line(lines: &[(&[u8], Step)]) {
    let texts: Vec<&[u8]> = lines.iter().map(|(text, _)| *text).collect();
    let (before, after) = texts.split_at(texts.len() / 2);
    for damage in [
        b"\n".as_slice(),
        b"{\"step\":1,\"lo\n",
        b"\xff\xfe\n",
        b"\0\0\n",
    ] {
        let log = [&before.concat(), damage, &after.concat()].concat();
        let found = read_lines::<Step>(&log);
        assert_eq!(found.damaged, [before.len() + 1]);
        assert!(
            found
                .lines
                .iter()
                .map(|(text, _)| *text)
                .eq(texts.iter().copied())
        );
    }
}

/// A session that resumes after `step` keeps the intact lines up to it, and appends.
fn resume(bytes: &[u8], lines: &[(&[u8], Step)], damaged: &[usize], step: u64) {
    fs::write(&*LOG, bytes).expect("writable");
    let mut log = MetricsLog::open(&LOG, step).expect("any bytes are a log");
    assert_eq!(log.damaged(), damaged);
    let kept: Vec<u8> = lines
        .iter()
        .filter(|(_, line)| line.step <= step)
        .flat_map(|(text, _)| *text)
        .copied()
        .collect();
    assert_eq!(fs::read(&*LOG).expect("readable"), kept);
    log.append(&line(step)).expect("writable");
    let stored = fs::read(&*LOG).expect("readable");
    let appended = stored.strip_prefix(kept.as_slice()).expect("only appended");
    let appended: Value = serde_json::from_slice(appended).expect("a line");
    assert_eq!(appended["step"].as_u64(), Some(step));
    assert_eq!(metrics_log::elapsed(&LOG), Some(1.5));
    let again = MetricsLog::open(&LOG, step).expect("its own");
    assert_eq!((again.damaged(), again.was_lost()), ([].as_slice(), false));
    assert_eq!(fs::read(&*LOG).expect("readable"), stored);
}

fn line(step: u64) -> MetricsLine {
    MetricsLine {
        step,
        epoch: 0.5,
        loss: f64::NAN,
        lr: 1e-4,
        grad_norm: 2.0,
        valid_relmse: Some(0.1),
        valid_ssim: None,
        dead_channels: Some(3),
        zero_share: None,
        dormant: None,
        skipped: 1,
        patches_per_s: 9.0,
        elapsed_s: 1.5,
    }
}
