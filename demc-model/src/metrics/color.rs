//! The colour spaces of FLIP: sRGB, linear RGB, XYZ, the opponent space YCxCz and Hunt-adjusted
//! L*a*b*. D65, single precision, constants of Andersson et al. 2020.

pub(super) type Color = [f32; 3];

const XYZ_FROM_RGB: [[f32; 3]; 3] = [
    [
        (10135552.0_f64 / 24577794.0) as f32,
        (8788810.0_f64 / 24577794.0) as f32,
        (4435075.0_f64 / 24577794.0) as f32,
    ],
    [
        (2613072.0_f64 / 12288897.0) as f32,
        (8788810.0_f64 / 12288897.0) as f32,
        (887015.0_f64 / 12288897.0) as f32,
    ],
    [
        (1425312.0_f64 / 73733382.0) as f32,
        (8788810.0_f64 / 73733382.0) as f32,
        (70074185.0_f64 / 73733382.0) as f32,
    ],
];
const RGB_FROM_XYZ: [[f32; 3]; 3] = [
    [3.241_003_3, -1.537_398_9, -0.498_615_9],
    [-0.969_224_3, 1.875_93, 0.041_554_22],
    [0.055_639_4, -0.204_011_2, 1.057_149],
];
const WHITE: Color = [0.950_428_54, 1.0, 1.088_900_4];

pub(super) fn linear_from_srgb(x: f32) -> f32 {
    if x > 0.04045 {
        ((x + 0.055) / 1.055).powf(2.4)
    } else {
        x / 12.92
    }
}

pub(super) fn opponent_from_linear(rgb: Color) -> Color {
    let [x, y, z] = white_relative(rgb);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

pub(super) fn linear_from_opponent([y, cx, cz]: Color) -> Color {
    let y = (y + 16.0) / 116.0;
    let xyz = [y + cx / 500.0, y, y - cz / 200.0];
    product(
        &RGB_FROM_XYZ,
        [xyz[0] * WHITE[0], xyz[1] * WHITE[1], xyz[2] * WHITE[2]],
    )
}

/// L*a*b* of linear RGB, with chroma scaled by lightness (the Hunt effect).
pub(super) fn hunt_lab_from_linear(rgb: Color) -> Color {
    const DELTA: f32 = 6.0 / 29.0;
    let f = |t: f32| {
        if t > DELTA * DELTA * DELTA {
            // Takes half the time of `cbrt` and is exact enough in single precision.
            t.powf(1.0 / 3.0)
        } else {
            t / (3.0 * DELTA * DELTA) + 4.0 / 29.0
        }
    };
    let [x, y, z] = white_relative(rgb).map(f);
    let l = 116.0 * y - 16.0;
    let hunt = 0.01 * l;
    [l, hunt * 500.0 * (x - y), hunt * 200.0 * (y - z)]
}

pub(super) fn hyab(a: Color, b: Color) -> f32 {
    let [l, x, y] = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    l.abs() + (x * x + y * y).sqrt()
}

fn white_relative(rgb: Color) -> Color {
    let [x, y, z] = product(&XYZ_FROM_RGB, rgb);
    [x / WHITE[0], y / WHITE[1], z / WHITE[2]]
}

fn product(matrix: &[[f32; 3]; 3], [a, b, c]: Color) -> Color {
    matrix.map(|[x, y, z]| x * a + y * b + z * c)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn white_and_black_have_their_known_values() {
        let near = |found: Color, expected: Color| {
            for (a, b) in found.into_iter().zip(expected) {
                assert!((a - b).abs() < 2e-3, "{found:?} {expected:?}");
            }
        };
        near(opponent_from_linear([1.0; 3]), [100.0, 0.0, 0.0]);
        near(hunt_lab_from_linear([1.0; 3]), [100.0, 0.0, 0.0]);
        near(hunt_lab_from_linear([0.0; 3]), [0.0, 0.0, 0.0]);
    }

    #[test]
    fn the_opponent_space_has_an_inverse() {
        for rgb in [[0.2, 0.5, 0.9], [1.0, 0.0, 0.0], [0.01, 0.02, 0.005]] {
            let back = linear_from_opponent(opponent_from_linear(rgb));
            for (a, b) in rgb.into_iter().zip(back) {
                // The inverse is rounded to seven digits.
                assert!((a - b).abs() < 2e-5, "{rgb:?} {back:?}");
            }
        }
    }
}
