//! A folder or file of any kind as a [`ClipSource`]: what `reviv data` and the op `clips` call when they are given a path.

pub use super::kind::{Dataset, HandModel};
use super::recording::{CutSettings, Recording};
use super::shards::ShardClips;
use super::track::SECOND;
use super::video_frames::Frames;
use super::{
    ClipSource, Outcome, ReadError, adt, arctic, ego_exo4d, egogen, egom2p, h2o, holoassist, hot3d,
    hot3d_clips, mps, neutral, nymeria, taco,
};
use crate::formats::place;
use crate::modality::{ClipFormat, DeclaredSettings};
use crate::video::{Video, VideoSettings, folder};
use std::path::Path;
use std::sync::Arc;

/// What a data set is opened with besides its own files.
#[derive(Debug, Clone, Copy, Default)]
pub struct OpenWith<'a> {
    /// Modalities that recordings with folders of their own bring along.
    pub declared: &'a [DeclaredSettings],
    /// The folder of the user's `MANO_LEFT.pkl` and `MANO_RIGHT.pkl`, for sets whose hands are MANO parameters.
    pub mano: Option<&'a Path>,
    /// Which model gives hands their joints, for sets that have the parameters of both (clips of HOT3D).
    pub hands: HandModel,
}

/// Opens `path` as this kind of data set; without a kind, as the first kind that finds its recordings there.
///
/// # Errors
/// [`ReadError::Absent`] when nothing is found; another when what is found cannot be opened.
pub fn open(
    path: &Path,
    kind: Option<Dataset>,
    settings: &CutSettings,
    with: OpenWith<'_>,
) -> Result<Arc<dyn ClipSource>, ReadError> {
    if place::is_remote(path) {
        return match kind {
            None | Some(Dataset::Shards) => Ok(Arc::new(ShardClips::open(path)?)),
            Some(_) => Err(ReadError::unsupported(
                path,
                "an address of an object store holds clips that were converted; recordings are read from a disk",
            )),
        };
    }
    let Some(kind) = kind else {
        for kind in Dataset::ALL {
            match open(path, Some(kind), settings, with) {
                // Nothing of this kind is there: try the next.
                Err(ReadError::Absent { .. }) => {}
                other => return other,
            }
        }
        return Err(ReadError::absent(
            path,
            format!(
                "no recordings found; kinds that are read: {}",
                Dataset::ALL.map(Dataset::name).join(", ")
            ),
        ));
    };
    let (settings, declared) = (settings.clone(), with.declared);
    // A file is a video or a clip in a tar, whatever is asked.
    let may_be_file = match kind {
        Dataset::Video => !hot3d_clips::is_clip(path),
        kind => kind == Dataset::Hot3dClips,
    };
    if path.is_file() && !may_be_file {
        return Err(ReadError::absent(
            path,
            "a file, not a folder of recordings",
        ));
    }
    Ok(match kind {
        Dataset::Adt => Arc::new(adt::source(path, settings)?.with_declared(declared)),
        Dataset::Hot3dAria => Arc::new(hot3d::aria(path, settings)?.with_declared(declared)),
        Dataset::Hot3dQuest => Arc::new(hot3d::quest(path, settings)?.with_declared(declared)),
        Dataset::Nymeria => Arc::new(nymeria::source(path, settings)?.with_declared(declared)),
        Dataset::EgoExo4d => Arc::new(ego_exo4d::source(path, settings)?.with_declared(declared)),
        Dataset::Holoassist => {
            Arc::new(holoassist::source(path, settings)?.with_declared(declared))
        }
        Dataset::Hot3dClips => {
            Arc::new(hot3d_clips::source(path, settings, with.mano, with.hands)?)
        }
        Dataset::Arctic => Arc::new(arctic::source(path, settings, with.mano)?),
        Dataset::Taco => Arc::new(taco::source(path, settings, with.mano)?),
        Dataset::H2o => Arc::new(h2o::source(path, settings, with.mano)?.with_declared(declared)),
        Dataset::Egogen => Arc::new(egogen::source(path, settings)?.with_declared(declared)),
        Dataset::Aria => Arc::new(mps::source(path, settings)?.with_declared(declared)),
        Dataset::Neutral => Arc::new(neutral::source(path, settings)?.with_declared(declared)),
        Dataset::Shards => Arc::new(ShardClips::open(path)?),
        Dataset::Egom2p => Arc::new(egom2p::Arrays::open(path, None, None, settings)?),
        Dataset::Video => {
            if path.is_dir() {
                match folder::list(path) {
                    Err(ReadError::Missing { path, reason }) => {
                        return Err(ReadError::Absent { path, reason });
                    }
                    listed => listed?,
                };
            }
            Arc::new(VideoClips::open(path, settings)?)
        }
    })
}

/// A video cut into clips: colour only.
#[derive(Debug)]
pub struct VideoClips {
    recording: Recording,
    settings: CutSettings,
}

impl VideoClips {
    /// # Errors
    /// When the video cannot be opened.
    pub fn open(path: &Path, settings: CutSettings) -> Result<Self, ReadError> {
        settings.check()?;
        let video = Video::open_with(path, &VideoSettings::by(settings.decoder))?;
        let name = path.file_stem().map_or_else(
            || "video".into(),
            |name| name.to_string_lossy().into_owned(),
        );
        let times = (0..video.info().frames)
            .map(|frame| (video.schedule().seconds(frame) * SECOND as f64).round() as i64)
            .collect();
        let mut recording = Recording::new("video", &name);
        recording.colour = Some(Box::new(Frames { video, times }));
        recording.check(&settings)?;
        Ok(VideoClips {
            recording,
            settings,
        })
    }
}

impl ClipSource for VideoClips {
    fn name(&self) -> &'static str {
        "video"
    }

    fn len(&self) -> usize {
        self.recording.clips(&self.settings)
    }

    fn modalities(&self) -> Vec<String> {
        self.recording.modalities()
    }

    fn format(&self) -> Option<ClipFormat> {
        Some(self.settings.format())
    }

    fn decoders(&self) -> Vec<(String, usize)> {
        let colour = self.recording.colour.iter();
        colour.filter_map(|c| Some((c.decoder()?, 1))).collect()
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        if index >= self.len() {
            return Err(ReadError::OutOfRange {
                source_name: self.recording.id.clone(),
                index,
                len: self.len(),
            });
        }
        self.recording.clip(index, &self.settings)
    }
}
