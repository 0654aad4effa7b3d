//! Clips and tokens in shards: which arrays a member holds.
//!
//! Every member is an npz: of a clip the arrays of its [`super::value::Value`], of tokens `arr_0`, integers in the shape of the
//! grid.

use super::Clip;
use super::shard::{ShardError, ShardIndex, ShardWriter};
use crate::formats::FormatError;
use crate::formats::npz::Npz;
use crate::modality;
use ndarray::{ArrayD, IxDyn};
use std::path::Path;

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
    for (modality, value) in &clip.held {
        let folder = format!("{modality}/{}", clip.source);
        let bytes = value.to_npz().to_bytes();
        let bytes = bytes.map_err(|e| ShardError::Member {
            path: folder.clone().into(),
            member: clip.id.clone(),
            reason: e.to_string(),
        })?;
        writer.add(&folder, &clip.id, &bytes)?;
    }
    Ok(())
}

/// Clips in shards, read one at a time.
#[derive(Debug, Clone)]
pub struct ClipSet {
    shards: ShardIndex,
    source: String,
}

impl ClipSet {
    /// Opens all shards below `root`.
    ///
    /// # Errors
    /// When there are none or a tar is damaged.
    pub fn open(root: &Path) -> Result<Self, ShardError> {
        Ok(Self {
            shards: ShardIndex::open(root)?,
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
    pub fn shards(&self) -> &ShardIndex {
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
                let npz = Npz::parse(&bytes).map_err(|e| e.to_string());
                let value = npz.and_then(|npz| modality::form(modality).read_npz(npz));
                let value = value.map_err(|e| self.shards.member_error(index, modality, e))?;
                clip.insert(modality, value);
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
    use crate::clip::CAMERA;
    use crate::formats::npy::NpyArray;
    use crate::world::{World, WorldSettings};
    use ndarray::Array1;

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
        written[1].remove("left_hand");
        written[2].remove("gaze");
        written[3].get_mut(CAMERA).unwrap().up_world = None;
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
            let (a, b) = (clip.camera().unwrap(), back.get_mut(CAMERA).unwrap());
            for (a, b) in a.T_world_camera.iter().zip(&mut b.T_world_camera) {
                assert!((a.to_homogeneous() - b.to_homogeneous()).amax() < 1e-12);
                *b = *a;
            }
            assert!(back == *clip, "{}", clip.id);
        }
        let only = set.clip_with(0, &["gaze"]).unwrap();
        assert!(only.rgb().is_none() && only.gaze().is_some());
    }

    #[test]
    fn members_of_other_shapes_are_errors_that_name_the_member() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = ShardWriter::new(folder.path(), 0);
        let npz = Npz::default()
            .with("joints", ndarray::Array3::<f32>::zeros((60, 21, 2)))
            .with("valid", ndarray::Array2::from_elem((60, 21), true))
            .with("rate", Array1::from_elem(1, 30.0));
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
