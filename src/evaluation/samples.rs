//! A system that was asked several times: one sample, the mean score of all, and the best of all.
//!
//! The best of n is chosen with the truth in hand: it says whether what happened is among what a model thinks possible, and grows
//! better with n whatever the model. It is never a result of the system, and no verdict is drawn from it.

use super::columns::{Better, Column};
use super::outcome::{Outcome, mean};

/// What names of these rows begin with.
pub const PREFIX: &str = "samples: ";
/// The first sample alone.
pub const ONE: &str = "samples: one";
/// The mean over the samples of their scores; the score of the mean signal is that of the decoding `mean`.
pub const MEAN: &str = "samples: mean score";
/// Per clip and column, the sample nearest to the truth.
pub const BEST: &str = "samples: best";

pub(super) fn mean_of(_: &Column, outcomes: &[Outcome]) -> Outcome {
    fold(outcomes, |numbers| mean(numbers.iter().copied()))
}

pub(super) fn best_of(column: &Column, outcomes: &[Outcome]) -> Outcome {
    fold(outcomes, |numbers| match column.better {
        Better::Lower => numbers.iter().copied().min_by(f64::total_cmp),
        Better::Higher => numbers.iter().copied().max_by(f64::total_cmp),
    })
}

/// Of the numbers; what is no number in every sample stays what it is.
fn fold(outcomes: &[Outcome], of: impl Fn(&[f64]) -> Option<f64>) -> Outcome {
    let numbers: Vec<f64> = outcomes.iter().filter_map(|o| o.number()).collect();
    let first = outcomes.first().copied().unwrap_or(Outcome::Null);
    of(&numbers).map_or(first, Outcome::Number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn best_follows_the_direction_of_the_column_and_mean_leaves_out_what_is_no_number() {
        let outcomes = [
            Outcome::Number(3.0),
            Outcome::Degenerate,
            Outcome::Number(1.0),
        ];
        let error = Column::named("body.ga_mpjpe").unwrap();
        let share = Column::named("depth.delta@depth").unwrap();
        assert_eq!(best_of(&error, &outcomes), Outcome::Number(1.0));
        assert_eq!(best_of(&share, &outcomes), Outcome::Number(3.0));
        assert_eq!(mean_of(&error, &outcomes), Outcome::Number(2.0));
        assert_eq!(
            best_of(&error, &[Outcome::Degenerate; 2]),
            Outcome::Degenerate
        );
    }
}
