//! Clips and tokens in shards: which arrays a member holds.
//!
//! Every member is an npz. Clips: `rgb {frames, rate}`, `depth {metres, rate}`, `camera {T_world_camera [T,4,4], valid, rate,
//! up_world?, intrinsics? (fx fy cx cy width height)}`, `gaze {points, valid, rate}`, hands and body `{joints, valid, rate}`,
//! declared modalities `{values, valid?}`. Tokens: `arr_0`, integers in the shape of the grid.

use super::shard::{ShardError, ShardWriter, Shards};
use super::{CameraTrack, Clip, Depth, GazeTrack, Intrinsics, JointTrack, Rgb, Signal};
use crate::formats::FormatError;
use crate::formats::npy::NpyArray;
use crate::formats::npz::Npz;
use crate::geometry::rigid;
use crate::modality::BUILT_IN;
use nalgebra::{Unit, Vector3};
use ndarray::{Array1, Array3, ArrayD, Ix1, Ix2, Ix3, Ix4, IxDyn};
use std::path::Path;

/// Why a member is not what it should be.
#[derive(Debug, thiserror::Error)]
enum Content {
    #[error(transparent)]
    Format(#[from] FormatError),
    #[error("{0}")]
    Words(String),
}

/// Writes clips as shard `number` below `root`; returns how many.
///
/// # Errors
/// The first error of the iterator, or what the disk says.
pub fn write_clips<E: From<ShardError>>(
    root: &Path,
    number: u32,
    clips: impl IntoIterator<Item = Result<Clip, E>>,
) -> Result<usize, E> {
    let mut writer = ShardWriter::new(root, number);
    let mut count = 0;
    for clip in clips {
        add_clip(&mut writer, &clip?)?;
        count += 1;
    }
    writer.finish()?;
    Ok(count)
}

fn add_clip(writer: &mut ShardWriter, clip: &Clip) -> Result<(), ShardError> {
    let mut add = |modality: &str, npz: &Npz| {
        let folder = format!("{modality}/{}", clip.source);
        let bytes = npz.to_bytes().map_err(|e| ShardError::Member {
            path: folder.clone().into(),
            member: clip.id.clone(),
            reason: e.to_string(),
        })?;
        writer.add(&folder, &clip.id, &bytes)
    };
    if let Some(rgb) = &clip.rgb {
        add(
            "rgb",
            &Npz::default()
                .with("frames", &rgb.frames)
                .with("rate", scalar(rgb.rate)),
        )?;
    }
    if let Some(depth) = &clip.depth {
        add(
            "depth",
            &Npz::default()
                .with("metres", &depth.metres)
                .with("rate", scalar(depth.rate)),
        )?;
    }
    if let Some(camera) = &clip.camera {
        add("camera", &camera_npz(camera))?;
    }
    if let Some(gaze) = &clip.gaze {
        let npz = Npz::default()
            .with("points", &gaze.points)
            .with("valid", &gaze.valid);
        add("gaze", &npz.with("rate", scalar(gaze.rate)))?;
    }
    let tracks = [
        ("left_hand", &clip.left_hand),
        ("right_hand", &clip.right_hand),
        ("body", &clip.body),
    ];
    for (name, track) in tracks {
        if let Some(track) = track {
            let npz = Npz::default()
                .with("joints", &track.joints)
                .with("valid", &track.valid);
            add(name, &npz.with("rate", scalar(track.rate)))?;
        }
    }
    for (name, signal) in &clip.declared {
        let mut npz = Npz::default().with("values", &signal.values);
        if let Some(valid) = &signal.valid {
            npz = npz.with("valid", valid);
        }
        add(name, &npz)?;
    }
    Ok(())
}

fn scalar(value: f64) -> Array1<f64> {
    Array1::from_elem(1, value)
}

fn camera_npz(camera: &CameraTrack) -> Npz {
    let poses = camera.T_world_camera.iter().map(rigid::to_row_major);
    let flat: Vec<f64> = poses.flatten().collect();
    let shape = (camera.T_world_camera.len(), 4, 4);
    let poses = Array3::from_shape_vec(shape, flat).expect("sixteen numbers per pose");
    let mut npz = Npz::default()
        .with("T_world_camera", &poses)
        .with("valid", Array1::from(camera.valid.clone()))
        .with("rate", scalar(camera.rate));
    if let Some(up) = &camera.up_world {
        npz = npz.with("up_world", Array1::from(vec![up.x, up.y, up.z]));
    }
    if let Some(k) = &camera.intrinsics {
        let values = vec![
            k.fx,
            k.fy,
            k.cx,
            k.cy,
            f64::from(k.width),
            f64::from(k.height),
        ];
        npz = npz.with("intrinsics", Array1::from(values));
    }
    npz
}

/// Clips in shards, read one at a time.
#[derive(Debug, Clone)]
pub struct ClipSet {
    shards: Shards,
    source: String,
}

impl ClipSet {
    /// Opens all shards below `root`.
    ///
    /// # Errors
    /// When there are none or a tar is damaged.
    pub fn open(root: &Path) -> Result<Self, ShardError> {
        Ok(Self {
            shards: Shards::open(root)?,
            source: String::new(),
        })
    }

