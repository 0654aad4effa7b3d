//! H.264 pictures from coded samples: a look into the parameter sets (can the embedded decoder take this stream, and which
//! colours does it carry?), and the decoder itself behind a wall that turns whatever goes wrong in it into an error.

mod sequence;

pub use sequence::Sequence;

use sequence::{Bits, recovers_at_once, tool_beyond, without_emulation};

use super::colour::{ColourSpace, Matrix};
use super::mp4::SampleEntry;
use rusty_h264_common::YuvFrame;
use rusty_h264_decoder::{DecodeError, Decoder};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

/// A sample entry: `avcC` with its parameter sets, how lengths are written in front of the NAL units of a sample, and what the
/// container says of colours.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Configuration {
    /// 1, 2 or 4 bytes.
    length_size: usize,
    /// Sequence and picture parameter sets with start codes in front; empty where they come in the samples (`avc3`).
    parameter_sets: Vec<u8>,
    /// Of the first sequence parameter set; none before [`Configuration::complete`] where sets come in the samples.
    pub sequence: Option<Sequence>,
    /// A tool of a picture parameter set that the embedded decoder does not have.
    beyond: Option<&'static str>,
    /// Matrix and range that hold where the stream says nothing.
    container: (Option<u8>, Option<bool>),
}

impl Configuration {
    /// Parses the payload of an `avcC` box and takes over the colours of its sample entry.
    ///
    /// # Errors
    /// A sentence that says what is wrong.
    pub fn of(entry: &SampleEntry) -> Result<Self, String> {
        let data = entry.avc_configuration.as_deref().unwrap_or(&[]);
        let mut configuration = Self::parse(data)?;
        configuration.container = (entry.matrix, entry.full_range);
        Ok(configuration)
    }

    /// Parses the payload of an `avcC` box.
    ///
    /// # Errors
    /// A sentence that says what is wrong.
    pub fn parse(data: &[u8]) -> Result<Self, String> {
        let cut = || "the H.264 configuration (`avcC`) is cut off".to_owned();
        let length_size = usize::from(data.get(4).ok_or_else(cut)? & 3) + 1;
        let mut parameter_sets = Vec::new();
        let (mut sequence, mut beyond) = (None, None);
        let mut at = 5;
        for mask in [0x1f, 0xff] {
            let count = data.get(at).ok_or_else(cut)? & mask;
            at += 1;
            for _ in 0..count {
                let size = data.get(at..at + 2).ok_or_else(cut)?;
                let size = usize::from(u16::from_be_bytes([size[0], size[1]]));
                let unit = data.get(at + 2..at + 2 + size).ok_or_else(cut)?;
                at += 2 + size;
                match unit.first().map(|head| head & 0x1f) {
                    Some(7) if sequence.is_none() => sequence = Some(Sequence::parse(unit)?),
                    Some(8) => beyond = beyond.or_else(|| tool_beyond(unit)),
                    _ => {}
                }
                parameter_sets.extend_from_slice(&[0, 0, 0, 1]);
                parameter_sets.extend_from_slice(unit);
            }
        }
        Ok(Configuration {
            length_size,
            parameter_sets,
            sequence,
            beyond,
            container: (None, None),
        })
    }

    /// Takes the parameter sets from the first sample where the configuration has none.
    ///
    /// # Errors
    /// A sentence that says what is wrong.
    pub fn complete(&mut self, sample: &[u8]) -> Result<Sequence, String> {
        if let Some(sequence) = self.sequence {
            return Ok(sequence);
        }
        let mut beyond = None;
        for unit in self.units(sample) {
            let unit = unit?;
            match unit[0] & 0x1f {
                7 if self.sequence.is_none() => self.sequence = Some(Sequence::parse(unit)?),
                8 => beyond = beyond.or_else(|| tool_beyond(unit)),
                _ => {}
            }
        }
        self.beyond = self.beyond.or(beyond);
        self.sequence
            .ok_or_else(|| "H.264 without a sequence parameter set at its start".to_owned())
    }

