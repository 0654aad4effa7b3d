//! Labels as 8-bit video, as released models were trained on: levels are truncated, not rounded.

use super::DepthLabelKind;

/// Metres of the brightest level.
pub const FARTHEST: f32 = 15.0;

/// Levels of the labels of one clip (or file). Relative labels span their own range; metric ones 0 to 15 m, and what is not
/// finite is 0. A constant relative clip has no range and is black.
#[must_use]
pub fn levels(kind: DepthLabelKind, labels: &[f32]) -> Vec<u8> {
    match kind {
        DepthLabelKind::Relative => {
            let finite = labels.iter().filter(|value| value.is_finite());
            let (low, high) = finite.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| {
                (low.min(*v), high.max(*v))
            });
            let span = if high > low {
                high - low
            } else {
                f32::INFINITY
            };
            let level = |value: &f32| ((value - low) / span).clamp(0.0, 1.0) * 255.0;
            labels.iter().map(|value| level(value) as u8).collect()
        }
        DepthLabelKind::Metric => labels
            .iter()
            .map(|value| {
                let level = value / FARTHEST * 255.0;
                if value.is_finite() {
                    level.clamp(0.0, 255.0) as u8
                } else {
                    0
                }
            })
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn constant_labels_are_black_and_holes_are_black() {
        assert_eq!(levels(DepthLabelKind::Relative, &[2.0; 3]), [0; 3]);
        assert_eq!(
            levels(DepthLabelKind::Relative, &[1.0, f32::NAN, 3.0]),
            [0, 0, 255]
        );
        let metres = [f32::INFINITY, f32::NAN, -1.0, 7.5, 40.0];
        assert_eq!(levels(DepthLabelKind::Metric, &metres), [0, 0, 0, 127, 255]);
    }
}
