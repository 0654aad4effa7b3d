//! Which position table a token grid gets; the tables are [`crate::nn::positions`].
//!
//! One axis is camera and gaze, two axes are time by joints, three are video. For time by joints the released table runs
//! through the grid the other way round than the tokens do: [`Positions::Released`] keeps that, as imported weights need it,
//! [`Positions::Aligned`] is the table one would have expected.

pub use crate::nn::positions::GridOrder as Positions;
use crate::nn::positions::{grid as joint_grid, line, volume};

/// The table of a token grid, `[tokens, width]` row-major; `None` where the grid has no rule (not 1 to 3 axes) or the width
/// does not fit it.
#[must_use]
pub fn table(grid: &[usize], width: usize, positions: Positions) -> Option<Vec<f32>> {
    if width == 0 || !width.is_multiple_of(divisor(grid)?) {
        return None;
    }
    Some(match *grid {
        [time] => line(time, width),
        [time, joints] => joint_grid(time, joints, width, positions),
        [time, height, columns] => volume([time, height, columns], width),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aligned_joint_table_is_aligned() {
        let (released, aligned) = (
            table(&[30, 7], 48, Positions::Released).unwrap(),
            table(&[30, 7], 48, Positions::Aligned).unwrap(),
        );
        assert_ne!(released, aligned);
        // Token (t, j) has the code of joint group j first, of time t second.
        let token = |t: usize, j: usize| &aligned[(t * 7 + j) * 48..][..48];
        assert_eq!(token(3, 5)[..24], token(20, 5)[..24]);
        assert_eq!(token(3, 5)[24..], token(3, 1)[24..]);
    }

    #[test]
    fn widths_that_do_not_fit_a_grid_are_refused() {
        assert!(table(&[5, 2, 2], 512, Positions::Released).is_none());
        assert!(table(&[30, 7], 2046, Positions::Released).is_none());
        assert!(table(&[30], 7, Positions::Released).is_none());
        assert!(table(&[2, 2, 2, 2], 24, Positions::Released).is_none());
    }
}
