//! Tiles of 6 x 16 for processors with AVX2 and FMA: 12 sums in registers, two registers of `b`, one for a value of `a`.

use std::arch::x86_64::{
    __m256, _MM_HINT_T0, _MM_HINT_T1, _mm_prefetch, _mm256_add_ps, _mm256_fmadd_ps,
    _mm256_loadu_ps, _mm256_mul_ps, _mm256_permute2f128_ps, _mm256_set1_ps, _mm256_setzero_ps,
    _mm256_shuffle_ps, _mm256_storeu_ps, _mm256_unpackhi_ps, _mm256_unpacklo_ps,
};

use super::tile::{Onto, SUMS, Strip, Tile, tile_functions};
use super::{Kernels, tile};

/// Values of a register.
const LANES: usize = 8;
/// Values from what is transposed to what is fetched meanwhile: four cache lines.
const AHEAD: usize = 64;
const ROWS: usize = 6;

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

tile::tile!("avx2,fma");

#[target_feature(enable = "avx2,fma")]
fn zero() -> __m256 {
    _mm256_setzero_ps()
}

#[target_feature(enable = "avx2,fma")]
fn splat(value: f32) -> __m256 {
    _mm256_set1_ps(value)
}

#[target_feature(enable = "avx2,fma")]
fn multiply(a: __m256, b: __m256) -> __m256 {
    _mm256_mul_ps(a, b)
}

#[target_feature(enable = "avx2,fma")]
fn plus(a: __m256, b: __m256) -> __m256 {
    _mm256_add_ps(a, b)
}

#[target_feature(enable = "avx2,fma")]
fn multiply_add(a: __m256, b: __m256, c: __m256) -> __m256 {
    _mm256_fmadd_ps(a, b, c)
}

/// # Safety
/// 8 values can be read.
#[target_feature(enable = "avx2,fma")]
unsafe fn load(from: *const f32) -> __m256 {
    // SAFETY: by the caller's promise.
    unsafe { _mm256_loadu_ps(from) }
}

/// # Safety
/// 8 values can be written.
#[target_feature(enable = "avx2,fma")]
unsafe fn store(to: *mut f32, value: __m256) {
    // SAFETY: by the caller's promise.
    unsafe { _mm256_storeu_ps(to, value) }
}

/// # Safety
/// `count` values can be read.
#[target_feature(enable = "avx2,fma")]
unsafe fn load_part(from: *const f32, count: usize) -> __m256 {
    if count >= LANES {
        // SAFETY: by the caller's promise.
        return unsafe { load(from) };
    }
    let mut values = [0.0; LANES];
    // SAFETY: `count` values can be read, and fit.
    unsafe {
        std::ptr::copy_nonoverlapping(from, values.as_mut_ptr(), count);
        load(values.as_ptr())
    }
}

/// # Safety
/// `count` values can be written.
#[target_feature(enable = "avx2,fma")]
unsafe fn store_part(to: *mut f32, count: usize, value: __m256) {
    if count >= LANES {
        // SAFETY: by the caller's promise.
        return unsafe { store(to, value) };
    }
    let mut values = [0.0; LANES];
    // SAFETY: `count` values can be written, and are there.
    unsafe {
        store(values.as_mut_ptr(), value);
        std::ptr::copy_nonoverlapping(values.as_ptr(), to, count);
    }
}

#[target_feature(enable = "avx2,fma")]
fn prefetch_near(place: *const f32) {
    _mm_prefetch::<_MM_HINT_T0>(place.cast());
}

#[target_feature(enable = "avx2,fma")]
fn prefetch_far(place: *const f32) {
    _mm_prefetch::<_MM_HINT_T1>(place.cast());
}

/// `rows x columns` values, at most 8 x 8 and `from_row` apart, as the first `rows` of each of `columns` rows that are `to_row`
/// apart. Each row is written 8 values wide.
///
/// # Safety
/// The processor has AVX2; the values can be read, and `columns` rows of 8 written.
unsafe fn transpose(
    from: *const f32,
    from_row: usize,
    rows: usize,
    columns: usize,
    to: *mut f32,
    to_row: usize,
) {
    // SAFETY: by the caller's promise.
    unsafe {
        if (rows, columns) == (LANES, LANES) {
            transpose_block::<true>(from, from_row, rows, columns, to, to_row);
        } else {
            transpose_block::<false>(from, from_row, rows, columns, to, to_row);
        }
    }
}

/// `WHOLE` says that there are as many rows and columns as lanes.
///
/// # Safety
/// As [`transpose`].
#[target_feature(enable = "avx2,fma")]
unsafe fn transpose_block<const WHOLE: bool>(
    from: *const f32,
    from_row: usize,
    rows: usize,
    columns: usize,
    to: *mut f32,
    to_row: usize,
) {
    let mut r = [zero(); 8];
    for (i, r) in r.iter_mut().enumerate() {
        let row = from.wrapping_add(i * from_row);
        prefetch_near(row.wrapping_add(AHEAD));
        // SAFETY: row `i` is there, and `columns` of its values.
        unsafe {
            if WHOLE {
                *r = load(row);
            } else if i < rows {
                *r = load_part(row, columns);
            }
        }
    }
    let mut t = [zero(); 8];
    for i in 0..4 {
        t[2 * i] = _mm256_unpacklo_ps(r[2 * i], r[2 * i + 1]);
        t[2 * i + 1] = _mm256_unpackhi_ps(r[2 * i], r[2 * i + 1]);
    }
    for i in [0, 4] {
        r[i] = _mm256_shuffle_ps::<0x44>(t[i], t[i + 2]);
        r[i + 1] = _mm256_shuffle_ps::<0xee>(t[i], t[i + 2]);
        r[i + 2] = _mm256_shuffle_ps::<0x44>(t[i + 1], t[i + 3]);
        r[i + 3] = _mm256_shuffle_ps::<0xee>(t[i + 1], t[i + 3]);
    }
    for i in 0..4 {
        t[i] = _mm256_permute2f128_ps::<0x20>(r[i], r[i + 4]);
        t[i + 4] = _mm256_permute2f128_ps::<0x31>(r[i], r[i + 4]);
    }
    for (i, t) in t.iter().enumerate() {
        if WHOLE || i < columns {
            // SAFETY: row `i` of the result is there, 8 values wide.
            unsafe { store(to.add(i * to_row), *t) }
        }
    }
}
