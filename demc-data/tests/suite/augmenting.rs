//! The effects of augmentations on a patch.

use std::collections::HashSet;

use crate::support::batches::first_batch;
use demc_data::{Augment, Batch, FEATURES};

/// Colour and second texture move among the pixels of a patch; its content does not.
#[test]
fn noise_changes_colour_and_second_texture_only() {
    let plain = first_batch(Augment::default());
    let varied = first_batch(Augment {
        noise: true,
        ..Augment::default()
    });
    assert_eq!(varied.patches, plain.patches);
    assert_eq!(varied.reference_hdr, plain.reference_hdr);
    let pixels = 64 * 64;
    let same = |a: &[f32], b: &[f32]| a.iter().zip(b).filter(|(a, b)| a == b).count();
    let features = varied
        .features
        .chunks(pixels)
        .zip(plain.features.chunks(pixels));
    for (plane, (varied, plain)) in features.enumerate() {
        if plane % FEATURES < 9 {
            assert_eq!(varied, plain, "plane {plane}");
        }
    }
    let share = same(&varied.color, &plain.color) as f32 / plain.color.len() as f32;
    assert!(share < 0.6, "{share} of the colour is what it was");
    assert_ne!(varied.features, plain.features);
}

#[test]
fn augmentation_turns_all_buffers_of_a_patch_alike() {
    let plain = first_batch(Augment::default());
    let turned = first_batch(Augment {
        flip: true,
        ..Augment::default()
    });
    assert_eq!(turned.patches, plain.patches);
    let corner = |batch: &Batch, b: usize, y: usize, x: usize| {
        let index = |plane: usize| (plane * 64 + y) * 64 + x;
        (
            batch.color[index(b * 3 + 1)],
            batch.features[index(b * FEATURES + 4)],
            batch.reference_hdr[index(b * 3)],
        )
    };
    let mut corners = HashSet::new();
    for b in 0..plain.size {
        let places = [(0, 0), (0, 63), (63, 0), (63, 63)];
        let from = places
            .iter()
            .position(|&(y, x)| corner(&plain, b, y, x) == corner(&turned, b, 0, 0));
        corners.insert(from.expect("the upper left corner comes from a corner"));
    }
    assert!(
        corners.len() > 1,
        "seven patches, four orientations: {corners:?}"
    );
}

/// One permutation applies to colour, textures and reference, one factor to colour and reference;
/// normals and positions stay.
#[test]
fn rgb_and_exposure_change_all_their_buffers_alike() {
    let plain = first_batch(Augment::default());
    let varied = first_batch(Augment {
        rgb: true,
        exposure: true,
        ..Augment::default()
    });
    let pixels = 64 * 64;
    let mut orders = HashSet::new();
    for b in 0..plain.size {
        let planes = |values: &[f32], channels: usize, first: usize, count: usize| {
            let from = (b * channels + first) * pixels;
            values[from..from + count * pixels].to_vec()
        };
        let images = |batch: &Batch| {
            let textures = [6, 9].map(|first| planes(&batch.features, FEATURES, first, 3));
            (planes(&batch.reference_hdr, 3, 0, 3), textures)
        };
        let geometry = |batch: &Batch| planes(&batch.features, FEATURES, 0, 6);
        assert_eq!(geometry(&plain), geometry(&varied));
        let ((before, textures), (after, varied_textures)) = (images(&plain), images(&varied));
        let sum = |planes: &[f32]| planes.iter().map(|v| f64::from(*v)).sum::<f64>();
        let exposure = sum(&after) / sum(&before);
        assert!((0.5..2.0).contains(&exposure), "{exposure}");
        // The source plane of each of the three planes.
        let order: Vec<usize> = after
            .chunks(pixels)
            .map(|plane| {
                let from = before.chunks(pixels).position(|from| {
                    let mut values = from.iter().zip(plane);
                    values.all(|(a, b)| {
                        (f64::from(*a) * exposure - f64::from(*b)).abs() < 1e-4 * f64::from(a + b)
                    })
                });
                from.expect("it comes from one of them")
            })
            .collect();
        for (before, after) in textures.iter().zip(&varied_textures) {
            for (plane, from) in after.chunks(pixels).zip(&order) {
                assert_eq!(plane, &before[from * pixels..][..pixels]);
            }
        }
        let gamma = |batch: &Batch, plane: usize| planes(&batch.color, 3, plane, 1);
        for (plane, from) in order.iter().enumerate() {
            for (a, b) in gamma(&plain, *from).iter().zip(gamma(&varied, plane)) {
                let expected = f64::from(*a) * exposure.powf(1.0 / 2.2);
                assert!((f64::from(b) - expected).abs() <= 1e-5 * expected + 1e-9);
            }
        }
        orders.insert(order);
    }
    assert!(orders.len() > 1, "seven patches, six orders: {orders:?}");
}

/// One permutation with signs applies to normals and positions; the other buffers stay.
#[test]
fn axis_permutations_are_the_same_for_normals_and_positions() {
    let plain = first_batch(Augment::default());
    let varied = first_batch(Augment {
        axes: true,
        ..Augment::default()
    });
    assert_eq!(plain.color, varied.color);
    assert_eq!(plain.reference_hdr, varied.reference_hdr);
    let pixels = 64 * 64;
    let features = |batch: &Batch| -> Vec<Vec<f32>> {
        let planes = batch.features.chunks(pixels);
        planes.map(<[f32]>::to_vec).collect()
    };
    let (before, after) = (features(&plain), features(&varied));
    let (mut ways, mut mirrored) = (HashSet::new(), HashSet::new());
    for (before, after) in before.chunks(FEATURES).zip(after.chunks(FEATURES)) {
        assert_eq!(before[6..], after[6..], "textures");
        // Positions decide: where a patch shows a single wall, two axes of its normal are equal.
        let sign = |turned| if turned { -1.0 } else { 1.0 };
        let is = |plane: &[f32], other: &[f32], turned: bool| {
            other.iter().zip(plane).all(|(a, b)| a * sign(turned) == *b)
        };
        let way: Vec<(usize, bool)> = (3..6)
            .map(|plane| {
                (0..3)
                    .flat_map(|from| [(from, false), (from, true)])
                    .find(|(from, turned)| is(&after[plane], &before[3 + from], *turned))
                    .expect("it is one of the axes")
            })
            .collect();
        for (normal, (from, turned)) in way.iter().enumerate() {
            assert!(is(&after[normal], &before[*from], *turned), "{way:?}");
        }
        mirrored.extend(way.iter().map(|(_, turned)| *turned));
        ways.insert(way);
    }
    assert!(ways.len() > 2, "seven patches, 48 ways: {ways:?}");
    assert_eq!(mirrored.len(), 2);
}
