//! Tests of `demc-infer evaluate` and `report` with baselines.

use std::fs;
use std::path::{Path, PathBuf};

use crate::arguments;
use crate::common::{demc_infer, run_directory, sample};
use demc_data::{ChannelLayout, SamplePrecision, read_frame, write_rgb};
use demc_model::metrics::METRICS;
use serde_json::Value;

const SCENES: [&str; 4] = [
    "col-classroom-1",
    "col-dining-room-1",
    "gen-room-test-1",
    "gen-table-test-1",
];

/// A directory with one image per scene: the reference with `change` applied to each value.
fn images(dir: &Path, name: &str, change: impl Fn(f32) -> f32) -> PathBuf {
    let out = dir.join(name);
    fs::create_dir(&out).expect("directory");
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    for scene in SCENES {
        let frame =
            read_frame(&sample().join(format!("test/{scene}.exr")), &layout).expect("a scene");
        let planes: Vec<f32> = frame
            .reference
            .iter()
            .flatten()
            .map(|x| change(*x))
            .collect();
        let path = out.join(format!("{scene}.exr"));
        write_rgb(
            &path,
            frame.width,
            frame.height,
            &planes,
            SamplePrecision::Float,
        )
        .expect("written");
    }
    out
}

#[test]
fn baselines_are_scored_beside_the_model_and_compared_with_it() {
    let run = run_directory();
    let perfect = images(run.path(), "perfect", |x| x);
    let bright = images(run.path(), "bright", |x| 1.5 * x);
    let file = run.path().join("scores.json");
    let (a, b) = (
        format!("perfect={}", perfect.display()),
        format!("bright={}", bright.display()),
    );
    let outcome = demc_infer(arguments![
        "evaluate",
        "--model",
        run.path(),
        "--data",
        sample(),
        "--baseline",
        a,
        "--baseline",
        b,
        "--metrics",
        "smape,energy-bias",
        "--json",
        file
    ])
    .success();
    let json: Value = serde_json::from_slice(&fs::read(&file).expect("file")).expect("JSON");
    let mean = &json["mean"]["baselines"];
    assert_eq!(mean["perfect"]["relmse"], 0.0);
    assert_eq!(mean["perfect"]["psnr"], Value::Null);
    let bias = mean["bright"]["energy-bias"].as_f64().expect("number");
    assert!((bias - 0.5).abs() < 1e-6, "{bias}");
    let differences = json["differences"].as_array().expect("array");
    let of = |against: &str, metric: &str| {
        differences
            .iter()
            .find(|d| d["against"] == against && d["metric"] == metric)
            .expect("a difference")
    };
    let found = of("perfect", "relmse");
    assert_eq!(found["scale"], "ratio");
    assert!(found["mean"].as_f64().expect("number") > 100.0);
    // Four base scenes: the sign-flip test cannot claim a difference.
    assert_eq!(
        (&found["images"], &found["bases"], &found["claimed"]),
        (&4.into(), &4.into(), &false.into())
    );
    assert_eq!(found["p_sign_flip"], 0.125);
    assert!(differences.iter().all(|d| d["against"] != "noisy"));
    for words in [
        "smape noisy",
        "bright",
        "denoised against perfect, 4 images of 4 base scenes: no difference shown in relmse (+",
        "no difference shown in smape",
        "fewer than 6 base scenes cannot show a difference",
    ] {
        assert!(
            outcome.stdout.contains(words),
            "{words}: {}",
            outcome.stdout
        );
    }
}

#[test]
fn missing_images_and_other_sizes_are_named_before_anything_is_computed() {
    let run = run_directory();
    let dir = images(run.path(), "other", |x| x);
    for scene in &SCENES[1..3] {
        fs::remove_file(dir.join(format!("{scene}.exr"))).expect("removed");
    }
    let baseline = format!("other={}", dir.display());
    let list = |verb: &str| {
        let mut list = arguments![
            verb,
            "--model",
            run.path(),
            "--data",
            sample(),
            "--baseline",
            baseline
        ]
        .to_vec();
        if verb == "report" {
            list.extend(arguments!["-o", run.path().join("page.html")]);
        }
        list
    };
    for verb in ["evaluate", "report"] {
        let outcome = demc_infer(list(verb)).failure(1, "baseline other: missing ");
        for scene in &SCENES[1..3] {
            assert!(
                outcome.stderr.contains(&format!("{scene}.exr")),
                "{}",
                outcome.stderr
            );
        }
        assert!(!outcome.stderr.contains(SCENES[0]), "{}", outcome.stderr);
    }
    assert!(!run.path().join("page.html").exists());
    for scene in &SCENES[1..3] {
        let path = dir.join(format!("{scene}.exr"));
        write_rgb(&path, 2, 3, &[1.0; 18], SamplePrecision::Half).expect("written");
    }
    let outcome = demc_infer(list("evaluate"));
    assert_eq!(outcome.code, 1, "{}", outcome.stderr);
    outcome.says("col-dining-room-1.exr: is 2x3, but the scene is ");
    outcome.says("error: 2 of 4 scenes were not scored\n");
}

#[test]
fn invalid_flags_are_exit_code_2() {
    let ask = |flag: &str, value: &str| {
        demc_infer(arguments!["evaluate", "--data", sample(), flag, value])
    };
    ask("--metrics", "smape,mse").failure(2, "--metrics: unknown metric \"mse\"; known: relmse, ");
    ask("--baseline", "noisy=x").failure(2, "--baseline noisy: ");
    let outcome = ask("--baseline", "x");
    assert_eq!(outcome.code, 2, "{}", outcome.stderr);
}

#[test]
fn a_report_is_one_file_with_the_numbers_of_evaluate() {
    let run = run_directory();
    let page = run.path().join("page.html");
    let model = run.path();
    let list = arguments!["report", "--model", model, "--data", sample(), "-o", page];
    let outcome = demc_infer(list).success();
    outcome.says("4 images");
    let list = arguments![
        "evaluate",
        "--model",
        model,
        "--data",
        sample(),
        "--json",
        "-"
    ];
    let expected = demc_infer(list).success().stdout;
    let expected: Value = serde_json::from_str(&expected).expect("JSON");

    let html = fs::read_to_string(&page).expect("a page");
    let json = |id: &str| -> Value {
        let start = format!("id=\"{id}\">");
        let from = html.find(&start).expect("an element") + start.len();
        let to = from + html[from..].find("</script").expect("an end");
        serde_json::from_str(&html[from..to]).expect("JSON")
    };
    let data = json("data");
    for metric in METRICS {
        let name = metric.name;
        assert_eq!(
            data["mean"]["denoised"][name],
            expected["mean"]["denoised"][name]
        );
    }
    for (i, scene) in SCENES.iter().enumerate() {
        assert_eq!(data["images"][i]["name"], *scene);
        let pictures = json(&format!("pictures-{i}"));
        for name in ["noisy", "denoised", "reference"] {
            let url = pictures["pictures"][name].as_str().expect("an address");
            assert!(url.starts_with("data:image/jpeg;base64,/9j/"), "{name}");
        }
        assert_eq!(pictures["patches"].as_array().map(Vec::len), Some(2));
    }
    for outside in ["http://", "https://", "src=\"", "@import"] {
        let found = html.replace("http://www.w3.org/2000/svg", "");
        assert!(!found.contains(outside), "{outside}");
    }
}
