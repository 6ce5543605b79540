//! Ctrl-C, SIGTERM, SIGHUP and SIGKILL at any moment lose nothing.
#![cfg(unix)]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use crate::common::{
    assert_same_run, command, config, metrics, place, stderr, trained, wait_until,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use signal_hook::consts::{SIGHUP, SIGINT, SIGKILL, SIGTERM};

const KILLS: usize = 40;
/// A checkpoint after each step, so that most of the time is spent on writing.
const EVERY_STEP: [&str; 1] = ["--set=run.checkpoint_every=1"];

fn send(child: &Child, signal: i32) {
    let status = Command::new("kill")
        .args([format!("-{signal}"), child.id().to_string()])
        .status();
    assert!(status.expect("kill runs").success(), "signal {signal}");
}

fn start(config: &Path, run: &Path, args: &[&str]) -> Child {
    command(config, run, args)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the binary runs")
}

fn wait_for_a_line(child: &mut Child, run: &Path) {
    wait_until(|| {
        assert!(child.try_wait().expect("a child").is_none(), "it ended");
        !metrics(run).is_empty()
    });
}

fn newest(run: &Path) -> Option<u64> {
    let names = std::fs::read_dir(run.join("checkpoints"))
        .ok()?
        .map(|entry| entry.expect("an entry").file_name());
    let steps = names.filter_map(|name| name.to_string_lossy().strip_prefix("step-")?.parse().ok());
    steps.max()
}

fn signal_of(status: ExitStatus) -> Option<i32> {
    std::os::unix::process::ExitStatusExt::signal(&status)
}

#[test]
fn runs_killed_dozens_of_times_equal_an_uninterrupted_one() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let whole = dir.path().join("whole");
    let started = Instant::now();
    trained(&config, &whole, &EVERY_STEP);
    let duration = started.elapsed();

    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let signals = [SIGKILL, SIGKILL, SIGTERM, SIGINT, SIGHUP];
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
            // Killed at once, stopped with everything saved, or complete before the signal.
            let known = [Some(0), Some(128 + signal)].contains(&code)
                || (alive && signal_of(output.status) == Some(signal));
            assert!(known, "{signal}: {:?}: {}", output.status, stderr(&output));
            saved += usize::from(alive && code == Some(128 + signal));
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
fn the_first_signal_saves_a_checkpoint_and_stops() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    for (signal, name) in [(SIGINT, "SIGINT"), (SIGTERM, "SIGTERM"), (SIGHUP, "SIGHUP")] {
        let run = dir.path().join(name);
        // The only checkpoint is that of the signal.
        let long = [
            "--set=train.steps=100000",
            "--set=run.checkpoint_every=100000",
        ];
        let mut child = start(&config, &run, &long);
        wait_for_a_line(&mut child, &run);
        send(&child, signal);
        let output = child.wait_with_output().expect("a child");
        assert_eq!(output.status.code(), Some(128 + signal));
        let text = String::from_utf8_lossy(&output.stdout);
        let step = newest(&run).expect("a checkpoint");
        let words = format!("{name}: stopped after step {step}, everything is saved");
        assert!(text.contains(&words), "{words}: {text}");
        assert_eq!(stderr(&output), "");
    }
}

/// Steps take seconds here. The second signal waits neither for the current step nor for a
/// checkpoint.
#[test]
fn the_second_signal_stops_at_once() {
    let (_dir, config, run) = place();
    let long = [
        "--set=train.steps=100000",
        "--set=run.checkpoint_every=100000",
        "--set=train.grad_accumulation=300",
        "--set=run.log_every=1",
    ];
    let mut child = start(&config, &run, &long);
    wait_for_a_line(&mut child, &run);
    send(&child, SIGINT);
    // Two signals within microseconds may reach two threads, and both count as the first.
    std::thread::sleep(Duration::from_millis(200));
    send(&child, SIGTERM);
    let output = child.wait_with_output().expect("a child");
    assert_eq!(output.status.code(), Some(128 + SIGTERM));
    assert_eq!(newest(&run), None);
}

#[test]
fn checkpoint_minutes_write_checkpoints() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run");
    // A hundredth of a second.
    let sets = [
        "--set=run.checkpoint_every=1000",
        "--set=run.checkpoint_minutes=0.00016",
        "--set=run.keep=100",
    ];
    trained(&config(dir.path()), &run, &sets);
    let count = std::fs::read_dir(run.join("checkpoints"))
        .expect("checkpoints")
        .count();
    assert!(count > 3, "{count}");
}
