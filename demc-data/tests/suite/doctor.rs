//! Damaged copies of sample scenes, and what `demc_data::check::doctor` finds in them.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use crate::support::{sample, write};
use demc_data::check::doctor::{Report, examine};
use demc_data::image::exr::ExrFile;
use exr::prelude::FlatSamples;
use serde_json::{Value, json};

const SIDE: usize = 224;
const PIXELS: usize = SIDE * SIDE;
const COLOR: [&str; 3] = ["R", "G", "B"];
const REFERENCE: [&str; 3] = ["ref.R", "ref.G", "ref.B"];
const NORMAL: [&str; 3] = ["normal.X", "normal.Y", "normal.Z"];
const POSITION: [&str; 3] = ["position.X", "position.Y", "position.Z"];
const ALBEDO: [&str; 3] = ["albedo1.R", "albedo1.G", "albedo1.B"];

/// The channels of a scene.
type Planes = BTreeMap<String, Vec<f32>>;

fn planes(name: &str) -> Planes {
    let mut file = ExrFile::open(&sample().join(format!("train/{name}.exr"))).expect("a scene");
    let names: Vec<String> = file.channels().iter().map(|c| c.name.clone()).collect();
    let read: Vec<&str> = names.iter().map(String::as_str).collect();
    let planes = file.read(&read).expect("sound");
    let samples = planes.iter().map(|plane| plane.to_f32());
    names.iter().cloned().zip(samples).collect()
}

fn save(path: &Path, planes: Planes) {
    let channels = planes
        .into_iter()
        .map(|(name, samples)| (name, FlatSamples::F32(samples)))
        .collect();
    write(path, (SIDE, SIDE), channels);
}

fn entry(name: &str, split: &str) -> Value {
    let file = format!("{name}.exr");
    json!({"name": name, "split": split, "base": name, "file": file, "width": SIDE, "height": SIDE})
}

/// Three scenes: `good` and `bad` for training, `other` for tests.
struct Set {
    dir: tempfile::TempDir,
    scenes: Vec<Value>,
}

impl Set {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a temporary directory");
        for (name, scene) in [
            ("good", "col-spaceship-0"),
            ("bad", "gen-room-train-0"),
            ("other", "gen-table-train-8"),
        ] {
            let from = sample().join(format!("train/{scene}.exr"));
            fs::copy(from, dir.path().join(format!("{name}.exr"))).expect("copied");
        }
        let scenes = vec![
            entry("good", "train"),
            entry("bad", "train"),
            entry("other", "test"),
        ];
        Self { dir, scenes }
    }

    /// The set with another `bad`.
    fn damaged(damage: impl FnOnce(&mut Planes)) -> Self {
        let set = Self::new();
        let mut planes = planes("gen-room-train-0");
        damage(&mut planes);
        save(&set.path("bad.exr"), planes);
        set
    }

    fn path(&self, file: &str) -> std::path::PathBuf {
        self.dir.path().join(file)
    }

    fn examine(&self) -> Report {
        let manifest = json!({"format": "demc-exr 1", "scenes": self.scenes});
        fs::write(self.path("manifest.json"), manifest.to_string()).expect("writable");
        examine(self.dir.path(), None, 128).unwrap_or_else(|error| panic!("{error}"))
    }

    /// Checks that there is one problem, that it starts with `problem`, and that `scene` has it.
    fn has(&self, problem: &str, scene: &str) -> String {
        let report = self.examine();
        let [found] = &report.problems[..] else {
            panic!("one problem, {problem}: {:#?}", report.problems)
        };
        assert!(
            found.problem.starts_with(problem),
            "{found:#?}, not {problem}"
        );
        assert_eq!(found.scenes[0].scene, scene, "{found:#?}");
        assert_eq!(found.scenes.len(), 1, "{found:#?}");
        format!("{}; {}", found.scenes[0].detail, found.cause)
    }
}

fn each(planes: &mut Planes, names: [&str; 3], change: impl Fn(f32) -> f32) {
    for name in names {
        let plane = planes.get_mut(name).expect("a channel");
        plane.iter_mut().for_each(|x| *x = change(*x));
    }
}

