//! Reuse of large buffers: an allocator for binaries that train or denoise.
//!
//! Each training step allocates the same few hundred maps. The system's allocator returns each to
//! the system and fetches it again. That costs a page fault every 4 KiB and zeros every page: a
//! seventh of a step's time at C = 64.
//!
//! [`Recycler`] keeps freed blocks of 64 KiB and more for later allocations. It works on Linux and
//! uses pages of 2 MiB where available. It holds at most 8 MiB more than the peak use of the
//! process. Smaller allocations go to the system's allocator.
//!
//! ```no_run
//! #[global_allocator]
//! static ALLOCATOR: demc_kernels::memory::Recycler = demc_kernels::memory::Recycler;
//! # fn main() {}
//! ```

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// Size of a large page on Linux, in bytes. Memory is requested from the system in multiples of it.
const LARGE: usize = 2 << 20;

/// Bytes that may be held above the peak use of the process: the rest of large pages.
const SLACK: usize = 4 * LARGE;

/// Size of the smallest block, in bytes; block sizes are multiples of it.
const GRAIN: usize = 64 << 10;

/// Maximum number of free blocks; further blocks are returned to the system.
const MOST_KEPT: usize = 512;

/// The system's allocator, except that it keeps freed large blocks on Linux.
#[derive(Clone, Copy, Debug, Default)]
pub struct Recycler;

#[derive(Clone, Copy)]
struct FreeBlock {
    address: usize,
    size: usize,
}

/// The free memory, as an array, because an allocator cannot allocate.
struct FreeList {
    blocks: [FreeBlock; MOST_KEPT],
    count: usize,
    bytes: usize,
    /// Bytes in use, and their maximum so far.
    used: usize,
    most_used: usize,
}

static KEPT: Mutex<FreeList> = Mutex::new(FreeList {
    blocks: [FreeBlock {
        address: 0,
        size: 0,
    }; MOST_KEPT],
    count: 0,
    bytes: 0,
    used: 0,
    most_used: 0,
});
/// Whether [`Recycler`] is the allocator of the process.
static INSTALLED: AtomicBool = AtomicBool::new(false);

impl FreeList {
    fn remove(&mut self, index: usize) -> FreeBlock {
        let block = self.blocks[index];
        self.count -= 1;
        self.blocks[index] = self.blocks[self.count];
        self.bytes -= block.size;
        block
    }

    fn insert(&mut self, block: FreeBlock) {
        self.blocks[self.count] = block;
        self.count += 1;
        self.bytes += block.size;
    }

    /// Takes `size` bytes from the smallest block that has them.
    fn take(&mut self, size: usize) -> Option<usize> {
        self.used += size;
        self.most_used = self.most_used.max(self.used);
        let fitting = (0..self.count).filter(|i| self.blocks[*i].size >= size);
        let block = fitting
            .min_by_key(|i| self.blocks[*i].size)
            .map(|i| self.remove(i))?;
        if block.size > size {
            // From the end, so that the rest still starts at a large page.
            self.insert(FreeBlock {
                address: block.address,
                size: block.size - size,
            });
        }
        Some(block.address + block.size - size)
    }

    /// Takes back memory that was in use.
    fn put(&mut self, block: FreeBlock) -> Option<FreeBlock> {
        self.used -= block.size;
        self.keep(block)
    }