    /// Why the embedded decoder cannot take this stream, if it cannot.
    #[must_use]
    pub fn beyond_embedded(&self) -> Option<String> {
        let Some(s) = &self.sequence else {
            return Some("H.264 without a sequence parameter set".to_owned());
        };
        if s.chroma_format == 3 {
            Some("H.264 4:4:4".to_owned())
        } else if s.chroma_format == 2 {
            Some("H.264 4:2:2".to_owned())
        } else if s.chroma_format != 1 {
            Some("grey H.264".to_owned())
        } else if s.bit_depth != 8 {
            Some(format!("H.264 with {} bits a sample", s.bit_depth))
        } else if s.interlaced {
            Some("interlaced H.264".to_owned())
        } else if s.lossless {
            Some("lossless H.264".to_owned())
        } else {
            self.beyond.map(|tool| format!("H.264 with {tool}"))
        }
    }

    /// Colours of a stream whose last sequence parameter set said `sequence`: its word counts more than the container's.
    fn colours(&self, sequence: &Sequence) -> ColourSpace {
        let (matrix, full_range) = self.container;
        ColourSpace {
            matrix: Matrix::from_code(sequence.matrix.or(matrix).unwrap_or(2)),
            full_range: sequence.full_range.or(full_range).unwrap_or(false),
        }
    }

    /// A sample's NAL units.
    fn units<'a>(&self, sample: &'a [u8]) -> Units<'a> {
        Units {
            rest: sample,
            length_size: self.length_size,
        }
    }

    /// Whether no other picture refers to this one, so that it may be skipped.
    #[must_use]
    pub fn is_disposable(&self, sample: &[u8]) -> bool {
        self.units(sample)
            .filter_map(Result::ok)
            .filter(|unit| matches!(unit[0] & 0x1f, 1..=5))
            .all(|unit| unit[0] & 0x60 == 0)
    }

    /// Whether decoding can start at this sample: an IDR picture, or intra slices behind a recovery point; with parameter sets
    /// where the configuration has none.
    #[must_use]
    pub fn is_start(&self, sample: &[u8]) -> bool {
        let (mut slices, mut sets, mut recovery) = (0, false, false);
        for unit in self.units(sample).filter_map(Result::ok) {
            match unit[0] & 0x1f {
                5 => slices += 1,
                1 => {
                    let header = without_emulation(&unit[1..unit.len().min(16)]);
                    let mut bits = Bits {
                        data: &header,
                        at: 0,
                    };
                    let kind = bits.unsigned().and_then(|_| bits.unsigned());
                    if !recovery || !matches!(kind, Some(2 | 7)) {
                        return false;
                    }
                    slices += 1;
                }
                2..=4 => return false,
                6 => recovery = recovery || recovers_at_once(unit),
                7 => sets = true,
                _ => {}
            }
        }
        slices > 0 && (sets || !self.parameter_sets.is_empty())
    }
}

/// NAL units of a sample, each at least one byte long.
struct Units<'a> {
    rest: &'a [u8],
    length_size: usize,
}

impl<'a> Iterator for Units<'a> {
    type Item = Result<&'a [u8], String>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if self.rest.is_empty() {
                return None;
            }
            let Some((length, rest)) = self.rest.split_at_checked(self.length_size) else {
                self.rest = &[];
                return Some(Err("a NAL unit's length is cut off".to_owned()));
            };
            let size = length
                .iter()
                .fold(0_usize, |size, byte| size << 8 | usize::from(*byte));
            let Some((unit, rest)) = rest.split_at_checked(size) else {
                let left = rest.len();
                self.rest = &[];
                return Some(Err(format!(
                    "a NAL unit claims {size} bytes, {left} are left in the sample"
                )));
            };
            self.rest = rest;
            if !unit.is_empty() {
                return Some(Ok(unit));
            }
        }
    }
}

