//! A folder or file of any kind as a [`ClipSource`]: what `reviv data` and the op `clips` call when they are given a path.

use super::recording::{ColourFrames, CutSettings, Recording};
use super::shards::ShardClips;
use super::track::SECOND;
use super::{
    ClipSource, Outcome, ReadError, adt, arctic, ego_exo4d, egogen, egom2p, h2o, holoassist, hot3d,
    hot3d_clips, mps, neutral, nymeria, taco,
};
use crate::modality::{ClipFormat, DeclaredSettings};
use crate::video::image::Image;
use crate::video::{Video, VideoSettings, folder};
use std::path::Path;
use std::sync::Arc;

/// The kinds of data sets that are read.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Dataset {
    /// Aria Digital Twin sequences.
    Adt,
    /// HOT3D recordings of Aria glasses.
    Hot3dAria,
    /// HOT3D recordings of Quest 3 headsets.
    Hot3dQuest,
    /// Nymeria sequences.
    Nymeria,
    /// Ego-Exo4D takes.
    EgoExo4d,
    /// Clips of HOT3D in tars, from Aria glasses and Quest 3 headsets.
    Hot3dClips,
    /// HoloAssist sessions.
    Holoassist,
    /// ARCTIC sequences, the head camera.
    Arctic,
    /// TACO sequences, the head camera.
    Taco,
    /// H2O recordings, the helmet camera.
    H2o,
    /// EgoGen as EgoM2P stores it.
    Egogen,
    /// Aria recordings with the files of Machine Perception Services.
    Aria,
    /// Clips in shards that were made before.
    Shards,
    /// Folders with `recording.yaml`.
    Neutral,
    /// The ancestors' arrays, one folder per modality.
    Egom2p,
    /// A video file or a folder of pictures.
    Video,
}

impl Dataset {
    /// Every kind, in the order in which a path is tried.
    pub const ALL: [Dataset; 16] = [
        Dataset::Shards,
        Dataset::Neutral,
        Dataset::Adt,
        Dataset::Hot3dAria,
        Dataset::Hot3dQuest,
        Dataset::Nymeria,
        Dataset::EgoExo4d,
        Dataset::Hot3dClips,
        Dataset::Holoassist,
        Dataset::Arctic,
        Dataset::Taco,
        Dataset::H2o,
        Dataset::Egogen,
        Dataset::Aria,
        Dataset::Egom2p,
        Dataset::Video,
    ];

    /// As it is written in settings and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Dataset::Adt => "adt",
            Dataset::Hot3dAria => "hot3d_aria",
            Dataset::Hot3dQuest => "hot3d_quest",
            Dataset::Nymeria => "nymeria",
            Dataset::EgoExo4d => "ego_exo4d",
            Dataset::Hot3dClips => "hot3d_clips",
            Dataset::Holoassist => "holoassist",
            Dataset::Arctic => "arctic",
            Dataset::Taco => "taco",
            Dataset::H2o => "h2o",
            Dataset::Egogen => "egogen",
            Dataset::Aria => "aria",
            Dataset::Shards => "shards",
            Dataset::Neutral => "neutral",
            Dataset::Egom2p => "egom2p",
            Dataset::Video => "video",
        }
    }

    /// By name.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }
}

/// Which model gives a hand its joints, where a data set has the parameters of both.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Default,
    serde::Serialize,
    serde::Deserialize,
    schemars::JsonSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum HandModel {
    /// UmeTrack where the wearer's profile is there, else MANO.
    #[default]
    Auto,
    Umetrack,
    Mano,
}

impl HandModel {
    /// Whether recordings of this kind may need the user's MANO models.
    #[must_use]
    pub fn may_need_mano(dataset: Option<Dataset>) -> bool {
        match dataset {
            None => true,
            Some(dataset) => matches!(
                dataset,
                Dataset::Hot3dClips | Dataset::Arctic | Dataset::Taco | Dataset::H2o
            ),
        }
    }
}

/// What a data set is opened with besides its own files.
#[derive(Debug, Clone, Copy, Default)]
pub struct OpenWith<'a> {
    /// Modalities that recordings with folders of their own bring along.
    pub declared: &'a [DeclaredSettings],
    /// The folder of the user's `MANO_LEFT.pkl` and `MANO_RIGHT.pkl`, for sets whose hands are MANO parameters.
    pub mano: Option<&'a Path>,
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

/// The frames of a video on their own clock.
pub(super) struct Frames {
    pub video: Video,
    pub times: Vec<i64>,
}

impl ColourFrames for Frames {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError> {
        for frame in self.video.chosen(indices.to_vec())? {
            let frame = frame?;
            each(frame.index, frame.image);
        }
        Ok(())
    }

    fn decoder(&self) -> Option<String> {
        Some(self.video.info().read_by())
    }
}