    /// How many clips there are.
    pub fn len(&self) -> usize {
        self.shards.samples().len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The ids of all clips, in order.
    pub fn ids(&self) -> &[String] {
        self.shards.samples()
    }

    /// The shards underneath.
    pub fn shards(&self) -> &Shards {
        &self.shards
    }

    /// Clip number `index` with everything it has.
    ///
    /// # Errors
    /// When it does not exist or a member is malformed.
    pub fn clip(&self, index: usize) -> Result<Clip, ShardError> {
        let all: Vec<&str> = self.shards.modalities().collect();
        self.clip_with(index, &all)
    }

    /// Clip number `index` with only these modalities: the others are not read.
    ///
    /// # Errors
    /// When it does not exist or a member is malformed.
    pub fn clip_with(&self, index: usize, modalities: &[&str]) -> Result<Clip, ShardError> {
        let id = self.ids().get(index).cloned().unwrap_or_default();
        let source = id.split('/').next().unwrap_or(&self.source).to_owned();
        let mut clip = Clip::empty(id, source);
        for modality in modalities {
            if let Some(bytes) = self.shards.read(index, modality)? {
                put(&mut clip, modality, &bytes)
                    .map_err(|e| self.shards.member_error(index, modality, e))?;
            }
        }
        Ok(clip)
    }

    /// All clips in order, one at a time.
    pub fn iter<'a>(
        &'a self,
        modalities: &'a [&'a str],
    ) -> impl Iterator<Item = Result<Clip, ShardError>> + 'a {
        (0..self.len()).map(move |index| self.clip_with(index, modalities))
    }
}

