//! `object_pose`: where the thing in the right hand is, and how it is turned, `[60, 7]`.
//!
//! Poses are more than channels over time: the mean of two quaternions is no rotation, and a pose moves with the window it was decoded in.
//! So the modality brings a type of its own ([`ObjectTrack`]), how that becomes numbers for the tokenizer and back ([`ObjectPose`]), how
//! windows are stitched and what the reconstruction shows ([`ObjectPath`]), and what scores it ([`ObjectMetrics`]).

use nalgebra::{
    Isometry3, Matrix3, Point3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3,
};
use ndarray::{Array1, Array2, Ix2};
use reviv::clip::tracks::pose_matrices;
use reviv::clip::{Arrays, Clip, Form, Held, Key, Signal, Value};
use reviv::evaluation::columns::{Column, ColumnInfo};
use reviv::evaluation::metric::{Baseline, ClipScore, MetricEntry, MetricSet, Pair};
use reviv::evaluation::{MetricError, Outcome};
use reviv::experiment::LinkedEntry;
use reviv::geometry::rigid::{Rigid, interpolate};
use reviv::geometry::skeleton::HAND;
use reviv::modality::code::SignalCode;
use reviv::modality::{
    ClipFormat, DeclaredSettings, Lengths, LinkedModality, Modality, ModalityError, Shape,
};
use reviv::reconstruction::export::files::Files;
use reviv::reconstruction::folder::FolderError;
use reviv::reconstruction::predictions::ScaleStatus;
use reviv::reconstruction::track::{Gap, Placement, Timeline, Track, TrackEntry};
use reviv::view::{Drawing, Part};

const NAME: &str = "object_pose";
/// What clips hold of it.
pub const OBJECT: Key<'static, ObjectTrack> = Key::new(NAME);

inventory::submit! { LinkedEntry { origin: "plugin_modality 0.1", text: include_str!("object_pose.yaml") } }
inventory::submit! { SignalCode { name: NAME, about: "The palm of the right hand stands for what it holds.", derive } }
inventory::submit! { LinkedModality { name: NAME, make: |format| Box::new(ObjectPose::new(format)), form: Form::of::<ObjectTrack>() } }
inventory::submit! { MetricEntry(&ObjectMetrics) }
inventory::submit! { TrackEntry { modality: NAME, make: |_| Box::new(ObjectPath::default()) } }

// ---- what a clip holds ------------------------------------------------------------------------------------------------

/// An object over time.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectTrack {
    /// Hz.
    pub rate: f64,
    /// `[T]`: the object in the first camera of the clip; `None` where it is not known.
    pub T_first_object: Vec<Option<Rigid>>,
}

/// Position and quaternion x y z w.
fn row(pose: &Rigid) -> [f64; 7] {
    let (p, q) = (pose.translation.vector, pose.rotation.coords);
    [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
}

/// The pose of a row; `None` where it holds none.
fn pose(row: [f64; 7]) -> Option<Rigid> {
    let [x, y, z, qx, qy, qz, qw] = row;
    let rotation = UnitQuaternion::try_new(Quaternion::new(qw, qx, qy, qz), 1e-6)?;
    let finite = row.iter().all(|value| value.is_finite());
    finite.then(|| Rigid::from_parts(Translation3::new(x, y, z), rotation))
}

impl Value for ObjectTrack {
    fn to_arrays(&self) -> Arrays {
        let poses = &self.T_first_object;
        let values = Array2::from_shape_fn((poses.len(), 7), |(t, c)| {
            poses[t].map_or(0.0, |pose| row(&pose)[c])
        });
        let valid: Array1<bool> = poses.iter().map(Option::is_some).collect();
        Arrays::new(values).valid(valid).rate(self.rate)
    }

    fn from_arrays(arrays: &Arrays) -> Result<Self, String> {
        let values = arrays.read::<f64, Ix2>()?;
        reviv::clip::value::expect_shape(&arrays.name, &[values.ncols()], &[7])?;
        let valid = arrays.read_valid::<ndarray::Ix1>(&[values.nrows()])?;
        let known = |t: usize| pose(std::array::from_fn(|c| values[[t, c]])).filter(|_| valid[t]);
        Ok(Self {
            rate: arrays.read_rate()?,
            T_first_object: (0..values.nrows()).map(known).collect(),
        })
    }
}

/// The palm: x towards the index finger's side, y towards the fingers.
#[allow(clippy::unnecessary_wraps, reason = "the type of `SignalCode::derive`")]
fn derive(clip: &Clip, settings: &DeclaredSettings) -> Result<Option<Signal>, ModalityError> {
    let (Some(camera), Some(hand)) = (clip.camera(), clip.right_hand()) else {
        return Ok(None);
    };
    let [wrist, index, middle, pinky] = ["wrist", "index1", "middle1", "pinky1"]
        .map(|name| HAND.joint(name).expect("a joint of the list"));
    let first = camera.T_world_camera[0];
    let palm = |t: usize| {
        let valid = camera.valid[0] && camera.valid[t] && hand.valid.row(t).iter().all(|v| *v);
        let joint = |j: usize| {
            Point3::from(std::array::from_fn::<f64, 3, _>(|k| {
                f64::from(hand.joints[[t, j, k]])
            }))
        };
        let y = (joint(middle) - joint(wrist)).try_normalize(1e-6)?;
        let across = joint(index) - joint(pinky);
        let x = (across - y * across.dot(&y)).try_normalize(1e-6)?;
        let turn = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, x.cross(&y)]));
        let in_camera = Isometry3::from_parts(
            joint(middle).into(),
            UnitQuaternion::from_rotation_matrix(&turn),
        );
        valid.then(|| first.inv_mul(&camera.T_world_camera[t]) * in_camera)
    };
    let track = ObjectTrack {
        rate: settings.signal.rate,
        T_first_object: (0..camera.T_world_camera.len()).map(palm).collect(),
    };
    Ok(Some(signal(&track)))
}

