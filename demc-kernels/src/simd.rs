//! Vectors of float32: one trait, one implementation per instruction path, and the selection at run
//! time.
//!
//! A kernel is a [`Leaf`]: code generic over [`Simd`] that runs on one thread. [`run`] compiles it
//! once per path and selects the path at run time. The leaf and all functions that it calls are
//! `#[inline(always)]`, so that they inherit the caller's target features. Threads are spawned
//! outside leaves, because target features do not extend into closures that run elsewhere.

#![allow(clippy::missing_safety_doc, reason = "stated once, at the trait")]

use crate::Isa;

pub(crate) const WIDEST: usize = 16;

/// A vector type and its operations.
///
/// Every function needs the instructions of its path, which [`run`] checks. Functions on pointers
/// need their values to be readable or writable, without alignment.
pub(crate) unsafe trait Simd: Copy + Send + Sync + 'static {
    type V: Copy;
    const LANES: usize;
    /// Accumulators of a product that fit into the registers besides its operands.
    const ACCUMULATORS: usize;
    /// Width of the widest block of columns in a product, in vectors.
    const COLUMNS: usize;

    unsafe fn splat(x: f32) -> Self::V;
    unsafe fn load(p: *const f32) -> Self::V;
    unsafe fn store(p: *mut f32, v: Self::V);
    /// Loads the first `n` values (1 to LANES); the other lanes are 0.
    unsafe fn load_part(p: *const f32, n: usize) -> Self::V;
    /// Stores the first `n` lanes (1 to LANES).
    unsafe fn store_part(p: *mut f32, n: usize, v: Self::V);
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c` with one rounding (two on a path without fused multiply-add).
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// `v` in the lanes where `gate` is positive, 0 elsewhere.
    unsafe fn gate(v: Self::V, gate: Self::V) -> Self::V;
    /// `yes` in the lanes where `a > b`, `no` elsewhere.
    unsafe fn greater(a: Self::V, b: Self::V, yes: Self::V, no: Self::V) -> Self::V;
    /// `v` where it is positive or NaN, 0 elsewhere.
    unsafe fn relu(v: Self::V) -> Self::V;
    /// `a` where it is NaN, `b` elsewhere.
    unsafe fn nan_or(a: Self::V, b: Self::V) -> Self::V;
    /// `a0 b0 a1 b1 ...`, in two vectors.
    unsafe fn interleave(a: Self::V, b: Self::V) -> [Self::V; 2];

    #[inline(always)]
    unsafe fn zero() -> Self::V {
        // SAFETY: guaranteed by the caller.
        unsafe { Self::splat(0.0) }
    }
}

/// Work for one thread.
pub(crate) trait Leaf {
    type Out;
    /// Does the work. Implementations are `#[inline(always)]`.
    ///
    /// # Safety
    /// The machine has the path of `S`, and the leaf's pointers are valid.
    unsafe fn run<S: Simd>(self) -> Self::Out;
}

/// Runs `leaf` on `isa`.
///
/// # Safety
/// As required by the leaf.
///
/// # Panics
/// If the machine does not have `isa`.
#[inline]
pub(crate) unsafe fn run<L: Leaf>(isa: Isa, leaf: L) -> L::Out {
    assert!(isa.is_available(), "{isa} is not on this machine");
    // SAFETY: just checked; the rest is the caller's.
    unsafe {
        match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => x86::avx512(leaf),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => x86::avx2(leaf),
            #[cfg(target_arch = "aarch64")]
            Isa::Neon => neon::neon(leaf),
            _ => leaf.run::<portable::Portable>(),
        }
    }
}