    /// Keeps memory, joined with its neighbours. Returns the memory if there is no room for another
    /// block.
    fn keep(&mut self, mut block: FreeBlock) -> Option<FreeBlock> {
        for index in (0..self.count).rev() {
            let other = self.blocks[index];
            let (below, above) = (
                other.address + other.size == block.address,
                block.address + block.size == other.address,
            );
            if below || above {
                self.remove(index);
                block = FreeBlock {
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

    /// Removes some block to return to the system.
    fn any(&mut self) -> Option<FreeBlock> {
        let last = self.count.checked_sub(1)?;
        Some(self.remove(last))
    }

    /// Removes a block to return to the system: the smallest one, as long as more is held than the
    /// peak use. This returns the memory of finished phases of a run, smallest pieces first.
    fn surplus(&mut self) -> Option<FreeBlock> {
        let too_much = self.used + self.bytes > self.most_used + SLACK;
        let smallest = (0..self.count).min_by_key(|i| self.blocks[*i].size);
        smallest.filter(|_| too_much).map(|i| self.remove(i))
    }
}

fn kept() -> std::sync::MutexGuard<'static, FreeList> {
    KEPT.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

fn block_size(size: usize, align: usize) -> Option<usize> {
    let large = cfg!(all(target_os = "linux", not(miri))) && size >= GRAIN && align <= GRAIN;
    large
        .then(|| size.checked_next_multiple_of(GRAIN))
        .flatten()
}

/// An initialised block, and whether it is zeroed; null if there is no memory.
fn block(size: usize) -> (*mut u8, bool) {
    let peak = {
        let mut kept = kept();
        let peak = kept.most_used;
        if let Some(address) = kept.take(size) {
            return (std::ptr::with_exposed_provenance_mut(address), false);
        }
        peak
    };
    // Before the process grows, blocks that are too small for this request are returned.
    give_back(None);
    let mapped = size.next_multiple_of(LARGE);
    let mut pointer = system::map(mapped);
    if pointer.is_null() {
        // A limit may leave no room beside the free blocks.
        std::iter::from_fn(|| kept().any()).for_each(|block| give_back(Some(block)));
        pointer = system::map(mapped);
    }
    if pointer.is_null() {
        let mut kept = kept();
        kept.used -= size;
        kept.most_used = peak.max(kept.used);
    }
    if mapped > size && !pointer.is_null() {
        let rest = FreeBlock {
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
/// The block came from [`block`] with this size and is no longer used.
unsafe fn release(pointer: *mut u8, size: usize) {
    let rejected = kept().put(FreeBlock {
        address: pointer.expose_provenance(),
        size,
    });
    give_back(rejected);
}

fn give_back(mut surplus: Option<FreeBlock>) {
    while let Some(FreeBlock { address, size }) = surplus.take().or_else(|| kept().surplus()) {
        // SAFETY: joined blocks are whole mapped pages. They were free, so nothing uses them.
        unsafe { system::unmap(std::ptr::with_exposed_provenance_mut(address), size) };
    }
}

#[cfg(all(target_os = "linux", not(miri)))]
mod system {
    use super::LARGE;

    /// Zeroed pages at a multiple of a large page; null if there are none.
    pub(super) fn map(size: usize) -> *mut u8 {
        let Some(with_room) = size.checked_add(LARGE) else {
            return std::ptr::null_mut();
        };
        let (access, kind) = (
            libc::PROT_READ | libc::PROT_WRITE,
            libc::MAP_PRIVATE | libc::MAP_ANONYMOUS,
        );
        // SAFETY: the kernel chooses the address. Only the unused ends of this mapping are
        // unmapped.
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
            // Kernels without large pages refuse this; small pages work, too.
            libc::madvise(block, size, libc::MADV_HUGEPAGE);
            block.cast()
        }
    }

    /// Returns pages to the system.
    ///
    /// # Safety
    /// They came from [`map`] and are no longer used.
    pub(super) unsafe fn unmap(block: *mut u8, size: usize) {
        // SAFETY: guaranteed by the caller.
        unsafe { libc::munmap(block.cast(), size) };
    }
}

/// Other systems: no block is large.
#[cfg(not(all(target_os = "linux", not(miri))))]
mod system {
    pub(super) fn map(_size: usize) -> *mut u8 {
        std::ptr::null_mut()
    }

    pub(super) unsafe fn unmap(_block: *mut u8, _size: usize) {}
}

/// A buffer of `len` values to overwrite. If [`Recycler`] is the allocator, it holds old values,
/// which saves the time for zeroing. Otherwise it holds zeros.
pub fn buffer(len: usize) -> Vec<f32> {
    // SAFETY: any bits are a float.
    unsafe { recycled(len) }.unwrap_or_else(|| vec![0.0; len])
}

/// Returns all free memory to the system. A library calls it when its work is done, because other
/// parts of the process may need the memory.
pub fn return_kept() {
    std::iter::from_fn(|| kept().any()).for_each(|block| give_back(Some(block)));
}

/// Bytes of free memory that is kept for later large blocks.
pub fn kept_bytes() -> usize {
    kept().bytes
}

/// Bytes of large blocks in use, and their maximum so far; 0 if [`Recycler`] is not the allocator.
pub fn used() -> [usize; 2] {
    let kept = kept();
    [kept.used, kept.most_used]
}

/// Whether the memory of `len` values of `T` is kept when they are dropped.
pub(crate) fn recycles<T>(len: usize) -> bool {
    kept_size::<T>(len).is_some()
}

/// Size in bytes of the block for `len` values of `T`, if they are large and [`Recycler`] is the
/// allocator.
fn kept_size<T>(len: usize) -> Option<usize> {
    let size = len
        .checked_mul(size_of::<T>())
        .and_then(|size| block_size(size, align_of::<T>()));
    size.filter(|_| INSTALLED.load(Ordering::Relaxed))
}

/// A recycled buffer of `len` values, if they are large and [`Recycler`] is the allocator.
///
/// # Safety
/// Any bits are a value of `T`.
pub(crate) unsafe fn recycled<T>(len: usize) -> Option<Vec<T>> {
    let size = kept_size::<T>(len)?;
    let (pointer, _) = block(size);
    assert!(!pointer.is_null(), "no memory for {size} bytes");
    // SAFETY: the block is initialised, since the kernel's pages are zeros. `len` values fit, and
    // it lies at a multiple of GRAIN. Recycler is the allocator and takes the block back by the
    // layout of `len` values.
    Some(unsafe { Vec::from_raw_parts(pointer.cast(), len, len) })
}

// SAFETY: whether an allocation is a block, and its size, depend on its layout alone, so `dealloc`
// and `realloc` find it again. Blocks are disjoint. The rest is delegated to `System`.
unsafe impl GlobalAlloc for Recycler {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        match block_size(layout.size(), layout.align()) {
            Some(size) => {
                INSTALLED.store(true, Ordering::Relaxed);
                block(size).0
            }
            // SAFETY: guaranteed by the caller.
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
            // SAFETY: guaranteed by the caller.
            None => unsafe { System.alloc_zeroed(layout) },
        }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: guaranteed by the caller; the size of a block follows from its layout.
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
            // SAFETY: guaranteed by the caller.
            return unsafe { System.realloc(pointer, layout, size) };
        }
        if old == new {
            return pointer;
        }
        // SAFETY: both hold the smaller of the two sizes, and the old block is released.
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
