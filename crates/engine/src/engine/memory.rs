//! An allocator that keeps large blocks for the next step, for programs that compute step by step.
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
//! takes large blocks from one piece of address space, in huge pages where the system has them. What is freed there stays with the
//! program until [`release`]; neighbours are joined, so it serves blocks of any size. Small blocks go to the system's allocator as
//! ever, and so do all where there is no such piece: off Linux, or under a limit of address space.
#![allow(unsafe_code)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::UnsafeCell;
use std::ptr::{NonNull, null_mut};
use std::sync::atomic::{AtomicBool, Ordering};

use talc::base::Talc;
use talc::base::binning::Binning;
use talc::base::bitfield::TwoLevelBitField;
use talc::source::Manual;

/// Blocks of this size and more come from the arena.
const FROM: usize = 1 << FROM_BITS;
const FROM_BITS: u32 = 16;
/// A huge page.
const HUGE: usize = 2 * 1024 * 1024;
/// Sizes per doubling: a block is at most a sixty-fourth larger than asked for.
const STEPS: usize = 1 << STEP_BITS;
const STEP_BITS: u32 = 6;
/// A cache line.
const LINE: usize = 64;
/// What the arena writes behind each block.
const TAG: usize = 8;

/// The allocator.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pool;

/// Gives all memory that nobody uses back to the system, and what the system's allocator keeps of small blocks: for the end of a stage.
pub fn release() {
    ARENA.with(Arena::discard);
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it may be called at any time, from any thread.
    unsafe {
        libc::malloc_trim(0);
    }
}

/// Calls [`release`] when it is dropped: the first thing in a stage, so that it goes after all that the stage made.
#[derive(Debug, Default)]
pub struct Stage;

impl Drop for Stage {
    fn drop(&mut self) {
        release();
    }
}

/// Free pieces by size. A block is as large as the smallest piece of its bin, so that a freed one serves the next of its size.
struct Bins;

impl Binning for Bins {
    type AvailabilityBitField = TwoLevelBitField<u64, u64, 25>;

    fn size_to_bin(size: usize) -> u32 {
        if size < FROM {
            return 0;
        }
        let doubling = size.ilog2();
        let step = (size >> (doubling - STEP_BITS)) as u32 % STEPS as u32;
        1 + (doubling - FROM_BITS) * STEPS as u32 + step
    }
}

/// The block in the arena that serves `layout`; `None` if the system's allocator does.
fn block(layout: Layout) -> Option<Layout> {
    if layout.size() < FROM {
        return None;
    }
    let piece = layout.size().checked_add(TAG)?;
    let step = 1 << (piece.ilog2() - STEP_BITS);
    let size = piece.checked_next_multiple_of(step)? - TAG;
    Layout::from_size_align(size, layout.align()).ok()
}

struct Arena {
    /// The address space was asked for: once, by the first block.
    opened: bool,
    start: *mut u8,
    /// Up to here the blocks go; beyond it is address space alone.
    heap: Option<NonNull<u8>>,
    end: *mut u8,
    blocks: Talc<Manual, Bins>,
}

/// What is written into a free piece at each end, at most.
const HEAD: usize = 64;
/// The heap grows by this and its multiples.
const GROWTH: usize = 16 * HUGE;
/// Free pieces that are discarded at once, at most.
const PIECES: usize = 512;

impl Arena {
    const EMPTY: Self = Self {
        opened: false,
        start: null_mut(),
        heap: None,
        end: null_mut(),
        blocks: Talc::new(Manual),
    };

    fn open(&mut self) {
        self.opened = true;
        let Some((start, size)) = pages::reserve() else {
            return;
        };
        // SAFETY: the pages are new, and nobody else's.
        self.heap = unsafe { self.blocks.claim(start, GROWTH) };
        self.start = start;
        self.end = start.wrapping_add(size);
        // Blocks are multiples of a cache line. If the first does not begin with one, none would: half a line is given away.
        let spacer = Layout::new::<u8>();
        // SAFETY: the size is not zero; what is given back was allocated with this layout.
        unsafe {
            if let Some(first) = self.blocks.try_allocate(spacer)
                && first.addr().get().is_multiple_of(LINE)
            {
                self.blocks.deallocate(first.as_ptr(), spacer);
            }
        }
    }

