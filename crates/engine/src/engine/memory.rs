//! An allocator that keeps large blocks for the next one of the same size, for programs that compute step by step.
//!
//! A training step allocates the same arrays again and again. Given back to the system, each comes as fresh pages, which the kernel
//! clears one fault at a time. A program that says
//!
//! ```
//! #[global_allocator]
//! static MEMORY: reviv_engine::engine::memory::Pool = reviv_engine::engine::memory::Pool;
//! # fn main() {}
//! ```
//!
//! keeps them instead: what is in use and what is kept are together at most an eighth more than what was in use at once since the last
//! [`release`]. On Linux, blocks of 2 MiB and more ask for huge pages. Small blocks go to the system's allocator as ever.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::UnsafeCell;
use std::ptr::null_mut;
use std::sync::atomic::{AtomicBool, Ordering};

/// Blocks of this size and more are kept.
const FROM: usize = 64 * 1024;
/// Blocks of this size and more are mapped, in huge pages where the system has them.
const HUGE: usize = 2 * 1024 * 1024;
/// Sizes per doubling: a block is at most an eighth larger than asked for.
const STEPS: usize = 8;
/// Doublings from [`FROM`] on; what is larger is not kept.
const DOUBLINGS: usize = 24;
/// Alignments that blocks have.
const ALIGN: usize = 64;

/// The allocator.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pool;

/// Gives all blocks that are kept back to the system, and what the system's allocator keeps of small ones: for the end of a stage. Gives
/// how many bytes of blocks that were.
pub fn release() -> usize {
    let (first, bytes) = SHARED.with(|state| {
        state.most = state.used;
        state.take_beyond(0)
    });
    // SAFETY: the blocks were taken out of the lists, so nobody else has them.
    unsafe { free_all(first) };
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it may be called at any time, from any thread.
    unsafe {
        libc::malloc_trim(0);
    }
    bytes
}

/// Calls [`release`] when it is dropped: the first thing in a stage, so that it goes after all that the stage made.
#[derive(Debug, Default)]
pub struct Stage;

impl Drop for Stage {
    fn drop(&mut self) {
        release();
    }
}

/// A block that nobody uses; the links lie in the blocks themselves.
struct Free {
    next: *mut Free,
    size: usize,
}

struct State {
    free: [*mut Free; STEPS * DOUBLINGS],
    /// Bytes in use, as blocks.
    used: usize,
    /// Bytes kept.
    kept: usize,
    /// The most that was in use since the last release.
    most: usize,
}

impl State {
    /// Takes blocks out, the largest first, until at most `keep` bytes stay: a list, and its bytes.
    fn take_beyond(&mut self, keep: usize) -> (*mut Free, usize) {
        let (mut list, mut bytes) = (null_mut(), 0);
        for first in self.free.iter_mut().rev() {
            while self.kept > keep && !first.is_null() {
                let block = *first;
                // SAFETY: blocks in the lists are valid, and only reached under the lock.
                unsafe {
                    *first = (*block).next;
                    (*block).next = list;
                    self.kept -= (*block).size;
                    bytes += (*block).size;
                }
                list = block;
            }
        }
        (list, bytes)
    }

    /// How much may be kept beside what is in use.
    fn room(&self) -> usize {
        (self.most + self.most / 8).saturating_sub(self.used)
    }
}

/// The state behind a lock that never allocates and is held for a few instructions.
struct Shared {
    taken: AtomicBool,
    state: UnsafeCell<State>,
}

// SAFETY: the state is only reached while `taken` is ours.
unsafe impl Sync for Shared {}

static SHARED: Shared = Shared {
    taken: AtomicBool::new(false),
    state: UnsafeCell::new(State {
        free: [null_mut(); STEPS * DOUBLINGS],
        used: 0,
        kept: 0,
        most: 0,
    }),
};

impl Shared {
    fn with<R>(&self, run: impl FnOnce(&mut State) -> R) -> R {
        while self
            .taken
            .compare_exchange_weak(false, true, Ordering::Acquire, Ordering::Relaxed)
            .is_err()
        {
            std::hint::spin_loop();
        }
        // SAFETY: the lock is ours; what runs under it neither panics nor allocates.
        let result = run(unsafe { &mut *self.state.get() });
        self.taken.store(false, Ordering::Release);
        result
    }
}