// ---- as numbers for the tokenizer -------------------------------------------------------------------------------------

/// `[T, 7]`; of a quaternion and its negative, which are the same rotation, the one nearer to the sample before.
fn signal(track: &ObjectTrack) -> Signal {
    let mut values = Array2::zeros((track.T_first_object.len(), 7));
    let mut before = Vector3::zeros().push(1.0);
    for (mut out, pose) in values.outer_iter_mut().zip(&track.T_first_object) {
        let Some(pose) = pose else { continue };
        let sign = if pose.rotation.coords.dot(&before) < 0.0 {
            -1.0
        } else {
            1.0
        };
        before = pose.rotation.coords * sign;
        for (c, value) in row(pose).into_iter().enumerate() {
            out[c] = (if c < 3 { value } else { sign * value }) as f32;
        }
    }
    let valid: Array1<bool> = track.T_first_object.iter().map(Option::is_some).collect();
    Signal {
        values: values.into_dyn(),
        valid: (!valid.iter().all(|v| *v)).then(|| valid.into_dyn()),
    }
}

/// The modality at the sizes of a format.
struct ObjectPose {
    samples: usize,
    rate: f64,
}

impl ObjectPose {
    fn new(format: &ClipFormat) -> Self {
        Self {
            samples: format.samples,
            rate: format.signal_rate,
        }
    }
}

impl Modality for ObjectPose {
    fn name(&self) -> &'static str {
        NAME
    }
    fn about(&self) -> &'static str {
        "Pose of what the right hand holds."
    }
    fn rate(&self) -> f64 {
        self.rate
    }
    fn shape(&self) -> Shape {
        Shape::Temporal {
            samples: self.samples,
            channels: 7,
        }
    }
    fn units(&self) -> Vec<String> {
        ["m", "m", "m", "1", "1", "1", "1"]
            .map(str::to_owned)
            .into()
    }
    fn lengths(&self) -> Lengths {
        Lengths::Metric
    }
    fn frame(&self) -> &'static str {
        "first camera of the clip (x right, y down, z forward)"
    }

    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError> {
        let track = clip
            .get(OBJECT)
            .filter(|track| track.T_first_object.iter().any(Option::is_some));
        Ok(track.map(signal))
    }

    fn insert(&self, signal: Signal, clip: &mut Clip) -> Result<(), ModalityError> {
        if signal.values.shape() != [self.samples, 7] {
            return Err(ModalityError::Shape {
                clip: clip.id.clone(),
                modality: NAME.to_owned(),
                found: signal.values.shape().to_vec(),
                expected: vec![self.samples, 7],
            });
        }
        let known = |t: usize| {
            let valid = signal.valid.as_ref().is_none_or(|valid| valid[[t]]);
            pose(std::array::from_fn(|c| f64::from(signal.values[[t, c]]))).filter(|_| valid)
        };
        let T_first_object = (0..self.samples).map(known).collect();
        clip.set(
            OBJECT,
            ObjectTrack {
                rate: self.rate,
                T_first_object,
            },
        );
        Ok(())
    }
}

// ---- in a reconstruction ----------------------------------------------------------------------------------------------

/// The object in the world, over the whole video.
#[derive(Debug, Default)]
pub struct ObjectPath {
    pub T_world_object: Vec<Option<Rigid>>,
}

