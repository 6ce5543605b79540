//! The subcommands find-lr, ablate and plot.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use crate::common::{config, copy_sample, error_line, metrics, says, stderr, trained};

fn run(args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_demc-train"));
    command.args(args).output().expect("the binary runs")
}

fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

fn stdout(output: &Output) -> String {
    assert!(output.status.success(), "{}", stderr(output));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn ablation(dir: &Path) -> std::path::PathBuf {
    let base = config(dir);
    let path = dir.join("ablation.toml");
    let text = format!(
        "base = {base:?}\ndir = {:?}\nseeds = [1, 2]\n\
         set = [\"train.steps=4\", \"model.width=4\", \"model.reading=paper\", \"run.checkpoint_every=1\"]\n\
         [[variants]]\nname = \"DEMC\"\n\
         [[variants]]\nname = \"SEMC\"\nset = [\"model.variant=semc\"]\n\
         [[variants]]\nname = \"color-only\"\nset = [\"model.variant=color-only\"]\n",
        dir.join("ablation")
    );
    fs::write(&path, text).expect("a file");
    path
}

fn finished_runs(dir: &Path) -> usize {
    let runs = fs::read_dir(dir).into_iter().flatten().flatten();
    runs.filter(|run| run.path().join("test.json").exists())
        .count()
}

#[test]
fn an_ablation_resumes_and_writes_table_and_figure() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let spec = ablation(dir.path());
    let out = dir.path().join("ablation");
    let args = ["ablate", "--config", text(&spec)];

    let mut first = Command::new(env!("CARGO_BIN_EXE_demc-train"))
        .args(args)
        .stdout(Stdio::null())
        .spawn()
        .expect("the binary runs");
    let started = Instant::now();
    while finished_runs(&out) < 2 {
        assert!(started.elapsed() < Duration::from_secs(300), "no progress");
        std::thread::sleep(Duration::from_millis(5));
    }
    first.kill().expect("a child");
    first.wait().expect("a child");
    let before = fs::read(out.join("DEMC-seed-1/metrics.jsonl")).expect("a log");

    let said = stdout(&run(&args));
    assert!(said.contains("DEMC, seed 1 (1 of 6): complete"), "{said}");
    let after = fs::read(out.join("DEMC-seed-1/metrics.jsonl")).expect("a log");
    assert_eq!(before, after, "a complete run is not trained again");
    assert_eq!(finished_runs(&out), 6);
    let table = fs::read_to_string(out.join("ablation.md")).expect("a table");
    assert!(said.contains(&table), "{said}");
    for words in [
        "| DEMC | 4 | ",
        "| SEMC | 5 | ",
        "| color-only | ",
        "4 test images of 4 base scenes, 2 seeds (1, 2).",
        "- color-only against DEMC: no difference shown in RelMSE (",
        "Fewer than 6 base scenes cannot show a difference.",
        "the same batches in the same order",
    ] {
        assert!(table.contains(words), "{words}: {table}");
    }
    // The mean of the table is the geometric mean of the runs' scores, and of the rows.
    let json = |path: &Path| -> serde_json::Value {
        serde_json::from_slice(&fs::read(path).expect("a file")).expect("JSON")
    };
    let row = &json(&out.join("ablation.json"))["rows"][0];
    let logs = [1, 2].map(|seed| {
        let report = json(&out.join(format!("DEMC-seed-{seed}/test.json")));
        let images = report["images"].as_array().expect("images").iter();
        let errors = images.map(|image| image["denoised"]["relmse"].as_f64().expect("a score"));
        errors.map(f64::ln).sum::<f64>() / 4.0
    });
    let mean = row["relmse"]["mean"].as_f64().expect("a mean");
    assert!((mean - ((logs[0] + logs[1]) / 2.0).exp()).abs() < 1e-12);
    assert!(logs[0] != logs[1], "seeds differ");

    let other = error_line(
        &run(&[&args[..], &["--set=optimizer.lr_start=0.5"]].concat()),
        1,
    );
    says(&other, "optimizer.lr_start: 0.5 instead of 0.001");
    says(&other, "undo the edit, or name another directory");
}

/// The rows of `results.csv` of a run.
fn rows(out: &Path, run: &str) -> usize {
    let text = fs::read_to_string(out.join("results.csv")).unwrap_or_default();
    let start = run.replace("-seed-", ",") + ",";
    text.lines().filter(|line| line.starts_with(&start)).count()
}