    fn holds(&self, block: *mut u8) -> bool {
        (self.start..self.end).contains(&block)
    }

    /// `None` if there is no room.
    fn take(&mut self, block: Layout) -> Option<NonNull<u8>> {
        if !self.opened {
            self.open();
        }
        let heap = self.heap?;
        // SAFETY: the size is not zero; the heap ends where it was said to end, and grows in what was reserved for it.
        unsafe {
            if let Some(start) = self.blocks.try_allocate(block) {
                return Some(start);
            }
            let more = block.size().checked_add(HUGE)?.next_multiple_of(GROWTH);
            if more > self.end.addr() - heap.addr().get() {
                return None;
            }
            let end = heap.as_ptr().wrapping_add(more);
            self.heap = Some(self.blocks.extend(heap, end));
            self.blocks.try_allocate(block)
        }
    }

    /// Gives the pages of free pieces back to the system, the largest first.
    fn discard(&mut self) {
        let Some(heap) = self.heap else {
            return;
        };
        let mut pieces = [(null_mut::<u8>(), Layout::new::<u8>()); PIECES];
        let mut count = 0;
        let mut size = (heap.addr().get() - self.start.addr()).next_power_of_two();
        while size >= HUGE && count < PIECES {
            let Ok(layout) = Layout::from_size_align(size - TAG, 1) else {
                break;
            };
            // SAFETY: the size is not zero.
            match unsafe { self.blocks.try_allocate(layout) } {
                Some(start) => {
                    pieces[count] = (start.as_ptr(), layout);
                    count += 1;
                }
                None => size /= 2,
            }
        }
        for (start, layout) in &pieces[..count] {
            // SAFETY: each was allocated above with this layout. What is written into free pieces lies at their ends, and so at
            // those of what was taken out of them.
            unsafe {
                self.blocks.deallocate(*start, *layout);
                pages::discard(start.add(HEAD), layout.size() - 2 * HEAD);
            }
        }
    }
}

/// The arena behind a lock that never allocates; it is held for a few instructions, but where pages are discarded.
struct Shared {
    taken: AtomicBool,
    arena: UnsafeCell<Arena>,
}

// SAFETY: the arena is only reached while `taken` is ours.
unsafe impl Sync for Shared {}

static ARENA: Shared = Shared {
    taken: AtomicBool::new(false),
    arena: UnsafeCell::new(Arena::EMPTY),
};

impl Shared {
    fn with<R>(&self, run: impl FnOnce(&mut Arena) -> R) -> R {
        while self
            .taken
            .compare_exchange_weak(false, true, Ordering::Acquire, Ordering::Relaxed)
            .is_err()
        {
            std::hint::spin_loop();
        }
        // SAFETY: the lock is ours; what runs under it neither panics nor allocates.
        let result = run(unsafe { &mut *self.arena.get() });
        self.taken.store(false, Ordering::Release);
        result
    }
}

fn in_arena(layout: Layout) -> Option<NonNull<u8>> {
    let block = block(layout)?;
    ARENA.with(|arena| arena.take(block))
}