fn copy(planes: &mut Planes, from: [&str; 3], to: [&str; 3]) {
    for (from, to) in from.into_iter().zip(to) {
        planes.insert(to.to_owned(), planes[from].clone());
    }
}

fn swap(planes: &mut Planes, a: [&str; 3], b: [&str; 3]) {
    let before = planes.clone();
    for (a, b) in a.into_iter().zip(b) {
        planes.insert(a.to_owned(), before[b].clone());
        planes.insert(b.to_owned(), before[a].clone());
    }
}

/// The plane `[a, 1 - 2 a, a]` filtered in both directions.
fn filtered(plane: &[f32], a: f32) -> Vec<f32> {
    let at = |x: usize, y: usize| plane[y.min(SIDE - 1) * SIDE + x.min(SIDE - 1)];
    let across =
        |x: usize, y| a * (at(x.saturating_sub(1), y) + at(x + 1, y)) + (1.0 - 2.0 * a) * at(x, y);
    let down = |i: usize| {
        let (x, y) = (i % SIDE, i / SIDE);
        a * (across(x, y.saturating_sub(1)) + across(x, y + 1)) + (1.0 - 2.0 * a) * across(x, y)
    };
    (0..PIXELS).map(down).collect()
}

#[test]
fn the_sample_has_no_problems() {
    let report = examine(&sample(), None, 128).expect("a data set");
    assert_eq!((report.scenes, report.layout.as_str()), (14, "demc-exr"));
    assert_eq!(report.problems, []);
    assert_eq!(Set::new().examine().problems, []);
}

#[test]
fn a_wide_pixel_filter_shows_in_the_noise() {
    let set = Set::damaged(|planes| {
        for name in COLOR {
            let plane = filtered(&planes[name], 0.14);
            planes.insert(name.to_owned(), plane);
        }
    });
    let found = set.has("noise of neighbouring pixels correlates", "bad");
    assert!(found.contains("by 0.") && found.contains("box"), "{found}");
}

#[test]
fn references_that_do_not_match_are_told_apart() {
    let set = Set::damaged(|planes| each(planes, REFERENCE, |x| 2.0 * x));
    let found = set.has("the reference has another exposure", "bad");
    assert!(found.starts_with("1.0 stops brighter"), "{found}");

    for (x, y) in [(1, 0), (0, 1), (2, 2)] {
        let set = Set::damaged(|planes| {
            for name in REFERENCE {
                let before = planes[name].clone();
                let from = |i: usize| {
                    let (column, row) = (i % SIDE, i / SIDE);
                    before[row.saturating_sub(y) * SIDE + column.saturating_sub(x)]
                };
                planes.insert(name.to_owned(), (0..PIXELS).map(from).collect());
            }
        });
        let found = set.has("the reference is shifted", "bad");
        assert!(
            found.starts_with(&format!("by +{x} +{y} pixels")),
            "{found}"
        );
    }

    let set = Set::damaged(|bad| {
        let other = planes("gen-room-train-12");
        for name in REFERENCE {
            bad.insert(name.to_owned(), other[name].clone());
        }
    });
    set.has("the reference shows another image", "bad");

    let set = Set::damaged(|planes| copy(planes, COLOR, REFERENCE));
    set.has("the reference is the noisy image itself", "bad");
    let set = Set::damaged(|planes| swap(planes, COLOR, REFERENCE));
    set.has("the reference is about as noisy", "bad");
    let set = Set::damaged(|planes| each(planes, REFERENCE, |_| 0.0));
    set.has("the reference is black", "bad");
    let set = Set::damaged(|planes| each(planes, COLOR, |_| 0.0));
    set.has("the noisy image is black", "bad");
}

#[test]
fn exposures_far_apart_are_reported_in_stops() {
    let set = Set::damaged(|planes| {
        each(planes, COLOR, |x| 512.0 * x);
        each(planes, REFERENCE, |x| 512.0 * x);
    });
    let found = set.has("exposures differ by", "bad");
    assert!(found.contains("stops from the median"), "{found}");
}

