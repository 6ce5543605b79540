use demc_data::ChannelLayout;
use demc_data::image::rewrite::{WriteOptions, rewrite};

use super::*;
use demc_program::checksum::sha256_of;

fn jobs(files: Vec<PathBuf>, output: &Path, previews: bool) -> Result<Jobs, UsageError> {
    let several = files.len() > 1;
    let sequences = Vec::new();
    let inputs = Inputs {
        files,
        several,
        sequences,
        empty: Vec::new(),
    };
    Jobs::new(&inputs, output, previews)
}

fn outputs(inputs: &[&str], output: &str) -> Result<Vec<PathBuf>, String> {
    let files = inputs.iter().map(PathBuf::from).collect();
    let jobs = jobs(files, Path::new(output), false).map_err(|error| error.to_string())?;
    Ok(jobs.list.into_iter().map(|job| job.output).collect())
}

/// The error of claiming the files of a job list.
fn refusal(jobs: &Jobs) -> String {
    let mut outputs = Outputs::default();
    for job in &jobs.list {
        outputs.protect(&job.input, "the input");
    }
    let claimed = jobs.claim(&mut outputs);
    claimed.expect_err("refused").to_string()
}

/// Writes an image with a record.
fn write_image(path: &Path, record: &Record) {
    let options = WriteOptions {
        record: Some(&record.text()),
        ..WriteOptions::default()
    };
    let sample = "../data/sample/test/gen-table-test-1.exr".as_ref();
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let mut input = ExrFile::open(sample).expect("the sample");
    let window = input.channel("R").expect("red").window;
    let color = vec![0.5; 3 * window.width * window.height];
    rewrite(&mut input, &layout, &color, path, &options).expect("written");
}

fn write_preview(path: &Path, image: &Path, exposure: f32) {
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    preview::write(path, image, &layout, exposure).expect("written");
}

fn set_time(path: &Path, seconds: u64) {
    let time = std::time::SystemTime::now() + std::time::Duration::from_secs(seconds);
    let file = fs::File::options().write(true).open(path).expect("a file");
    file.set_modified(time).expect("a time");
}

#[test]
fn one_input_makes_a_file_and_several_fill_a_directory() {
    assert_eq!(outputs(&["a.exr"], "out.exr"), Ok(vec!["out.exr".into()]));
    assert_eq!(outputs(&["x/a.exr"], "out/"), Ok(vec!["out/a.exr".into()]));
    let both = vec!["out/a.exr".into(), "out/b.exr".into()];
    assert_eq!(outputs(&["x/a.exr", "b.exr"], "out"), Ok(both));
}

#[test]
fn equal_file_names_are_refused() {
    let error = outputs(&["x/a.exr", "y/a.exr"], "out").expect_err("collision");
    assert!(
        error.starts_with("x/a.exr and y/a.exr have the same file name"),
        "{error}"
    );
}

#[test]
fn an_input_is_never_replaced() -> std::io::Result<()> {
    let dir = tempfile::tempdir()?;
    let [input, picture] = ["a.exr", "pin.png"].map(|name| dir.path().join(name));
    fs::write(&input, "")?;
    fs::write(&picture, "")?;
    let out = dir.path().join("pin.exr");
    for (input, output) in [
        (&input, input.as_path()),
        (&input, dir.path()),
        (&picture, &out),
    ] {
        let jobs = jobs(vec![input.clone()], output, true).expect("a job");
        let error = refusal(&jobs);
        assert!(error.contains("would replace the input"), "{error}");
    }
    Ok(())
}

/// The record of an image with these options.
fn image_record(options: &Record, input: &Path) -> Record {
    options.of_image("a.exr", &sha256_of(input).expect("an input"))
}

/// What is left to write of one input `a.exr` in `dir`, and what was kept.
fn left(dir: &Path, record: &Record, exposure: f32) -> (bool, bool, Vec<String>) {
    let inputs = vec![dir.join("in/a.exr")];
    let mut jobs = jobs(inputs, &dir.join("out/"), true).expect("a job");
    let of_image = |input: &Path| Some(image_record(record, input));
    jobs.skip_existing(of_image, exposure, &mut Outputs::default());
    let job = jobs.list.first();
    let due = job.is_some_and(|job| job.is_due);
    let preview = job.is_some_and(|job| job.preview.is_some());
    (due, preview, jobs.kept.into_keys().collect())
}