#[test]
fn an_ablation_resumes_from_its_results_and_remakes_its_tables() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let spec = ablation(dir.path());
    let out = dir.path().join("ablation");
    let args = ["ablate", "--config", text(&spec)];
    stdout(&run(&args));
    let results = out.join("results.csv");
    let complete = fs::read_to_string(&results).expect("results");
    // Four images with RelMSE and SSIM.
    assert_eq!(rows(&out, "DEMC-seed-1"), 8);
    assert_eq!(complete.lines().count(), 1 + 6 * 8);
    let made = ["md", "json", "svg"].map(|ending| out.join(format!("ablation.{ending}")));
    let contents = made.each_ref().map(|path| fs::read(path).expect("a table"));

    // Cut: a run without its rows is trained again, one with its rows is not.
    for name in ["DEMC-seed-1", "SEMC-seed-2"] {
        fs::remove_dir_all(out.join(name)).expect("a run");
    }
    let is_kept = |line: &&str| !line.starts_with("SEMC,2,");
    let cut: Vec<&str> = complete.lines().filter(is_kept).collect();
    fs::write(&results, cut.join("\n") + "\n").expect("results");
    assert_eq!(rows(&out, "SEMC-seed-2"), 0);
    let said = stdout(&run(&args));
    says(&said, "DEMC, seed 1 (1 of 6): complete in");
    says(&said, "results.csv");
    assert!(!out.join("DEMC-seed-1").exists(), "its rows are enough");
    assert!(out.join("SEMC-seed-2").exists(), "trained again");
    let values = |text: &str| -> Vec<String> {
        let columns = |line: &str| line.split(',').take(7).collect::<Vec<_>>().join(",");
        text.lines().map(columns).collect()
    };
    let resumed = fs::read_to_string(&results).expect("results");
    assert_eq!(values(&resumed), values(&complete), "the same scores");

    // Rows of another configuration do not count.
    let other = complete.replace(&hash_of(&complete, "DEMC,1,"), "0000000000000000");
    fs::write(&results, other).expect("results");
    let said = stdout(&run(&args));
    assert!(!said.contains("DEMC, seed 1 (1 of 6): complete"), "{said}");
    assert!(out.join("DEMC-seed-1").exists(), "trained again");
    assert_eq!(rows(&out, "DEMC-seed-1"), 8);

    // Nor do runs on other data.
    let data = dir.path().join("data");
    copy_sample(&data);
    let moved = format!("data.root={}", text(&data));
    let said = stdout(&run(&[&args[..], &["--set", &moved]].concat()));
    says(&said, "DEMC, seed 1 (1 of 6): complete in");
    let scenes =
        ["gen-table-test-1.exr", "gen-room-test-1.exr"].map(|name| data.join("test").join(name));
    fs::copy(&scenes[0], &scenes[1]).expect("another image");
    let error = error_line(&run(&[&args[..], &["--set", &moved]].concat()), 1);
    says(
        &error,
        "files of scenes changed since the run started: gen-room-test-1",
    );

    // Nor do runs with another channel layout, neither from their directories nor from the results.
    let layout = ["--set", "data.layout=mitsuba3"];
    let error = error_line(&run(&[&args[..], &layout].concat()), 1);
    says(&error, "data.layout: mitsuba3 instead of demc-exr");
    for entry in fs::read_dir(&out).expect("runs") {
        let path = entry.expect("a run").path();
        if path.is_dir() {
            fs::remove_dir_all(path).expect("a run");
        }
    }
    let error = error_line(&run(&[&args[..], &layout].concat()), 1);
    says(&error, "no channel");

    // The results alone make all tables.
    let alone = dir.path().join("alone");
    fs::create_dir(&alone).expect("a directory");
    fs::write(alone.join("results.csv"), &complete).expect("results");
    let copy = alone.join("results.csv");
    stdout(&run(&["ablate", "--results", text(&copy)]));
    for (path, content) in made.iter().zip(contents) {
        let name = path.file_name().expect("a name");
        assert_eq!(
            fs::read(alone.join(name)).expect("a table"),
            content,
            "{name:?}"
        );
    }
    fs::write(&copy, "nothing\n").expect("results");
    let error = error_line(&run(&["ablate", "--results", text(&copy)]), 1);
    says(
        &error,
        "expected the columns variant,seed,image,base,metric,value",
    );
}

