//! Large buffers that are used again: an allocator for binaries that train or denoise.
//!
//! A training step asks for the same few hundred maps every time. The system's allocator gives each back to the system
//! and fetches it again, at a page fault every 4 KiB and a page's zeros written before ours: a seventh of a step's time at
//! C = 64. [`Recycler`] keeps freed blocks of 2 MiB and more for the next one, on pages of 2 MiB where Linux has them, and
//! leaves everything smaller to the system's allocator.
//!
//! ```no_run
//! #[global_allocator]
//! static ALLOCATOR: demc_kernels::memory::Recycler = demc_kernels::memory::Recycler;
//! # fn main() {}
//! ```

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// A large page: where blocks begin, and the smallest that is one, bytes.
const PAGE: usize = 2 << 20;

/// What sizes are rounded up to, bytes.
const GRAIN: usize = 64 << 10;

/// Blocks that can be kept at a time; more go back to the system.
const MOST_KEPT: usize = 256;

/// Share of the bytes in use that may be kept beside them: 1 / this. More is hardly faster, and is memory.
const KEPT_SHARE: usize = 8;

/// Bytes that are kept however little is in use.
const ALWAYS_KEPT: usize = 64 << 20;

/// The system's allocator, but for large blocks, which it keeps.
#[derive(Clone, Copy, Debug, Default)]
pub struct Recycler;

/// A free block.
#[derive(Clone, Copy)]
struct Block {
    address: usize,
    size: usize,
}

/// The free blocks: an array, because an allocator cannot allocate.
struct Free {
    blocks: [Block; MOST_KEPT],
    count: usize,
    bytes: usize,
}

static FREE: Mutex<Free> = Mutex::new(Free {
    blocks: [Block { address: 0, size: 0 }; MOST_KEPT],
    count: 0,
    bytes: 0,
});
static USED: AtomicUsize = AtomicUsize::new(0);
/// Whether this is the allocator of the process.
static INSTALLED: AtomicBool = AtomicBool::new(false);

impl Free {
    /// A block of exactly this size: sizes repeat, and a block's size can be told from what was asked for.
    fn take(&mut self, size: usize) -> Option<Block> {
        let index = (0..self.count).rev().find(|i| self.blocks[*i].size == size)?;
        let block = self.blocks[index];
        self.count -= 1;
        self.blocks[index] = self.blocks[self.count];
        self.bytes -= block.size;
        Some(block)
    }

    /// Whether the block was kept.
    fn put(&mut self, block: Block) -> bool {
        // What a phase of a run leaves behind goes back to the system.
        let most = (USED.load(Ordering::Relaxed) / KEPT_SHARE).max(ALWAYS_KEPT);
        let kept = self.count < MOST_KEPT && self.bytes + block.size <= most;
        if kept {
            self.blocks[self.count] = block;
            self.count += 1;
            self.bytes += block.size;
        }
        kept
    }
}

fn free() -> std::sync::MutexGuard<'static, Free> {
    FREE.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

fn is_large(layout: Layout) -> bool {
    layout.size() >= PAGE && layout.align() <= PAGE
}

/// The layout of the block for an allocation of this size.
fn block_layout(size: usize) -> Layout {
    let size = size.checked_next_multiple_of(GRAIN).unwrap_or(size);
    // A power of two, and sizes were a Layout's before they were rounded up.
    Layout::from_size_align(size, PAGE).unwrap_or_else(|_| Layout::new::<()>())
}

/// A block for `size` bytes, all of them initialised, and whether they are zeros; null where there is no memory.
fn block(size: usize) -> (*mut u8, bool) {
    let layout = block_layout(size);
    if layout.size() < size {
        return (std::ptr::null_mut(), false);
    }
    USED.fetch_add(layout.size(), Ordering::Relaxed);
    if let Some(block) = free().take(layout.size()) {
        return (std::ptr::with_exposed_provenance_mut(block.address), false);
    }
    let pointer = system::fresh(layout);
    if pointer.is_null() {
        USED.fetch_sub(layout.size(), Ordering::Relaxed);
    }
    (pointer, true)
}

/// Where blocks come from: zeroed memory at a multiple of [`PAGE`].
#[cfg(all(target_os = "linux", not(miri)))]
mod system {
    use super::PAGE;
    use std::alloc::Layout;

    /// A block from the kernel itself, which cuts it to size; null where there is none.
    pub(super) fn fresh(layout: Layout) -> *mut u8 {
        let Some(size) = layout.size().checked_add(PAGE) else {
            return std::ptr::null_mut();
        };
        let (access, kind) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_PRIVATE | libc::MAP_ANONYMOUS);
        // SAFETY: a mapping at an address of the kernel's choice; what is unmapped is its own unused ends.
        unsafe {
            let start = libc::mmap(std::ptr::null_mut(), size, access, kind, -1, 0);
            if start == libc::MAP_FAILED {
                return std::ptr::null_mut();
            }
            let head = start.align_offset(PAGE);
            let block = start.byte_add(head);
            if head > 0 {
                libc::munmap(start, head);
            }
            if PAGE > head {
                libc::munmap(block.byte_add(layout.size()), PAGE - head);
            }
            // Refused by kernels without large pages: small ones do as well.
            libc::madvise(block, layout.size(), libc::MADV_HUGEPAGE);
            block.cast()
        }
    }

    /// Gives a block back.
    ///
    /// # Safety
    /// It came from [`fresh`] with this layout, and nobody uses it any more.
    pub(super) unsafe fn give_back(block: *mut u8, layout: Layout) {
        // SAFETY: the caller's.
        unsafe { libc::munmap(block.cast(), layout.size()) };
    }
}

