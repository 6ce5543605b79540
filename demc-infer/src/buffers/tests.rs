//! Views with every kind of strides, and frames made of them.

use demc_data::image::layout::Missing;
use demc_model::Variant;
use half::f16;

use super::*;
use crate::Bundle;
use crate::bundle::testing::bundle;
use crate::denoise::Layer;

const SHAPE: [usize; 3] = [3, 2, 4];

/// Planar samples 0, 1, 2, ... of [`SHAPE`].
fn numbers() -> Vec<f32> {
    (0..24).map(|i| i as f32).collect()
}

fn bytes(samples: &[f32]) -> Vec<u8> {
    samples.iter().flat_map(|x| x.to_ne_bytes()).collect()
}

fn interleaved(planar: &[f32]) -> Vec<f32> {
    (0..24).map(|i| planar[i % 3 * 8 + i / 3]).collect()
}

#[test]
fn planar_interleaved_flipped_and_cropped_images_are_the_same() {
    let (planar, packed) = (bytes(&numbers()), bytes(&interleaved(&numbers())));
    let halves: Vec<u8> = numbers()
        .iter()
        .flat_map(|x| f16::from_f32(*x).to_ne_bytes())
        .collect();
    // Rows from the last one up, with two bytes before each sample that do not belong to it.
    let mut flipped = vec![0xff; 24 * 6];
    for (i, value) in numbers().iter().enumerate() {
        let (channel, row, column) = (i / 8, i / 4 % 2, i % 4);
        let start = ((channel * 2 + 1 - row) * 4 + column) * 6 + 2;
        flipped[start..start + 4].copy_from_slice(&value.to_ne_bytes());
    }
    let views = [
        View::planar(&planar, Sample::Float, SHAPE),
        View::interleaved(&packed, Sample::Float, SHAPE),
        View::planar(&halves, Sample::Half, SHAPE),
        View::new(&flipped, Sample::Float, SHAPE, 4 * 6 + 2, [48, -24, 6]),
    ];
    for view in views {
        let view = view.expect("inside");
        assert_eq!(view.to_planar(), Ok(numbers()), "{view:?}");
    }
}

#[test]
fn a_sample_outside_the_memory_is_refused() {
    let memory = bytes(&numbers());
    let view = |first, strides| View::new(&memory, Sample::Float, SHAPE, first, strides);
    assert!(view(0, [32, 16, 4]).is_ok());
    for (first, strides) in [
        (1, [32, 16, 4]),
        (0, [33, 16, 4]),
        (0, [32, -16, 4]),
        (usize::MAX, [32, 16, 4]),
        (0, [isize::MAX, 16, 4]),
        (0, [isize::MIN, isize::MAX, 4]),
    ] {
        let error = view(first, strides).expect_err("outside").to_string();
        assert_eq!(
            error,
            "the image of 3 x 2 x 4 samples reaches outside of its 96 bytes"
        );
    }
}

#[test]
fn outputs_are_written_with_any_strides_but_samples_do_not_share_memory() {
    let mut memory = vec![0; 96];
    let strides = [4, 48, 12];
    let mut output = ViewMut::new(&mut memory, Sample::Float, SHAPE, 0, strides).expect("inside");
    assert_eq!(output.write(&numbers()), Ok(0));
    assert_eq!(memory, bytes(&interleaved(&numbers())));
    for strides in [[0, 16, 4], [32, 16, 2], [4, 16, 4], [16, 4, 4]] {
        let refused = ViewMut::new(&mut memory, Sample::Float, SHAPE, 0, strides);
        assert!(
            matches!(refused, Err(BufferError::Overlap { .. })),
            "{strides:?}"
        );
    }
}

#[test]
fn half_outputs_are_limited() {
    let mut memory = vec![0; 4];
    let mut output = ViewMut::planar(&mut memory, Sample::Half, [1, 1, 2]).expect("inside");
    assert_eq!(output.write(&[1e6, 0.5]), Ok(1));
    let halves = [0, 2].map(|i| f16::from_ne_bytes([memory[i], memory[i + 1]]).to_f32());
    assert_eq!(halves, [65504.0, 0.5]);
    let other = output_error(&mut memory);
    assert_eq!(other, "the output has 2 samples, but the image has 3");
}