/// Declares functions of an implementation; each body is a single intrinsic.
macro_rules! ops {
    ($( fn $name:ident($($arg:ident: $ty:ty),*) $(-> $out:ty)? $body:block )*) => {
        $(
            #[inline(always)]
            #[allow(unused_unsafe, reason = "some bodies of the portable path are safe")]
            unsafe fn $name($($arg: $ty),*) $(-> $out)? {
                // SAFETY: as stated at the trait: the machine has the instructions, and the
                // pointers are valid.
                unsafe { $body }
            }
        )*
    };
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Leaf, Simd};
    use std::arch::x86_64::*;

    #[derive(Clone, Copy)]
    pub(super) struct Avx512;
    #[derive(Clone, Copy)]
    pub(super) struct Avx2;

    #[target_feature(enable = "avx512f,avx2,fma")]
    pub(super) unsafe fn avx512<L: Leaf>(leaf: L) -> L::Out {
        // SAFETY: guaranteed by the caller.
        unsafe { leaf.run::<Avx512>() }
    }

    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn avx2<L: Leaf>(leaf: L) -> L::Out {
        // SAFETY: guaranteed by the caller.
        unsafe { leaf.run::<Avx2>() }
    }

    #[inline(always)]
    fn mask16(n: usize) -> __mmask16 {
        ((1u32 << n) - 1) as __mmask16
    }

    // SAFETY: each function is the instruction that its name says.
    unsafe impl Simd for Avx512 {
        type V = __m512;
        const LANES: usize = 16;
        const ACCUMULATORS: usize = 24;
        const COLUMNS: usize = 4;

        ops! {
            fn splat(x: f32) -> __m512 { _mm512_set1_ps(x) }
            fn load(p: *const f32) -> __m512 { _mm512_loadu_ps(p) }
            fn store(p: *mut f32, v: __m512) { _mm512_storeu_ps(p, v) }
            fn load_part(p: *const f32, n: usize) -> __m512 { _mm512_maskz_loadu_ps(mask16(n), p) }
            fn store_part(p: *mut f32, n: usize, v: __m512) { _mm512_mask_storeu_ps(p, mask16(n), v) }
            fn add(a: __m512, b: __m512) -> __m512 { _mm512_add_ps(a, b) }
            fn sub(a: __m512, b: __m512) -> __m512 { _mm512_sub_ps(a, b) }
            fn mul(a: __m512, b: __m512) -> __m512 { _mm512_mul_ps(a, b) }
            fn fma(a: __m512, b: __m512, c: __m512) -> __m512 { _mm512_fmadd_ps(a, b, c) }
            fn gate(v: __m512, gate: __m512) -> __m512 {
                _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(gate, _mm512_setzero_ps()), v)
            }
            fn greater(a: __m512, b: __m512, yes: __m512, no: __m512) -> __m512 {
                _mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(a, b), no, yes)
            }
            // The instruction returns its second operand if one operand is NaN.
            fn relu(v: __m512) -> __m512 { _mm512_max_ps(_mm512_setzero_ps(), v) }
            fn nan_or(a: __m512, b: __m512) -> __m512 {
                _mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_UNORD_Q>(a, a), b, a)
            }
            fn interleave(a: __m512, b: __m512) -> [__m512; 2] {
                let low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
                let high = _mm512_add_epi32(low, _mm512_set1_epi32(8));
                [_mm512_permutex2var_ps(a, low, b), _mm512_permutex2var_ps(a, high, b)]
            }
        }
    }

    #[inline(always)]
    unsafe fn mask8(n: usize) -> __m256i {
        const ONES_THEN_ZEROS: [i32; 16] = [-1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0];
        // SAFETY: 8 values from 8 - n, n from 0 to 8, lie inside.
        unsafe { _mm256_loadu_si256(ONES_THEN_ZEROS.as_ptr().add(8 - n).cast()) }
    }

    // SAFETY: each function is the instruction that its name says.
    unsafe impl Simd for Avx2 {
        type V = __m256;
        const LANES: usize = 8;
        const ACCUMULATORS: usize = 12;
        const COLUMNS: usize = 2;

        ops! {
            fn splat(x: f32) -> __m256 { _mm256_set1_ps(x) }
            fn load(p: *const f32) -> __m256 { _mm256_loadu_ps(p) }
            fn store(p: *mut f32, v: __m256) { _mm256_storeu_ps(p, v) }
            fn load_part(p: *const f32, n: usize) -> __m256 { _mm256_maskload_ps(p, mask8(n)) }
            fn store_part(p: *mut f32, n: usize, v: __m256) { _mm256_maskstore_ps(p, mask8(n), v) }
            fn add(a: __m256, b: __m256) -> __m256 { _mm256_add_ps(a, b) }
            fn sub(a: __m256, b: __m256) -> __m256 { _mm256_sub_ps(a, b) }
            fn mul(a: __m256, b: __m256) -> __m256 { _mm256_mul_ps(a, b) }
            fn fma(a: __m256, b: __m256, c: __m256) -> __m256 { _mm256_fmadd_ps(a, b, c) }
            fn gate(v: __m256, gate: __m256) -> __m256 {
                _mm256_and_ps(v, _mm256_cmp_ps::<_CMP_GT_OQ>(gate, _mm256_setzero_ps()))
            }
            fn greater(a: __m256, b: __m256, yes: __m256, no: __m256) -> __m256 {
                _mm256_blendv_ps(no, yes, _mm256_cmp_ps::<_CMP_GT_OQ>(a, b))
            }
            // The instruction returns its second operand if one operand is NaN.
            fn relu(v: __m256) -> __m256 { _mm256_max_ps(_mm256_setzero_ps(), v) }
            fn nan_or(a: __m256, b: __m256) -> __m256 {
                _mm256_blendv_ps(b, a, _mm256_cmp_ps::<_CMP_UNORD_Q>(a, a))
            }
            fn interleave(a: __m256, b: __m256) -> [__m256; 2] {
                let (low, high) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
                [_mm256_permute2f128_ps::<0x20>(low, high), _mm256_permute2f128_ps::<0x31>(low, high)]
            }
        }
    }
}

