//! Token shards as a data set: `<folder>/<modality>/shard-000000.tar` (or up to three folders further down, as in
//! `<modality>/<data set>/token/`), one member per clip.
//!
//! A member is `<clip>.npy` or `<clip>.npz` (array `arr_0`), integers of any width and of any shape with the right number of
//! elements. Raw video lies beside the tokens as bytes. A clip whose member is missing from a modality, or whose ids all equal
//! the vocabulary (how the release marks invalid hands), does not have that modality. Opening reads the shards' directories only;
//! nothing is unpacked, and every read goes to the shard again, so one that vanishes is noticed.

use super::source::{DataError, TokenSample, TokenSource};
use crate::formats::npz::Npz;
use crate::formats::tar::{self, Header, Member};
use crate::formats::{FormatError, npy};
use crate::mget::MgetSpec;
use crate::tokenizer::TokenGrid;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

/// The largest member that is read: a raw clip of 32 frames of 512 x 512 has 25 MB.
const MAX_MEMBER: u64 = 256 << 20;

/// Token shards of one data set and split.
#[derive(Debug)]
pub struct TokenShards {
    name: String,
    /// Per modality of the model: its name, the shape of its values of a clip, and its vocabulary (none for raw video).
    modalities: Vec<(String, Vec<usize>, Option<usize>)>,
    paths: Vec<PathBuf>,
    /// In order of names; per modality where the member lies.
    clips: Vec<(String, Vec<Option<Place>>)>,
}

#[derive(Debug, Clone, Copy)]
struct Place {
    shard: u32,
    member: Member,
    zipped: bool,
}

fn shard_error(path: &Path, reason: &dyn std::fmt::Display) -> DataError {
    DataError::Shard {
        shard: path.display().to_string(),
        reason: reason.to_string(),
    }
}

impl TokenShards {
    /// The shards below `folder`, one sub-folder per modality of `spec`.
    ///
    /// # Errors
    /// When a folder or a shard cannot be read, or a modality has two clips of one name.
    pub fn open(folder: &Path, name: &str, spec: &MgetSpec) -> Result<Self, DataError> {
        let mut shards = Self {
            name: name.to_owned(),
            modalities: Vec::new(),
            paths: Vec::new(),
            clips: Vec::new(),
        };
        let mut members: BTreeMap<String, Vec<Option<Place>>> = BTreeMap::new();
        for (index, modality) in spec.modalities.iter().enumerate() {
            let shape = match modality.input {
                crate::mget::Input::Tokens { ref grid, .. } => grid.clone(),
                crate::mget::Input::Pixels { clip, .. } => clip.to_vec(),
            };
            shards
                .modalities
                .push((modality.name.clone(), shape, modality.vocabulary()));
            for path in tars(&folder.join(&modality.name))? {
                let shard = shards.paths.len() as u32;
                let found = directory(&path)?;
                shards.paths.push(path);
                for (stem, zipped, member) in found {
                    let place = Place {
                        shard,
                        member,
                        zipped,
                    };
                    let entry = members
                        .entry(stem.clone())
                        .or_insert_with(|| vec![None; spec.modalities.len()]);
                    if let Some(first) = entry[index].replace(place) {
                        let path = |place: Place| {
                            let path = &shards.paths[place.shard as usize];
                            path.display().to_string()
                        };
                        return Err(DataError::Twice {
                            modality: modality.name.clone(),
                            clip: stem,
                            first: path(first),
                            second: path(place),
                        });
                    }
                }
            }
        }
        shards.clips = members.into_iter().collect();
        Ok(shards)
    }

    fn bytes(&self, place: Place) -> Result<Vec<u8>, DataError> {
        let path = &self.paths[place.shard as usize];
        let read = || place.member.read(&mut File::open(path)?);
        read().map_err(|error| shard_error(path, &error))
    }
}

/// How deep shards may lie below a modality's folder: `<modality>/<data set>/token/`.
const DEPTH: usize = 3;