impl Track for ObjectPath {
    fn push(&mut self, clip: &Clip, place: &mut Placement<'_>) -> Vec<Gap> {
        let Some(track) = clip.get(OBJECT) else {
            return Vec::new();
        };
        let world = |pose: &Option<Rigid>| pose.map(|pose| place.T_world_first * pose);
        let poses: Vec<Option<Rigid>> = track.T_first_object.iter().map(world).collect();
        let shared = place.window.shared(&self.T_world_object, &poses);
        let distance = |(a, b): (&Option<Rigid>, &Option<Rigid>)| {
            Some(((*a)?.translation.vector - (*b)?.translation.vector).norm())
        };
        let gap = Gap::new("object_m", shared.filter_map(distance).collect());
        place
            .window
            .append(&mut self.T_world_object, &poses, |a, b, t| match (a, b) {
                (Some(a), Some(b)) => Some(interpolate(a, b, t)),
                (a, b) => a.or(*b),
            });
        vec![gap]
    }

    fn write(&self, files: &mut Files<'_>) -> Result<(), FolderError> {
        let nowhere = || Rigid::translation(f64::NAN, f64::NAN, f64::NAN);
        let poses: Vec<Rigid> = self
            .T_world_object
            .iter()
            .map(|pose| pose.unwrap_or_else(nowhere))
            .collect();
        let valid: Array1<bool> = self.T_world_object.iter().map(Option::is_some).collect();
        let frame = "world: z up, origin and heading of the first camera";
        let scale = ScaleStatus::Metric {
            by: "learning from metric data".into(),
        };
        files.array_with_validity(
            "object_pose.npz",
            "T_world_object",
            pose_matrices(&poses),
            valid,
            "m",
            frame,
            scale,
        );
        Ok(())
    }

    fn follows_camera(&self) -> bool {
        true
    }

    fn parts(&self, _: &Timeline<'_>) -> Vec<Part> {
        let values = Array2::from_shape_fn((self.T_world_object.len(), 7), |(t, c)| {
            self.T_world_object[t].map_or(f32::NAN, |pose| row(&pose)[c] as f32)
        });
        vec![Part::new(NAME, NAME, Drawing::Pose, values)]
    }
}

// ---- in an evaluation -------------------------------------------------------------------------------------------------

/// Distance and angle from the true pose, over the samples where that is known.
struct ObjectMetrics;

impl MetricSet for ObjectMetrics {
    fn name(&self) -> &'static str {
        NAME
    }

    fn columns(&self) -> &'static [ColumnInfo] {
        const {
            &[
                ColumnInfo::lower(
                    "object_pose.position",
                    "m",
                    "mean distance from the true position",
                ),
                ColumnInfo::lower(
                    "object_pose.rotation",
                    "deg",
                    "mean angle from the true rotation",
                ),
            ]
        }
    }

    fn score(&self, pair: &Pair<'_>, columns: &[Column]) -> Result<ClipScore, MetricError> {
        let Some((truth, prediction)) = pair.both(OBJECT) else {
            return Ok(ClipScore::default());
        };
        let (truth, prediction) = (&truth.T_first_object, &prediction.T_first_object);
        let (mut metres, mut degrees, mut count) = (0.0, 0.0, 0_usize);
        for (t, truth) in truth.iter().enumerate() {
            let Some(truth) = truth else { continue };
            // A system cannot leave out what it finds hard.
            let Some(Some(pose)) = prediction.get(t) else {
                return Err(MetricError::NotFinite {
                    field: NAME,
                    position: vec![t],
                });
            };
            metres += (truth.translation.vector - pose.translation.vector).norm();
            degrees += truth.rotation.angle_to(&pose.rotation).to_degrees();
            count += 1;
        }
        let mean = |sum: f64| Outcome::of((count > 0).then(|| sum / count as f64));
        Ok(ClipScore::of(columns, |metric| match metric {
            "position" => mean(metres),
            _ => mean(degrees),
        }))
    }

    fn baselines(&self, _: &[Column]) -> Vec<Box<dyn Baseline>> {
        vec![Box::new(StillObject)]
    }
}

/// The object never moves from where it was first seen.
struct StillObject;

impl Baseline for StillObject {
    fn name(&self) -> &'static str {
        "still object"
    }

    fn modality(&self) -> &str {
        NAME
    }

    fn predict(&self, truth: &Clip, _: Option<&Array2<f64>>) -> Option<Held> {
        let track = truth.get(OBJECT)?;
        let first = track.T_first_object.iter().flatten().next().copied();
        Some(Held::new(ObjectTrack {
            rate: track.rate,
            T_first_object: vec![first; track.T_first_object.len()],
        }))
    }
}