#[cfg(target_arch = "aarch64")]
mod neon {
    use super::{Leaf, Simd};
    use std::arch::aarch64::*;

    #[derive(Clone, Copy)]
    pub(super) struct Neon;

    #[target_feature(enable = "neon")]
    pub(super) unsafe fn neon<L: Leaf>(leaf: L) -> L::Out {
        // SAFETY: guaranteed by the caller.
        unsafe { leaf.run::<Neon>() }
    }

    // SAFETY: each function is the instruction that its name says.
    unsafe impl Simd for Neon {
        type V = float32x4_t;
        const LANES: usize = 4;
        const ACCUMULATORS: usize = 24;
        const COLUMNS: usize = 4;

        ops! {
            fn splat(x: f32) -> float32x4_t { vdupq_n_f32(x) }
            fn load(p: *const f32) -> float32x4_t { vld1q_f32(p) }
            fn store(p: *mut f32, v: float32x4_t) { vst1q_f32(p, v) }
            fn load_part(p: *const f32, n: usize) -> float32x4_t {
                let mut lanes = [0.0; 4];
                std::ptr::copy_nonoverlapping(p, lanes.as_mut_ptr(), n);
                vld1q_f32(lanes.as_ptr())
            }
            fn store_part(p: *mut f32, n: usize, v: float32x4_t) {
                let mut lanes = [0.0; 4];
                vst1q_f32(lanes.as_mut_ptr(), v);
                std::ptr::copy_nonoverlapping(lanes.as_ptr(), p, n);
            }
            fn add(a: float32x4_t, b: float32x4_t) -> float32x4_t { vaddq_f32(a, b) }
            fn sub(a: float32x4_t, b: float32x4_t) -> float32x4_t { vsubq_f32(a, b) }
            fn mul(a: float32x4_t, b: float32x4_t) -> float32x4_t { vmulq_f32(a, b) }
            fn fma(a: float32x4_t, b: float32x4_t, c: float32x4_t) -> float32x4_t { vfmaq_f32(c, a, b) }
            fn gate(v: float32x4_t, gate: float32x4_t) -> float32x4_t {
                vbslq_f32(vcgtzq_f32(gate), v, vdupq_n_f32(0.0))
            }
            fn greater(a: float32x4_t, b: float32x4_t, yes: float32x4_t, no: float32x4_t) -> float32x4_t {
                vbslq_f32(vcgtq_f32(a, b), yes, no)
            }
            // The instruction returns NaN if an operand is NaN.
            fn relu(v: float32x4_t) -> float32x4_t { vmaxq_f32(v, vdupq_n_f32(0.0)) }
            fn nan_or(a: float32x4_t, b: float32x4_t) -> float32x4_t { vbslq_f32(vceqq_f32(a, a), b, a) }
            fn interleave(a: float32x4_t, b: float32x4_t) -> [float32x4_t; 2] { [vzip1q_f32(a, b), vzip2q_f32(a, b)] }
        }
    }
}