fn put(clip: &mut Clip, modality: &str, bytes: &[u8]) -> Result<(), Content> {
    let npz = Npz::parse(bytes)?;
    let rate = || -> Result<f64, Content> {
        let rate = npz.get("rate")?.to::<f64>()?;
        match rate.first() {
            Some(rate) if rate.is_finite() && *rate > 0.0 => Ok(*rate),
            _ => Err(Content::Words("`rate` is not a positive number".to_owned())),
        }
    };
    // What is no field of a clip is a declared modality.
    if !BUILT_IN.contains(&modality) {
        let values = npz.get("values")?.to::<f32>()?;
        let valid = npz
            .arrays
            .get("valid")
            .map(NpyArray::to::<bool>)
            .transpose()?;
        if let Some(valid) = &valid {
            same(
                valid.shape(),
                &values.shape()[..values.ndim().saturating_sub(1)],
            )?;
        }
        clip.declared
            .insert(modality.to_owned(), Signal { values, valid });
        return Ok(());
    }
    let rate = rate()?;
    match modality {
        "rgb" => {
            let frames = npz.get("frames")?.to_dim::<u8, Ix4>()?;
            clip.rgb = Some(Rgb { rate, frames });
        }
        "depth" => {
            let metres = npz.get("metres")?.to_dim::<f32, Ix3>()?;
            clip.depth = Some(Depth { rate, metres });
        }
        "camera" => clip.camera = Some(camera_of(&npz, rate)?),
        "gaze" => {
            let points = npz.get("points")?.to_dim::<f32, Ix2>()?;
            let valid = npz.get("valid")?.to_dim::<bool, Ix1>()?;
            same(points.shape(), &[valid.len(), 2])?;
            clip.gaze = Some(GazeTrack {
                rate,
                points,
                valid,
            });
        }
        _ => {
            let joints = npz.get("joints")?.to_dim::<f32, Ix3>()?;
            let valid = npz.get("valid")?.to_dim::<bool, Ix2>()?;
            same(&joints.shape()[..2], valid.shape())?;
            same(&joints.shape()[2..], &[3])?;
            let track = Some(JointTrack {
                rate,
                joints,
                valid,
            });
            match modality {
                "left_hand" => clip.left_hand = track,
                "right_hand" => clip.right_hand = track,
                _ => clip.body = track,
            }
        }
    }
    Ok(())
}

fn same(found: &[usize], expected: &[usize]) -> Result<(), Content> {
    if found == expected {
        Ok(())
    } else {
        Err(Content::Words(format!(
            "shape {found:?}, expected {expected:?}"
        )))
    }
}

fn camera_of(npz: &Npz, rate: f64) -> Result<CameraTrack, Content> {
    let poses = npz.get("T_world_camera")?.to_dim::<f64, Ix3>()?;
    let valid = npz.get("valid")?.to_dim::<bool, Ix1>()?.to_vec();
    same(poses.shape(), &[valid.len(), 4, 4])?;
    let mut track = Vec::with_capacity(valid.len());
    for (t, pose) in poses.outer_iter().enumerate() {
        let mut m = [0.0; 16];
        m.iter_mut().zip(pose.iter()).for_each(|(a, b)| *a = *b);
        match rigid::from_row_major(&m) {
            Ok(pose) => track.push(pose),
            Err(_) if !valid[t] => track.push(rigid::Rigid::identity()),
            Err(e) => return Err(Content::Words(format!("pose {t}: {e}"))),
        }
    }
    let numbers = |name: &str, count: usize| -> Result<Option<Vec<f64>>, Content> {
        let Some(array) = npz.arrays.get(name) else {
            return Ok(None);
        };
        let values = array.to_dim::<f64, Ix1>()?.to_vec();
        same(&[values.len()], &[count])?;
        if !values.iter().all(|v| v.is_finite()) {
            return Err(Content::Words(format!("`{name}` is not finite")));
        }
        Ok(Some(values))
    };
    let up = numbers("up_world", 3)?.map(|v| Vector3::new(v[0], v[1], v[2]));
    if up.is_some_and(|up| (up.norm() - 1.0).abs() > 1e-3) {
        return Err(Content::Words(
            "`up_world` is not of unit length".to_owned(),
        ));
    }
    let intrinsics = numbers("intrinsics", 6)?.map(|v| Intrinsics {
        fx: v[0],
        fy: v[1],
        cx: v[2],
        cy: v[3],
        width: v[4] as u32,
        height: v[5] as u32,
    });
    Ok(CameraTrack {
        rate,
        T_world_camera: track,
        valid,
        up_world: up.map(Unit::new_unchecked),
        intrinsics,
    })
}

/// The member of one token grid.
///
/// # Errors
/// When `ids` do not fill `grid`.
pub fn tokens_to_bytes(ids: &[u32], grid: &[usize]) -> Result<Vec<u8>, FormatError> {
    let ids: Vec<i64> = ids.iter().map(|id| i64::from(*id)).collect();
    let array = ArrayD::from_shape_vec(IxDyn(grid), ids).map_err(|e| FormatError::Conversion {
        reason: e.to_string(),
    })?;
    Npz::default().with("arr_0", &array).to_bytes()
}

