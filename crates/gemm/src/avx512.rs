//! Tiles of 14 x 32 for processors with AVX-512: 28 sums in registers, two registers of `b`, one for a value of `a`.

use std::arch::x86_64::{
    __m512, __mmask16, _MM_HINT_T0, _MM_HINT_T1, _mm_prefetch, _mm512_add_ps, _mm512_castpd_ps,
    _mm512_castps_pd, _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_mask_storeu_ps,
    _mm512_maskz_loadu_ps, _mm512_mul_ps, _mm512_set1_ps, _mm512_setzero_ps, _mm512_shuffle_f32x4,
    _mm512_storeu_ps, _mm512_unpackhi_pd, _mm512_unpackhi_ps, _mm512_unpacklo_pd,
    _mm512_unpacklo_ps,
};

use super::tile::{Onto, SUMS, Strip, Tile, tile_functions};
use super::{Kernels, tile};

/// Values of a register.
const LANES: usize = 16;
/// Values from what is transposed to what is fetched meanwhile: four cache lines.
const AHEAD: usize = 64;
const ROWS: usize = 14;

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
        tile_functions!(tile, 7),
        tile_functions!(tile, 8),
        tile_functions!(tile, 9),
        tile_functions!(tile, 10),
        tile_functions!(tile, 11),
        tile_functions!(tile, 12),
        tile_functions!(tile, 13),
        tile_functions!(tile, 14),
    ],
    row,
    outer,
    transpose,
};

tile::tile!("avx512f");

#[target_feature(enable = "avx512f")]
fn zero() -> __m512 {
    _mm512_setzero_ps()
}

#[target_feature(enable = "avx512f")]
fn splat(value: f32) -> __m512 {
    _mm512_set1_ps(value)
}

#[target_feature(enable = "avx512f")]
fn multiply(a: __m512, b: __m512) -> __m512 {
    _mm512_mul_ps(a, b)
}

#[target_feature(enable = "avx512f")]
fn plus(a: __m512, b: __m512) -> __m512 {
    _mm512_add_ps(a, b)
}

#[target_feature(enable = "avx512f")]
fn multiply_add(a: __m512, b: __m512, c: __m512) -> __m512 {
    _mm512_fmadd_ps(a, b, c)
}

/// The first `count` lanes, of fewer than 16.
fn mask(count: usize) -> __mmask16 {
    (1 << count) - 1
}

/// # Safety
/// 16 values can be read.
#[target_feature(enable = "avx512f")]
unsafe fn load(from: *const f32) -> __m512 {
    // SAFETY: by the caller's promise.
    unsafe { _mm512_loadu_ps(from) }
}

/// # Safety
/// 16 values can be written.
#[target_feature(enable = "avx512f")]
unsafe fn store(to: *mut f32, value: __m512) {
    // SAFETY: by the caller's promise.
    unsafe { _mm512_storeu_ps(to, value) }
}

/// # Safety
/// `count` values can be read.
#[target_feature(enable = "avx512f")]
unsafe fn load_part(from: *const f32, count: usize) -> __m512 {
    if count >= LANES {
        // SAFETY: by the caller's promise.
        return unsafe { load(from) };
    }
    // SAFETY: by the caller's promise; masked lanes are not touched.
    unsafe { _mm512_maskz_loadu_ps(mask(count), from) }
}

/// # Safety
/// `count` values can be written.
#[target_feature(enable = "avx512f")]
unsafe fn store_part(to: *mut f32, count: usize, value: __m512) {
    if count >= LANES {
        // SAFETY: by the caller's promise.
        return unsafe { store(to, value) };
    }
    // SAFETY: by the caller's promise; masked lanes are not touched.
    unsafe { _mm512_mask_storeu_ps(to, mask(count), value) }
}

#[target_feature(enable = "avx512f")]
fn prefetch_near(place: *const f32) {
    _mm_prefetch::<_MM_HINT_T0>(place.cast());
}

#[target_feature(enable = "avx512f")]
fn prefetch_far(place: *const f32) {
    _mm_prefetch::<_MM_HINT_T1>(place.cast());
}

/// `rows x columns` values, at most 16 x 16 and `from_row` apart, as the first `rows` of each of `columns` rows that are `to_row`
/// apart. Each row is written 16 values wide.
///
/// # Safety
/// The processor has AVX-512; the values can be read, and `columns` rows of 16 written.
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
#[target_feature(enable = "avx512f")]
unsafe fn transpose_block<const WHOLE: bool>(
    from: *const f32,
    from_row: usize,
    rows: usize,
    columns: usize,
    to: *mut f32,
    to_row: usize,
) {
    let mut r = [zero(); 16];
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
    let mut t = [zero(); 16];
    for i in 0..8 {
        t[2 * i] = _mm512_unpacklo_ps(r[2 * i], r[2 * i + 1]);
        t[2 * i + 1] = _mm512_unpackhi_ps(r[2 * i], r[2 * i + 1]);
    }
    for i in 0..4 {
        let (a, b) = (_mm512_castps_pd(t[4 * i]), _mm512_castps_pd(t[4 * i + 1]));
        let (c, d) = (
            _mm512_castps_pd(t[4 * i + 2]),
            _mm512_castps_pd(t[4 * i + 3]),
        );
        r[4 * i] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c));
        r[4 * i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
        r[4 * i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d));
        r[4 * i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
    }
    for i in 0..4 {
        t[i] = _mm512_shuffle_f32x4::<0x88>(r[i], r[i + 4]);
        t[i + 4] = _mm512_shuffle_f32x4::<0xdd>(r[i], r[i + 4]);
        t[i + 8] = _mm512_shuffle_f32x4::<0x88>(r[i + 8], r[i + 12]);
        t[i + 12] = _mm512_shuffle_f32x4::<0xdd>(r[i + 8], r[i + 12]);
    }
    for i in 0..4 {
        r[i] = _mm512_shuffle_f32x4::<0x88>(t[i], t[i + 8]);
        r[i + 8] = _mm512_shuffle_f32x4::<0xdd>(t[i], t[i + 8]);
        r[i + 4] = _mm512_shuffle_f32x4::<0x88>(t[i + 4], t[i + 12]);
        r[i + 12] = _mm512_shuffle_f32x4::<0xdd>(t[i + 4], t[i + 12]);
    }
    for (i, r) in r.iter().enumerate() {
        if WHOLE || i < columns {
            // SAFETY: row `i` of the result is there, 16 values wide.
            unsafe { store(to.add(i * to_row), *r) }
        }
    }
}