#[test]
fn existing_files_are_finished_outdated_or_of_another_kind() {
    let dir = tempfile::tempdir().expect("a directory");
    let at = |name: &str| dir.path().join(name);
    let record = Record::of_model("quality", "1a");
    let found = |record: &Record| left(dir.path(), record, 0.0);
    for folder in ["in", "out"] {
        fs::create_dir(at(folder)).expect("a directory");
    }
    fs::write(at("in/a.exr"), "").expect("a file");
    let nothing = Vec::new();
    assert_eq!(found(&record), (true, true, nothing.clone()), "missing");

    write_image(&at("out/a.exr"), &image_record(&record, &at("in/a.exr")));
    assert_eq!(found(&record), (false, true, nothing.clone()), "no preview");
    write_preview(&at("out/a.png"), &at("out/a.exr"), 0.0);
    assert_eq!(found(&record), (false, false, nothing.clone()), "finished");
    assert_eq!(
        left(dir.path(), &record, 1.5),
        (false, true, nothing.clone())
    );
    let preview = fs::read(at("out/a.png")).expect("a preview");
    for length in [preview.len() / 2, preview.len() - 1] {
        fs::write(at("out/a.png"), &preview[..length]).expect("a file");
        assert_eq!(found(&record), (false, true, nothing.clone()), "half of it");
    }
    fs::write(at("out/a.png"), &preview).expect("a file");
    set_time(&at("in/a.exr"), 120);
    assert_eq!(found(&record), (false, false, nothing.clone()), "touched");
    fs::write(at("in/a.exr"), "rendered again").expect("a file");
    set_time(&at("in/a.exr"), 120);
    assert_eq!(found(&record), (true, true, nothing), "rendered again");

    // Without --overwrite, what another command or program made stays, although the input is newer.
    let fast = Record::of_model("fast", "2b");
    let expected =
        vec!["made with other content of input a.exr, --model quality instead of fast".to_owned()];
    assert_eq!(found(&fast), (false, false, expected));
    set_time(&at("out/a.exr"), 180);
    let kept = vec!["made with other content of input a.exr".to_owned()];
    assert_eq!(found(&record), (false, false, kept), "an older input");
    write_image(&at("out/a.exr"), &image_record(&record, &at("in/a.exr")));
    let expected = (false, true, Vec::new());
    assert_eq!(found(&record), expected, "the preview of another image");
    let whole = fs::read(at("out/a.exr")).expect("an image");
    for length in [100, whole.len() - 1] {
        fs::write(at("out/a.exr"), &whole[..length]).expect("a file");
        let kept = vec!["damaged, or not an EXR file".to_owned()];
        assert_eq!(found(&record), (false, false, kept), "{length} bytes");
    }
    fs::copy("../data/sample/test/gen-table-test-1.exr", at("out/a.exr")).expect("copied");
    let kept = vec!["not written by this program".to_owned()];
    assert_eq!(found(&record), (false, false, kept.clone()));
    fs::remove_file(at("out/a.exr")).expect("removed");
    fs::write(at("out/a.png"), "a photograph").expect("a file");
    assert_eq!(found(&record), (true, false, kept), "a foreign preview");
}

#[test]
fn an_output_is_an_exr_file() {
    for output in ["o.png", "o.tif", "-", "o", "/dev/stdout"] {
        let sample = "../data/sample/test/gen-table-test-1.exr";
        let error = outputs(&[sample], output).expect_err("no EXR file");
        assert!(
            error.starts_with(&format!("-o {output}: an output")),
            "{error}"
        );
    }
    assert!(outputs(&["a.exr"], "o.EXR").is_ok());
    let error = outputs(&["a.%.exr"], "o").expect_err("no input");
    assert_eq!(error, "a.%.exr: no such file");
}

#[test]
fn a_file_cannot_take_several_images() -> std::io::Result<()> {
    let file = tempfile::NamedTempFile::new()?;
    let inputs = vec!["a.exr".into(), "b.exr".into()];
    let error = jobs(inputs, file.path(), false)
        .expect_err("file")
        .to_string();
    assert!(
        error.ends_with("is a file; 2 input(s) need a directory"),
        "{error}"
    );
    Ok(())
}