/// Where blocks come from: zeroed memory at a multiple of [`PAGE`].
#[cfg(not(all(target_os = "linux", not(miri))))]
mod system {
    use std::alloc::{GlobalAlloc, Layout, System};

    /// A block of the system's allocator; null where there is none.
    pub(super) fn fresh(layout: Layout) -> *mut u8 {
        // SAFETY: the layout is that of a large block, not empty.
        unsafe { System.alloc_zeroed(layout) }
    }

    /// Gives a block back.
    ///
    /// # Safety
    /// It came from [`fresh`] with this layout, and nobody uses it any more.
    pub(super) unsafe fn give_back(block: *mut u8, layout: Layout) {
        // SAFETY: the caller's.
        unsafe { System.dealloc(block, layout) }
    }
}

/// Takes back a block for `size` bytes.
///
/// # Safety
/// It came from [`block`], for the same size, and nobody uses it any more.
unsafe fn release(pointer: *mut u8, size: usize) {
    let layout = block_layout(size);
    USED.fetch_sub(layout.size(), Ordering::Relaxed);
    let block = Block { address: pointer.expose_provenance(), size: layout.size() };
    if !free().put(block) {
        // SAFETY: the caller's; the layout is that of its size.
        unsafe { system::give_back(pointer, layout) };
    }
}

/// A buffer of `len` values to write into: those of an earlier user where [`Recycler`] is the process's allocator, so
/// that no time goes into zeros that nobody reads; zeros elsewhere.
pub fn buffer(len: usize) -> Vec<f32> {
    let size = len * size_of::<f32>();
    if size < PAGE || !INSTALLED.load(Ordering::Relaxed) {
        return vec![0.0; len];
    }
    let (pointer, _) = block(size);
    assert!(!pointer.is_null(), "no memory for {size} bytes");
    // SAFETY: the block is initialised, for every block is zeroed once, and `len` values fit. Recycler, which is the
    // process's allocator, takes it back by the layout of `len` values.
    unsafe { Vec::from_raw_parts(pointer.cast(), len, len) }
}

// SAFETY: large blocks come from `System` with a layout that depends on the size alone, so that `dealloc` finds it
// again; one that was kept was given up before. All else is `System`'s.
unsafe impl GlobalAlloc for Recycler {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if is_large(layout) {
            INSTALLED.store(true, Ordering::Relaxed);
            return block(layout.size()).0;
        }
        // SAFETY: the caller's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        if !is_large(layout) {
            // SAFETY: the caller's.
            return unsafe { System.alloc_zeroed(layout) };
        }
        INSTALLED.store(true, Ordering::Relaxed);
        let (pointer, zeros) = block(layout.size());
        if !zeros && !pointer.is_null() {
            // SAFETY: the block holds at least this many bytes.
            unsafe { pointer.write_bytes(0, layout.size()) };
        }
        pointer
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        if !is_large(layout) {
            // SAFETY: the caller's.
            return unsafe { System.dealloc(pointer, layout) };
        }
        // SAFETY: a large layout's pointer is a block's.
        unsafe { release(pointer, layout.size()) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let grown = Layout::from_size_align(size, layout.align()).unwrap_or(layout);
        if !is_large(layout) && !is_large(grown) {
            // SAFETY: the caller's.
            return unsafe { System.realloc(pointer, layout, size) };
        }
        if grown.size() < size {
            return std::ptr::null_mut();
        }
        if is_large(layout) && is_large(grown) && block_layout(layout.size()) == block_layout(size) {
            return pointer;
        }
        // SAFETY: both hold the smaller of the sizes, and the old one is given up.
        unsafe {
            let new = self.alloc(grown);
            if !new.is_null() {
                std::ptr::copy_nonoverlapping(pointer, new, layout.size().min(size));
                self.dealloc(pointer, layout);
            }
            new
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_large_block_comes_back_and_is_zeroed_where_asked() {
        let layout = Layout::from_size_align(3 * PAGE - 100, 64).expect("a layout");
        // SAFETY: allocated, used within and freed with one layout.
        unsafe {
            let first = Recycler.alloc(layout);
            first.write_bytes(7, layout.size());
            Recycler.dealloc(first, layout);
            let second = Recycler.alloc_zeroed(layout);
            assert_eq!(second, first, "the block just freed");
            assert!(std::slice::from_raw_parts(second, layout.size()).iter().all(|x| *x == 0));
            Recycler.dealloc(second, layout);
        }
    }

    #[test]
    fn growing_keeps_the_values_across_the_bound() {
        let layout = Layout::from_size_align(100, 4).expect("a layout");
        // SAFETY: as above.
        unsafe {
            let small = Recycler.alloc(layout);
            small.write_bytes(3, 100);
            let large = Recycler.realloc(small, layout, 2 * PAGE);
            assert!(std::slice::from_raw_parts(large, 100).iter().all(|x| *x == 3));
            Recycler.dealloc(large, Layout::from_size_align(2 * PAGE, 4).expect("a layout"));
        }
    }

    #[test]
    fn a_buffer_has_its_length() {
        assert_eq!(buffer(PAGE).len(), PAGE);
    }
}
