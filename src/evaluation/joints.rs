//! Joint errors in millimetres: MPJPE, RA-, GA- and PA-MPJPE (Sec. 5), body and hands.
//!
//! | name | alignment | mean over |
//! |---|---|---|
//! | MPJPE | none | valid (frame, joint) |
//! | RA | the frame's root joint subtracted from both | valid (frame, joint) of frames whose root is valid |
//! | GA | one similarity for the clip | valid (frame, joint) |
//! | PA | one similarity per frame | joints, then frames |

use super::outcome::{MetricError, Outcome, mean};
use crate::geometry::alignment::{Freedom, align};
use nalgebra::Vector3;
use ndarray::{ArrayView1, ArrayView2, ArrayView3, Axis};

/// What counts.
#[derive(Debug, Clone, Copy)]
pub enum Valid<'a> {
    /// Every joint of every frame.
    All,
    /// `[T]`
    Frames(ArrayView1<'a, bool>),
    /// `[T, J]`
    Joints(ArrayView2<'a, bool>),
}

impl Valid<'_> {
    fn at(&self, frame: usize, joint: usize) -> bool {
        match self {
            Self::All => true,
            Self::Frames(valid) => valid[frame],
            Self::Joints(valid) => valid[(frame, joint)],
        }
    }

    fn fits(&self, frames: usize, joints: usize) -> bool {
        match self {
            Self::All => true,
            Self::Frames(valid) => valid.len() == frames,
            Self::Joints(valid) => valid.dim() == (frames, joints),
        }
    }

    fn shape(&self) -> Vec<usize> {
        match self {
            Self::All => Vec::new(),
            Self::Frames(valid) => valid.shape().to_vec(),
            Self::Joints(valid) => valid.shape().to_vec(),
        }
    }
}

/// Joint errors of one clip, in millimetres.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct JointErrors {
    /// Frames with at least one valid joint.
    pub n_frames: usize,
    /// Valid (frame, joint) pairs.
    pub n_points: usize,
    /// Mean distance without alignment; `None` without a valid joint.
    pub mpjpe: Option<f64>,
    /// Mean distance with both roots at the origin; `None` where no frame has a valid root.
    pub ra: Option<f64>,
    /// Present also when [`Self::ga_degenerate`]: then it is one optimum of many and must not be averaged.
    pub ga: Option<f64>,
    /// What the clip's similarity multiplies the prediction by, without unit; `None` without a valid joint.
    pub ga_scale: Option<f64>,
    /// The clip's similarity has no unique optimum: points that coincide, lie on a line, or fit a mirror image best.
    pub ga_degenerate: bool,
    /// Mean over the frames whose alignment is unique.
    pub pa: Option<f64>,
    /// Frames with a valid joint whose own similarity is not unique: they are not in [`Self::pa`].
    pub pa_degenerate_frames: usize,
}

impl JointErrors {
    /// MPJPE as the clip's score.
    #[must_use]
    pub fn mpjpe_outcome(&self) -> Outcome {
        Outcome::of(self.mpjpe)
    }

    /// RA-MPJPE as the clip's score; null where no frame has a valid root.
    #[must_use]
    pub fn ra_outcome(&self) -> Outcome {
        Outcome::of(self.ra)
    }

    /// GA-MPJPE as the clip's score; degenerate where the similarity is not unique.
    #[must_use]
    pub fn ga_outcome(&self) -> Outcome {
        Outcome::unless(self.ga_degenerate, self.ga)
    }

    /// PA-MPJPE as the clip's score; degenerate where the similarity of no frame is unique.
    #[must_use]
    pub fn pa_outcome(&self) -> Outcome {
        match self.pa {
            None if self.pa_degenerate_frames > 0 => Outcome::Degenerate,
            value => Outcome::of(value),
        }
    }
}

const MM: f64 = 1000.0;