/// The shards of one modality in order of names; none when the folder does not exist.
fn tars(folder: &Path) -> Result<Vec<PathBuf>, DataError> {
    if folder.is_dir() {
        tar::below(folder, DEPTH).map_err(|error| refused(folder, error))
    } else {
        Ok(Vec::new())
    }
}

fn refused(path: &Path, error: FormatError) -> DataError {
    match error {
        FormatError::File { path, source } => shard_error(&path, &source),
        error => shard_error(path, &error),
    }
}

/// The members of a shard by stem, and whether they are zipped.
fn directory(path: &Path) -> Result<Vec<(String, bool, Member)>, DataError> {
    let mut members = Vec::new();
    for Header { name, member, .. } in tar::headers(path).map_err(|error| refused(path, error))? {
        let name = String::from_utf8_lossy(&name);
        let Some((stem, zipped)) = name
            .strip_suffix(".npy")
            .map(|stem| (stem, false))
            .or_else(|| Some((name.strip_suffix(".npz")?, true)))
        else {
            continue;
        };
        if member.size > MAX_MEMBER {
            let reason = format!("member {name} of {} bytes is too large", member.size);
            return Err(shard_error(path, &reason));
        }
        members.push((stem.to_owned(), zipped, member));
    }
    Ok(members)
}

impl TokenSource for TokenShards {
    fn name(&self) -> &str {
        &self.name
    }

    fn len(&self) -> usize {
        self.clips.len()
    }

