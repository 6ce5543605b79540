//! Images out: what is written, and that it is whole or not there.

use std::fs;
use std::path::Path;

use demc_data::exr::ExrFile;
use demc_data::plane::Plane;
use demc_data::{Precision, write_rgb};

const SIZE: (usize, usize) = (7, 5);
const PIXELS: usize = 35;

#[test]
fn written_images_read_back_as_r_g_b() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("out.exr");
    let rgb: Vec<f32> = (0..3 * PIXELS).map(|i| i as f32 * 0.37).collect();
    write_rgb(&path, SIZE.0, SIZE.1, &rgb, Precision::Float).expect("writable");
    let read = |path: &Path| -> Vec<f32> {
        let file = ExrFile::open(path).expect("just written");
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
    write_rgb(&path, SIZE.0, SIZE.1, &bright, Precision::Half).expect("writable over the old one");
    for (read, written) in read(&path).into_iter().zip(bright) {
        // Half has 11 bits; what is too bright for it becomes its largest value, not infinity.
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
fn outputs_can_be_read_by_everyone() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("out.exr");
    write_rgb(&path, 1, 1, &[1.0; 3], Precision::Half).expect("writable");
    assert_eq!(
        fs::metadata(&path)
            .expect("just written")
            .permissions()
            .mode()
            & 0o777,
        0o644
    );
}

#[test]
fn an_output_that_cannot_be_written_is_named_and_leaves_nothing() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let nowhere = dir.path().join("missing/out.exr");
    let error =
        write_rgb(&nowhere, 1, 1, &[1.0; 3], Precision::Half).expect_err("no such directory");
    assert_eq!(
        error.to_string(),
        format!("cannot write {}", nowhere.display())
    );
    // A directory is in the way.
    let taken = dir.path().join("taken.exr");
    fs::create_dir_all(taken.join("in use")).expect("writable");
    write_rgb(&taken, 1, 1, &[1.0; 3], Precision::Half).expect_err("it is a directory");
    assert_eq!(
        fs::read_dir(dir.path()).expect("readable").count(),
        1,
        "no temporary file is left"
    );
}