/// Errors of `pred` against `gt`, both `[T, J, 3]` in metres; `root` is the joint that RA subtracts (hand: wrist, body: pelvis).
///
/// # Errors
/// When the shapes differ, there is no joint `root`, or a coordinate of a valid joint is not finite in either.
pub fn joint_errors<T: Copy + Into<f64>>(
    pred: ArrayView3<T>,
    gt: ArrayView3<T>,
    valid: Valid,
    root: usize,
) -> Result<JointErrors, MetricError> {
    let (frames, joints, axes) = gt.dim();
    if pred.dim() != gt.dim() || axes != 3 {
        return Err(MetricError::Shape {
            field: "joints",
            found: pred.shape().to_vec(),
            expected: vec![frames, joints, 3],
        });
    }
    if !valid.fits(frames, joints) {
        return Err(MetricError::Shape {
            field: "validity of joints",
            found: valid.shape(),
            expected: vec![frames, joints],
        });
    }
    if joints > 0 && root >= joints {
        return Err(MetricError::Argument {
            name: "root",
            found: root as f64,
            allowed: format!("below {joints}, the number of joints"),
        });
    }
    // Valid points of all frames, one after another; `ends[t]` closes frame t.
    let mut source = Vec::with_capacity(frames * joints);
    let mut target = Vec::with_capacity(frames * joints);
    let mut roots = Vec::with_capacity(frames);
    let mut ends = Vec::with_capacity(frames);
    for t in 0..frames {
        for j in 0..joints {
            if valid.at(t, j) {
                source.push(finite(&pred, t, j, "prediction")?);
                target.push(finite(&gt, t, j, "ground truth")?);
            }
        }
        roots.push(
            (joints > 0 && valid.at(t, root)).then(|| (point(&pred, t, root), point(&gt, t, root))),
        );
        ends.push(source.len());
    }
    let mut errors = JointErrors {
        n_points: source.len(),
        ..JointErrors::default()
    };
    if source.is_empty() {
        return Ok(errors);
    }
    let distances = source.iter().zip(&target).map(|(x, y)| (x - y).norm());
    errors.mpjpe = mean(distances).map(|m| m * MM);

    let whole = align(&source, &target, Freedom::Similarity);
    let aligned = source
        .iter()
        .zip(&target)
        .map(|(x, y)| (whole.transform.apply(x) - y).norm());
    errors.ga = mean(aligned).map(|m| m * MM);
    errors.ga_scale = Some(whole.transform.scale);
    errors.ga_degenerate = whole.degenerate.is_some();

    let (mut rooted, mut per_frame, mut start) = (
        Vec::with_capacity(source.len()),
        Vec::with_capacity(frames),
        0,
    );
    for (end, root) in ends.into_iter().zip(roots) {
        let (x, y) = (&source[start..end], &target[start..end]);
        start = end;
        if x.is_empty() {
            continue;
        }
        errors.n_frames += 1;
        if let Some((root_x, root_y)) = root {
            rooted.extend(
                x.iter()
                    .zip(y)
                    .map(|(x, y)| ((x - root_x) - (y - root_y)).norm()),
            );
        }
        let frame = align(x, y, Freedom::Similarity);
        if frame.degenerate.is_some() {
            errors.pa_degenerate_frames += 1;
        } else {
            per_frame.extend(mean(
                x.iter()
                    .zip(y)
                    .map(|(x, y)| (frame.transform.apply(x) - y).norm()),
            ));
        }
    }
    errors.ra = mean(rooted).map(|m| m * MM);
    errors.pa = mean(per_frame).map(|m| m * MM);
    Ok(errors)
}

/// How a clip's two hands become one number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HandMode {
    /// Mean of the hands that have a value: the headline.
    Strict,
    /// A hand without a valid frame counts as 0.0, as in the published hand table; it makes numbers look better.
    Compat,
}

/// Combines the outcome of the left and the right hand.
///
/// Strict: a degenerate hand makes the clip degenerate only if no hand has a number.
#[must_use]
pub fn pair_of_hands(hands: [Outcome; 2], mode: HandMode) -> Outcome {
    match mode {
        HandMode::Strict => match mean(hands.into_iter().filter_map(Outcome::number)) {
            Some(value) => Outcome::Number(value),
            None if hands.contains(&Outcome::Degenerate) => Outcome::Degenerate,
            None => Outcome::Null,
        },
        HandMode::Compat if hands.contains(&Outcome::Degenerate) => Outcome::Degenerate,
        HandMode::Compat => Outcome::of(mean(hands.map(|hand| hand.number().unwrap_or(0.0)))),
    }
}

/// Mean joint distance in millimetres without any alignment and without a mask: the tokenizer's reconstruction error.
///
/// # Errors
/// When the shapes differ or a value is not finite.
pub fn reconstruction_mm<T: Copy + Into<f64>>(
    pred: ArrayView3<T>,
    gt: ArrayView3<T>,
) -> Result<Option<f64>, MetricError> {
    Ok(joint_errors(pred, gt, Valid::All, 0)?.mpjpe)
}

fn point<T: Copy + Into<f64>>(joints: &ArrayView3<T>, frame: usize, joint: usize) -> Vector3<f64> {
    let lane = joints.index_axis(Axis(0), frame);
    Vector3::from_fn(|axis, _| lane[(joint, axis)].into())
}

