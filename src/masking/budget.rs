//! From proportions to token counts (Supp. B; Alg. 1, lines 3 to 6).

use super::Overflow;
use super::dirichlet::{largest_share, proportions};
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

/// Budgets for one side of a sample: Dirichlet proportions (or `shares`, if given) of `total` within `room`.
pub fn draw(
    alphas: &[f64],
    total: usize,
    room: &[usize],
    overflow: Overflow,
    shares: Option<&[f32]>,
    rng: &mut StreamRng,
) -> Vec<usize> {
    let own;
    let shares = if let Some(shares) = shares {
        shares
    } else {
        own = proportions(alphas, rng);
        &own
    };
    if shares.iter().all(|share| *share == 0.0) {
        return vec![0; room.len()];
    }
    let mut budgets = allocate(shares, total, || largest_share(alphas, rng));
    let mut excess = clamp(&mut budgets, room);
    while overflow == Overflow::Respill && excess > 0 {
        let left: Vec<usize> = room.iter().zip(&budgets).map(|(r, b)| r - b).collect();
        let alphas: Vec<f64> = alphas
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
    budgets
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::stream;

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
                let budgets = draw(&alphas, 2048, &room, overflow, None, &mut rng);
                assert!(budgets.iter().zip(room).all(|(b, r)| *b <= r));
                budgets.iter().sum::<usize>()
            };
            assert!(sum(Overflow::Drop) <= 2048);
            assert_eq!(sum(Overflow::Respill), 2048);
        }
        let mut rng = stream(0, "test.overflow", 1, 0);
        let all = draw(
            &[1.0, 1.0],
            900,
            &[30, 210],
            Overflow::Respill,
            None,
            &mut rng,
        );
        assert_eq!(all, [30, 210], "stops when nothing has room");
    }

    #[test]
    fn nothing_is_given_to_concentration_zero() {
        for sample in 0..200 {
            let mut rng = stream(0, "test.never", 0, sample);
            let budgets = draw(
                &[0.0, 1.0, 0.0],
                777,
                &[5120, 210, 30],
                Overflow::Respill,
                None,
                &mut rng,
            );
            assert_eq!(budgets, [0, 210, 0]);
        }
    }
}
