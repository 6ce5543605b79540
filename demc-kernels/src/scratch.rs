//! Reuse of buffers: a training step asks for the same sizes every time, and fresh memory costs a
//! page fault every 4 KiB. The allocator keeps large buffers for all users; this module keeps small
//! ones.

use std::ops::{Deref, DerefMut};
use std::sync::Mutex;

use crate::memory;

#[derive(Clone, Copy)]
#[repr(align(64))]
struct CacheLine(#[allow(dead_code, reason = "read through a pointer")] [f32; LINE]);

const LINE: usize = 16;

static POOL: Mutex<Vec<Vec<CacheLine>>> = Mutex::new(Vec::new());

/// A buffer of float32 that starts at a cache line and holds arbitrary old values.
pub(crate) struct Scratch {
    lines: Vec<CacheLine>,
    len: usize,
}

impl Scratch {
    /// A buffer of `len` values: the smallest returned buffer that is large enough, else the
    /// largest one, grown.
    pub(crate) fn take(len: usize) -> Self {
        let count = len.div_ceil(LINE);
        // SAFETY: any bits are floats.
        if let Some(lines) = unsafe { memory::recycled(count) } {
            return Scratch { lines, len };
        }
        let mut lines = {
            let mut pool = POOL.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
            let fitting = pool.iter().enumerate().filter(|(_, b)| b.len() >= count);
            let best = fitting.min_by_key(|(_, b)| b.len()).map(|(i, _)| i);
            let largest = || (0..pool.len()).max_by_key(|i| pool[*i].len());
            match best.or_else(largest) {
                Some(index) => pool.swap_remove(index),
                None => Vec::new(),
            }
        };
        if lines.len() < count {
            lines = Vec::new();
            lines.resize(count, CacheLine([0.0; LINE]));
        }
        Scratch { lines, len }
    }

    pub(crate) fn zeroed(len: usize) -> Self {
        let mut scratch = Self::take(len);
        scratch.fill(0.0);
        scratch
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let lines = std::mem::take(&mut self.lines);
        if memory::recycles::<CacheLine>(lines.len()) {
            return;
        }
        POOL.lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner())
            .push(lines);
    }
}

impl Deref for Scratch {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        // SAFETY: a `CacheLine` is LINE initialised values without padding, and the buffer has at
        // least `len` of them.
        unsafe { std::slice::from_raw_parts(self.lines.as_ptr().cast(), self.len) }
    }
}

impl DerefMut for Scratch {
    fn deref_mut(&mut self) -> &mut [f32] {
        // SAFETY: as for `deref`, and `self` is borrowed mutably.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), self.len) }
    }
}

/// A pointer that threads may share. Each use states which values it reads and writes.
#[derive(Clone, Copy)]
pub(crate) struct Shared(*mut f32);

// SAFETY: a pointer is a number; each use states why its accesses are sound.
unsafe impl Send for Shared {}
// SAFETY: as above.
unsafe impl Sync for Shared {}

impl Shared {
    pub(crate) fn new(slice: &mut [f32]) -> Self {
        Shared(slice.as_mut_ptr())
    }

    pub(crate) fn offset(self, values: usize) -> Self {
        Shared(self.0.wrapping_add(values))
    }

    pub(crate) fn pointer(self) -> *mut f32 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_are_aligned_and_come_back() {
        let mut first = Scratch::take(100);
        first[99] = 7.0;
        assert_eq!(first.as_ptr().addr() % 64, 0);
        drop(first);
        let zeros = Scratch::zeroed(50);
        assert!(zeros.iter().all(|x| *x == 0.0) && zeros.len() == 50);
    }
}