/// The hash of the configuration in the first row that starts with `start`.
fn hash_of(results: &str, start: &str) -> String {
    let mut rows = results.lines().filter(|line| line.starts_with(start));
    let hash = rows.next().and_then(|row| row.split(',').nth(6));
    hash.expect("a hash").to_owned()
}

#[test]
fn invalid_ablations_exit_with_2_and_one_line() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let spec = ablation(dir.path());
    let text_of = fs::read_to_string(&spec).expect("a file");
    fs::write(&spec, text_of.replace("SEMC", "DEMC")).expect("a file");
    let error = error_line(&run(&["ablate", "--config", text(&spec)]), 2);
    assert!(error.contains("`DEMC` is listed twice"), "{error}");
    let error = error_line(&run(&["ablate", "--config", "/nowhere.toml"]), 2);
    assert!(error.contains("/nowhere.toml"), "{error}");
}

#[test]
fn an_ablation_checks_all_initial_weights_first() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let spec = ablation(dir.path());
    let text_of = fs::read_to_string(&spec).expect("a file");
    let set = "\"model.variant=color-only\"";
    let nowhere = format!("{set}, \"train.init=/nowhere.safetensors\"");
    fs::write(&spec, text_of.replace(set, &nowhere)).expect("a file");
    let error = error_line(&run(&["ablate", "--config", text(&spec)]), 1);
    assert!(
        error.contains("color-only") && error.contains("/nowhere.safetensors"),
        "{error}"
    );
    assert!(!dir.path().join("ablation").exists());
}

#[test]
fn a_sweep_suggests_a_rate_and_writes_table_and_chart() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let stem = dir.path().join("new/sweep");
    // Without batch normalisation, with which no step diverges.
    let paper = ["--set=model.reading=paper"];
    let args = ["find-lr", "--config", text(&config), "--out", text(&stem)];
    let args = [&args[..], &paper].concat();
    let said = stdout(&run(&[
        &args[..],
        &["--from", "1e-5", "--to", "1e3", "--steps", "120"],
    ]
    .concat()));
    says(&said, "the loss diverged at a learning rate of ");
    let suggestion = said
        .split("optimizer.lr_start=")
        .nth(1)
        .expect("a suggestion");
    let rate: f64 = suggestion
        .split(',')
        .next()
        .and_then(|s| s.parse().ok())
        .expect("a number");
    let csv = fs::read_to_string(dir.path().join("new/sweep.csv")).expect("a table");
    let rates: Vec<f64> = csv
        .lines()
        .skip(1)
        .map(|line| {
            line.split(',')
                .nth(1)
                .and_then(|s| s.parse().ok())
                .expect("a rate")
        })
        .collect();
    assert!(rates.is_sorted() && rates.len() < 120, "{}", rates.len());
    let last = rates.last().expect("a rate");
    assert!(rate > 1e-5 && rate < last / 2.0, "{rate} of {last}");
    assert!(dir.path().join("new/sweep.svg").is_file());
    assert!(
        !dir.path().join("runs").exists(),
        "no run directory is touched"
    );

    let error = error_line(
        &run(&[&args[..], &["--from", "1", "--to", "0.1"]].concat()),
        2,
    );
    assert!(error.contains("expected positive, rising rates"), "{error}");
}

#[test]
fn curves_of_one_and_several_runs_are_drawn() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let runs = ["one", "two"].map(|name| dir.path().join(name));
    for (seed, path) in runs.iter().enumerate() {
        let seed = format!("train.seed={seed}");
        trained(&config, path, &["--set", &seed]);
    }
    assert!(!metrics(&runs[0]).is_empty());
    let stem = dir.path().join("both");
    let said = stdout(&run(&[
        "plot",
        text(&runs[0]),
        text(&runs[1]),
        "--out",
        text(&stem),
    ]));
    assert!(said.contains("both.svg"), "{said}");
    let svg = fs::read_to_string(dir.path().join("both.svg")).expect("a picture");
    for words in [">one<", ">two<", "validation RelMSE"] {
        assert!(svg.replace('\n', "").contains(words), "{words}");
    }
    stdout(&run(&["plot", text(&runs[0])]));
    assert!(runs[0].join("curves.svg").is_file());
    let error = error_line(&run(&["plot", text(dir.path())]), 1);
    assert!(error.contains("metrics.jsonl"), "{error}");
}
