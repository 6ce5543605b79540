//! Tests the allocator by running on it, and tests its bookkeeping.

use super::*;

/// The allocator of all tests of this crate: [`Recycler`] must take back every block that it
/// returned.
#[global_allocator]
static ALLOCATOR: Recycler = Recycler;

#[test]
fn a_large_block_comes_back_and_is_zeroed_where_asked() {
    // Under Miri all memory is the system's, and Miri is slow.
    let size = if cfg!(miri) { 100 } else { 3 * LARGE - 100 };
    let layout = Layout::from_size_align(size, 64).expect("a layout");
    // SAFETY: allocated, used within and freed with one layout.
    unsafe {
        let first = Recycler.alloc(layout);
        first.write_bytes(7, layout.size());
        Recycler.dealloc(first, layout);
        let second = Recycler.alloc_zeroed(layout);
        assert!(
            std::slice::from_raw_parts(second, layout.size())
                .iter()
                .all(|x| *x == 0)
        );
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
        let large = Recycler.realloc(small, layout, 2 * LARGE);
        assert!(
            std::slice::from_raw_parts(large, 100)
                .iter()
                .all(|x| *x == 3)
        );
        Recycler.dealloc(
            large,
            Layout::from_size_align(2 * LARGE, 4).expect("a layout"),
        );
    }
}

#[test]
fn memory_is_cut_and_joined_again() {
    let mut kept = FreeList {
        blocks: [FreeBlock {
            address: 0,
            size: 0,
        }; MOST_KEPT],
        count: 0,
        bytes: 0,
        used: 0,
        most_used: 0,
    };
    assert_eq!(kept.take(10), None);
    assert!(
        kept.put(FreeBlock {
            address: 100,
            size: 10
        })
        .is_none()
    );
    let (end, start) = (
        kept.take(4).expect("a part"),
        kept.take(6).expect("the rest"),
    );
    assert_eq!((start, end), (100, 106));
    assert!(
        kept.put(FreeBlock {
            address: end,
            size: 4
        })
        .is_none()
    );
    assert!(
        kept.put(FreeBlock {
            address: start,
            size: 6
        })
        .is_none()
    );
    assert_eq!(
        (kept.count, kept.bytes, kept.blocks[0].address),
        (1, 10, 100)
    );
    // Little more than the peak use is kept.
    assert_eq!(kept.take(SLACK), None);
    assert!(
        kept.put(FreeBlock {
            address: 200,
            size: SLACK
        })
        .is_none()
    );
    assert!(kept.surplus().is_none());
    assert_eq!(kept.take(2 * SLACK + 1), None);
    assert!(
        kept.put(FreeBlock {
            address: 2 * SLACK,
            size: 2 * SLACK + 1
        })
        .is_none()
    );
    assert_eq!(
        kept.surplus().map(|block| block.address),
        Some(100),
        "the smallest one"
    );
    assert!(kept.surplus().is_none());
}

#[test]
fn a_buffer_has_its_length() {
    assert_eq!(buffer(LARGE).len(), LARGE);
}