/// The embedded decoder for one stream, fed sample by sample in decoding order.
pub struct Pictures {
    configurations: Arc<Vec<Configuration>>,
    decoder: Decoder,
    /// One sample with start codes; kept to reuse its allocation.
    stream: Vec<u8>,
    /// The configuration whose parameter sets the decoder has.
    current: Option<usize>,
    /// What the last sequence parameter set said.
    sequence: Option<Sequence>,
}

impl std::fmt::Debug for Pictures {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pictures")
            .field("configurations", &self.configurations)
            .finish_non_exhaustive()
    }
}

/// Why a sample did not become a picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PictureError {
    /// A coding tool that the embedded decoder does not have.
    Unsupported(String),
    /// It does not follow the format, is cut off, or the decoder failed on it: what is wrong, in words.
    Damaged(String),
}

impl Pictures {
    /// A decoder that has seen nothing; samples name their configuration by its index here.
    #[must_use]
    pub fn new(configurations: Arc<Vec<Configuration>>) -> Self {
        Pictures {
            configurations,
            decoder: Decoder::new(),
            stream: Vec::new(),
            current: None,
            sequence: None,
        }
    }

    /// Forgets every picture and parameter set.
    pub fn restart(&mut self) {
        self.decoder = Decoder::new();
        self.current = None;
    }

    /// Decodes one sample, coded as configuration `entry` says.
    ///
    /// # Errors
    /// When the sample is damaged, uses a tool the decoder lacks, or makes the decoder fail in any way. A panic inside the
    /// decoder is caught here: its state is thrown away, and the caller sees a damaged sample.
    pub fn decode(
        &mut self,
        entry: usize,
        sample: &[u8],
    ) -> Result<Option<(YuvFrame, ColourSpace)>, PictureError> {
        let configurations = Arc::clone(&self.configurations);
        let configuration = configurations.get(entry).ok_or_else(|| {
            PictureError::Damaged("its sample description does not exist".to_owned())
        })?;
        self.stream.clear();
        if self.current != Some(entry) {
            self.stream.extend_from_slice(&configuration.parameter_sets);
            self.sequence = configuration.sequence;
            self.current = Some(entry);
        }
        for unit in configuration.units(sample) {
            let unit = unit.map_err(PictureError::Damaged)?;
            if unit[0] & 0x1f == 7 {
                // A parameter set inside the stream may change the size: the same limits hold for it.
                self.sequence = Some(Sequence::parse(unit).map_err(PictureError::Damaged)?);
            }
            self.stream.extend_from_slice(&[0, 0, 0, 1]);
            self.stream.extend_from_slice(unit);
        }
        let colours = self
            .sequence
            .as_ref()
            .map(|sequence| configuration.colours(sequence))
            .unwrap_or_default();
        let (decoder, stream) = (&mut self.decoder, &self.stream);
        match catch_unwind(AssertUnwindSafe(|| decoder.decode(stream))) {
            Ok(Ok(Some(picture))) if !picture.is_valid() => Err(PictureError::Damaged(
                "the decoder returned an incomplete picture".to_owned(),
            )),
            Ok(Ok(picture)) => Ok(picture.map(|picture| (picture, colours))),
            Ok(Err(DecodeError::Unsupported(what))) => {
                Err(PictureError::Unsupported(what.to_owned()))
            }
            Ok(Err(error)) => Err(PictureError::Damaged(error.to_string())),
            Err(_) => {
                self.restart();
                Err(PictureError::Damaged(
                    "the H.264 decoder gave up on this sample".to_owned(),
                ))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn no_configuration_makes_the_parser_panic(data in proptest::collection::vec(any::<u8>(), 0..200)) {
            if let Ok(mut configuration) = Configuration::parse(&data) {
                let _ = configuration.complete(&data);
                let _ = configuration.is_start(&data);
                let _ = configuration.beyond_embedded();
            }
        }
    }
}
