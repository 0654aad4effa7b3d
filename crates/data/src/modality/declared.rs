//! Modalities declared in YAML: a new sensor in one registry file, no Rust.
//!
//! The values travel in the clip under the modality's name, `[samples, channels]`.

use super::{ClipFormat, Modality, ModalityError, Shape, expect_shape};
use crate::clip::{Clip, Key, Signal};
use ndarray::ArrayD;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a modality declared in a registry entry is, as clips carry it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DeclaredSettings {
    /// The registry name; filled from the entry.
    #[serde(default)]
    pub name: String,
    /// One line for `reviv list`; filled from the entry.
    #[serde(default)]
    pub about: String,
    /// What is measured.
    pub signal: SignalSettings,
    /// How the tokenizer scales the values.
    #[serde(default)]
    pub normalize: Normalize,
    /// Where clips get it from.
    #[serde(default)]
    pub source: SignalSource,
}

/// Rate, channels and units of a declared modality.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SignalSettings {
    /// Samples per second; two seconds at 30 Hz make 60 samples.
    #[serde(default = "thirty")]
    pub rate: f64,
    /// A name per channel.
    pub channels: Vec<String>,
    /// A unit per channel, or one for all.
    pub units: Vec<String>,
    /// The frame of reference of the values, in words.
    #[serde(default)]
    pub frame: String,
    /// How the files mark a missing value.
    #[serde(default)]
    pub missing: Missing,
}

fn thirty() -> f64 {
    crate::clip::clock::SIGNAL_RATE
}

/// How a tokenizer scales the values of a declared modality.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Normalize {
    /// Mean 0 and deviation 1 per channel, fitted on the training clips and stored with the tokenizer.
    #[default]
    Standard,
    /// As they are.
    None,
}

/// How files mark a missing value.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Missing {
    /// NaN: the sample is invalid and masked in the loss.
    #[default]
    Nan,
    /// Nothing is ever missing; NaN is an error of the file.
    Never,
}

/// Where clips get a declared modality from.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SignalSource {
    /// A file of each recording's folder.
    pub npz: Option<String>,
    /// The array in that file, `[samples, channels]`.
    pub key: Option<String>,
    /// A sensor of the built-in world instead: `head_imu`.
    pub world: Option<String>,
    /// Code of a plug-in crate that makes it from the other signals of the clip, by name.
    pub code: Option<String>,
}

/// A modality from [`DeclaredSettings`].
#[derive(Debug, Clone)]
pub struct Declared {
    settings: DeclaredSettings,
    samples: usize,
}

impl Declared {
    /// The number of samples is the clip's length at the declared rate.
    pub fn new(settings: DeclaredSettings, format: &ClipFormat) -> Self {
        let seconds = format.samples as f64 / format.signal_rate;
        let samples = (seconds * settings.signal.rate).round_ties_even() as usize;
        Self { settings, samples }
    }

    /// What the entry declares.
    pub fn settings(&self) -> &DeclaredSettings {
        &self.settings
    }

    fn expected(&self) -> [usize; 2] {
        [self.samples, self.settings.signal.channels.len()]
    }
}

impl DeclaredSettings {
    /// What is wrong with the declaration, if anything, as (key, reason).
    pub fn problem(&self) -> Option<(&'static str, String)> {
        let signal = &self.signal;
        // Names of modalities are names of folders and of arrays.
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.' | '@');
        if !self.name.chars().all(plain) || self.name.starts_with('.') || self.name.len() > 64 {
            let name: String = self.name.chars().take(64).collect();
            return Some((
                "name",
                format!(
                    "`{name}` is no name of a modality: letters, digits, `_`, `-`, `.` and `@`, at most 64, no dot in front"
                ),
            ));
        }
        if let Some(file) = &self.source.npz
            && !crate::formats::stays_inside(std::path::Path::new(file))
        {
            return Some((
                "source.npz",
                format!(
                    "`{file}` is outside of the recording: a file of its folder is named, without `..`"
                ),
            ));
        }
        if !(signal.rate.is_finite() && signal.rate > 0.0 && signal.rate <= 10_000.0) {
            return Some((
                "signal.rate",
                format!("{} is not in (0, 10000] Hz", signal.rate),
            ));
        }
        if signal.channels.is_empty() {
            return Some(("signal.channels", "needs at least one channel".to_owned()));
        }
        if signal.units.len() != 1 && signal.units.len() != signal.channels.len() {
            let (units, channels) = (signal.units.len(), signal.channels.len());
            return Some((
                "signal.units",
                format!("{units} units for {channels} channels"),
            ));
        }
        for (i, channel) in signal.channels.iter().enumerate() {
            if signal.channels[..i].contains(channel) {
                return Some(("signal.channels", format!("`{channel}` is there twice")));
            }
        }
        None
    }
}