/// The list and the size of blocks that serve `layout`; `None` if it is not kept.
fn class(layout: Layout) -> Option<(usize, usize)> {
    if layout.size() < FROM || layout.align() > ALIGN {
        return None;
    }
    // Sizes above 2^n, up to 2^(n + 1), in eight steps.
    let below = (layout.size() - 1).ilog2() as usize;
    let step = (1 << below) / STEPS;
    let size = layout.size().next_multiple_of(step);
    let index = (below + 1 - FROM.ilog2() as usize) * STEPS + (size - (1 << below)) / step;
    (index < STEPS * DOUBLINGS).then_some((index, size))
}

fn block_layout(size: usize) -> Option<Layout> {
    Layout::from_size_align(size, ALIGN).ok()
}

/// A new block, and whether it is known to be zeros.
fn fresh(size: usize) -> (*mut u8, bool) {
    #[cfg(target_os = "linux")]
    if size >= HUGE {
        return (mapped::map(size), true);
    }
    let Some(layout) = block_layout(size) else {
        return (null_mut(), false);
    };
    // SAFETY: the size is not zero.
    (unsafe { System.alloc(layout) }, false)
}

/// # Safety
/// `block` came from [`fresh`] with this size, and nobody uses it any more.
unsafe fn free(block: *mut u8, size: usize) {
    #[cfg(target_os = "linux")]
    if size >= HUGE {
        // SAFETY: blocks of this size were mapped.
        unsafe { mapped::unmap(block, size) };
        return;
    }
    if let Some(layout) = block_layout(size) {
        // SAFETY: it was allocated with this layout.
        unsafe { System.dealloc(block, layout) };
    }
}

/// # Safety
/// The blocks of the list are nobody else's.
unsafe fn free_all(mut list: *mut Free) {
    while !list.is_null() {
        // SAFETY: a block of the list carries its link and its size.
        unsafe {
            let (next, size) = ((*list).next, (*list).size);
            free(list.cast(), size);
            list = next;
        }
    }
}

/// A block of the class, and whether it is known to be zeros.
fn take(index: usize, size: usize) -> (*mut u8, bool) {
    let (found, surplus) = SHARED.with(|state| {
        state.used += size;
        state.most = state.most.max(state.used);
        let found = state.free[index];
        if !found.is_null() {
            // SAFETY: blocks in the lists are valid.
            state.free[index] = unsafe { (*found).next };
            state.kept -= size;
        }
        let room = state.room();
        (found, state.take_beyond(room).0)
    });
    // SAFETY: the surplus was taken out of the lists.
    unsafe { free_all(surplus) };
    if !found.is_null() {
        return (found.cast(), false);
    }
    let (block, zeros) = fresh(size);
    if block.is_null() {
        SHARED.with(|state| state.used -= size);
    }
    (block, zeros)
}

// SAFETY: blocks come from the system, or were given back to us, are as large and as aligned as their class, and go back by the same
// class; all else is the system's.
unsafe impl GlobalAlloc for Pool {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        match class(layout) {
            Some((index, size)) => take(index, size).0,
            // SAFETY: as the caller promises.
            None => unsafe { System.alloc(layout) },
        }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        let Some((index, size)) = class(layout) else {
            // SAFETY: as the caller promises.
            return unsafe { System.alloc_zeroed(layout) };
        };
        let (block, zeros) = take(index, size);
        if !zeros && !block.is_null() {
            // SAFETY: the block is at least as large.
            unsafe { block.write_bytes(0, layout.size()) };
        }
        block
    }

    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        let Some((index, size)) = class(layout) else {
            // SAFETY: as the caller promises.
            return unsafe { System.dealloc(block, layout) };
        };
        let surplus = SHARED.with(|state| {
            state.used -= size;
            if size > state.room().saturating_sub(state.kept) {
                return true;
            }
            let free: *mut Free = block.cast();
            let next = state.free[index];
            // SAFETY: the block is ours again, aligned, and has the room.
            unsafe { free.write(Free { next, size }) };
            state.free[index] = free;
            state.kept += size;
            false
        });
        if surplus {
            // SAFETY: it came from `fresh` with the size of its class.
            unsafe { free(block, size) };
        }
    }

    unsafe fn realloc(&self, block: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        // SAFETY: the caller promises that the size is valid for the alignment.
        let new = unsafe { Layout::from_size_align_unchecked(new_size, layout.align()) };
        match (class(layout), class(new)) {
            // SAFETY: as the caller promises; both are the system's.
            (None, None) => unsafe { System.realloc(block, layout, new_size) },
            (Some(old), Some(new)) if old == new => block,
            _ => {
                // SAFETY: as the caller promises; the blocks are different.
                unsafe {
                    let moved = self.alloc(new);
                    if !moved.is_null() {
                        let length = layout.size().min(new_size);
                        std::ptr::copy_nonoverlapping(block, moved, length);
                        self.dealloc(block, layout);
                    }
                    moved
                }
            }
        }
    }
}

