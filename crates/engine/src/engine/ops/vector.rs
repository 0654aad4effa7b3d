//! Loops that vectorise on whatever the processor has, found out at run time, without fused multiply-adds: the same bits
//! everywhere.
// Vector instructions reach only what is inlined; coefficients stand as published.
#![allow(clippy::inline_always, clippy::excessive_precision)]

use std::f32::consts::LOG2_E;

/// Partial sums that one reduction keeps: the widest vector register, twice over on smaller machines.
const LANES: usize = 16;

/// Runs `body` compiled for this processor's vector instructions. Mark the closure `#[inline(always)]`.
pub fn vectorised<R>(body: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(body)
}

/// The sum of `term(i-th values of the arrays)`, over what the arrays have in common.
#[inline(always)]
fn reduce<const N: usize>(arrays: [&[f32]; N], term: impl Fn([f32; N]) -> f32) -> f32 {
    let length = arrays.iter().map(|array| array.len()).min().unwrap_or(0);
    let (whole, rest) = (length / LANES, length % LANES);
    // Chunks of a known length: an index that has to be checked keeps a loop from becoming vector instructions.
    let arrays = arrays.map(|array| array[..length].as_chunks::<LANES>());
    let chunks = arrays.map(|(chunks, _)| &chunks[..whole]);
    let rests = arrays.map(|(_, values)| &values[..rest]);
    let mut lanes = [0.0_f32; LANES];
    for place in 0..whole {
        let chunks = chunks.map(|chunks| &chunks[place]);
        for (lane, sum) in lanes.iter_mut().enumerate() {
            *sum += term(chunks.map(|chunk| chunk[lane]));
        }
    }
    let mut sum = lanes.iter().sum::<f32>();
    for place in 0..rest {
        sum += term(rests.map(|values| values[place]));
    }
    sum
}

#[inline(always)]
pub fn sum(x: &[f32]) -> f32 {
    reduce([x], |[x]| x)
}

/// The sum of `(x - mean)^2`.
#[inline(always)]
pub fn squares_about(x: &[f32], mean: f32) -> f32 {
    reduce([x], |[x]| (x - mean) * (x - mean))
}

/// The sum of `e^(x - top)`.
#[inline(always)]
pub fn sum_of_exp(x: &[f32], top: f32) -> f32 {
    reduce([x], |[x]| exp(x - top))
}

/// The inner product; of the shorter length if they differ.
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    reduce([a, b], |[a, b]| a * b)
}

/// The largest value; negative infinity of none.
#[inline(always)]
pub fn largest(x: &[f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let (chunks, rest) = x.as_chunks::<LANES>();
    for chunk in chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane = if *value > *lane { *value } else { *lane };
        }
    }
    let mut top = f32::NEG_INFINITY;
    for value in lanes.iter().chain(rest) {
        top = if *value > top { *value } else { top };
    }
    top
}