// SAFETY: a block comes from the arena or from the system's allocator, and goes back to where it came from: its address says which.
unsafe impl GlobalAlloc for Pool {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        match in_arena(layout) {
            Some(start) => start.as_ptr(),
            // SAFETY: as the caller promises.
            None => unsafe { System.alloc(layout) },
        }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        match in_arena(layout) {
            Some(start) => {
                // SAFETY: the block is at least as large as the layout.
                unsafe { start.write_bytes(0, layout.size()) };
                start.as_ptr()
            }
            // SAFETY: as the caller promises.
            None => unsafe { System.alloc_zeroed(layout) },
        }
    }

    unsafe fn dealloc(&self, start: *mut u8, layout: Layout) {
        let Some(block) = block(layout) else {
            // SAFETY: as the caller promises.
            return unsafe { System.dealloc(start, layout) };
        };
        let held = ARENA.with(|arena| {
            let held = arena.holds(start);
            if held {
                // SAFETY: it was allocated there with this layout.
                unsafe { arena.blocks.deallocate(start, block) };
            }
            held
        });
        if !held {
            // SAFETY: as the caller promises.
            unsafe { System.dealloc(start, layout) }
        }
    }

    unsafe fn realloc(&self, start: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        // SAFETY: the caller promises that the size is valid for the alignment.
        let new = unsafe { Layout::from_size_align_unchecked(new_size, layout.align()) };
        match (block(layout), block(new)) {
            // SAFETY: as the caller promises; both are the system's.
            (None, None) => return unsafe { System.realloc(start, layout, new_size) },
            (Some(old), Some(new)) => {
                let in_place = ARENA.with(|arena| {
                    // SAFETY: it was allocated there with the old layout.
                    arena.holds(start)
                        && unsafe { arena.blocks.try_realloc_in_place(start, old, new.size()) }
                });
                if in_place {
                    return start;
                }
            }
            _ => {}
        }
        // SAFETY: as the caller promises; the blocks are different.
        unsafe {
            let moved = self.alloc(new);
            if !moved.is_null() {
                std::ptr::copy_nonoverlapping(start, moved, layout.size().min(new_size));
                self.dealloc(start, layout);
            }
            moved
        }
    }
}

#[cfg(target_os = "linux")]
mod pages {
    //! Pages straight from the kernel.

    use super::{GROWTH, HUGE};
    use std::ptr::null_mut;

    /// The largest page of any system, but for huge ones.
    const PAGE: usize = 64 * 1024;

    /// Address space for twice the memory of this machine, and its size; none where address space is limited or memory is promised
    /// strictly. Pages come when they are written.
    pub fn reserve() -> Option<(*mut u8, usize)> {
        // SAFETY: the calls only ask; a new private mapping touches nothing that is there.
        unsafe {
            let mut limit = std::mem::zeroed::<libc::rlimit>();
            if libc::getrlimit(libc::RLIMIT_AS, &raw mut limit) != 0
                || limit.rlim_cur != libc::RLIM_INFINITY
            {
                return None;
            }
            let pages = usize::try_from(libc::sysconf(libc::_SC_PHYS_PAGES)).ok()?;
            let page = usize::try_from(libc::sysconf(libc::_SC_PAGESIZE)).ok()?;
            let size = (2 * pages * page).next_multiple_of(GROWTH);
            let start = libc::mmap(
                null_mut(),
                size + HUGE,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_NORESERVE,
                -1,
                0,
            );
            if start == libc::MAP_FAILED {
                return None;
            }
            let start: *mut u8 = start.cast();
            let start = start.add(start.align_offset(HUGE));
            // Advice: whether it is taken changes nothing but speed.
            libc::madvise(start.cast(), size, libc::MADV_HUGEPAGE);
            Some((start, size))
        }
    }

    /// # Safety
    /// Nobody needs what is in these bytes.
    pub unsafe fn discard(start: *mut u8, size: usize) {
        let before = start.align_offset(PAGE);
        let whole = size.saturating_sub(before) / PAGE * PAGE;
        // SAFETY: only whole pages of these bytes.
        unsafe { libc::madvise(start.add(before).cast(), whole, libc::MADV_DONTNEED) };
    }
}

#[cfg(not(target_os = "linux"))]
mod pages {
    pub fn reserve() -> Option<(*mut u8, usize)> {
        None
    }

