//! The tar of a clip of HOT3D-Clips, read in place: where its members are.

use crate::datasets::ReadError;
use crate::datasets::recording::ColourFrames;
use crate::formats::read_error::Position;
use crate::formats::{TAR_CUT, tar_has_end};
use crate::video::image::Image;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

pub(super) const SHAPES: &str = "__hand_shapes.json__";
/// A hand profile with its mesh has a megabyte; nothing else in text is as large.
const LONGEST_TEXT: u64 = 64 << 20;
/// No picture of these cameras is larger.
const LONGEST_PICTURE: u64 = 64 << 20;

/// Where a member is.
#[derive(Debug, Clone, Copy)]
pub(super) struct Member {
    pub(super) offset: u64,
    pub(super) size: u64,
}

/// The members of a frame that matter.
#[derive(Debug, Default)]
pub(super) struct Frame {
    pub(super) pictures: BTreeMap<String, Member>,
    pub(super) cameras: Option<Member>,
    pub(super) info: Option<Member>,
    pub(super) hands: Option<Member>,
}

/// A tar: where everything is.
pub(super) struct Tar {
    pub(super) path: PathBuf,
    pub(super) file: File,
    pub(super) frames: BTreeMap<u32, Frame>,
    pub(super) shapes: Option<Member>,
}

impl Tar {
    /// One pass over the headers, in whatever order the members are.
    pub(super) fn index(path: &Path) -> Result<Self, ReadError> {
        let io = |cause| ReadError::io(path, cause);
        let damaged = |offset: u64, reason: String| {
            ReadError::malformed(path, Position::Offset(offset), reason)
        };
        let file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut archive = ::tar::Archive::new(File::open(path).map_err(io)?);
        let (mut frames, mut shapes) = (BTreeMap::<u32, Frame>::new(), None);
        let (mut offset, mut end) = (0, 0);
        let entries = archive
            .entries_with_seek()
            .map_err(|error| damaged(0, error.to_string()))?;
        for entry in entries {
            let entry = entry.map_err(|error| damaged(offset, error.to_string()))?;
            offset = entry.raw_file_position();
            let size = entry.size();
            if offset.checked_add(size).is_none_or(|end| end > length) {
                let reason = format!("a member of {size} bytes in a file of {length}");
                return Err(damaged(offset, reason));
            }
            end = offset + size;
            let member = Member { offset, size };
            let name = entry.path_bytes();
            let name = String::from_utf8_lossy(&name);
            let name = name.rsplit('/').next().unwrap_or(&name);
            if name == SHAPES {
                shapes = Some(member);
            }
            let Some((number, kind)) = name.split_once('.') else {
                continue;
            };
            let Ok(number) = number.parse() else {
                continue;
            };
            let frame = frames.entry(number).or_default();
            match kind {
                "cameras.json" => frame.cameras = Some(member),
                "info.json" => frame.info = Some(member),
                "hands.json" => frame.hands = Some(member),
                _ => {
                    let stream = kind
                        .strip_prefix("image_")
                        .and_then(|rest| rest.rsplit_once('.'));
                    if let Some((stream, "jpg" | "jpeg" | "png")) = stream {
                        frame.pictures.insert(stream.to_owned(), member);
                    }
                }
            }
        }
        if !tar_has_end(length, end) {
            return Err(damaged(end, TAR_CUT.to_owned()));
        }
        if frames.is_empty() {
            return Err(damaged(
                0,
                "there are no frames of HOT3D-Clips in it".to_owned(),
            ));
        }
        Ok(Tar {
            path: path.to_owned(),
            file,
            frames,
            shapes,
        })
    }

    pub(super) fn json<T: DeserializeOwned>(
        &self,
        member: Member,
        name: &str,
    ) -> Result<T, ReadError> {
        let bytes = read(&self.path, &self.file, member, LONGEST_TEXT)?;
        serde_json::from_slice(&bytes).map_err(|error| {
            let offset = Position::Offset(member.offset);
            ReadError::malformed(&self.path, offset, format!("`{name}`: {error}"))
        })
    }
}

/// The bytes of a member.
fn read(path: &Path, mut file: &File, member: Member, most: u64) -> Result<Vec<u8>, ReadError> {
    if member.size > most {
        return Err(ReadError::malformed(
            path,
            Position::Offset(member.offset),
            format!("a member of {} bytes", member.size),
        ));
    }
    let mut bytes = vec![0; member.size as usize];
    file.seek(SeekFrom::Start(member.offset))
        .and_then(|_| file.read_exact(&mut bytes))
        .map_err(|cause| ReadError::io(path, cause))?;
    Ok(bytes)
}

/// Pictures inside a tar.
pub(super) struct TarPictures {
    pub(super) path: PathBuf,
    pub(super) members: Vec<Member>,
    pub(super) times: Vec<i64>,
}

impl ColourFrames for TarPictures {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError> {
        let file = File::open(&self.path).map_err(|cause| ReadError::io(&self.path, cause))?;
        for &index in indices {
            let member = self.members[index];
            let bytes = read(&self.path, &file, member, LONGEST_PICTURE)?;
            let image = Image::from_bytes(&bytes).map_err(|reason| {
                ReadError::malformed(&self.path, Position::Offset(member.offset), reason)
            })?;
            each(index, image);
        }
        Ok(())
    }
}