/// `e^x`, within two units in the last place; 0 below -87.3, capped above 88.3.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // Adding and subtracting 1.5 * 2^23 rounds to an integer.
    const ROUND: f32 = 12_582_912.0;
    let capped = if x > 88.3 { 88.3 } else { x };
    let floored = if capped < -87.3 { -87.3 } else { capped };
    let rounded = floored * LOG2_E + ROUND;
    let n = rounded - ROUND;
    // ln 2 in two parts: the first has few bits, so the product is exact.
    let f = (floored - n * 0.693_359_375) + n * 2.121_944_4e-4;
    let mut p = 1.987_569_15e-4_f32;
    for coefficient in [
        1.398_199_95e-3,
        8.333_451_9e-3,
        4.166_579_6e-2,
        1.666_666_55e-1,
        5.000_000_1e-1,
    ] {
        p = p * f + coefficient;
    }
    let e = p * f * f + f + 1.0;
    // The rounded number's last bits are the integer. A cast would check for overflow, which has no vector instructions.
    let integer = rounded.to_bits().wrapping_sub(ROUND.to_bits());
    let power = f32::from_bits(integer.wrapping_add(127) << 23);
    if x < -87.3 { 0.0 } else { e * power }
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// The error function as a ratio of polynomials on [-4, 4] (the approximation of Eigen and XLA); absolute error below 4e-7.
#[inline(always)]
pub fn erf(x: f32) -> f32 {
    let x = if x > 4.0 { 4.0 } else { x };
    let x = if x < -4.0 { -4.0 } else { x };
    let s = x * x;
    let mut p = -2.726_142_3e-10_f32;
    for coefficient in [
        2.770_681_4e-8,
        -2.101_024e-6,
        -5.692_506_5e-5,
        -7.349_906_3e-4,
        -2.954_599_8e-3,
        -1.609_603_3e-2,
    ] {
        p = p * s + coefficient;
    }
    let mut q = -1.456_607_2e-5_f32;
    for coefficient in [
        -2.133_740_55e-4,
        -1.682_827e-3,
        -7.373_329e-3,
        -1.426_473_9e-2,
    ] {
        q = q * s + coefficient;
    }
    x * p / q
}

/// The hyperbolic tangent as a ratio of polynomials on [-7.9, 7.9] (the approximation of Eigen); within 4e-7 of the exact value.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    let x = if x > 7.905_311 { 7.905_311 } else { x };
    let x = if x < -7.905_311 { -7.905_311 } else { x };
    let s = x * x;
    let mut p = -2.760_768_5e-16_f32;
    for coefficient in [
        2.000_187_9e-13,
        -8.604_671_5e-11,
        5.122_297_1e-8,
        1.485_722_4e-5,
        6.372_619_3e-4,
        4.893_524_6e-3,
    ] {
        p = p * s + coefficient;
    }
    let mut q = 1.198_258_4e-6_f32;
    for coefficient in [1.185_347_1e-4, 2.268_434_6e-3, 4.893_525_2e-3] {
        q = q * s + coefficient;
    }
    x * p / q
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_within_two_units_in_the_last_place() {
        for i in -8000..=8000 {
            let x = i as f32 * 0.0109;
            let exact = f64::from(x).exp();
            let error = (f64::from(exp(x)) - exact).abs() / exact;
            assert!(error < 2.4e-7, "{x}: {error}");
        }
        assert_eq!(exp(-200.0), 0.0);
        assert_eq!(exp(f32::NEG_INFINITY), 0.0);
        assert!(exp(f32::NAN).is_nan());
    }

    /// The series of erf, exact in f64 for small arguments.
    fn exact_erf(x: f64) -> f64 {
        let mut term = x;
        let mut sum = x;
        for n in 1..200 {
            term *= -x * x / f64::from(n);
            sum += term / f64::from(2 * n + 1);
        }
        sum * 2.0 / std::f64::consts::PI.sqrt()
    }

    #[test]
    fn erf_is_accurate_over_its_whole_range() {
        for i in -500..=500 {
            let x = i as f32 * 0.01;
            let error = (f64::from(erf(x)) - exact_erf(f64::from(x))).abs();
            assert!(error < 4e-7, "{x}: {error}");
        }
    }

    #[test]
    fn tanh_is_accurate_over_its_whole_range() {
        for i in -1200..=1200 {
            let x = i as f32 * 0.01;
            let error = (f64::from(tanh(x)) - f64::from(x).tanh()).abs();
            assert!(error < 4e-7, "{x}: {error}");
        }
        assert!(tanh(f32::NAN).is_nan());
    }

    #[test]
    fn reductions_take_every_element_once() {
        let x: Vec<f32> = (0..37).map(|i| i as f32).collect();
        assert_eq!(sum(&x), 666.0);
        assert_eq!(dot(&x, &x), 16_206.0);
        assert_eq!(largest(&x), 36.0);
        assert_eq!(largest(&[]), f32::NEG_INFINITY);
    }
}