#[test]
fn unusable_samples_are_counted() {
    let set = Set::damaged(|planes| {
        let plane = planes.get_mut("ref.G").expect("a channel");
        plane[3 * SIDE + 5] = f32::NAN;
        plane[4 * SIDE] = f32::INFINITY;
    });
    let found = set.has("NaN or infinite samples", "bad");
    assert!(
        found.starts_with("ref.G: 2, the first NaN at x 5, y 3"),
        "{found}"
    );
    let set = Set::damaged(|planes| {
        for name in COLOR {
            let plane = planes.get_mut(name).expect("a channel");
            plane.iter_mut().step_by(12).for_each(|x| *x = -0.01);
        }
    });
    set.has("much negative radiance", "bad");
}

#[test]
fn features_of_a_wrong_kind_are_recognised() {
    let set = Set::damaged(|planes| each(planes, ALBEDO, |_| 0.0));
    set.has("texture1 is constant", "bad");
    let set = Set::damaged(|planes| each(planes, NORMAL, |x| x / 2.0 + 0.5));
    let found = set.has("normal: wrong space or buffer", "bad");
    assert!(found.contains("is it packed into 0 to 1?"), "{found}");
    let set = Set::damaged(|planes| each(planes, NORMAL, |x| 3.0 * x));
    let found = set.has("normal: wrong space or buffer", "bad");
    assert!(found.starts_with("its length is 3.0"), "{found}");
    let set = Set::damaged(|planes| {
        // A camera that looks down by 45 degrees.
        let [y, z] = ["normal.Y", "normal.Z"].map(|name| planes[name].clone());
        let turned = |sign: f32| {
            let pairs = y.iter().zip(&z);
            pairs.map(|(y, z)| (y + sign * z) * 0.5f32.sqrt()).collect()
        };
        planes.insert("normal.Y".to_owned(), turned(1.0));
        let down: Vec<f32> = turned(-1.0);
        planes.insert("normal.Z".to_owned(), down.iter().map(|x| -x).collect());
    });
    let found = set.has("normal: wrong space or buffer", "bad");
    assert!(found.contains("normals in camera space"), "{found}");
}

#[test]
fn swapped_features_are_recognised() {
    let problems = |set: Set| -> Vec<String> {
        let problems = set.examine().problems.into_iter();
        problems.map(|problem| problem.problem).collect()
    };
    let normal = "normal: wrong space or buffer";
    let set = Set::damaged(|planes| swap(planes, NORMAL, ALBEDO));
    assert_eq!(problems(set), [normal, "texture1: wrong space or buffer"]);
    let set = Set::damaged(|planes| swap(planes, NORMAL, POSITION));
    assert_eq!(
        problems(set),
        ["position: its vectors have length 1", normal]
    );
}

#[test]
fn one_view_in_both_splits_is_found() {
    let mut set = Set::new();
    let mut planes = planes("col-spaceship-0");
    // The same view, rendered again.
    each(&mut planes, COLOR, |x| 1.01 * x);
    each(&mut planes, REFERENCE, |x| 1.01 * x + 1e-3);
    save(&set.path("again.exr"), planes);
    set.scenes.push(entry("again", "test"));
    let found = set.has("views that are in both splits", "again");
    assert!(found.starts_with("correlates with good by "), "{found}");

    let mut set = Set::new();
    fs::copy(set.path("good.exr"), set.path("copy.exr")).expect("copied");
    set.scenes.push(entry("copy", "train"));
    set.has("copies of another scene", "copy");
}

