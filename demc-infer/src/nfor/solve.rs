//! Least squares of several pixels at once: one lane of a vector each.

/// Pixels that are solved together.
pub(super) const LANES: usize = 16;
/// One value for each pixel.
pub(super) type Lanes = [f32; LANES];
/// Columns of the regression: 1, place in x and y, normal (3), albedo (3), depth.
pub(super) const COLUMNS: usize = 10;
/// Columns and right-hand sides: red, green, blue.
pub(super) const ALL: usize = COLUMNS + COLORS;
/// Right-hand sides.
pub(super) const COLORS: usize = 3;
/// Added to the squares of columns of length 1 (ours: the paper is silent). Columns that hardly differ from
/// others then get no large coefficients; float32 sums have errors of about 1e-6.
const RIDGE: f32 = 1e-4;

/// The sums of weighted products of columns i and j, `[i][j]`: those with j >= i count.
pub(super) type Sums = [[Lanes; ALL]; COLUMNS];
/// A coefficient for each column and colour.
pub(super) type Coefficients = [[Lanes; COLORS]; COLUMNS];

/// A value for each column.
type Column = [Lanes; COLUMNS];

const ZERO: Lanes = [0.0; LANES];

/// The coefficients of least squares: ridge regression, whose result is corrected once for what the ridge
/// left unexplained. An exact fit is then found to the square of the ridge, 1e-8, and a column that depends
/// on others is harmless.
#[inline(always)]
pub(super) fn solve(sums: &Sums) -> Coefficients {
    let scale = scale(sums);
    let (lower, inverse) = decompose(sums, &scale);
    let mut found = [[ZERO; COLORS]; COLUMNS];
    for color in 0..COLORS {
        let mut right = [ZERO; COLUMNS];
        for j in 0..COLUMNS {
            right[j] = times(&sums[j][COLUMNS + color], &scale[j]);
        }
        let first = substitute(&lower, &inverse, &right);
        // With a ridge r, (A + r) first = right, so right - A first = r first.
        let mut rest = first;
        for value in rest.as_flattened_mut() {
            *value *= RIDGE;
        }
        let second = substitute(&lower, &inverse, &rest);
        for j in 0..COLUMNS {
            for l in 0..LANES {
                found[j][color][l] = (first[j][l] + second[j][l]) * scale[j][l];
            }
        }
    }
    found
}

#[inline(always)]
fn times(a: &Lanes, b: &Lanes) -> Lanes {
    let mut product = *a;
    for l in 0..LANES {
        product[l] *= b[l];
    }
    product
}

/// One divided by the length of each column; 0 for a column of zeros.
#[inline(always)]
fn scale(sums: &Sums) -> Column {
    let mut scale = [ZERO; COLUMNS];
    for (i, scale) in scale.iter_mut().enumerate() {
        for l in 0..LANES {
            let square = sums[i][i][l];
            scale[l] = if square > f32::MIN_POSITIVE {
                1.0 / square.sqrt()
            } else {
                0.0
            };
        }
    }
    scale
}

/// The Cholesky decomposition of scaled sums with the ridge: its lower triangle, and one divided by its
/// diagonal.
#[inline(always)]
fn decompose(sums: &Sums, scale: &Column) -> ([Column; COLUMNS], Column) {
    let mut lower = [[ZERO; COLUMNS]; COLUMNS];
    let mut inverse = [ZERO; COLUMNS];
    for j in 0..COLUMNS {
        for i in j..COLUMNS {
            let mut value = times(&times(&sums[j][i], &scale[j]), &scale[i]);
            if i == j {
                for value in &mut value {
                    *value += RIDGE;
                }
            }
            for (a, b) in lower[i][..j].iter().zip(&lower[j]) {
                for l in 0..LANES {
                    value[l] -= a[l] * b[l];
                }
            }
            if i == j {
                for l in 0..LANES {
                    // Rounding must not make a square root of a negative number.
                    let square = if value[l] > 0.5 * RIDGE {
                        value[l]
                    } else {
                        0.5 * RIDGE
                    };
                    inverse[j][l] = 1.0 / square.sqrt();
                }
            }
            lower[i][j] = times(&value, &inverse[j]);
        }
    }
    (lower, inverse)
}

/// Solves the decomposed system for one right-hand side.
#[inline(always)]
fn substitute(lower: &[Column; COLUMNS], inverse: &Column, right: &Column) -> Column {
    let mut found = [ZERO; COLUMNS];
    for j in 0..COLUMNS {
        let mut value = right[j];
        for k in 0..j {
            for l in 0..LANES {
                value[l] -= lower[j][k][l] * found[k][l];
            }
        }
        found[j] = times(&value, &inverse[j]);
    }
    for j in (0..COLUMNS).rev() {
        let mut value = found[j];
        for i in j + 1..COLUMNS {
            for l in 0..LANES {
                value[l] -= lower[i][j][l] * found[i][l];
            }
        }
        found[j] = times(&value, &inverse[j]);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sums of rows of columns and colours.
    fn sums(rows: &[[f32; ALL]]) -> Sums {
        let product = |i: usize, j: usize| rows.iter().map(|row| row[i] * row[j]).sum::<f32>();
        std::array::from_fn(|i| std::array::from_fn(|j| [product(i, j); LANES]))
    }

    #[test]
    fn an_exact_fit_is_found_beside_columns_that_depend_on_others() {
        let expected = [0.5, -1.0, 2.0, 0.25, 0.0, 3.0, -0.5, 1.0, 0.0, 0.0];
        let rows: Vec<[f32; ALL]> = (0..40)
            .map(|row| {
                let mut columns: [f32; ALL] = std::array::from_fn(|column| {
                    let place = (row * 129 + column * 782) as f32;
                    (place.sin() * 437.58).fract()
                });
                columns[0] = 1.0;
                // The last two columns depend on others, or are 0.
                columns[8] = columns[3] - 2.0 * columns[4];
                columns[9] = 0.0;
                let fit: f32 = expected.iter().zip(columns).map(|(a, b)| a * b).sum();
                columns[COLUMNS..].copy_from_slice(&[fit, -fit, 0.0]);
                columns
            })
            .collect();
        let found = solve(&sums(&rows));
        // Coefficients of columns that depend on others are not unique; the fit is.
        for row in rows {
            for color in 0..COLORS {
                let terms = (0..COLUMNS).map(|column| row[column] * found[column][color][7]);
                let (fit, expected) = (terms.sum::<f32>(), row[COLUMNS + color]);
                assert!((fit - expected).abs() < 1e-4, "{color}: {fit} {expected}");
            }
        }
    }

    #[test]
    fn nothing_gives_zeros() {
        let found = solve(&sums(&[]));
        assert_eq!(found, [[[0.0; LANES]; COLORS]; COLUMNS]);
    }
}