/// Ids and shape of a token member: any integer type, an npz with `arr_0` or a bare npy, as the released data have them.
///
/// # Errors
/// When the bytes are malformed or an id is negative or fractional.
pub fn tokens_from_bytes(bytes: &[u8]) -> Result<(Vec<u32>, Vec<usize>), FormatError> {
    let array = if bytes.starts_with(b"PK") {
        Npz::parse(bytes)?.get("arr_0")?.clone()
    } else {
        crate::formats::npy::parse(bytes)?
    };
    let ids = array.to::<u32>()?;
    Ok((ids.iter().copied().collect(), array.shape.clone()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{World, WorldSettings};

    fn clips(count: u64) -> Vec<Clip> {
        let settings = WorldSettings {
            size: 16,
            ..WorldSettings::default()
        };
        let world = World::new(settings, 4);
        (0..count).map(|i| world.clip(i)).collect()
    }

    #[test]
    fn clips_come_back_to_the_last_bit() {
        let folder = tempfile::tempdir().unwrap();
        let mut written = clips(5);
        written[1].left_hand = None;
        written[2].gaze = None;
        written[3].camera.as_mut().unwrap().up_world = None;
        for (number, part) in written.chunks(2).enumerate() {
            let part = part.iter().cloned().map(Ok::<Clip, ShardError>);
            write_clips(folder.path(), number as u32, part).unwrap();
        }
        let set = ClipSet::open(folder.path()).unwrap();
        assert_eq!(set.len(), 5);
        for (index, clip) in written.iter().enumerate() {
            let mut back = set.clip(index).unwrap();
            assert_eq!(back.id, clip.id);
            // A rotation stored as a matrix comes back within rounding.
            let (a, b) = (clip.camera.as_ref().unwrap(), back.camera.as_mut().unwrap());
            for (a, b) in a.T_world_camera.iter().zip(&mut b.T_world_camera) {
                assert!((a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12);
                *b = *a;
            }
            assert!(back == *clip, "{}", clip.id);
        }
        let only = set.clip_with(0, &["gaze"]).unwrap();
        assert!(only.rgb.is_none() && only.gaze.is_some());
    }

    #[test]
    fn members_of_other_shapes_are_errors_that_name_the_member() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = ShardWriter::new(folder.path(), 0);
        let npz = Npz::default()
            .with("joints", Array3::<f32>::zeros((60, 21, 2)))
            .with("valid", ndarray::Array2::from_elem((60, 21), true))
            .with("rate", scalar(30.0));
        writer
            .add("body/world", "world/1", &npz.to_bytes().unwrap())
            .unwrap();
        writer.add("gaze/world", "world/1", b"PK nonsense").unwrap();
        writer.finish().unwrap();
        let set = ClipSet::open(folder.path()).unwrap();
        for modality in ["body", "gaze"] {
            let message = set.clip_with(0, &[modality]).unwrap_err().to_string();
            assert!(
                message.contains("world/1") && message.contains(modality),
                "{message}"
            );
        }
    }

    #[test]
    fn tokens_are_read_in_every_form_of_the_released_data() {
        let bytes = tokens_to_bytes(&[1, 63_999, 7, 0, 5, 6], &[2, 3]).unwrap();
        assert_eq!(
            tokens_from_bytes(&bytes).unwrap(),
            (vec![1, 63_999, 7, 0, 5, 6], vec![2, 3])
        );
        let npy = crate::formats::npy::to_bytes(&NpyArray::from(&Array1::from(vec![3i32, 4])));
        assert_eq!(tokens_from_bytes(&npy).unwrap(), (vec![3, 4], vec![2]));
        let negative = crate::formats::npy::to_bytes(&NpyArray::from(&Array1::from(vec![-3i64])));
        assert!(tokens_from_bytes(&negative).is_err());
        assert!(tokens_to_bytes(&[1, 2], &[3]).is_err());
    }
}