    /// # Safety
    /// Nobody needs what is in these bytes.
    pub unsafe fn discard(_: *mut u8, _: usize) {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    /// The pool is one for the whole program.
    static ALONE: Mutex<()> = Mutex::new(());

    fn layout(size: usize) -> Layout {
        Layout::from_size_align(size, 64).unwrap()
    }

    #[test]
    fn a_block_is_at_most_a_sixty_fourth_larger_and_fills_the_smallest_piece_of_its_bin() {
        assert_eq!(block(layout(FROM - 1)), None);
        let mut size = FROM;
        while size < 1 << 40 {
            let piece = block(layout(size)).unwrap().size() + TAG;
            assert!(piece > size && piece - size <= size / STEPS + TAG, "{size}");
            let bin = Bins::size_to_bin(piece);
            assert_eq!(Bins::size_to_bin(piece - 1) + 1, bin, "{size}");
            assert!(bin < Bins::BIN_COUNT, "{size}");
            size += size / 97 + 1;
        }
    }

    #[test]
    fn blocks_do_not_overlap_keep_what_is_in_them_and_are_cleared_where_zeros_are_asked_for() {
        let _alone = ALONE.lock();
        let mut state = 1_u64;
        // The high bits of a linear congruential generator.
        let mut random = |below: usize| {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            (state >> 33) as usize % below
        };
        let mut blocks: Vec<(*mut u8, Layout, u8)> = Vec::new();
        // SAFETY: each block is used within its layout, and given back once.
        unsafe {
            let ends =
                |start: *mut u8, size: usize| [start, start.add(size / 2), start.add(size - 1)];
            for turn in 0..4000 {
                let most = 1 << (10 + random(14));
                let size = FROM / 2 + random(most);
                let label = turn as u8;
                match random(4) {
                    0 | 1 => {
                        let zeros = random(2) == 0;
                        let start = if zeros {
                            Pool.alloc_zeroed(layout(size))
                        } else {
                            Pool.alloc(layout(size))
                        };
                        assert_eq!(start.addr() % 64, 0);
                        for place in ends(start, size) {
                            assert!(!zeros || *place == 0);
                            place.write(label);
                        }
                        blocks.push((start, layout(size), label));
                    }
                    kind if !blocks.is_empty() => {
                        let index = random(blocks.len());
                        let (start, old, label) = blocks.swap_remove(index);
                        let found = ends(start, old.size()).map(|place| *place);
                        assert_eq!(found, [label; 3]);
                        if kind == 2 {
                            Pool.dealloc(start, old);
                        } else {
                            let start = Pool.realloc(start, old, size);
                            assert_eq!(*start, label);
                            for place in ends(start, size) {
                                place.write(label);
                            }
                            blocks.push((start, layout(size), label));
                        }
                    }
                    _ => {}
                }
                if turn % 1000 == 999 {
                    release();
                }
            }
            for (start, layout, label) in blocks {
                assert_eq!(*start.add(layout.size() - 1), label);
                Pool.dealloc(start, layout);
            }
        }
    }

    /// How many of these bytes lie in memory.
    #[cfg(all(target_os = "linux", target_arch = "x86_64"))]
    fn resident(start: *mut u8, size: usize) -> usize {
        const PAGE: usize = 4096;
        let start = start.wrapping_sub(start.addr() % PAGE);
        let mut pages = vec![0_u8; size.div_ceil(PAGE)];
        // SAFETY: it only asks; a byte comes back for each page.
        let done = unsafe { libc::mincore(start.cast(), size, pages.as_mut_ptr()) };
        assert_eq!(done, 0, "pages are 4 KiB, and mapped");
        pages.iter().filter(|page| **page & 1 != 0).count() * PAGE
    }

    #[test]
    #[cfg(all(target_os = "linux", target_arch = "x86_64"))]
    fn what_is_freed_serves_the_next_and_goes_back_on_release() {
        let _alone = ALONE.lock();
        let size = 64 * HUGE;
        // SAFETY: the blocks are used within their layouts, and given back once.
        unsafe {
            let start = Pool.alloc(layout(size));
            start.write_bytes(7, size);
            Pool.dealloc(start, layout(size));
            assert_eq!(resident(start, size), size);
            // Two of half the size lie where the one lay.
            let half = layout(size / 2 - FROM);
            let halves = [Pool.alloc(half), Pool.alloc(half)];
            for place in halves {
                assert!((start..start.add(size)).contains(&place));
                Pool.dealloc(place, half);
            }
            release();
            assert!(resident(start, size) < HUGE);
        }
    }
}