fn finite<T: Copy + Into<f64>>(
    joints: &ArrayView3<T>,
    frame: usize,
    joint: usize,
    field: &'static str,
) -> Result<Vector3<f64>, MetricError> {
    let point = point(joints, frame, joint);
    if point.iter().all(|c| c.is_finite()) {
        Ok(point)
    } else {
        Err(MetricError::NotFinite {
            field,
            position: vec![frame, joint],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, Array3};
    use rand::RngExt;

    fn motion(name: &str) -> Array3<f64> {
        let mut rng = crate::random::stream(3, name, 0, 0);
        Array3::from_shape_fn((10, 21, 3), |_| rng.random::<f64>())
    }

    #[test]
    fn errors_do_not_change_where_an_alignment_promises_it() {
        let (pred, gt) = (motion("joints.pred"), motion("joints.gt"));
        let base = joint_errors(pred.view(), gt.view(), Valid::All, 0).unwrap();
        let scaled = pred.mapv(|v| 3.0 * v + 2.0);
        let moved = joint_errors(scaled.view(), gt.view(), Valid::All, 0).unwrap();
        assert!((moved.ga.unwrap() - base.ga.unwrap()).abs() < 1e-9);
        assert!((moved.pa.unwrap() - base.pa.unwrap()).abs() < 1e-9);
        let mut walked = pred.clone();
        for (t, mut frame) in walked.outer_iter_mut().enumerate() {
            frame.mapv_inplace(|v| v + t as f64);
        }
        let walked = joint_errors(walked.view(), gt.view(), Valid::All, 0).unwrap();
        assert!((walked.ra.unwrap() - base.ra.unwrap()).abs() < 1e-9);
        assert!((walked.pa.unwrap() - base.pa.unwrap()).abs() < 1e-9);
    }

    #[test]
    fn a_perfect_prediction_scores_zero_and_a_mirrored_one_does_not() {
        let gt = motion("joints.same");
        let same = joint_errors(gt.view(), gt.view(), Valid::All, 0).unwrap();
        assert!(same.mpjpe.unwrap() == 0.0 && same.ga.unwrap() < 1e-9 && same.pa.unwrap() < 1e-9);
        let mirrored = gt.mapv(|v| -v);
        let errors = joint_errors(mirrored.view(), gt.view(), Valid::All, 0).unwrap();
        assert!(errors.ga.unwrap() > 50.0 && errors.pa.unwrap() > 50.0);
    }

    #[test]
    fn an_invalid_frame_changes_nothing_and_a_hole_on_a_valid_one_is_refused() {
        let (mut pred, gt) = (motion("joints.pred"), motion("joints.gt"));
        let mut valid = Array2::from_elem((10, 21), true);
        valid.row_mut(4).fill(false);
        let before = joint_errors(pred.view(), gt.view(), Valid::Joints(valid.view()), 0).unwrap();
        pred[(4, 3, 1)] = f64::NAN;
        let after = joint_errors(pred.view(), gt.view(), Valid::Joints(valid.view()), 0).unwrap();
        assert_eq!(before, after);
        let refused = joint_errors(pred.view(), gt.view(), Valid::All, 0).unwrap_err();
        assert_eq!(
            refused,
            MetricError::NotFinite {
                field: "prediction",
                position: vec![4, 3]
            }
        );
    }

    #[test]
    fn a_root_that_is_no_joint_is_named_and_not_called_a_shape() {
        let (pred, gt) = (motion("joints.pred"), motion("joints.gt"));
        let refused = joint_errors(pred.view(), gt.view(), Valid::All, 21).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "`root` is 21; it must be below 21, the number of joints"
        );
        let short = ndarray::Array1::from_elem(9, true);
        let refused = joint_errors(pred.view(), gt.view(), Valid::Frames(short.view()), 0);
        assert_eq!(
            refused.unwrap_err().to_string(),
            "validity of joints: shape [9] does not fit [10, 21]"
        );
    }

    #[test]
    fn hands_without_a_frame_are_left_out_unless_compat_is_asked_for() {
        let hands = [Outcome::Number(8.0), Outcome::Null];
        assert_eq!(pair_of_hands(hands, HandMode::Strict), Outcome::Number(8.0));
        assert_eq!(pair_of_hands(hands, HandMode::Compat), Outcome::Number(4.0));
        let none = [Outcome::Null; 2];
        assert_eq!(pair_of_hands(none, HandMode::Strict), Outcome::Null);
        assert_eq!(pair_of_hands(none, HandMode::Compat), Outcome::Number(0.0));
    }
}
