//! One-dimensional transforms of the two tile sizes, named by their input length, and their use in
//! two dimensions.

use crate::simd::Simd;

/// `B^T d`.
///
/// # Safety
/// The machine has the path of `S`; this holds for all functions here.
#[inline(always)]
pub(super) unsafe fn input<S: Simd, const IN: usize>(d: [S::V; IN]) -> [S::V; IN] {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let mut t = d;
        if IN == 4 {
            t[0] = S::sub(d[0], d[2]);
            t[1] = S::add(d[1], d[2]);
            t[2] = S::sub(d[2], d[1]);
            t[3] = S::sub(d[1], d[3]);
        } else {
            let (two, four, five) = (S::splat(2.0), S::splat(4.0), S::splat(-5.0));
            let even = S::fma(four, S::sub(S::zero(), d[2]), d[4]);
            let odd = S::fma(four, S::sub(S::zero(), d[1]), d[3]);
            let (near, far) = (S::sub(d[4], d[2]), S::mul(two, S::sub(d[3], d[1])));
            t[0] = S::fma(four, d[0], S::fma(five, d[2], d[4]));
            t[1] = S::add(even, odd);
            t[2] = S::sub(even, odd);
            t[3] = S::add(near, far);
            t[4] = S::sub(near, far);
            t[5] = S::fma(four, d[1], S::fma(five, d[3], d[5]));
        }
        t
    }
}

/// `A^T m`, of which the first `IN - 2` count.
#[inline(always)]
pub(super) unsafe fn output<S: Simd, const IN: usize>(m: [S::V; IN]) -> [S::V; IN] {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let mut y = m;
        if IN == 4 {
            y[0] = S::add(S::add(m[0], m[1]), m[2]);
            y[1] = S::sub(S::sub(m[1], m[2]), m[3]);
        } else {
            let (two, four, eight) = (S::splat(2.0), S::splat(4.0), S::splat(8.0));
            let (s1, d1) = (S::add(m[1], m[2]), S::sub(m[1], m[2]));
            let (s2, d2) = (S::add(m[3], m[4]), S::sub(m[3], m[4]));
            y[0] = S::add(S::add(m[0], s1), s2);
            y[1] = S::fma(two, d2, d1);
            y[2] = S::fma(four, s2, s1);
            y[3] = S::add(S::fma(eight, d2, d1), m[5]);
        }
        y
    }
}

/// `A y`: the transpose of [`output`], for the first `IN - 2` values.
#[inline(always)]
pub(super) unsafe fn output_transposed<S: Simd, const IN: usize>(y: [S::V; IN]) -> [S::V; IN] {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let mut m = y;
        if IN == 4 {
            m[0] = y[0];
            m[1] = S::add(y[0], y[1]);
            m[2] = S::sub(y[0], y[1]);
            m[3] = S::sub(S::zero(), y[1]);
        } else {
            let (two, four, eight) = (S::splat(2.0), S::splat(4.0), S::splat(8.0));
            let (even, odd) = (S::add(y[0], y[2]), S::add(y[1], y[3]));
            let (even2, odd2) = (
                S::fma(four, y[2], y[0]),
                S::fma(eight, y[3], S::mul(two, y[1])),
            );
            m[0] = y[0];
            m[1] = S::add(even, odd);
            m[2] = S::sub(even, odd);
            m[3] = S::add(even2, odd2);
            m[4] = S::sub(even2, odd2);
            m[5] = y[3];
        }
        m
    }
}

/// `G w`, of the first 3.
#[inline(always)]
pub(super) unsafe fn weight<S: Simd, const IN: usize>(w: [S::V; IN]) -> [S::V; IN] {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let mut u = w;
        if IN == 4 {
            let half = S::splat(0.5);
            let (sum, mid) = (S::mul(half, S::add(w[0], w[2])), S::mul(half, w[1]));
            u[0] = w[0];
            u[1] = S::add(sum, mid);
            u[2] = S::sub(sum, mid);
            u[3] = w[2];
        } else {
            let (sixth, twelfth) = (S::splat(-1.0 / 6.0), S::splat(1.0 / 12.0));
            let (sum, mid) = (S::mul(sixth, S::add(w[0], w[2])), S::mul(sixth, w[1]));
            let far = S::fma(
                S::splat(1.0 / 24.0),
                w[0],
                S::mul(S::splat(1.0 / 6.0), w[2]),
            );
            let mid2 = S::mul(twelfth, w[1]);
            u[0] = S::mul(S::splat(0.25), w[0]);
            u[1] = S::add(sum, mid);
            u[2] = S::sub(sum, mid);
            u[3] = S::add(far, mid2);
            u[4] = S::sub(far, mid2);
            u[5] = w[2];
        }
        u
    }
}

/// `G^T u`, of which the first 3 count.
#[inline(always)]
pub(super) unsafe fn weight_transposed<S: Simd, const IN: usize>(u: [S::V; IN]) -> [S::V; IN] {
    // SAFETY: guaranteed by the caller.
    unsafe {
        let mut w = u;
        let (s1, d1) = (S::add(u[1], u[2]), S::sub(u[1], u[2]));
        if IN == 4 {
            let half = S::splat(0.5);
            w[0] = S::fma(half, s1, u[0]);
            w[1] = S::mul(half, d1);
            w[2] = S::fma(half, s1, u[3]);
        } else {
            let (sixth, twelfth) = (S::splat(1.0 / 6.0), S::splat(1.0 / 12.0));
            let (s2, d2) = (S::add(u[3], u[4]), S::sub(u[3], u[4]));
            let near = S::mul(sixth, s1);
            w[0] = S::sub(
                S::fma(S::splat(0.25), u[0], S::mul(S::splat(1.0 / 24.0), s2)),
                near,
            );
            w[1] = S::sub(S::mul(twelfth, d2), S::mul(sixth, d1));
            w[2] = S::add(S::sub(S::mul(sixth, s2), near), u[5]);
        }
        w
    }
}

/// Expands the body once for each `$i` below `$n` (at most 6), with `$i` as a constant. An array
/// indexed inside a real loop would live in memory instead of registers.
macro_rules! each {
    ($i:ident < $n:expr, $body:block) => {{
        each!(@ $i, $n, $body, 0 1 2 3 4 5);
    }};
    (@ $i:ident, $n:expr, $body:block, $($value:literal)*) => {
        $(
            if $value < $n {
                let $i: usize = $value;
                $body
            }
        )*
    };
}

pub(super) use each;

/// A transform in both dimensions: over all columns, then over all rows.
macro_rules! both {
    ($f:path, $s:ty, $n:expr, $d:expr) => {{
        let mut values = $d;
        each!(c < $n, {
            let mut column: [<$s>::V; $n] = [values[0][c]; $n];
            each!(r < $n, {
                column[r] = values[r][c];
            });
            let column = $f(column);
            each!(r < $n, {
                values[r][c] = column[r];
            });
        });
        each!(r < $n, {
            values[r] = $f(values[r]);
        });
        values
    }};
}

pub(super) use both;
