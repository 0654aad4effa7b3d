//! The 21 joints of a hand and of the body, in the order the tokenizers were trained with.
//!
//! The kinematic tokenizer groups three consecutive joints (Supp. A), so this order is part of the model. The body is the
//! 22-joint SMPL list without its first spine joint; a hand is the MANO list with the fingertips appended.

use ndarray::{Array3, ArrayViewMut3};

/// Joints of every skeleton here.
pub const JOINTS: usize = 21;

/// One pose of 21 joints, metres; NaN where unknown.
pub type Joints = [[f32; 3]; JOINTS];

/// A named joint list with its tree and its mirror image.
#[derive(Debug, Clone, Copy)]
pub struct Skeleton {
    /// `hand` or `body`.
    pub name: &'static str,
    /// What the joints are called, in the order of every array of joints.
    pub joints: [&'static str; JOINTS],
    /// The joint nearer to the root; the root is its own parent.
    pub parents: [usize; JOINTS],
    /// The joint's counterpart in the mirror image of the same skeleton.
    pub mirror: [usize; JOINTS],
}

/// A hand, left or right: 0 wrist, three joints for each of index, middle, pinky, ring and thumb from the knuckle outwards,
/// then the tips of thumb, index, middle, ring, pinky.
pub const HAND: Skeleton = Skeleton {
    name: "hand",
    joints: [
        "wrist",
        "index1",
        "index2",
        "index3",
        "middle1",
        "middle2",
        "middle3",
        "pinky1",
        "pinky2",
        "pinky3",
        "ring1",
        "ring2",
        "ring3",
        "thumb1",
        "thumb2",
        "thumb3",
        "thumb_tip",
        "index_tip",
        "middle_tip",
        "ring_tip",
        "pinky_tip",
    ],
    parents: [
        0, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14, 15, 3, 6, 12, 9,
    ],
    // Mirroring turns a left hand into a right hand; every joint keeps its place.
    mirror: [
        0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20,
    ],
};

/// The body: SMPL's 22 joints without `spine1`.
pub const BODY: Skeleton = Skeleton {
    name: "body",
    joints: [
        "pelvis",
        "left_hip",
        "right_hip",
        "left_knee",
        "right_knee",
        "spine2",
        "left_ankle",
        "right_ankle",
        "spine3",
        "left_foot",
        "right_foot",
        "neck",
        "left_collar",
        "right_collar",
        "head",
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
        "right_elbow",
        "left_wrist",
        "right_wrist",
    ],
    parents: [
        0, 0, 0, 1, 2, 0, 3, 4, 5, 6, 7, 8, 8, 8, 11, 12, 13, 15, 16, 17, 18,
    ],
    mirror: [
        0, 2, 1, 4, 3, 5, 7, 6, 8, 10, 9, 11, 13, 12, 14, 16, 15, 18, 17, 20, 19,
    ],
};

/// A joint of the body, in the order of [`BODY`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[allow(missing_docs, reason = "the names say it")]
pub enum Joint {
    Pelvis,
    LeftHip,
    RightHip,
    LeftKnee,
    RightKnee,
    Spine2,
    LeftAnkle,
    RightAnkle,
    Spine3,
    LeftFoot,
    RightFoot,
    Neck,
    LeftCollar,
    RightCollar,
    Head,
    LeftShoulder,
    RightShoulder,
    LeftElbow,
    RightElbow,
    LeftWrist,
    RightWrist,
}

impl From<Joint> for usize {
    fn from(joint: Joint) -> usize {
        joint as usize
    }
}

/// A joint of a hand, in the order of [`HAND`]; `1` is the knuckle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[allow(missing_docs, reason = "the names say it")]
pub enum HandJoint {
    Wrist,
    Index1,
    Index2,
    Index3,
    Middle1,
    Middle2,
    Middle3,
    Pinky1,
    Pinky2,
    Pinky3,
    Ring1,
    Ring2,
    Ring3,
    Thumb1,
    Thumb2,
    Thumb3,
    ThumbTip,
    IndexTip,
    MiddleTip,
    RingTip,
    PinkyTip,
}

impl From<HandJoint> for usize {
    fn from(joint: HandJoint) -> usize {
        joint as usize
    }
}

impl Skeleton {
    /// (parent, child) of every joint but the root.
    pub fn bones(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        (0..JOINTS)
            .filter(|&j| self.parents[j] != j)
            .map(|j| (self.parents[j], j))
    }