    fn read(&self, index: usize) -> Result<TokenSample, DataError> {
        let (key, members) = &self.clips[index];
        let mut sample = TokenSample {
            key: key.clone(),
            ..TokenSample::default()
        };
        for ((name, shape, vocabulary), member) in self.modalities.iter().zip(members) {
            let Some(place) = *member else { continue };
            let path = &self.paths[place.shard as usize];
            let shard = path.display().to_string();
            sample.shards.insert(name.clone(), shard);
            let bytes = self.bytes(place)?;
            let refuse = |error: &dyn std::fmt::Display| {
                shard_error(path, &format!("{key}, {name}: {error}"))
            };
            let array = if place.zipped {
                let arrays = Npz::parse(&bytes).map_err(|error| refuse(&error))?.arrays;
                let first = arrays.into_values().next();
                first.ok_or_else(|| refuse(&"an empty archive"))?
            } else {
                npy::parse(&bytes).map_err(|error| refuse(&error))?
            };
            let Some(vocabulary) = vocabulary else {
                let clip = array.to::<u8>().map_err(|error| refuse(&error))?;
                sample
                    .pixels
                    .insert(name.clone(), clip.into_raw_vec_and_offset().0);
                continue;
            };
            let ids = array.to::<u32>().map_err(|error| refuse(&error))?;
            let ids = ids.into_raw_vec_and_offset().0;
            if ids.iter().any(|id| *id as usize != *vocabulary) {
                let grid = shape.clone();
                sample.tokens.insert(name.clone(), TokenGrid { ids, grid });
            }
        }
        Ok(sample)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mget::{ModalitySpec, Positions, Size};
    use ndarray::ArrayD;

    fn write(folder: &Path, modality: &str, members: &[(&str, Vec<i64>)]) {
        let folder = folder.join(modality);
        std::fs::create_dir_all(&folder).unwrap();
        let mut tar = ::tar::Builder::new(File::create(folder.join("shard-000000.tar")).unwrap());
        for (key, ids) in members {
            let array = ArrayD::from_shape_vec(vec![ids.len()], ids.clone()).unwrap();
            let bytes = npy::to_bytes(&npy::NpyArray::from(&array));
            let mut header = ::tar::Header::new_gnu();
            header.set_size(bytes.len() as u64);
            header.set_mode(0o644);
            tar.append_data(&mut header, format!("{key}.npy"), bytes.as_slice())
                .unwrap();
        }
        tar.finish().unwrap();
    }

    fn spec() -> MgetSpec {
        MgetSpec {
            size: Size::default(),
            positions: Positions::Released,
            modalities: vec![
                ModalitySpec::tokens("camera", &[2], 8),
                ModalitySpec::tokens("left_hand", &[2], 4),
            ],
        }
    }

    #[test]
    fn clips_are_read_by_modality_and_may_lack_one() {
        let folder = tempfile::tempdir().unwrap();
        write(
            folder.path(),
            "camera",
            &[("a", vec![1, 2]), ("b", vec![3, 4]), ("c", vec![5, 6])],
        );
        write(
            folder.path(),
            "left_hand",
            &[("a", vec![0, 3]), ("c", vec![4, 4])],
        );
        let shards = TokenShards::open(folder.path(), "set", &spec()).unwrap();
        assert_eq!(shards.len(), 3);
        assert_eq!(shards.read(0).unwrap().tokens["left_hand"].ids, [0, 3]);
        assert_eq!(shards.read(1).unwrap().tokens["camera"].ids, [3, 4]);
        assert!(
            !shards.read(1).unwrap().tokens.contains_key("left_hand"),
            "no member"
        );
        assert!(
            !shards.read(2).unwrap().tokens.contains_key("left_hand"),
            "marked invalid"
        );
    }

    #[test]
    fn two_clips_of_one_name_are_refused_with_both_shards() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), "camera/first", &[("a", vec![1, 2])]);
        write(folder.path(), "camera/second", &[("b", vec![1, 2])]);
        assert_eq!(
            TokenShards::open(folder.path(), "set", &spec())
                .unwrap()
                .len(),
            2
        );
        write(folder.path(), "camera/third", &[("a", vec![5, 6])]);
        let error = TokenShards::open(folder.path(), "set", &spec()).unwrap_err();
        let message = error.to_string();
        for part in [
            "`a`",
            "first/shard-000000.tar",
            "third/shard-000000.tar",
            "camera",
        ] {
            assert!(message.contains(part), "{message}");
        }
    }

    #[test]
    fn a_token_out_of_its_vocabulary_names_the_shard_of_its_modality() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), "camera", &[("a", vec![1, 8])]);
        write(folder.path(), "left_hand", &[("a", vec![0, 3])]);
        let shards = TokenShards::open(folder.path(), "set", &spec()).unwrap();
        let error = shards.read(0).unwrap().check(&spec()).unwrap_err();
        let message = error.to_string();
        assert!(message.contains("camera/shard-000000.tar"), "{message}");
    }

    #[test]
    fn a_shard_that_was_cut_between_two_clips_is_no_whole_one_with_fewer() {
        let folder = tempfile::tempdir().unwrap();
        write(
            folder.path(),
            "camera",
            &[("a", vec![1, 2]), ("b", vec![3, 4])],
        );
        let path = folder.path().join("camera/shard-000000.tar");
        let bytes = std::fs::read(&path).unwrap();
        // Two members of a header and a block each, and two blocks for the end.
        assert_eq!(bytes.len(), 6 * 512);
        for blocks in [0, 2, 4] {
            std::fs::write(&path, &bytes[..blocks * 512]).unwrap();
            let error = TokenShards::open(folder.path(), "set", &spec()).unwrap_err();
            assert!(
                error.to_string().contains(crate::formats::TAR_CUT),
                "{blocks}: {error}"
            );
        }
    }

    #[test]
    fn a_shard_that_goes_away_or_is_cut_is_named() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), "camera", &[("a", vec![1, 2])]);
        let shards = TokenShards::open(folder.path(), "set", &spec()).unwrap();
        let path = folder.path().join("camera/shard-000000.tar");
        let bytes = std::fs::read(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        assert!(
            shards
                .read(0)
                .unwrap_err()
                .to_string()
                .contains("shard-000000.tar")
        );
        std::fs::write(&path, &bytes[..600]).unwrap();
        assert!(TokenShards::open(folder.path(), "set", &spec()).is_err());
        std::fs::write(&path, &bytes).unwrap();
        assert!(shards.read(0).is_ok());
    }
}