#[test]
fn mistakes_of_the_manifest_are_found() {
    let mut set = Set::new();
    let mut twice = entry("second", "train");
    twice["file"] = "good.exr".into();
    set.scenes.push(twice);
    let found = set.has("files that are listed twice", "second");
    assert!(found.starts_with("the file of good"), "{found}");

    let mut set = Set::new();
    set.scenes[1]["name"] = "good".into();
    set.has("names that are listed twice", "good");

    let mut set = Set::new();
    set.scenes[1]["base"] = "other".into();
    set.has("base scenes in both splits", "other");

    let mut set = Set::new();
    set.scenes[1]["width"] = 200.into();
    let found = set.has("sizes differ from the manifest", "bad");
    assert!(found.starts_with("224x224, not 200x224"), "{found}");
}

#[test]
fn unusable_files_are_found() {
    let set = Set::new();
    fs::remove_file(set.path("bad.exr")).expect("removed");
    set.has("files are missing", "bad");

    let set = Set::new();
    let bytes = fs::read(set.path("bad.exr")).expect("readable");
    fs::write(set.path("bad.exr"), &bytes[..bytes.len() / 2]).expect("writable");
    set.has("files cannot be read", "bad");

    let set = Set::damaged(|planes| planes.retain(|name, _| !name.starts_with("ref")));
    let found = set.has("channels are missing", "bad");
    assert!(found.starts_with("ref.R, ref.G, ref.B"), "{found}");

    let report = examine(&sample(), None, 256).expect("a data set");
    let [problem] = &report.problems[..] else {
        panic!("{:#?}", report.problems)
    };
    let expected = "images smaller than a patch of 256x256";
    assert_eq!(
        (problem.problem.as_str(), problem.scenes.len()),
        (expected, 10)
    );
}

/// Six scenes of the sample, each with 31 mistakes.
const SCENES: [&str; 6] = [
    "col-ashtray-0",
    "col-bathroom-0",
    "col-staircase-0",
    "gen-room-train-0",
    "gen-table-train-1",
    "gen-table-train-8",
];

fn moved(planes: &mut Planes, names: &[&str], place: impl Fn(usize, usize) -> (usize, usize)) {
    for name in names {
        let before = planes[*name].clone();
        let from = |i: usize| {
            let (x, y) = place(i % SIDE, i / SIDE);
            before[y.min(SIDE - 1) * SIDE + x.min(SIDE - 1)]
        };
        planes.insert((*name).to_owned(), (0..PIXELS).map(from).collect());
    }
}

fn srgb(x: f32) -> f32 {
    if x <= 0.003_130_8 {
        12.92 * x
    } else {
        1.055 * x.powf(1.0 / 2.4) - 0.055
    }
}

