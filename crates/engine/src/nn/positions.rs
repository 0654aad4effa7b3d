//! Fixed sine-cosine position tables, row-major `[positions, width]`.
//!
//! Released models computed theirs in f32, and angles of f32 are off by up to a few 1e-6 at position 30: the frequencies and
//! angles here are rounded as theirs, which brings the tables within 1e-7 of the released ones.

/// One axis: all sines, then all cosines; frequency `i` of `width / 2` is `10000^(-i / (width / 2))`.
///
/// # Panics
/// When `width` is odd.
#[must_use]
pub fn line(positions: usize, width: usize) -> Vec<f32> {
    assert!(width.is_multiple_of(2), "the width of a line code is even");
    (0..positions)
        .flat_map(|position| halves(position, width))
        .collect()
}

/// `[sin(p w_0) .., cos(p w_0) ..]` of `width` values.
fn halves(position: usize, width: usize) -> Vec<f32> {
    let half = width / 2;
    let codes = (0..half).map(|i| sine_cosine(position, i as f32 / half as f32));
    let (mut code, cosines): (Vec<f32>, Vec<f32>) = codes.unzip();
    code.extend(cosines);
    code
}

/// Sine and cosine of `position * 10000^-exponent`, with power, frequency and angle rounded to f32 one after the other.
fn sine_cosine(position: usize, exponent: f32) -> (f32, f32) {
    let frequency = 1.0 / 10_000_f64.powf(f64::from(exponent)) as f32;
    let angle = f64::from(position as f32 * frequency);
    (angle.sin() as f32, angle.cos() as f32)
}

/// One axis, sines and cosines in turn: channel `2 j` of position `p` is `sin(p 10000^(-2 j / width))`, channel `2 j + 1` the
/// cosine. Rounded once, at the end.
#[must_use]
pub fn interleaved(positions: usize, width: usize) -> Vec<f32> {
    (0..positions * width)
        .map(|i| {
            let (position, channel) = (i / width, i % width);
            let exponent = (channel / 2 * 2) as f64 / width as f64;
            let angle = position as f64 * 10_000_f64.powf(-exponent);
            let value = if channel.is_multiple_of(2) {
                angle.sin()
            } else {
                angle.cos()
            };
            value as f32
        })
        .collect()
}

/// Which way a table of a `rows x columns` grid of tokens is enumerated.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Default,
    serde::Serialize,
    serde::Deserialize,
    schemars::JsonSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum GridOrder {
    /// As released models have it: entry `n` codes `(n / rows, n % rows)`, although token `n` is `(n / columns, n % columns)`.
    #[default]
    Released,
    /// Entry `n` codes its token's own column and row.
    Aligned,
}

/// Two axes for hands and bodies: entry `n` is `[sin(a w), cos(a w), sin(b w), cos(b w)]` with `width / 4` frequencies, where
/// `a` is the column (joint group) and `b` the row (time) in the given order.
///
/// # Panics
/// When `width` is not divisible by 4.
#[must_use]
pub fn grid(rows: usize, columns: usize, width: usize, order: GridOrder) -> Vec<f32> {
    assert!(
        width.is_multiple_of(4),
        "the width of a grid code is divisible by 4"
    );
    (0..rows * columns)
        .flat_map(|n| {
            let (a, b) = match order {
                GridOrder::Released => (n / rows, n % rows),
                GridOrder::Aligned => (n % columns, n / columns),
            };
            let mut code = halves(a, width / 2);
            code.extend(halves(b, width / 2));
            code
        })
        .collect()
}

/// Three axes for video: `[code(t) | code(h) | code(w)]`, each `[sin, cos, sin, cos, ..]` of `width / 3` values with frequency
/// `j` equal to `10000^(-2 j / (width / 3))`; rows in `(t, h, w)` order.
///
/// # Panics
/// When `width` is not divisible by 6.
#[must_use]
pub fn volume([times, heights, widths]: [usize; 3], width: usize) -> Vec<f32> {
    assert!(
        width.is_multiple_of(6),
        "the width of a volume code is divisible by 6"
    );
    let channels = width / 3;
    let code = |position: usize| -> Vec<f32> {
        (0..channels / 2)
            .flat_map(|j| {
                let (sine, cosine) = sine_cosine(position, (2 * j) as f32 / channels as f32);
                [sine, cosine]
            })
            .collect()
    };
    let codes: Vec<Vec<f32>> = (0..times.max(heights).max(widths)).map(code).collect();
    let mut table = Vec::with_capacity(times * heights * widths * width);
    for t in 0..times {
        for h in 0..heights {
            for w in 0..widths {
                for position in [t, h, w] {
                    table.extend_from_slice(&codes[position]);
                }
            }
        }
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Golden values computed with numpy from the formulas (technical reference, 10.3).
    fn close(found: f32, expected: f64) {
        assert!(
            (f64::from(found) - expected).abs() < 2e-6,
            "{found} {expected}"
        );
    }

    fn total(table: &[f32]) -> f64 {
        table.iter().map(|value| f64::from(*value)).sum()
    }

    #[test]
    fn the_line_table_has_the_golden_values() {
        let table = line(30, 768);
        for (column, value) in [
            (0, 0.841_471),
            (1, 0.828_430_8),
            (2, 0.815_250_6),
            (384, 0.540_302_3),
        ] {
            close(table[768 + column], value);
        }
        close(table[29 * 768 + 383], 0.002_970_39);
        assert!((total(&table) - 9749.6942).abs() < 1e-3);
    }

    #[test]
    fn the_released_grid_table_has_the_golden_values() {
        let table = grid(30, 7, 768, GridOrder::Released);
        let columns = [0, 1, 192, 193, 384, 385, 576, 577];
        let rows = [
            (
                1,
                [
                    0.0,
                    0.0,
                    1.0,
                    1.0,
                    0.841_471,
                    0.815_250_6,
                    0.540_302_3,
                    0.579_108_3,
                ],
            ),
            (
                209,
                [
                    -0.279_415_5,
                    -0.534_751_8,
                    0.960_170_3,
                    0.845_009_2,
                    -0.663_633_9,
                    0.591_275_3,
                    -0.748_057_5,
                    -0.806_469_8,
                ],
            ),
        ];
        for (row, values) in rows {
            for (column, value) in columns.iter().zip(values) {
                close(table[row * 768 + column], value);
            }
        }
        assert!((total(&table) - 74_027.697_1).abs() < 1e-2);
    }

    #[test]
    fn an_aligned_grid_codes_each_token_by_its_own_row_and_column() {
        let table = grid(3, 2, 4, GridOrder::Aligned);
        let token = 2 * 2 + 1;
        close(table[token * 4], 1_f64.sin());
        close(table[token * 4 + 2], 2_f64.sin());
    }

    #[test]
    fn the_volume_tables_have_the_golden_values() {
        let table = volume([5, 32, 32], 768);
        close(table[2215 * 768], 0.909_297_4);
        close(table[2215 * 768 + 257], 0.283_662_2);
        close(table[2215 * 768 + 512], 0.656_986_6);
        assert!((total(&table) - 1_769_669.748).abs() < 0.1);
        assert!((total(&volume([4, 32, 32], 768)) - 1_425_456.619).abs() < 0.1);
    }
}