#[cfg(target_os = "linux")]
mod mapped {
    //! Blocks straight from the kernel, aligned to huge pages.

    use super::HUGE;
    use std::ptr::null_mut;

    /// `size` bytes of zeros, in huge pages as far as the system has them; null if there is no memory.
    pub fn map(size: usize) -> *mut u8 {
        let Some(length) = size.checked_add(HUGE) else {
            return null_mut();
        };
        // SAFETY: a new private mapping touches nothing that is there; what is cut off lies in it and is nobody's.
        unsafe {
            let start = libc::mmap(
                null_mut(),
                length,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_PRIVATE | libc::MAP_ANONYMOUS,
                -1,
                0,
            );
            if start == libc::MAP_FAILED {
                return null_mut();
            }
            let start: *mut u8 = start.cast();
            let before = start.align_offset(HUGE);
            let block = start.add(before);
            let end = before + rounded(size);
            if before > 0 {
                libc::munmap(start.cast(), before);
            }
            if end < length {
                libc::munmap(start.add(end).cast(), length - end);
            }
            // Advice: whether it is taken changes nothing but speed.
            libc::madvise(block.cast(), size, libc::MADV_HUGEPAGE);
            block
        }
    }

    /// # Safety
    /// `block` came from [`map`] with this size, and nobody uses it any more.
    pub unsafe fn unmap(block: *mut u8, size: usize) {
        // SAFETY: exactly what was mapped.
        unsafe { libc::munmap(block.cast(), rounded(size)) };
    }

    /// In whole pages, of any size that systems have.
    fn rounded(size: usize) -> usize {
        size.next_multiple_of(64 * 1024)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(size: usize) -> Layout {
        Layout::from_size_align(size, 16).unwrap()
    }

    #[test]
    fn a_block_is_at_most_an_eighth_larger_and_classes_do_not_overlap() {
        assert_eq!(class(layout(FROM - 1)), None);
        let (mut last, mut size) = ((0, 0), FROM);
        while size < 1 << 34 {
            let (index, block) = class(layout(size)).unwrap();
            assert!(block >= size && block - size <= size / 8, "{size}: {block}");
            assert!(block == last.1 || index > last.0, "{size}");
            last = (index, block);
            size += size / 97 + 1;
        }
        assert_eq!(class(layout(1 << 50)), None);
        assert_eq!(class(Layout::from_size_align(FROM, 4096).unwrap()), None);
    }

    /// One test, because the pool is one for the whole program.
    #[test]
    fn a_block_comes_again_cleared_where_zeros_are_asked_for_and_goes_back_on_release() {
        for size in [FROM + 1, 5 * HUGE] {
            // SAFETY: the blocks are used within their layouts, and given back once.
            unsafe {
                let block = Pool.alloc(layout(size));
                block.write_bytes(7, size);
                Pool.dealloc(block, layout(size));
                let again = Pool.alloc_zeroed(layout(size));
                assert_eq!(again, block);
                assert!((0..size).all(|i| *again.add(i) == 0));
                again.add(size - 1).write(9);
                let grown = Pool.realloc(again, layout(size), 2 * size);
                assert_eq!((*grown.add(size - 1), *grown.add(1)), (9, 0));
                Pool.dealloc(grown, layout(2 * size));
                assert!(release() > 0);
                assert_eq!(release(), 0);
            }
        }
    }
}