type Fault = (&'static str, fn(&mut Planes, &Planes));

const FEATURES: [&str; 12] = [
    "normal.X",
    "normal.Y",
    "normal.Z",
    "position.X",
    "position.Y",
    "position.Z",
    "albedo1.R",
    "albedo1.G",
    "albedo1.B",
    "albedo2.R",
    "albedo2.G",
    "albedo2.B",
];
const ALBEDO2: [&str; 3] = ["albedo2.R", "albedo2.G", "albedo2.B"];

/// Mistakes within a scene; the second argument is another scene.
const FAULTS: [Fault; 29] = [
    ("features of another scene", |planes, other| {
        for name in FEATURES {
            planes.insert(name.to_owned(), other[name].clone());
        }
    }),
    ("features shifted by 4", |planes, _| {
        moved(planes, &FEATURES, |x, y| (x + 4, y))
    }),
    ("features mirrored", |planes, _| {
        moved(planes, &FEATURES, |x, y| (SIDE - 1 - x, y))
    }),
    ("red and blue of the reference exchanged", |planes, _| {
        swap(planes, ["ref.R"; 3], ["ref.B"; 3])
    }),
    ("reference shifted by 4", |planes, _| {
        moved(planes, &REFERENCE, |x, y| (x.saturating_sub(4), y))
    }),
    ("albedos exchanged", |planes, _| {
        swap(planes, ALBEDO, ALBEDO2)
    }),
    ("both images in sRGB", |planes, _| {
        each(planes, COLOR, srgb);
        each(planes, REFERENCE, srgb);
    }),
    ("reference half mixed with the noisy image", |planes, _| {
        for (name, noisy) in REFERENCE.into_iter().zip(COLOR) {
            let pairs = planes[name].iter().zip(&planes[noisy]);
            let mixed = pairs.map(|(a, b)| 0.5 * (a + b)).collect();
            planes.insert(name.to_owned(), mixed);
        }
    }),
    ("x and y of the normal exchanged", |planes, _| {
        swap(planes, ["normal.X"; 3], ["normal.Y"; 3])
    }),
    ("y and z of the normal exchanged", |planes, _| {
        swap(planes, ["normal.Y"; 3], ["normal.Z"; 3])
    }),
    ("noisy image clamped", |planes, _| {
        each(planes, COLOR, |x| x.min(1.0))
    }),
    ("albedo is the colour", |planes, _| {
        copy(planes, COLOR, ALBEDO)
    }),
    ("reference shifted by 1", |planes, _| {
        moved(planes, &REFERENCE, |x, y| (x, y + 1))
    }),
    ("reference of another scene", |planes, other| {
        for name in REFERENCE {
            planes.insert(name.to_owned(), other[name].clone());
        }
    }),
    ("reference is the noisy image", |planes, _| {
        copy(planes, COLOR, REFERENCE)
    }),
    ("reference and noisy image exchanged", |planes, _| {
        swap(planes, COLOR, REFERENCE)
    }),
    ("reference black", |planes, _| {
        each(planes, REFERENCE, |_| 0.0)
    }),
    ("noisy image black", |planes, _| {
        each(planes, COLOR, |_| 0.0)
    }),
    ("reference brighter", |planes, _| {
        each(planes, REFERENCE, |x| 2.0 * x)
    }),
    ("reference darker", |planes, _| {
        each(planes, REFERENCE, |x| 0.6 * x)
    }),
    ("NaN in the reference", |planes, _| {
        planes.get_mut("ref.G").expect("green")[77] = f32::NAN
    }),
    ("negative radiance", |planes, _| {
        for name in COLOR {
            let plane = planes.get_mut(name).expect("a channel");
            plane.iter_mut().step_by(12).for_each(|x| *x = -0.01);
        }
    }),
    ("a wide pixel filter", |planes, _| {
        for name in COLOR {
            let plane = filtered(&planes[name], 0.14);
            planes.insert(name.to_owned(), plane);
        }
    }),
    ("albedo constant", |planes, _| each(planes, ALBEDO, |_| 0.5)),
    ("normals packed", |planes, _| {
        each(planes, NORMAL, |x| x / 2.0 + 0.5)
    }),
    ("normals in camera space", |planes, _| {
        let [y, z] = ["normal.Y", "normal.Z"].map(|name| planes[name].clone());
        let turned = |sign: f32, scale: f32| {
            let pairs = y.iter().zip(&z);
            pairs.map(|(y, z)| (y + sign * z) * scale).collect()
        };
        let half = 0.5f32.sqrt();
        planes.insert("normal.Y".to_owned(), turned(1.0, half));
        planes.insert("normal.Z".to_owned(), turned(-1.0, -half));
    }),
    ("normals too long", |planes, _| {
        each(planes, NORMAL, |x| 3.0 * x)
    }),
    ("normal and albedo exchanged", |planes, _| {
        swap(planes, NORMAL, ALBEDO)
    }),
    ("normal and position exchanged", |planes, _| {
        swap(planes, NORMAL, POSITION)
    }),
];

/// Of 186 mistakes, at least 165 are found.
#[test]
fn planted_mistakes_are_found() {
    let scenes: BTreeMap<&str, Planes> = SCENES
        .into_iter()
        .map(|name| (name, planes(name)))
        .collect();
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut entries = Vec::new();
    for (number, (fault, damage)) in FAULTS.iter().enumerate() {
        for (index, name) in SCENES.iter().enumerate() {
            let mut planes = scenes[name].clone();
            damage(&mut planes, &scenes[SCENES[(index + 1) % SCENES.len()]]);
            let file = format!("{number}-{name}");
            save(&dir.path().join(format!("{file}.exr")), planes);
            let mut entry = entry(&file, "train");
            entry["base"] = format!("{fault}, {name}").into();
            entries.push(entry);
        }
    }
    let manifest = json!({"format": "demc-exr 1", "scenes": entries});
    fs::write(dir.path().join("manifest.json"), manifest.to_string()).expect("writable");
    let report = examine(dir.path(), None, 128).expect("a data set");
    let affected = report.problems.iter().flat_map(|problem| &problem.scenes);
    let with_problem: std::collections::BTreeSet<&str> =
        affected.map(|affected| affected.scene.as_str()).collect();
    let mut found = 0;
    for (number, (fault, _)) in FAULTS.iter().enumerate() {
        let of_fault = SCENES.iter().filter(|name| {
            let file = format!("{number}-{name}");
            with_problem.contains(file.as_str())
        });
        let count = of_fault.count();
        println!("{count} of 6: {fault}");
        found += count;
    }
    // A view in the other split, mirrored or cropped.
    for (fault, place) in [
        (
            "mirrored view",
            (|x, y| (SIDE - 1 - x, y)) as fn(usize, usize) -> (usize, usize),
        ),
        ("crop", |x, y| (x / 2 + 50, y / 2 + 50)),
    ] {
        let mut count = 0;
        for name in SCENES {
            let mut set = Set::new();
            save(&set.path("bad.exr"), scenes[name].clone());
            let mut copy = scenes[name].clone();
            let names: Vec<String> = copy.keys().cloned().collect();
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            moved(&mut copy, &names, place);
            save(&set.path("copy.exr"), copy);
            set.scenes.push(entry("copy", "test"));
            let problems = set.examine().problems;
            let both = problems
                .iter()
                .filter(|problem| problem.problem.contains("both splits"));
            count += usize::from(both.count() > 0);
        }
        println!("{count} of 6: {fault}");
        found += count;
    }
    println!("{found} of 186");
    assert!(found >= 165, "{found}");
}

/// Channels of half buffers, variances, depth, and parts, as `tools/render --passes paper` writes them.
fn add_passes(planes: &mut Planes) {
    let noise = |i: usize| [0.9, 1.1][i.wrapping_mul(2_654_435_761) >> 7 & 1];
    let mut passes = Planes::new();
    let depth: Vec<f32> = planes["position.Z"].iter().map(|z| 1.0 + z.abs()).collect();
    passes.insert("depth.Z".to_owned(), depth);
    for (name, whole) in planes.iter() {
        let (prefix, end) = name.rsplit_once('.').unwrap_or(("", name));
        let reference = if prefix == "ref" { "ref." } else { "" };
        if prefix.is_empty() || prefix == "ref" {
            for (part, share) in [("diffuse", 0.75), ("specular", 0.25)] {
                let samples = whole.iter().map(|x| x * share).collect();
                passes.insert(format!("{reference}{part}.{end}"), samples);
            }
        }
    }
    let all: Planes = planes
        .iter()
        .chain(&passes)
        .map(|(n, p)| (n.clone(), p.clone()))
        .collect();
    for (name, whole) in &all {
        let (prefix, _) = name.rsplit_once('.').unwrap_or(("", name));
        if ["", "normal", "albedo1", "depth"].contains(&prefix) {
            let half = |sign: f32| {
                let samples = whole.iter().enumerate();
                samples
                    .map(|(i, x)| x * (1.0 + sign * (noise(i) - 1.0)))
                    .collect::<Vec<f32>>()
            };
            passes.insert(format!("half1.{name}"), half(1.0));
            passes.insert(format!("half2.{name}"), half(-1.0));
        }
        if ["", "normal", "albedo1", "depth", "diffuse", "specular"].contains(&prefix) {
            let variance = whole.iter().map(|x| (0.1 * x).powi(2)).collect();
            passes.insert(format!("variance.{name}"), variance);
        }
    }
    planes.extend(passes);
}

/// A set with passes, one of whose scenes is damaged.
fn damaged_passes(damage: &dyn Fn(&mut Planes)) -> Set {
    Set::damaged(|planes| {
        add_passes(planes);
        damage(planes);
    })
}

#[test]
fn sound_passes_are_no_problem() {
    let sound = Set::damaged(add_passes);
    assert_eq!(sound.examine().problems, []);
    // Without noise, a variance of 0 is right.
    let noiseless = damaged_passes(&|planes| {
        for name in planes.keys().cloned().collect::<Vec<_>>() {
            if let Some(whole) = name.strip_prefix("variance.albedo1.") {
                planes.get_mut(&name).expect("there").fill(0.0);
                let whole = planes[&format!("albedo1.{whole}")].clone();
                let half = name.trim_start_matches("variance.");
                let flat = vec![whole[0]; whole.len()];
                for start in ["", "half1.", "half2."] {
                    planes.insert(format!("{start}{half}"), flat.clone());
                }
            }
        }
    });
    let problems = noiseless.examine().problems;
    let is_of_variance = |problem: &str| problem.starts_with("variance");
    assert!(
        !problems.iter().any(|found| is_of_variance(&found.problem)),
        "{problems:#?}"
    );
}

#[test]
fn wrong_passes_are_told_apart() {
    let damaged = damaged_passes;
    let lacking = damaged(&|planes| drop(planes.remove("variance.depth.Z")));
    assert!(
        lacking
            .has("passes are incomplete", "bad")
            .starts_with("variance.depth.Z;")
    );
    let lacking = damaged(&|planes| drop(planes.remove("half1.R")));
    lacking.has("passes are incomplete", "bad");
    for start in ["half1.", "specular.", "ref.diffuse.", "depth."] {
        let lacking = damaged(&|planes| planes.retain(|name, _| !name.starts_with(start)));
        lacking.has("passes are incomplete", "bad");
    }
    let flat = damaged(&|planes| {
        for name in ["diffuse.R", "diffuse.G", "diffuse.B"] {
            let variance = format!("variance.{name}");
            planes.get_mut(&variance).expect("there").fill(0.0);
        }
    });
    flat.has(
        "variances of diffuse and specular do not fit that of color",
        "bad",
    );
    let equal = damaged(&|planes| {
        for name in ["R", "G", "B"] {
            let whole = planes[name].clone();
            planes.insert(format!("half1.{name}"), whole.clone());
            planes.insert(format!("half2.{name}"), whole);
        }
    });
    equal.has("the half buffers of color are equal", "bad");
    let scaled = damaged(&|planes| {
        for name in ["half1.normal.X", "half1.normal.Y", "half1.normal.Z"] {
            planes
                .get_mut(name)
                .expect("there")
                .iter_mut()
                .for_each(|x| *x *= 1.2);
        }
    });
    scaled.has("normal is not the mean of its half buffers", "bad");
    // The variance of the samples, not of their mean.
    let samples = damaged(&|planes| {
        for name in ["variance.R", "variance.G", "variance.B"] {
            planes
                .get_mut(name)
                .expect("there")
                .iter_mut()
                .for_each(|x| *x *= 4.0);
        }
    });
    assert!(
        samples
            .has("variance of color does not fit", "bad")
            .starts_with("4.0")
    );
    let negative = damaged(&|planes| planes.get_mut("variance.R").expect("there")[5] = -1.0);
    negative.has("variance of color is negative", "bad");
    let invalid = damaged(&|planes| planes.get_mut("depth.Z").expect("there")[5] = f32::NAN);
    assert!(
        invalid
            .has("depth: NaN or infinite samples", "bad")
            .starts_with("1;")
    );
    let dark = damaged(&|planes| planes.get_mut("specular.R").expect("there").fill(0.0));
    dark.has(
        "color is not the sum of its diffuse and specular part",
        "bad",
    );
    let cleaned = damaged(&|planes| planes.get_mut("ref.diffuse.R").expect("there").fill(0.0));
    cleaned.has(
        "reference is not the sum of its diffuse and specular part",
        "bad",
    );
}