    /// The index of a joint by name.
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|j| *j == name)
    }

    /// Bone lengths of one pose, metres, in the order of [`Skeleton::bones`].
    pub fn bone_lengths(&self, pose: &[[f64; 3]; JOINTS]) -> Vec<f64> {
        self.bones()
            .map(|(a, b)| {
                (0..3)
                    .map(|k| (pose[a][k] - pose[b][k]).powi(2))
                    .sum::<f64>()
                    .sqrt()
            })
            .collect()
    }

    /// The mirror image of `[T, 21, 3]` across the plane x = 0, with left and right joints exchanged.
    ///
    /// In the camera frame and in the gravity frame x points to the right, so this is the sagittal mirror.
    pub fn mirrored(&self, joints: &Array3<f32>) -> Array3<f32> {
        let mut out = joints.clone();
        self.mirror_into(joints, out.view_mut());
        out
    }

    fn mirror_into(&self, joints: &Array3<f32>, mut out: ArrayViewMut3<f32>) {
        for ((t, j, k), value) in out.indexed_iter_mut() {
            let source = joints[[t, self.mirror[j], k]];
            *value = if k == 0 { -source } else { source };
        }
    }
}

/// `ours[i] = common[HAND_FROM_COMMON[i]]`, where common is wrist, then thumb, index, middle, ring, pinky, knuckle to tip.
pub const HAND_FROM_COMMON: [usize; JOINTS] = [
    0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3, 4, 8, 12, 16, 20,
];

/// Wrist, thumb, index, middle, ring, pinky among the 26 joints of HoloLens 2 (palm and wrist, then the thumb's four, then five of
/// each finger with the metacarpal first).
pub const COMMON_FROM_HOLOLENS: [usize; JOINTS] = [
    1, 2, 3, 4, 5, 7, 8, 9, 10, 12, 13, 14, 15, 17, 18, 19, 20, 22, 23, 24, 25,
];

/// `ours[i] = smpl22[BODY_FROM_SMPL22[i]]`.
pub const BODY_FROM_SMPL22: [usize; JOINTS] = [
    0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21,
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_common_order_of_a_hand_goes_finger_by_finger_from_knuckle_to_tip() {
        let mut common = [""; JOINTS];
        for (name, at) in HAND.joints.into_iter().zip(HAND_FROM_COMMON) {
            common[at] = name;
        }
        assert_eq!(
            common[1..9],
            [
                "thumb1",
                "thumb2",
                "thumb3",
                "thumb_tip",
                "index1",
                "index2",
                "index3",
                "index_tip"
            ]
        );
        assert_eq!(common[20], "pinky_tip");
    }

    #[test]
    fn trees_have_one_root_twenty_bones_and_reach_it() {
        for skeleton in [HAND, BODY] {
            assert_eq!(skeleton.bones().count(), 20);
            for mut joint in 0..JOINTS {
                for _ in 0..10 {
                    joint = skeleton.parents[joint];
                }
                assert_eq!(joint, 0, "{}", skeleton.name);
            }
        }
    }

    #[test]
    fn body_bones_follow_the_drawing_chains() {
        let chains: [&[usize]; 5] = [
            &[0, 2, 4, 7, 10],
            &[0, 1, 3, 6, 9],
            &[0, 5, 8, 11, 14],
            &[8, 13, 16, 18, 20],
            &[8, 12, 15, 17, 19],
        ];
        for chain in chains {
            for pair in chain.windows(2) {
                assert_eq!(BODY.parents[pair[1]], pair[0]);
            }
        }
    }

    #[test]
    fn mirroring_twice_is_nothing_and_swaps_sides_by_name() {
        for (joint, name) in BODY.joints.iter().enumerate() {
            let swapped = name
                .replace("left", "LEFT")
                .replace("right", "left")
                .replace("LEFT", "right");
            assert_eq!(BODY.joints[BODY.mirror[joint]], swapped);
        }
        let pose = Array3::from_shape_fn((2, JOINTS, 3), |(t, j, k)| (t + 3 * j + 7 * k) as f32);
        assert_eq!(BODY.mirrored(&BODY.mirrored(&pose)), pose);
        assert_ne!(BODY.mirrored(&pose), pose);
    }

    #[test]
    fn the_body_is_smpl_without_its_first_spine_joint() {
        assert!(!BODY_FROM_SMPL22.contains(&3));
        assert!(BODY_FROM_SMPL22.is_sorted());
        assert_eq!(BODY_FROM_SMPL22[BODY.joint("left_wrist").unwrap()], 20);
        assert_eq!(BODY_FROM_SMPL22[BODY.joint("left_foot").unwrap()], 10);
    }
}
