use super::*;

fn directory_of(names: &[&str]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a directory");
    for name in names {
        let path = dir.path().join(name);
        fs::create_dir_all(path.parent().expect("a directory")).expect("a directory");
        fs::write(path, "").expect("a file");
    }
    dir
}

fn names(dir: &tempfile::TempDir, argument: &str, frames: Option<&str>) -> Vec<String> {
    let frames = frames.map(|text| text.parse().expect("frames"));
    let found = Inputs::expand(&[dir.path().join(argument)], frames.as_ref()).expect("files");
    let name = |path: &PathBuf| path.file_name().map(|name| name.to_string_lossy().into());
    found.files.iter().filter_map(name).collect()
}

#[test]
fn a_directory_stands_for_its_images_by_name() {
    let dir = directory_of(&["b.exr", "a.EXR", "c.txt"]);
    fs::create_dir(dir.path().join("d.exr")).expect("a directory");
    assert_eq!(names(&dir, "", None), ["a.EXR", "b.exr"]);
}

#[test]
fn a_sequence_stands_for_its_frames_by_number() {
    let dir = directory_of(&[
        "s.0009.exr",
        "s.0010.exr",
        "s.12345.exr",
        "s.010.exr",
        "s.00011.exr",
        "s.abcd.exr",
        "t.0001.exr",
    ]);
    for pattern in ["s.####.exr", "s.%04d.exr"] {
        let all = names(&dir, pattern, None);
        assert_eq!(all, ["s.0009.exr", "s.0010.exr", "s.12345.exr"]);
        assert_eq!(names(&dir, pattern, Some("10-99")), ["s.0010.exr"]);
    }
    assert_eq!(names(&dir, "s.%d.exr", None), ["s.12345.exr"]);
}

#[test]
fn a_pattern_finds_files_and_a_file_may_have_such_a_name() {
    let dir = directory_of(&["a1.exr", "a2.exr", "b.exr"]);
    assert_eq!(names(&dir, "a*.exr", None), ["a1.exr", "a2.exr"]);
    assert_eq!(names(&dir, "[ab]?.exr", None), ["a1.exr", "a2.exr"]);
    let odd = directory_of(&["x[1].exr", "x1.exr", "shot#1.exr"]);
    assert_eq!(names(&odd, "x[1].exr", None), ["x[1].exr"]);
    assert_eq!(names(&odd, "shot#1.exr", None), ["shot#1.exr"]);
}

/// As in a shell: a wildcard matches no first dot. A name that is not UTF-8 is left out.
#[test]
fn a_pattern_leaves_out_hidden_files_and_names_that_are_not_utf8() {
    let dir = directory_of(&["a.exr", ".a.exr", ".b/a.exr", "c/a.exr", "c/.d/a.exr"]);
    #[cfg(unix)]
    {
        use std::os::unix::ffi::OsStrExt;
        let odd = std::ffi::OsStr::from_bytes(b"\xff.exr");
        fs::write(dir.path().join(odd), "").expect("a file");
    }
    let count = |pattern: &str| names(&dir, pattern, None).len();
    assert_eq!(names(&dir, "*.exr", None), ["a.exr"]);
    assert_eq!(names(&dir, ".*.exr", None), [".a.exr"]);
    assert_eq!([count("*/*.exr"), count(".b*/*.exr")], [1, 1]);
    assert_eq!([count("**/*.exr"), count("c/.d/*.exr")], [2, 1]);
}

#[test]
fn arguments_without_images_are_named_and_others_go_on() {
    let dir = directory_of(&["a.txt", ".hidden.exr", "sub/b.exr"]);
    let file = dir.path().join("sub/b.exr");
    for argument in ["*.exr", "s.####.exr"] {
        let found = Inputs::expand(&[dir.path().join(argument), file.clone()], None);
        let found = found.expect("one file");
        assert_eq!(found.files, std::slice::from_ref(&file));
        assert!(
            found.empty[0].ends_with("no images found"),
            "{:?}",
            found.empty
        );
    }
    let found = Inputs::expand(&[dir.path().to_owned()], None).expect("no file");
    let hint = format!(
        "it has 1 directories: try '{}/*/*.exr'",
        dir.path().display()
    );
    assert!(found.empty[0].ends_with(&hint), "{:?}", found.empty);
    let absent = dir.path().join("absent.exr");
    let found = Inputs::expand(std::slice::from_ref(&absent), None).expect("as it is");
    assert_eq!((found.files, found.several), (vec![absent], false));
    let twice = [dir.path().join("sub"), dir.path().join("sub/../sub/b.exr")];
    let found = Inputs::expand(&twice, None).expect("as it is");
    assert_eq!(found.files, [file]);
    let frames = "1-2".parse().ok();
    let error = Inputs::expand(&["a.exr".into()], frames.as_ref()).expect_err("no sequence");
    assert!(error.to_string().starts_with("--frames needs"), "{error}");
}

#[test]
fn images_that_are_not_chosen_are_protected() {
    let dir = directory_of(&["s.1.exr", "s.2.exr", "s.3.exr"]);
    let frames = "1-2".parse().ok();
    let found = Inputs::expand(&[dir.path().join("s.#.exr")], frames.as_ref()).expect("frames");
    let mut outputs = Outputs::default();
    found.protect(&mut outputs);
    assert!(outputs.claim(&dir.path().join("s.3.exr"), true).is_err());
    assert!(outputs.claim(&dir.path().join("s.4.exr"), true).is_ok());
}

#[test]
fn a_number_padded_with_spaces_is_refused() {
    let error = Inputs::expand(&["shot.%4d.exr".into()], None).expect_err("spaces");
    let why = "shot.%4d.exr: %4d pads numbers with spaces; write %04d";
    assert_eq!(error.to_string(), why);
}

#[test]
fn missing_frames_are_named_and_frames_after_the_last_are_noted() {
    let dir = directory_of(&["s.03.exr", "s.04.exr", "s.07.exr"]);
    let told = |frames: Option<&str>| {
        let frames = frames.map(|text| text.parse::<Frames>().expect("frames"));
        let found = Inputs::expand(&[dir.path().join("s.##.exr")], frames.as_ref());
        let sequence = found.expect("frames").sequences.remove(0);
        let end = |text: Option<String>| Some(text?.split_once(": ")?.1.to_owned());
        (end(sequence.missing), end(sequence.after))
    };
    let missing = |text: &str| Some(format!("{text} frames are missing: 5-6"));
    let after = |count: &str| Some(format!("{count} chosen frames are after its last one, 7"));
    assert_eq!(told(None), (missing("2 of 5"), None));
    assert_eq!(told(Some("3-10")), (missing("2 of 5"), after("3 of 8")));
    assert_eq!(told(Some("4,7-9x2")), (None, after("1 of 3")));
    assert_eq!(told(Some("7")), (None, None));
}
