//! Large buffers that are used again: an allocator for binaries that train or denoise.
//!
//! A training step asks for the same few hundred maps every time. The system's allocator gives each back to the system
//! and fetches it again, at a page fault every 4 KiB and a page's zeros written before ours: a seventh of a step's time at
//! C = 64. [`Recycler`] keeps freed blocks of 64 KiB and more for the next ones, on Linux, on pages of 2 MiB where there
//! are; it holds 8 MiB more than the process once used and no more, and leaves everything smaller to the system's allocator.
//!
//! ```no_run
//! #[global_allocator]
//! static ALLOCATOR: demc_kernels::memory::Recycler = demc_kernels::memory::Recycler;
//! # fn main() {}
//! ```

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// A large page of Linux, bytes: memory is fetched from the system in multiples of it.
const LARGE: usize = 2 << 20;

/// Bytes that may be held beyond what the process once used: the rests of large pages.
const SLACK: usize = 4 * LARGE;

/// The smallest block, and what sizes are rounded up to, bytes.
const GRAIN: usize = 64 << 10;

/// Blocks that can be kept at a time; more go back to the system.
const MOST_KEPT: usize = 512;

/// The system's allocator, but on Linux for large blocks, which it keeps.
#[derive(Clone, Copy, Debug, Default)]
pub struct Recycler;

/// A stretch of free memory.
#[derive(Clone, Copy)]
struct Block {
    address: usize,
    size: usize,
}

/// The memory that is kept: an array, because an allocator cannot allocate.
struct Kept {
    blocks: [Block; MOST_KEPT],
    count: usize,
    /// Bytes of all blocks.
    bytes: usize,
    /// Bytes that the process uses, and the most so far.
    used: usize,
    most_used: usize,
}

static KEPT: Mutex<Kept> = Mutex::new(Kept {
    blocks: [Block {
        address: 0,
        size: 0,
    }; MOST_KEPT],
    count: 0,
    bytes: 0,
    used: 0,
    most_used: 0,
});
/// Whether this is the allocator of the process.
static INSTALLED: AtomicBool = AtomicBool::new(false);

impl Kept {
    fn remove(&mut self, index: usize) -> Block {
        let block = self.blocks[index];
        self.count -= 1;
        self.blocks[index] = self.blocks[self.count];
        self.bytes -= block.size;
        block
    }

    fn insert(&mut self, block: Block) {
        self.blocks[self.count] = block;
        self.count += 1;
        self.bytes += block.size;
    }

    /// Memory of this size, cut from the smallest block that has it.
    fn take(&mut self, size: usize) -> Option<usize> {
        self.used += size;
        self.most_used = self.most_used.max(self.used);
        let fitting = (0..self.count).filter(|i| self.blocks[*i].size >= size);
        let block = fitting
            .min_by_key(|i| self.blocks[*i].size)
            .map(|i| self.remove(i))?;
        if block.size > size {
            // From the end, so that what stays begins where a large page does.
            self.insert(Block {
                address: block.address,
                size: block.size - size,
            });
        }
        Some(block.address + block.size - size)
    }

    /// Takes memory back that was used.
    fn put(&mut self, block: Block) -> Option<Block> {
        self.used -= block.size;
        self.keep(block)
    }

    /// Keeps memory, joined with its neighbours; the memory itself where there is no room for one more block.
    fn keep(&mut self, mut block: Block) -> Option<Block> {
        for index in (0..self.count).rev() {
            let other = self.blocks[index];
            let (below, above) = (
                other.address + other.size == block.address,
                block.address + block.size == other.address,
            );
            if below || above {
                self.remove(index);
                block = Block {
                    address: block.address.min(other.address),
                    size: block.size + other.size,
                };
            }
        }
        if self.count == MOST_KEPT {
            return Some(block);
        }
        self.insert(block);
        None
    }