fn output_error(memory: &mut [u8]) -> String {
    let mut output = ViewMut::planar(memory, Sample::Half, [1, 1, 2]).expect("inside");
    output
        .write(&[0.0; 3])
        .expect_err("another size")
        .to_string()
}

fn buffers(memory: &[u8]) -> Buffers<'_> {
    let view = View::planar(memory, Sample::Float, SHAPE).expect("inside");
    let mut buffers = Buffers::new(view);
    buffers.normal = Some(view);
    buffers.position = Some(view);
    buffers.albedo = Some(view);
    buffers.albedo2 = Some(view);
    buffers
}

fn refusal(bundle: &Bundle, buffers: &Buffers) -> String {
    let error = bundle.frame("image", buffers).expect_err("refused");
    error.to_string()
}

#[test]
fn absent_buffers_are_replaced_as_the_model_says() {
    let mut bundle = bundle(Variant::Demc);
    let memory = bytes(&numbers());
    let mut given = buffers(&memory);
    given.position = None;
    given.albedo2 = None;
    let frame = bundle.frame("image", &given).expect("a frame");
    let planes: Vec<&[f32]> = frame.features.chunks_exact(24).collect();
    assert_eq!(planes[0], numbers());
    assert_eq!(planes[1], [0.0; 24]);
    assert_eq!(planes[3], planes[2]);
    given.normal = None;
    assert_eq!(
        refusal(&bundle, &given),
        "no normal, which this model needs"
    );
    bundle.meta.layout.missing.normal = Missing::Zeros;
    assert!(bundle.frame("image", &given).is_ok());
}

#[test]
fn negative_colour_becomes_black_and_infinite_positions_become_zero() {
    let bundle = bundle(Variant::Demc);
    let mut samples = numbers();
    samples[3] = -1.0;
    let color = bytes(&samples);
    let mut samples = numbers();
    for i in [5, 13, 21] {
        samples[i] = f32::INFINITY;
    }
    let position = bytes(&samples);
    let mut given = buffers(&color);
    given.normal = Some(View::planar(&position, Sample::Float, SHAPE).expect("inside"));
    let error = refusal(&bundle, &given);
    assert_eq!(
        error,
        "normal has 3 NaN or infinite sample(s); the first one is inf in row 1, column 1"
    );
    given.position = given.normal;
    given.normal = given.albedo;
    let frame = bundle.frame("image", &given).expect("a frame");
    assert_eq!((frame.color[3], frame.clamped), (0.0, 1));
    assert_eq!([5, 13, 21].map(|i| frame.features[24 + i]), [0.0; 3]);
}

#[test]
fn wrong_shapes_name_the_buffer() {
    let bundle = bundle(Variant::Demc);
    let memory = bytes(&numbers());
    let view = |shape| Some(View::planar(&memory, Sample::Float, shape).expect("inside"));
    let mut given = buffers(&memory);
    given.albedo = view([1, 2, 4]);
    assert_eq!(
        refusal(&bundle, &given),
        "albedo has 1 channels instead of 3"
    );
    given.albedo = view([3, 4, 2]);
    assert_eq!(
        refusal(&bundle, &given),
        "albedo has 4x2 pixels, but color has 2x4 (height x width)"
    );
    let empty = View::planar(&[], Sample::Float, [3, 0, 4]).expect("no samples");
    let error = refusal(&bundle, &Buffers::new(empty));
    assert!(error.contains("4x0"), "{error}");
}

#[test]
fn a_layer_has_one_channel_of_the_frames_size() {
    let memory = bytes(&numbers());
    let view = View::planar(&memory, Sample::Float, [1, 2, 4]).expect("inside");
    let layer = Layer::copied("key.R", &view, [2, 4]).expect("a layer");
    assert_eq!(layer.samples, numbers()[..8]);
    let error = Layer::copied("key.R", &view, [4, 2]).expect_err("another size");
    assert!(
        error.to_string().starts_with("key.R has 2x4 pixels"),
        "{error}"
    );
}
