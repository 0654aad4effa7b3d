//! The tar of a clip of HOT3D-Clips, read in place: where its members are.

use crate::datasets::ReadError;
use crate::datasets::recording::ColourFrames;
use crate::formats::FormatError;
use crate::formats::read_error::Position;
use crate::formats::tar::{self, Header, Member};
use crate::video::image::Image;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

pub(super) const SHAPES: &str = "__hand_shapes.json__";
/// A hand profile with its mesh has a megabyte; nothing else in text is as large.
const LONGEST_TEXT: u64 = 64 << 20;
/// No picture of these cameras is larger.
const LONGEST_PICTURE: u64 = 64 << 20;

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
        let file = File::open(path).map_err(|cause| ReadError::io(path, cause))?;
        let (mut frames, mut shapes) = (BTreeMap::<u32, Frame>::new(), None);
        for Header { name, member, .. } in
            tar::headers(path).map_err(|error| damaged(path, error))?
        {
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
        if frames.is_empty() {
            let place = Position::Offset(0);
            return Err(ReadError::malformed(
                path,
                place,
                "there are no frames of HOT3D-Clips in it",
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
    member
        .read(&mut file)
        .map_err(|cause| ReadError::io(path, cause))
}

fn damaged(path: &Path, error: FormatError) -> ReadError {
    match error {
        FormatError::File { path, source } => damaged(&path, *source),
        FormatError::Io(cause) => ReadError::io(path, cause),
        FormatError::Malformed { offset, reason, .. } => {
            ReadError::malformed(path, Position::Offset(offset), reason)
        }
        error => ReadError::malformed(path, Position::File, error.to_string()),
    }
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
