//! A stretch of the built-in world as a [`ClipSource`].

use super::World;
use crate::clip::clock::SIGNAL_RATE;
use crate::clip::source::{ClipSource, Outcome};
use crate::clip::{Key, Signal};
use crate::formats::ReadError;
use crate::modality::declared::{Missing, Normalize, SignalSettings, SignalSource};
use crate::modality::{BUILT_IN, ClipFormat, DeclaredSettings, put};
use std::ops::Range;

/// Clips `first..first + count` of a world.
#[derive(Debug, Clone)]
pub struct WorldClips {
    world: World,
    clips: Range<u64>,
    /// Which sensor feeds which declared modality; none: every sensor under its own name.
    declared: Option<Vec<DeclaredSettings>>,
}

/// Sensors of the world that a declared modality can be fed from.
pub const SENSORS: [&str; 1] = ["head_imu"];

/// The sensor that a declared modality asks for: the one it names, or the one of its own name.
pub fn sensor_of<'a>(name: &'a str, settings: &'a DeclaredSettings) -> &'a str {
    settings.source.world.as_deref().unwrap_or(name)
}

impl WorldClips {
    /// These clips of `world`.
    pub fn new(world: World, clips: Range<u64>) -> Self {
        Self {
            world,
            clips,
            declared: None,
        }
    }

    /// With these declared modalities, each fed from the sensor it asks for, and no others.
    #[must_use]
    pub fn with_declared(self, declared: &[DeclaredSettings]) -> Self {
        Self {
            declared: Some(declared.to_vec()),
            ..self
        }
    }
}

/// What the world's own sensor measures.
fn head_imu() -> DeclaredSettings {
    let unit = |unit: &str| vec![unit.to_owned(); 3];
    DeclaredSettings {
        name: SENSORS[0].to_owned(),
        about: "Head-mounted IMU of the built-in world.".to_owned(),
        signal: SignalSettings {
            rate: SIGNAL_RATE,
            channels: ["ax", "ay", "az", "gx", "gy", "gz"]
                .map(str::to_owned)
                .to_vec(),
            units: [unit("m/s2"), unit("rad/s")].concat(),
            frame: "head camera of the same sample (x right, y down, z forward)".to_owned(),
            missing: Missing::Nan,
        },
        normalize: Normalize::Standard,
        source: SignalSource {
            world: Some(SENSORS[0].to_owned()),
            ..SignalSource::default()
        },
    }
}

impl ClipSource for WorldClips {
    fn name(&self) -> &'static str {
        "world"
    }

    fn len(&self) -> usize {
        (self.clips.end.saturating_sub(self.clips.start)) as usize
    }

    fn modalities(&self) -> Vec<String> {
        BUILT_IN.map(str::to_owned).to_vec()
    }

    fn format(&self) -> Option<ClipFormat> {
        Some(ClipFormat {
            declared: self.declared.clone().unwrap_or_else(|| vec![head_imu()]),
            ..self.world.settings().format()
        })
    }

    /// Every clip is a recording of its own.
    fn recordings(&self) -> Vec<(String, Range<usize>)> {
        (0..self.len())
            .map(|index| {
                (
                    format!("{:06}", self.clips.start + index as u64),
                    index..index + 1,
                )
            })
            .collect()
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        if index >= self.len() {
            return Err(ReadError::OutOfRange {
                source_name: "world".to_owned(),
                index,
                len: self.len(),
            });
        }
        let mut clip = self.world.clip(self.clips.start + index as u64);
        if let Some(declared) = &self.declared {
            let format = self.format().unwrap_or_default();
            let sensors = SENSORS.map(|name| (name, clip.take::<Signal>(Key::new(name))));
            for settings in declared {
                let sensor = sensor_of(&settings.name, settings);
                let found = sensors.iter().find(|(name, _)| *name == sensor);
                if let Some((_, Some(signal))) = found {
                    put(settings, &format, signal.clone(), &mut clip)
                        .map_err(|error| ReadError::Settings(error.to_string()))?;
                }
            }
        }
        Ok(Outcome::Clip(Box::new(clip)))
    }
}
