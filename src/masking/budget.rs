//! From proportions to token counts (Supp. B; Alg. 1, lines 3 to 6).

use super::Overflow;
use super::dirichlet::{JUST_BELOW_ONE, largest_share, proportions};
use crate::random::StreamRng;

/// `floor(share * total)` per modality, in f32 as the reference computes it, then the rest one token at a time to the
/// modality `next` names.
pub fn allocate(
    shares: &[f32],
    total: usize,
    mut next: impl FnMut() -> Option<usize>,
) -> Vec<usize> {
    let mut budgets: Vec<usize> = shares
        .iter()
        .map(|share| (share * total as f32).floor() as usize)
        .collect();
    let rest = total.saturating_sub(budgets.iter().sum());
    for _ in 0..rest {
        let Some(winner) = next() else { break };
        budgets[winner] += 1;
    }
    budgets
}

/// Limits each budget to the tokens there are; returns how much was cut off.
pub fn clamp(budgets: &mut [usize], room: &[usize]) -> usize {
    let mut excess = 0;
    for (budget, room) in budgets.iter_mut().zip(room) {
        excess += budget.saturating_sub(*room);
        *budget = (*budget).min(*room);
    }
    excess
}

/// One side of a sample's budget.
#[derive(Debug, Clone, Copy)]
pub struct Side<'a> {
    /// Concentrations; 0 means never.
    pub alphas: &'a [f64],
    /// Tokens to spend.
    pub total: usize,
    /// Tokens each modality can take.
    pub room: &'a [usize],
    /// What becomes of the rest.
    pub overflow: Overflow,
    /// Whether one share may be the whole; see [`super::MaskingSettings::whole_budget`].
    pub whole_budget: bool,
}

impl Side<'_> {
    /// Budgets from Dirichlet proportions, or from `shares` where given.
    pub fn draw(&self, shares: Option<&[f32]>, rng: &mut StreamRng) -> Vec<usize> {
        let mut shares = shares.map_or_else(|| proportions(self.alphas, rng), <[f32]>::to_vec);
        if shares.iter().all(|share| *share == 0.0) {
            return vec![0; self.room.len()];
        }
        if !self.whole_budget {
            for share in &mut shares {
                *share = share.min(JUST_BELOW_ONE);
            }
        }
        let mut budgets = allocate(&shares, self.total, || largest_share(self.alphas, rng));
        let excess = clamp(&mut budgets, self.room);
        if self.overflow == Overflow::Redistribute {
            self.redistribute(&mut budgets, excess, rng);
        }
        budgets
    }

    fn redistribute(&self, budgets: &mut [usize], mut excess: usize, rng: &mut StreamRng) {
        while excess > 0 {
            let left: Vec<usize> = self
                .room
                .iter()
                .zip(&*budgets)
                .map(|(r, b)| r - b)
                .collect();
            let alphas: Vec<f64> = self
                .alphas
                .iter()
                .zip(&left)
                .map(|(alpha, left)| if *left > 0 { *alpha } else { 0.0 })
                .collect();
            if alphas.iter().all(|alpha| *alpha == 0.0) {
                break;
            }
            let shares = proportions(&alphas, rng);
            let mut more = allocate(&shares, excess, || largest_share(&alphas, rng));
            excess = clamp(&mut more, &left);
            for (budget, more) in budgets.iter_mut().zip(more) {
                *budget += more;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::stream;

    fn side<'a>(
        alphas: &'a [f64],
        total: usize,
        room: &'a [usize],
        overflow: Overflow,
    ) -> Side<'a> {
        Side {
            alphas,
            total,
            room,
            overflow,
            whole_budget: false,
        }
    }

    #[test]
    fn whole_budget_is_spent_before_clamping() {
        let mut turns = [2, 0, 2].into_iter();
        assert_eq!(allocate(&[0.5, 0.25, 0.25], 11, || turns.next()), [6, 2, 3]);
        assert_eq!(allocate(&[1.0, 0.0], 2048, || panic!("no rest")), [2048, 0]);
    }

    #[test]
    fn overflow_is_lost_or_drawn_again() {
        for sample in 0..300 {
            let room = [30, 210, 5120];
            let alphas = [0.1, 0.1, 0.1];
            let sum = |overflow| {
                let mut rng = stream(0, "test.overflow", 0, sample);
                let budgets = side(&alphas, 2048, &room, overflow).draw(None, &mut rng);
                assert!(budgets.iter().zip(room).all(|(b, r)| *b <= r));
                budgets.iter().sum::<usize>()
            };
            assert!(sum(Overflow::Drop) <= 2048);
            assert_eq!(sum(Overflow::Redistribute), 2048);
        }
        let mut rng = stream(0, "test.overflow", 1, 0);
        let all = side(&[1.0, 1.0], 900, &[30, 210], Overflow::Redistribute).draw(None, &mut rng);
        assert_eq!(all, [30, 210], "stops when nothing has room");
    }

    #[test]
    fn nothing_is_given_to_concentration_zero() {
        for sample in 0..200 {
            let mut rng = stream(0, "test.never", 0, sample);
            let room = [5120, 210, 30];
            let budgets =
                side(&[0.0, 1.0, 0.0], 777, &room, Overflow::Redistribute).draw(None, &mut rng);
            assert_eq!(budgets, [0, 210, 0]);
        }
    }
}
