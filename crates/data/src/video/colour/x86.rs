//! Sixteen pixels at a time with the instructions of x86, as the compiler does not find them: bytes of three colours are brought
//! together by shuffles.

// Vector instructions reach only what is inlined.
#![allow(clippy::inline_always)]

use super::Factors;
use pulp::cast;
use pulp::x86::V3;
use std::arch::x86_64::__m128i;

/// Pixels that are converted together.
const BLOCK: usize = 16;

/// For each third of the bytes that come out, where the pixels of red, green and blue go.
const PLACES: [[[u8; 16]; 3]; 3] = [
    [places(0, 0), places(0, 1), places(0, 2)],
    [places(1, 0), places(1, 1), places(1, 2)],
    [places(2, 0), places(2, 1), places(2, 2)],
];

const fn places(third: usize, colour: usize) -> [u8; 16] {
    // The highest bit set: nothing comes here.
    let mut places = [0x80; 16];
    let mut byte = 0;
    while byte < 16 {
        let at = 16 * third + byte;
        if at % 3 == colour {
            places[byte] = (at / 3) as u8;
        }
        byte += 1;
    }
    places
}

/// Converts whole blocks from the left on; the number of pixels, none on a processor that lacks the instructions.
pub(super) fn blocks_to_rgb(
    out: &mut [u8],
    y: &[u8],
    u: &[u8],
    v: &[u8],
    factors: Factors,
) -> usize {
    let Some(simd) = V3::try_new() else { return 0 };
    let (y, _) = y.as_chunks::<BLOCK>();
    let (u, _) = u.as_chunks::<{ BLOCK / 2 }>();
    let (v, _) = v.as_chunks::<{ BLOCK / 2 }>();
    let (out, _) = out.as_chunks_mut::<{ 3 * BLOCK }>();
    simd.vectorize(
        #[inline(always)]
        || {
            for (((out, y), u), v) in out.iter_mut().zip(y).zip(u).zip(v) {
                block_to_rgb(simd, out, y, u, v, factors);
            }
        },
    );
    y.len() * BLOCK
}

#[inline(always)]
fn block_to_rgb(
    simd: V3,
    out: &mut [u8; 3 * BLOCK],
    y: &[u8; BLOCK],
    u: &[u8; BLOCK / 2],
    v: &[u8; BLOCK / 2],
    factors: Factors,
) {
    let V3 { sse2, .. } = simd;
    let zero = sse2._mm_setzero_si128();
    let (u, v) = (chroma(simd, u), chroma(simd, v));
    let red = product(simd, v, factors.v_red);
    let green = sse2._mm_add_epi16(
        product(simd, u, factors.u_green),
        product(simd, v, factors.v_green),
    );
    let blue = product(simd, u, factors.u_blue);
    let y: __m128i = cast(*y);
    let luma = [
        luma(simd, sse2._mm_unpacklo_epi8(y, zero), factors),
        luma(simd, sse2._mm_unpackhi_epi8(y, zero), factors),
    ];
    let colours = [
        sums(simd, luma, red),
        sums(simd, luma, green),
        sums(simd, luma, blue),
    ];
    let (thirds, _) = out.as_chunks_mut::<16>();
    for (third, places) in thirds.iter_mut().zip(&PLACES) {
        let red = simd.ssse3._mm_shuffle_epi8(colours[0], cast(places[0]));
        let green = simd.ssse3._mm_shuffle_epi8(colours[1], cast(places[1]));
        let blue = simd.ssse3._mm_shuffle_epi8(colours[2], cast(places[2]));
        *third = cast(sse2._mm_or_si128(sse2._mm_or_si128(red, green), blue));
    }
}

/// Eight samples less 128, with three bits of fraction.
#[inline(always)]
fn chroma(simd: V3, samples: &[u8; BLOCK / 2]) -> __m128i {
    let V3 { sse2, .. } = simd;
    let samples = sse2._mm_set_epi64x(0, i64::from_le_bytes(*samples));
    let wide = sse2._mm_unpacklo_epi8(samples, sse2._mm_setzero_si128());
    sse2._mm_slli_epi16::<3>(sse2._mm_sub_epi16(wide, sse2._mm_set1_epi16(128)))
}

#[inline(always)]
fn luma(simd: V3, samples: __m128i, factors: Factors) -> __m128i {
    let V3 { sse2, .. } = simd;
    let samples = sse2._mm_sub_epi16(samples, sse2._mm_set1_epi16(factors.luma_offset));
    product(simd, sse2._mm_slli_epi16::<3>(samples), factors.luma)
}

/// The upper halves.
#[inline(always)]
fn product(simd: V3, values: __m128i, factor: i16) -> __m128i {
    let factor = simd.sse2._mm_set1_epi16(factor);
    simd.sse2._mm_mulhi_epi16(values, factor)
}

/// Each of eight values added to two pixels, as bytes.
#[inline(always)]
fn sums(simd: V3, luma: [__m128i; 2], add: __m128i) -> __m128i {
    let V3 { sse2, .. } = simd;
    sse2._mm_packus_epi16(
        sse2._mm_add_epi16(luma[0], sse2._mm_unpacklo_epi16(add, add)),
        sse2._mm_add_epi16(luma[1], sse2._mm_unpackhi_epi16(add, add)),
    )
}
