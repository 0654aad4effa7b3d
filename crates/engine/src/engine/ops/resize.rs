//! The geometry of a bilinear resize with aligned corners: the corner pixels of source and target coincide.

/// Packed frames `[frames * height * width, C]` of one size to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Resize {
    /// Frames of all samples together.
    pub frames: usize,
    /// Height and width.
    pub from: [usize; 2],
    /// Height and width.
    pub to: [usize; 2],
}

impl Resize {
    /// How many rows come in.
    #[must_use]
    pub fn rows_in(self) -> usize {
        self.frames * self.from[0] * self.from[1]
    }

    /// How many rows come out.
    #[must_use]
    pub fn rows_out(self) -> usize {
        self.frames * self.to[0] * self.to[1]
    }
}

/// What one target element of an axis is made of: `lower (1 - weight) + upper weight`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Index of the source element at or before the place.
    pub lower: usize,
    /// Index of the next one; the same at the end of the axis.
    pub upper: usize,
    /// The share of the upper one, in `[0, 1)`.
    pub weight: f32,
}

/// The steps of an axis from `source` to `target` elements: element `i` lies at `i (source - 1) / (target - 1)`, and at 0 if it
/// is the only one.
///
/// # Panics
/// When the source is empty.
#[must_use]
pub fn steps(source: usize, target: usize) -> Vec<Step> {
    assert!(source > 0, "an axis to resize has elements");
    let span = target.saturating_sub(1).max(1);
    (0..target)
        .map(|i| {
            let place = i * (source - 1);
            let lower = place / span;
            Step {
                lower,
                upper: (lower + 1).min(source - 1),
                weight: ((place % span) as f64 / span as f64) as f32,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_coincide_and_a_single_element_is_the_first() {
        let ends = |source, target| {
            let all = steps(source, target);
            let place = |step: &Step| step.lower as f32 + step.weight;
            (place(&all[0]), place(&all[target - 1]))
        };
        assert_eq!(ends(5, 9), (0.0, 4.0));
        assert_eq!(ends(9, 4), (0.0, 8.0));
        assert_eq!(ends(7, 1), (0.0, 0.0));
        assert_eq!(ends(1, 6), (0.0, 0.0));
        assert_eq!(steps(3, 5)[1].weight, 0.5);
    }
}
