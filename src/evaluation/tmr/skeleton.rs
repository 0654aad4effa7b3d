//! The 22 joints of `HumanML3D` (SMPL's order), their tree, and the reference lengths that every motion is retargeted to.

/// Joints of a pose.
pub const JOINTS: usize = 22;

/// One pose: metres.
pub type Pose = [[f64; 3]; JOINTS];

/// The joint nearer to the root; the root is its own parent.
pub const PARENTS: [usize; JOINTS] = [
    0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19,
];

/// Metres from each joint to its parent in the reference motion ("000021") of `HumanML3D`.
pub const LENGTHS: [f64; JOINTS] = [
    0.0,
    0.103_073_968_014_040_12,
    0.109_883_367_931_551_28,
    0.131_568_242_723_915_62,
    0.393_623_201_046_372_44,
    0.390_188_226_356_762_8,
    0.143_190_214_696_485_05,
    0.432_433_081_252_883_54,
    0.425_643_344_551_513_4,
    0.057_364_735_143_330_216,
    0.143_381_818_664_103_57,
    0.149_419_072_820_892_6,
    0.219_360_052_891_646_7,
    0.137_486_767_617_009,
    0.143_382_832_828_553_3,
    0.103_039_219_469_378_32,
    0.131_614_045_840_072_72,
    0.122_984_378_039_318_66,
    0.256_840_004_809_803_3,
    0.263_091_744_171_133_9,
    0.266_011_722_625_214_7,
    0.269_876_403_150_959_4,
];

/// The direction of each bone at rest.
pub const AXES: [[f64; 3]; JOINTS] = [
    [0.0, 0.0, 0.0],
    [1.0, 0.0, 0.0],
    [-1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [0.0, 0.0, 1.0],
    [0.0, 1.0, 0.0],
    [1.0, 0.0, 0.0],
    [-1.0, 0.0, 0.0],
    [0.0, 0.0, 1.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, -1.0, 0.0],
];

/// Legs, spine and arms. The arms start at joint 9 but with the rotation of the root, as the original code has it.
pub const CHAINS: [&[usize]; 5] = [
    &[0, 2, 5, 8, 11],
    &[0, 1, 4, 7, 10],
    &[0, 3, 6, 9, 12, 15],
    &[9, 14, 17, 19, 21],
    &[9, 13, 16, 18, 20],
];

/// The first spine joint, which the product's body lacks.
pub const SPINE1: usize = 3;
/// Its neighbours in the list of 22.
const PELVIS: usize = 0;
const SPINE2: usize = 6;

/// Where on the way from pelvis to second spine joint the first lies: its share in the reference skeleton.
#[must_use]
pub fn spine_share() -> f64 {
    LENGTHS[SPINE1] / (LENGTHS[SPINE1] + LENGTHS[SPINE2])
}

/// The product's 21 joints with the first spine joint put on the straight line. (On the pelvis it would be a bone without
/// length, from which the original code makes a rigid spine without a word.)
#[must_use]
pub fn spine_filled(pose: &[[f64; 3]; JOINTS - 1]) -> Pose {
    let mut filled: Pose =
        std::array::from_fn(|j| pose[if j > SPINE1 { j - 1 } else { j.min(SPINE1 - 1) }]);
    let (pelvis, spine2) = (filled[PELVIS], filled[SPINE2]);
    filled[SPINE1] = std::array::from_fn(|k| pelvis[k] + spine_share() * (spine2[k] - pelvis[k]));
    filled
}

/// From z up to y up: a rotation, not a mirror.
#[must_use]
pub fn y_up(pose: &Pose) -> Pose {
    pose.map(|[x, y, z]| [-x, z, y])
}