mod portable {
    use super::Simd;

    /// Four lanes, as in SSE2, which every 64-bit PC has, and as on most other architectures.
    #[derive(Clone, Copy)]
    pub(super) struct Portable;

    #[inline(always)]
    fn zip(a: [f32; 4], b: [f32; 4], f: impl Fn(f32, f32) -> f32) -> [f32; 4] {
        std::array::from_fn(|i| f(a[i], b[i]))
    }

    // SAFETY: it uses no special instructions.
    unsafe impl Simd for Portable {
        type V = [f32; 4];
        const LANES: usize = 4;
        const ACCUMULATORS: usize = 8;
        const COLUMNS: usize = 2;

        ops! {
            fn splat(x: f32) -> [f32; 4] { [x; 4] }
            fn load(p: *const f32) -> [f32; 4] { p.cast::<[f32; 4]>().read_unaligned() }
            fn store(p: *mut f32, v: [f32; 4]) { p.cast::<[f32; 4]>().write_unaligned(v) }
            fn load_part(p: *const f32, n: usize) -> [f32; 4] {
                let mut lanes = [0.0; 4];
                std::ptr::copy_nonoverlapping(p, lanes.as_mut_ptr(), n);
                lanes
            }
            fn store_part(p: *mut f32, n: usize, v: [f32; 4]) {
                std::ptr::copy_nonoverlapping(v.as_ptr(), p, n)
            }
            fn add(a: [f32; 4], b: [f32; 4]) -> [f32; 4] { zip(a, b, |a, b| a + b) }
            fn sub(a: [f32; 4], b: [f32; 4]) -> [f32; 4] { zip(a, b, |a, b| a - b) }
            fn mul(a: [f32; 4], b: [f32; 4]) -> [f32; 4] { zip(a, b, |a, b| a * b) }
            fn fma(a: [f32; 4], b: [f32; 4], c: [f32; 4]) -> [f32; 4] {
                std::array::from_fn(|i| a[i] * b[i] + c[i])
            }
            fn gate(v: [f32; 4], gate: [f32; 4]) -> [f32; 4] { zip(v, gate, |v, g| if g > 0.0 { v } else { 0.0 }) }
            fn greater(a: [f32; 4], b: [f32; 4], yes: [f32; 4], no: [f32; 4]) -> [f32; 4] {
                std::array::from_fn(|i| if a[i] > b[i] { yes[i] } else { no[i] })
            }
            fn relu(v: [f32; 4]) -> [f32; 4] { v.map(|v| if 0.0 > v { 0.0 } else { v }) }
            fn nan_or(a: [f32; 4], b: [f32; 4]) -> [f32; 4] { zip(a, b, |a, b| if a.is_nan() { a } else { b }) }
            fn interleave(a: [f32; 4], b: [f32; 4]) -> [[f32; 4]; 2] {
                [[a[0], b[0], a[1], b[1]], [a[2], b[2], a[3], b[3]]]
            }
        }
    }
}
