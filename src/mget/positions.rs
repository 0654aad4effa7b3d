//! Position tables: fixed sine and cosine codes per token grid (model.md 1.4).
//!
//! One axis, a time-by-joints grid and a video grid have three different layouts; all three are kept as released. For the
//! time-by-joints grid the released table runs through the grid the other way round than the tokens do, so its code is not
//! aligned with time and joint group; [`Positions::Aligned`] is the table one would have expected.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Which table a time-by-joints grid gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Positions {
    /// As released: needed for imported weights.
    #[default]
    Release,
    /// Aligned with the tokens' own time and joint group.
    Aligned,
}

/// The table of a token grid, `[tokens, width]` row-major; `None` where the grid has no rule (not 1 to 3 axes) or the width
/// does not fit it.
#[must_use]
pub fn table(grid: &[usize], width: usize, positions: Positions) -> Option<Vec<f32>> {
    if width == 0 || !width.is_multiple_of(divisor(grid)?) {
        return None;
    }
    Some(match *grid {
        [time] => sequence(time, width),
        [time, joints] => joint_grid(time, joints, width, positions),
        [time, height, columns] => video(time, height, columns, width),
        _ => return None,
    })
}

/// What the width must be divisible by for a grid; `None` where the grid has no rule.
#[must_use]
pub fn divisor(grid: &[usize]) -> Option<usize> {
    match grid.len() {
        1 => Some(2),
        2 => Some(4),
        3 => Some(6),
        _ => None,
    }
}

/// Camera and gaze: all sines, then all cosines, of `n * 10000^(-i / (width / 2))`.
fn sequence(time: usize, width: usize) -> Vec<f32> {
    let mut table = Vec::with_capacity(time * width);
    for n in 0..time {
        sines_then_cosines(&mut table, n, width);
    }
    table
}

/// Hands and body: the code of one axis in the first half of the width, of the other axis in the second.
fn joint_grid(time: usize, joints: usize, width: usize, positions: Positions) -> Vec<f32> {
    let mut table = Vec::with_capacity(time * joints * width);
    for n in 0..time * joints {
        let (first, second) = match positions {
            Positions::Release => (n / time, n % time),
            Positions::Aligned => (n % joints, n / joints),
        };
        sines_then_cosines(&mut table, first, width / 2);
        sines_then_cosines(&mut table, second, width / 2);
    }
    table
}

fn sines_then_cosines(table: &mut Vec<f32>, position: usize, width: usize) {
    let half = width / 2;
    let angle = |i: usize| position as f64 * 10_000_f64.powf(-(i as f64) / half as f64);
    table.extend((0..half).map(|i| angle(i).sin() as f32));
    table.extend((0..half).map(|i| angle(i).cos() as f32));
}

/// Video: a third of the width per axis (time, height, columns), sines and cosines interleaved.
fn video(time: usize, height: usize, columns: usize, width: usize) -> Vec<f32> {
    let third = width / 3;
    let mut table = Vec::with_capacity(time * height * columns * width);
    for t in 0..time {
        for h in 0..height {
            for w in 0..columns {
                for position in [t, h, w] {
                    for j in 0..third / 2 {
                        let frequency = 10_000_f64.powf(-2.0 * j as f64 / third as f64);
                        let angle = position as f64 * frequency;
                        table.push(angle.sin() as f32);
                        table.push(angle.cos() as f32);
                    }
                }
            }
        }
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(found: f32, expected: f64) {
        assert!(
            (f64::from(found) - expected).abs() < 2e-6,
            "{found} {expected}"
        );
    }

    fn sum(table: &[f32]) -> f64 {
        table.iter().map(|value| f64::from(*value)).sum()
    }

    // Golden values: model.md 10.3.

    #[test]
    fn sequence_table_matches_the_reference() {
        let table = table(&[30], 768, Positions::Release).unwrap();
        close(table[768], 0.841_471);
        close(table[768 + 2], 0.815_250_6);
        close(table[768 + 384], 0.540_302_3);
        close(table[29 * 768 + 383], 0.002_970_39);
        assert!((sum(&table) - 9749.694_2).abs() < 1e-3);
    }

    #[test]
    fn joint_table_keeps_the_released_order() {
        let table = table(&[30, 7], 768, Positions::Release).unwrap();
        let row = |n: usize| -> Vec<f32> {
            [0, 1, 192, 193, 384, 385, 576, 577]
                .map(|c| table[n * 768 + c])
                .to_vec()
        };
        let expected = [
            0.14112,
            0.27838,
            -0.989_992_5,
            -0.960_471,
            -0.544_021_1,
            -0.106_637_7,
            -0.839_071_5,
            -0.994_297_9,
        ];
        for (found, expected) in row(100).into_iter().zip(expected) {
            close(found, expected);
        }
        close(row(1)[0], 0.0);
        close(row(1)[4], 0.841_471);
        assert!((sum(&table) - 74_027.697_1).abs() < 1e-2);
    }

    #[test]
    fn aligned_joint_table_is_aligned() {
        let (release, aligned) = (
            table(&[30, 7], 48, Positions::Release).unwrap(),
            table(&[30, 7], 48, Positions::Aligned).unwrap(),
        );
        assert_ne!(release, aligned);
        // Token (t, j) has the code of joint group j first, of time t second.
        let token = |t: usize, j: usize| &aligned[(t * 7 + j) * 48..][..48];
        assert_eq!(token(3, 5)[..24], token(20, 5)[..24]);
        assert_eq!(token(3, 5)[24..], token(3, 1)[24..]);
    }

    #[test]
    fn video_tables_match_the_reference() {
        let tokens = table(&[5, 32, 32], 768, Positions::Release).unwrap();
        close(tokens[2215 * 768], 0.909_297_4);
        close(tokens[2215 * 768 + 257], 0.283_662_2);
        close(tokens[2215 * 768 + 514], 0.228_774_9);
        assert!((sum(&tokens) - 1_769_669.748).abs() < 0.1);
        let pixels = table(&[4, 32, 32], 768, Positions::Release).unwrap();
        close(pixels[3500 * 768 + 512], -0.536_572_9);
        assert!((sum(&pixels) - 1_425_456.619).abs() < 0.1);
    }

    #[test]
    fn widths_that_do_not_fit_a_grid_are_refused() {
        assert!(table(&[5, 2, 2], 512, Positions::Release).is_none());
        assert!(table(&[30, 7], 2046, Positions::Release).is_none());
        assert!(table(&[30], 7, Positions::Release).is_none());
        assert!(table(&[2, 2, 2, 2], 24, Positions::Release).is_none());
    }
}