    /// A block to give back to the system: the smallest one, while more is held than the process once used. So what a
    /// phase of a run leaves behind goes back, and splinters go first.
    fn surplus(&mut self) -> Option<Block> {
        let too_much = self.used + self.bytes > self.most_used + SLACK;
        let smallest = (0..self.count).min_by_key(|i| self.blocks[*i].size);
        smallest.filter(|_| too_much).map(|i| self.remove(i))
    }
}

fn kept() -> std::sync::MutexGuard<'static, Kept> {
    KEPT.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

/// Bytes of the block for an allocation; none where the system's allocator has it.
fn block_size(size: usize, align: usize) -> Option<usize> {
    let large = cfg!(all(target_os = "linux", not(miri))) && size >= GRAIN && align <= GRAIN;
    large
        .then(|| size.checked_next_multiple_of(GRAIN))
        .flatten()
}

/// A block, all of it initialised, and whether it is zeros; null where there is no memory.
fn block(size: usize) -> (*mut u8, bool) {
    if let Some(address) = kept().take(size) {
        return (std::ptr::with_exposed_provenance_mut(address), false);
    }
    // Pieces too small for this must not make the process larger than what it uses.
    give_back(None);
    let mapped = size.next_multiple_of(LARGE);
    let pointer = system::map(mapped);
    if mapped > size && !pointer.is_null() {
        let rest = Block {
            address: pointer.expose_provenance() + size,
            size: mapped - size,
        };
        let rejected = kept().keep(rest);
        give_back(rejected);
    }
    (pointer, true)
}

/// Takes back a block.
///
/// # Safety
/// It came from [`block`], of this size, and nobody uses it any more.
unsafe fn release(pointer: *mut u8, size: usize) {
    let rejected = kept().put(Block {
        address: pointer.expose_provenance(),
        size,
    });
    give_back(rejected);
}

/// Gives a block that was not kept, and all surplus, back to the system.
fn give_back(mut surplus: Option<Block>) {
    while let Some(Block { address, size }) = surplus.take().or_else(|| kept().surplus()) {
        // SAFETY: joined blocks are whole pages that were mapped; these were kept, so they are nobody's.
        unsafe { system::unmap(std::ptr::with_exposed_provenance_mut(address), size) };
    }
}

/// Where blocks come from: the kernel.
#[cfg(all(target_os = "linux", not(miri)))]
mod system {
    use super::LARGE;

    /// Zeroed pages at a multiple of a large page; null where there are none.
    pub(super) fn map(size: usize) -> *mut u8 {
        let Some(with_room) = size.checked_add(LARGE) else {
            return std::ptr::null_mut();
        };
        let (access, kind) = (
            libc::PROT_READ | libc::PROT_WRITE,
            libc::MAP_PRIVATE | libc::MAP_ANONYMOUS,
        );
        // SAFETY: a mapping at an address of the kernel's choice; what is unmapped is its own unused ends.
        unsafe {
            let start = libc::mmap(std::ptr::null_mut(), with_room, access, kind, -1, 0);
            if start == libc::MAP_FAILED {
                return std::ptr::null_mut();
            }
            let head = start.align_offset(LARGE);
            let block = start.byte_add(head);
            if head > 0 {
                libc::munmap(start, head);
            }
            if LARGE > head {
                libc::munmap(block.byte_add(size), LARGE - head);
            }
            // Refused by kernels without large pages: small ones do as well.
            libc::madvise(block, size, libc::MADV_HUGEPAGE);
            block.cast()
        }
    }

    /// Gives pages back.
    ///
    /// # Safety
    /// They came from [`map`], and nobody uses them any more.
    pub(super) unsafe fn unmap(block: *mut u8, size: usize) {
        // SAFETY: the caller's.
        unsafe { libc::munmap(block.cast(), size) };
    }
}

/// Nowhere: no block is large.
#[cfg(not(all(target_os = "linux", not(miri))))]
mod system {
    pub(super) fn map(_size: usize) -> *mut u8 {
        std::ptr::null_mut()
    }

    pub(super) unsafe fn unmap(_block: *mut u8, _size: usize) {}
}

