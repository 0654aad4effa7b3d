//! The kinds of data sets, by name.

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
    /// UmeTrack; needs the wearer's profile, which is part of the recording: without it there are no hands.
    Umetrack,
    /// MANO; needs the user's licensed model files: without them there are no hands.
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
