//! Ctrl-C, SIGTERM, SIGHUP and SIGKILL at any moment: nothing is lost.
#![cfg(unix)]

mod common;

use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus, Stdio};
use std::time::Instant;

use common::{assert_same_run, command, config, metrics, stderr, train, wait_until};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rustix::process::{Pid, Signal, kill_process};

/// How often runs are killed.
const KILLS: usize = 40;
/// A checkpoint each step: most of the time goes into writing them.
const EVERY_STEP: [&str; 2] = ["--set", "run.checkpoint_every=1"];

fn send(child: &Child, signal: Signal) {
    let pid = Pid::from_child(child);
    kill_process(pid, signal).expect("a child that was not waited for");
}

fn start(config: &Path, run: &Path, args: &[&str]) -> Child {
    command(config, run, args)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the binary runs")
}

/// Waits until the log has a line.
fn wait_for_a_line(child: &mut Child, run: &Path) {
    wait_until(|| {
        assert!(child.try_wait().expect("a child").is_none(), "it ended");
        !metrics(run).is_empty()
    });
}

/// The newest checkpoint's step.
fn newest(run: &Path) -> Option<u64> {
    let names = std::fs::read_dir(run.join("checkpoints")).ok()?;
    let names = names.map(|entry| entry.expect("an entry").file_name());
    let steps = names.filter_map(|name| name.to_string_lossy().strip_prefix("step-")?.parse().ok());
    steps.max()
}

fn signal_of(status: ExitStatus) -> Option<i32> {
    std::os::unix::process::ExitStatusExt::signal(&status)
}

/// Runs are killed at random moments, by random signals, until they end nevertheless.
#[test]
fn runs_killed_dozens_of_times_end_like_one_that_never_was() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let whole = dir.path().join("whole");
    let started = Instant::now();
    let output = train(&config, &whole, &EVERY_STEP);
    assert!(output.status.success(), "{}", stderr(&output));
    let duration = started.elapsed();

    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let signals = [
        Signal::KILL,
        Signal::KILL,
        Signal::TERM,
        Signal::INT,
        Signal::HUP,
    ];
    let args = [&EVERY_STEP[..], &["--resume"]].concat();
    let (mut kills, mut saved, mut runs) = (0, 0, 0);
    while kills < KILLS {
        let run: PathBuf = dir.path().join(format!("run-{runs}"));
        runs += 1;
        loop {
            let mut child = start(&config, &run, &args);
            std::thread::sleep(duration.mul_f64(rng.random_range(0.1..0.6)));
            let signal = signals[rng.random_range(0..signals.len())];
            let alive = child.try_wait().expect("a child").is_none();
            if alive {
                send(&child, signal);
                kills += 1;
            }
            let output = child.wait_with_output().expect("a child");
            let code = output.status.code();
            // Killed at once, stopped with everything saved, or done before the signal came.
            let known = [Some(0), Some(128 + signal.as_raw())].contains(&code)
                || (alive && signal_of(output.status) == Some(signal.as_raw()));
            assert!(
                known,
                "{signal:?}: {:?}: {}",
                output.status,
                stderr(&output)
            );
            saved += usize::from(alive && code == Some(128 + signal.as_raw()));
            if code == Some(0) {
                break;
            }
        }
        assert_same_run(
            &whole,
            &run,
            &format!("run {runs} after {kills} kills in all"),
        );
    }
    println!("{kills} kills over {runs} runs, {saved} of them with everything saved");
}

#[test]
fn the_first_signal_saves_and_stops() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    for (signal, name) in [
        (Signal::INT, "SIGINT"),
        (Signal::TERM, "SIGTERM"),
        (Signal::HUP, "SIGHUP"),
    ] {
        let run = dir.path().join(name);
        // No checkpoint but the signal's.
        let long = [
            "--set",
            "train.steps=100000",
            "--set",
            "run.checkpoint_every=100000",
        ];
        let mut child = start(&config, &run, &long);
        wait_for_a_line(&mut child, &run);
        send(&child, signal);
        let output = child.wait_with_output().expect("a child");
        assert_eq!(output.status.code(), Some(128 + signal.as_raw()));
        let text = String::from_utf8_lossy(&output.stdout);
        let step = newest(&run).expect("a checkpoint");
        let words = format!("{name}: stopped after step {step}, everything is saved");
        assert!(text.contains(&words), "{words}: {text}");
        assert_eq!(stderr(&output), "");
    }
}

/// Steps take seconds here: the second signal waits neither for the one under way nor for a checkpoint.
#[test]
fn the_second_signal_stops_at_once() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let run = dir.path().join("run");
    let long = [
        "--set",
        "train.steps=100000",
        "--set",
        "run.checkpoint_every=100000",
        "--set",
        "train.grad_accumulation=300",
        "--set",
        "run.log_every=1",
    ];
    let mut child = start(&config, &run, &long);
    wait_for_a_line(&mut child, &run);
    for signal in [Signal::STOP, Signal::INT, Signal::TERM, Signal::CONT] {
        send(&child, signal);
    }
    let output = child.wait_with_output().expect("a child");
    // The system decides which of the two comes second.
    let codes = [Signal::INT, Signal::TERM].map(|signal| Some(128 + signal.as_raw()));
    assert!(codes.contains(&output.status.code()), "{:?}", output.status);
    assert_eq!(newest(&run), None);
}

/// A checkpoint is due by the clock, whatever the steps.
#[test]
fn minutes_make_checkpoints_too() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run");
    // A hundredth of a second.
    let sets = [
        "--set",
        "run.checkpoint_every=1000",
        "--set",
        "run.checkpoint_minutes=0.00016",
        "--set",
        "run.keep=100",
    ];
    let output = train(&config(dir.path()), &run, &sets);
    assert!(output.status.success(), "{}", stderr(&output));
    let count = std::fs::read_dir(run.join("checkpoints"))
        .expect("checkpoints")
        .count();
    assert!(count > 3, "{count}");
}
