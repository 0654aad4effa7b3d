//! Tiles of 6 x 16 in plain Rust, for every other processor: loops over arrays of a known length, which compilers turn into the
//! vector instructions that the target always has.
// Vector instructions reach only what is inlined.
#![allow(clippy::inline_always)]

use super::tile::{Onto, SUMS, Strip, Tile, tile_functions};
use super::{Kernels, tile};

/// Values that are computed together.
const LANES: usize = 8;
const ROWS: usize = 6;

type Lanes = [f32; LANES];

pub(super) static KERNELS: Kernels = Kernels {
    rows: ROWS,
    lanes: LANES,
    tiles: &[
        tile_functions!(tile, 1),
        tile_functions!(tile, 2),
        tile_functions!(tile, 3),
        tile_functions!(tile, 4),
        tile_functions!(tile, 5),
        tile_functions!(tile, 6),
    ],
    row,
    outer,
    transpose,
};

tile::tile!();

#[inline(always)]
fn zero() -> Lanes {
    [0.0; LANES]
}

#[inline(always)]
fn splat(value: f32) -> Lanes {
    [value; LANES]
}

#[inline(always)]
fn multiply(a: Lanes, b: Lanes) -> Lanes {
    std::array::from_fn(|i| a[i] * b[i])
}

#[inline(always)]
fn plus(a: Lanes, b: Lanes) -> Lanes {
    std::array::from_fn(|i| a[i] + b[i])
}

/// Rounded once where the target always has the instruction, as in the other tiles; elsewhere rounded twice.
#[inline(always)]
fn multiply_add(a: Lanes, b: Lanes, c: Lanes) -> Lanes {
    if super::PORTABLE_FUSES {
        std::array::from_fn(|i| a[i].mul_add(b[i], c[i]))
    } else {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
}

/// # Safety
/// 8 values can be read.
#[inline(always)]
unsafe fn load(from: *const f32) -> Lanes {
    // SAFETY: by the caller's promise.
    unsafe { from.cast::<Lanes>().read_unaligned() }
}

/// # Safety
/// 8 values can be written.
#[inline(always)]
unsafe fn store(to: *mut f32, value: Lanes) {
    // SAFETY: by the caller's promise.
    unsafe { to.cast::<Lanes>().write_unaligned(value) }
}

/// # Safety
/// `count` values can be read.
#[inline(always)]
unsafe fn load_part(from: *const f32, count: usize) -> Lanes {
    let mut values = zero();
    // SAFETY: `count` values can be read, and no more than fit are.
    unsafe { std::ptr::copy_nonoverlapping(from, values.as_mut_ptr(), count.min(LANES)) };
    values
}

/// # Safety
/// `count` values can be written.
#[inline(always)]
unsafe fn store_part(to: *mut f32, count: usize, value: Lanes) {
    // SAFETY: `count` values can be written, and no more than there are.
    unsafe { std::ptr::copy_nonoverlapping(value.as_ptr(), to, count.min(LANES)) };
}

#[inline(always)]
fn prefetch_near(_: *const f32) {}

#[inline(always)]
fn prefetch_far(_: *const f32) {}

/// `rows x columns` values, at most 8 x 8 and `from_row` apart, as the first `rows` of each of `columns` rows that are `to_row`
/// apart. Each row is written 8 values wide.
///
/// # Safety
/// The values can be read, and `columns` rows of 8 written.
unsafe fn transpose(
    from: *const f32,
    from_row: usize,
    rows: usize,
    columns: usize,
    to: *mut f32,
    to_row: usize,
) {
    for j in 0..columns {
        let mut values = zero();
        for (i, value) in values.iter_mut().enumerate().take(rows) {
            // SAFETY: the value in row `i` and column `j` is there.
            *value = unsafe { *from.add(i * from_row + j) };
        }
        // SAFETY: row `j` of the result is there, 8 values wide.
        unsafe { store(to.add(j * to_row), values) }
    }
}
