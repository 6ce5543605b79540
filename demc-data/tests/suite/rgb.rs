//! Finished images from other programs.

use demc_data::image::rgb::read_rgb;
use demc_data::{Error, SamplePrecision, write_rgb};

#[test]
fn written_images_read_back_and_negative_values_are_clamped() {
    let dir = tempfile::tempdir().expect("directory");
    let path = dir.path().join("a.exr");
    let planes: Vec<f32> = (0..3 * 6).map(|i| i as f32 - 1.0).collect();
    write_rgb(&path, 3, 2, &planes, SamplePrecision::Half).expect("written");
    let image = read_rgb(&path).expect("read");
    assert_eq!((image.width, image.height, image.clamped), (3, 2, 1));
    assert_eq!(image.planes[0], 0.0);
    assert_eq!(image.planes[1..], planes[1..]);
}

#[test]
fn values_that_are_not_finite_are_counted_and_refused() {
    let dir = tempfile::tempdir().expect("directory");
    let path = dir.path().join("a.exr");
    let mut planes = vec![1.0; 3 * 6];
    planes[6 + 4] = f32::NAN;
    planes[6 + 5] = f32::INFINITY;
    write_rgb(&path, 3, 2, &planes, SamplePrecision::Float).expect("written");
    match read_rgb(&path) {
        Err(Error::NonFinite {
            channel,
            x,
            y,
            count,
            ..
        }) => assert_eq!((channel.as_str(), x, y, count), ("G", 1, 1, 2)),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_single_layer_with_colour_is_found_and_two_are_refused() {
    let dir = tempfile::tempdir().expect("directory");
    let path = dir.path().join("a.exr");
    let value = |x: f32| crate::support::half([x; 4]);
    let layer = [
        ("out.R", value(1.0)),
        ("out.G", value(2.0)),
        ("out.B", value(3.0)),
        ("depth.Z", value(9.0)),
    ];
    crate::support::write(&path, (2, 2), crate::support::named(layer));
    let image = read_rgb(&path).expect("one layer");
    assert_eq!(
        [image.planes[0], image.planes[4], image.planes[8]],
        [1.0, 2.0, 3.0]
    );
    let two = ["a", "b"]
        .map(|layer| ["R", "G", "B"].map(|channel| (format!("{layer}.{channel}"), value(1.0))));
    crate::support::write(&path, (2, 2), two.into_iter().flatten().collect());
    let error = read_rgb(&path).expect_err("two layers").to_string();
    assert!(
        error.contains("no channel R, G, B; the file has a.B"),
        "{error}"
    );
}