/// A buffer of `len` values to write into: those of an earlier user where [`Recycler`] is the process's allocator, so
/// that no time goes into zeros that nobody reads; zeros elsewhere.
pub fn buffer(len: usize) -> Vec<f32> {
    // SAFETY: any bits are a float.
    unsafe { recycled(len) }.unwrap_or_else(|| vec![0.0; len])
}

/// Bytes of free memory that is kept for the next large blocks.
pub fn kept_bytes() -> usize {
    kept().bytes
}

/// Bytes in large blocks that the process uses, and the most that it used at a time; 0 where [`Recycler`] is not its
/// allocator.
pub fn used() -> [usize; 2] {
    let kept = kept();
    [kept.used, kept.most_used]
}

/// Whether `len` values of a type are kept when they are dropped.
pub(crate) fn recycles<T>(len: usize) -> bool {
    kept_size::<T>(len).is_some()
}

/// Bytes of the block for `len` values, where [`Recycler`] is the process's allocator and they are large.
fn kept_size<T>(len: usize) -> Option<usize> {
    let size = len
        .checked_mul(size_of::<T>())
        .and_then(|size| block_size(size, align_of::<T>()));
    size.filter(|_| INSTALLED.load(Ordering::Relaxed))
}

/// `len` values of an earlier user, where they are large and [`Recycler`] is the process's allocator.
///
/// # Safety
/// Any bits are a value of `T`.
pub(crate) unsafe fn recycled<T>(len: usize) -> Option<Vec<T>> {
    let size = kept_size::<T>(len)?;
    let (pointer, _) = block(size);
    assert!(!pointer.is_null(), "no memory for {size} bytes");
    // SAFETY: the block is initialised, for the kernel's pages are zeros, `len` values fit, and it lies at a multiple of
    // GRAIN. Recycler, which is the process's allocator, takes it back by the layout of `len` values.
    Some(unsafe { Vec::from_raw_parts(pointer.cast(), len, len) })
}

// SAFETY: whether an allocation is a block, and of which size, depends on its layout alone, so that `dealloc` and
// `realloc` find it again; blocks are disjoint. All else is `System`'s.
unsafe impl GlobalAlloc for Recycler {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        match block_size(layout.size(), layout.align()) {
            Some(size) => {
                INSTALLED.store(true, Ordering::Relaxed);
                block(size).0
            }
            // SAFETY: the caller's.
            None => unsafe { System.alloc(layout) },
        }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        match block_size(layout.size(), layout.align()) {
            Some(size) => {
                INSTALLED.store(true, Ordering::Relaxed);
                let (pointer, zeros) = block(size);
                if !zeros && !pointer.is_null() {
                    // SAFETY: the block holds at least this many bytes.
                    unsafe { pointer.write_bytes(0, layout.size()) };
                }
                pointer
            }
            // SAFETY: the caller's.
            None => unsafe { System.alloc_zeroed(layout) },
        }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's; a block's size is that of its layout.
        unsafe {
            match block_size(layout.size(), layout.align()) {
                Some(size) => release(pointer, size),
                None => System.dealloc(pointer, layout),
            }
        }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        let Ok(grown) = Layout::from_size_align(size, layout.align()) else {
            return std::ptr::null_mut();
        };
        let (old, new) = (
            block_size(layout.size(), layout.align()),
            block_size(size, layout.align()),
        );
        if old.is_none() && new.is_none() {
            // SAFETY: the caller's.
            return unsafe { System.realloc(pointer, layout, size) };
        }
        if old == new {
            return pointer;
        }
        // SAFETY: both hold the smaller of the sizes, and the old one is given up.
        unsafe {
            let moved = self.alloc(grown);
            if !moved.is_null() {
                std::ptr::copy_nonoverlapping(pointer, moved, layout.size().min(size));
                self.dealloc(pointer, layout);
            }
            moved
        }
    }
}

#[cfg(test)]
mod tests;