impl Modality for Declared {
    fn name(&self) -> &str {
        &self.settings.name
    }
    fn about(&self) -> &str {
        &self.settings.about
    }
    fn rate(&self) -> f64 {
        self.settings.signal.rate
    }
    fn shape(&self) -> Shape {
        Shape::Temporal {
            samples: self.samples,
            channels: self.settings.signal.channels.len(),
        }
    }
    fn units(&self) -> Vec<String> {
        self.settings.signal.units.clone()
    }
    fn channels(&self) -> Vec<String> {
        self.settings.signal.channels.clone()
    }
    fn frame(&self) -> &str {
        &self.settings.signal.frame
    }

    fn extract(&self, clip: &Clip) -> Result<Option<Signal>, ModalityError> {
        let Some(signal) = clip.signal(self.name()) else {
            return Ok(None);
        };
        expect_shape(
            &clip.id,
            self.name(),
            signal.values.shape(),
            &self.expected(),
        )?;
        let mut signal = signal.clone();
        let mut valid = match signal.valid.take() {
            Some(valid) => {
                expect_shape(&clip.id, self.name(), valid.shape(), &[self.samples])?;
                valid
            }
            None => ArrayD::from_elem(vec![self.samples], true),
        };
        for t in 0..self.samples {
            let channels = self.settings.signal.channels.len();
            let finite = (0..channels).all(|c| signal.values[[t, c]].is_finite());
            if !finite && valid[[t]] && self.settings.signal.missing == Missing::Never {
                return Err(ModalityError::Degenerate {
                    clip: clip.id.clone(),
                    modality: self.name().to_owned(),
                    reason: format!("sample {t} is not finite, but `missing: never` was declared"),
                });
            }
            valid[[t]] &= finite;
            if !valid[[t]] {
                for c in 0..channels {
                    signal.values[[t, c]] = 0.0;
                }
            }
        }
        if !valid.iter().any(|v| *v) {
            return Ok(None);
        }
        signal.valid = (!valid.iter().all(|v| *v)).then_some(valid);
        Ok(Some(signal))
    }

    fn insert(&self, signal: Signal, clip: &mut Clip) -> Result<(), ModalityError> {
        expect_shape(
            &clip.id,
            self.name(),
            signal.values.shape(),
            &self.expected(),
        )?;
        clip.set(Key::new(self.name()), signal);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head_imu() -> DeclaredSettings {
        serde_json::from_value(serde_json::json!({
            "name": "head_imu",
            "about": "Head-mounted IMU, six channels.",
            "signal": {
                "rate": 30,
                "channels": ["ax", "ay", "az", "gx", "gy", "gz"],
                "units": ["m/s2", "m/s2", "m/s2", "rad/s", "rad/s", "rad/s"],
                "missing": "nan"
            },
            "normalize": "standard",
            "source": {"npz": "imu.npz", "key": "imu"}
        }))
        .unwrap()
    }

    #[test]
    fn a_declared_sensor_behaves_like_a_built_in_one() {
        let format = ClipFormat {
            declared: vec![head_imu()],
            ..ClipFormat::default()
        };
        let all = super::super::all(&format);
        let names: Vec<&str> = all.iter().map(|m| m.name()).collect();
        assert_eq!(
            names,
            [
                "rgb",
                "depth",
                "camera",
                "gaze",
                "left_hand",
                "right_hand",
                "body",
                "head_imu"
            ]
        );
        let imu = &all[7];
        assert_eq!(
            imu.shape(),
            Shape::Temporal {
                samples: 60,
                channels: 6
            }
        );
        let mut clip = Clip::empty("a", "test");
        let mut values = ArrayD::from_elem(vec![60, 6], 1.5);
        values[[4, 2]] = f32::NAN;
        imu.insert(
            Signal {
                values,
                valid: None,
            },
            &mut clip,
        )
        .unwrap();
        let signal = imu.extract(&clip).unwrap().unwrap();
        assert!(!signal.valid.unwrap()[[4]]);
        assert_eq!(signal.values[[4, 0]], 0.0);
    }

    #[test]
    fn declarations_that_contradict_themselves_are_named() {
        assert_eq!(head_imu().problem(), None);
        let mut bad = head_imu();
        bad.signal.units.pop();
        assert_eq!(bad.problem().unwrap().0, "signal.units");
        let mut bad = head_imu();
        bad.signal.channels[1] = "ax".to_owned();
        assert_eq!(bad.problem().unwrap().0, "signal.channels");
        let mut bad = head_imu();
        bad.signal.rate = f64::NAN;
        assert_eq!(bad.problem().unwrap().0, "signal.rate");
    }

    #[test]
    fn a_sensor_that_never_misses_refuses_nan() {
        let mut settings = head_imu();
        settings.signal.missing = Missing::Never;
        let imu = Declared::new(settings, &ClipFormat::default());
        let mut clip = Clip::empty("a", "test");
        let mut values = ArrayD::from_elem(vec![60, 6], 1.5);
        values[[4, 2]] = f32::NAN;
        imu.insert(
            Signal {
                values,
                valid: None,
            },
            &mut clip,
        )
        .unwrap();
        assert!(imu.extract(&clip).is_err());
    }
}
