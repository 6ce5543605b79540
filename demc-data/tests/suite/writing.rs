//! Written images: their content, and that they are complete or absent.

use std::fs;
use std::path::Path;

use demc_data::image::exr::ExrFile;
use demc_data::image::plane::Plane;
use demc_data::{Error, SamplePrecision, write_rgb};

const SIZE: (usize, usize) = (7, 5);
const PIXELS: usize = 35;

#[test]
fn written_images_read_back_as_r_g_b() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("out.exr");
    let rgb: Vec<f32> = (0..3 * PIXELS).map(|i| i as f32 * 0.37).collect();
    write_rgb(&path, SIZE.0, SIZE.1, &rgb, SamplePrecision::Float).expect("writable");
    let read = |path: &Path| -> Vec<f32> {
        let mut file = ExrFile::open(path).expect("just written");
        assert_eq!(
            file.channels()
                .iter()
                .map(|c| c.name.as_str())
                .collect::<Vec<_>>(),
            ["B", "G", "R"]
        );
        file.read(&["R", "G", "B"])
            .expect("just written")
            .iter()
            .flat_map(Plane::to_f32)
            .collect()
    };
    assert_eq!(read(&path), rgb);

    let bright: Vec<f32> = rgb.iter().map(|value| value * 5000.0).collect();
    write_rgb(&path, SIZE.0, SIZE.1, &bright, SamplePrecision::Half)
        .expect("writable over the old one");
    for (read, written) in read(&path).into_iter().zip(bright) {
        // Half has 11 bits; brighter values become its largest value, not infinity.
        let written = written.min(65504.0);
        assert!(
            (read - written).abs() <= written / 2048.0,
            "{read} is not {written}"
        );
    }
    assert_eq!(
        fs::read_dir(dir.path()).expect("readable").count(),
        1,
        "no temporary file is left"
    );
}

#[cfg(unix)]
#[test]
fn a_replaced_file_keeps_its_mode() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("out.exr");
    for mode in [0o600, 0o664, 0o755] {
        fs::write(&path, "old").expect("writable");
        fs::set_permissions(&path, fs::Permissions::from_mode(mode)).expect("ours");
        write_rgb(&path, 1, 1, &[1.0; 3], SamplePrecision::Half).expect("writable");
        let found = fs::metadata(&path).expect("just written").permissions();
        assert_eq!(found.mode() & 0o777, mode);
    }
}

#[test]
fn an_output_that_cannot_be_written_is_named_and_leaves_nothing() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let nowhere = dir.path().join("missing/out.exr");
    let error =
        write_rgb(&nowhere, 1, 1, &[1.0; 3], SamplePrecision::Half).expect_err("no such directory");
    assert_eq!(
        error.to_string(),
        format!("cannot write {}", nowhere.display())
    );
    // A directory has this name.
    let taken = dir.path().join("taken.exr");
    fs::create_dir_all(taken.join("in use")).expect("writable");
    write_rgb(&taken, 1, 1, &[1.0; 3], SamplePrecision::Half).expect_err("it is a directory");
    assert_eq!(
        fs::read_dir(dir.path()).expect("readable").count(),
        1,
        "no temporary file is left"
    );
}

#[cfg(unix)]
#[test]
fn a_link_stays_and_the_file_it_leads_to_is_replaced() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (file, link) = (dir.path().join("out.exr"), dir.path().join("latest.exr"));
    fs::write(&file, "old").expect("writable");
    std::os::unix::fs::symlink("out.exr", &link).expect("writable");
    write_rgb(&link, 1, 1, &[1.0; 3], SamplePrecision::Half).expect("writable through the link");
    assert!(link.is_symlink() && !file.is_symlink());
    ExrFile::open(&file).expect("just written");
    fs::remove_file(&file).expect("it is there");
    let error =
        write_rgb(&link, 1, 1, &[1.0; 3], SamplePrecision::Half).expect_err("a link to nothing");
    assert!(link.is_symlink(), "{error}");
}

#[cfg(unix)]
#[test]
fn special_files_are_refused_and_stay_unchanged() {
    use std::os::unix::fs::{FileTypeExt, symlink};
    // A FIFO stands in for a device: a test must not touch real ones.
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (fifo, link) = (dir.path().join("fifo"), dir.path().join("link"));
    let made = std::process::Command::new("mkfifo").arg(&fifo).status();
    assert!(made.expect("mkfifo is there").success());
    symlink(&fifo, &link).expect("writable");
    for path in [&fifo, &link, &dir.path().to_owned()] {
        let error = write_rgb(path, 1, 1, &[1.0; 3], SamplePrecision::Half).expect_err("no file");
        assert_eq!(
            error.to_string(),
            format!("cannot write {}", path.display())
        );
        let Error::File(demc_program::file::FileError::Write { source, .. }) = error else {
            panic!("{error:?}");
        };
        assert_eq!(source.kind(), std::io::ErrorKind::InvalidInput);
        let reasons = ["not a regular file", "is a directory; name a file"];
        assert!(reasons.contains(&source.to_string().as_str()), "{source}");
    }
    let kind = fs::symlink_metadata(&fifo)
        .expect("still there")
        .file_type();
    assert!(kind.is_fifo() && link.is_symlink());
    assert_eq!(fs::read_dir(dir.path()).expect("readable").count(), 2);
}
