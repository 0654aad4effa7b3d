//! H.264 pictures from coded samples: a look into the parameter sets (can the embedded decoder take this stream, and which
//! colours does it carry?), and the decoder itself behind a wall that turns whatever goes wrong in it into an error.

use super::colour::{ColourSpace, Matrix};
use rusty_h264_common::YuvFrame;
use rusty_h264_decoder::{DecodeError, Decoder};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// 8192 x 4608 and the like. Beyond this a small hostile file could ask for gigabytes of picture buffers.
const MOST_PIXELS: u64 = 40_000_000;

/// `avcC`: parameter sets, and how lengths are written in front of the NAL units of a sample.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Configuration {
    /// 1, 2 or 4 bytes.
    length_size: usize,
    /// Sequence and picture parameter sets with start codes in front.
    parameter_sets: Vec<u8>,
    pub sequence: Sequence,
}

/// What the first sequence parameter set says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sequence {
    pub profile: u8,
    pub width: u32,
    pub height: u32,
    /// 0 grey, 1 4:2:0, 2 4:2:2, 3 4:4:4.
    pub chroma_format: u32,
    pub bit_depth: u32,
    /// Interlaced coding is possible.
    pub interlaced: bool,
    pub colour: ColourSpace,
}

impl Configuration {
    /// Parses the payload of an `avcC` box.
    ///
    /// # Errors
    /// A sentence that says what is wrong.
    pub fn parse(data: &[u8]) -> Result<Self, String> {
        let cut = || "the H.264 configuration (`avcC`) is cut off".to_owned();
        let length_size = usize::from(data.get(4).ok_or_else(cut)? & 3) + 1;
        let mut parameter_sets = Vec::new();
        let mut sequence = None;
        let mut at = 5;
        for mask in [0x1f, 0xff] {
            let count = data.get(at).ok_or_else(cut)? & mask;
            at += 1;
            for _ in 0..count {
                let size = data.get(at..at + 2).ok_or_else(cut)?;
                let size = usize::from(u16::from_be_bytes([size[0], size[1]]));
                let unit = data.get(at + 2..at + 2 + size).ok_or_else(cut)?;
                at += 2 + size;
                if sequence.is_none() && unit.first().is_some_and(|head| head & 0x1f == 7) {
                    sequence = Some(Sequence::parse(unit)?);
                }
                parameter_sets.extend_from_slice(&[0, 0, 0, 1]);
                parameter_sets.extend_from_slice(unit);
            }
        }
        Ok(Configuration {
            length_size,
            parameter_sets,
            sequence: sequence.ok_or("the H.264 configuration has no sequence parameter set")?,
        })
    }

    /// Why the embedded decoder cannot take this stream, if it cannot.
    #[must_use]
    pub fn beyond_embedded(&self) -> Option<String> {
        let s = &self.sequence;
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
        } else {
            None
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

    /// Whether decoding can start at this sample: all its slices are intra coded.
    #[must_use]
    pub fn is_intra(&self, sample: &[u8]) -> bool {
        let mut slices = 0;
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
                    if !matches!(kind, Some(2 | 7)) {
                        return false;
                    }
                    slices += 1;
                }
                2..=4 => return false,
                _ => {}
            }
        }
        slices > 0
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
    configuration: Configuration,
    decoder: Decoder,
    /// One sample with start codes; kept to reuse its allocation.
    stream: Vec<u8>,
    fresh: bool,
}

impl std::fmt::Debug for Pictures {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pictures")
            .field("configuration", &self.configuration)
            .finish_non_exhaustive()
    }
}

/// Why a sample did not become a picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PictureError {
    /// A coding tool that the embedded decoder does not have.
    Unsupported(String),
    Damaged(String),
}

impl Pictures {
    #[must_use]
    pub fn new(configuration: Configuration) -> Self {
        Pictures {
            configuration,
            decoder: Decoder::new(),
            stream: Vec::new(),
            fresh: true,
        }
    }

    /// Decodes one sample.
    ///
    /// # Errors
    /// When the sample is damaged, uses a tool the decoder lacks, or makes the decoder fail in any way. A panic inside the
    /// decoder is caught here: its state is thrown away, and the caller sees a damaged sample.
    pub fn decode(&mut self, sample: &[u8]) -> Result<Option<YuvFrame>, PictureError> {
        self.stream.clear();
        if self.fresh {
            self.stream
                .extend_from_slice(&self.configuration.parameter_sets);
            self.fresh = false;
        }
        for unit in self.configuration.units(sample) {
            let unit = unit.map_err(PictureError::Damaged)?;
            if unit[0] & 0x1f == 7 {
                // A parameter set inside the stream may change the size: the same limits hold for it.
                Sequence::parse(unit).map_err(PictureError::Damaged)?;
            }
            self.stream.extend_from_slice(&[0, 0, 0, 1]);
            self.stream.extend_from_slice(unit);
        }
        let (decoder, stream) = (&mut self.decoder, &self.stream);
        match catch_unwind(AssertUnwindSafe(|| decoder.decode(stream))) {
            Ok(Ok(Some(picture))) if !picture.is_valid() => Err(PictureError::Damaged(
                "the decoder returned an incomplete picture".to_owned(),
            )),
            Ok(Ok(picture)) => Ok(picture),
            Ok(Err(DecodeError::Unsupported(what))) => {
                Err(PictureError::Unsupported(what.to_owned()))
            }
            Ok(Err(error)) => Err(PictureError::Damaged(error.to_string())),
            Err(_) => {
                self.decoder = Decoder::new();
                self.fresh = true;
                Err(PictureError::Damaged(
                    "the H.264 decoder gave up on this sample".to_owned(),
                ))
            }
        }
    }
}

impl Sequence {
    /// Parses a sequence parameter set (ITU-T H.264, 7.3.2.1.1 and annex E), its NAL header included.
    fn parse(unit: &[u8]) -> Result<Self, String> {
        let payload = without_emulation(unit.get(1..).unwrap_or(&[]));
        let mut bits = Bits {
            data: &payload,
            at: 0,
        };
        Self::read(&mut bits)
            .ok_or_else(|| "the H.264 sequence parameter set is damaged".to_owned())
            .and_then(|sequence| {
                let pixels = u64::from(sequence.width) * u64::from(sequence.height);
                if pixels == 0 || pixels > MOST_PIXELS {
                    return Err(format!(
                        "the H.264 sequence parameter set asks for {} x {} pixels",
                        sequence.width, sequence.height
                    ));
                }
                Ok(sequence)
            })
    }

    fn read(bits: &mut Bits<'_>) -> Option<Self> {
        let profile = bits.take(8)? as u8;
        bits.take(16)?; // constraints, level
        bits.unsigned()?; // id
        let (mut chroma_format, mut bit_depth) = (1, 8);
        if matches!(
            profile,
            100 | 110 | 122 | 244 | 44 | 83 | 86 | 118 | 128 | 138 | 139 | 134 | 135
        ) {
            chroma_format = bits.unsigned()?;
            if chroma_format == 3 {
                bits.take(1)?;
            }
            let luma = bits.unsigned()?;
            let chroma = bits.unsigned()?;
            bit_depth = luma.max(chroma).checked_add(8)?;
            bits.take(1)?;
            if bits.take(1)? == 1 {
                for list in 0..if chroma_format == 3 { 12 } else { 8 } {
                    if bits.take(1)? == 1 {
                        bits.skip_scaling_list(if list < 6 { 16 } else { 64 })?;
                    }
                }
            }
        }
        bits.unsigned()?; // log2_max_frame_num_minus4
        match bits.unsigned()? {
            0 => {
                bits.unsigned()?;
            }
            1 => {
                bits.take(1)?;
                bits.signed()?;
                bits.signed()?;
                for _ in 0..bits.unsigned()?.min(256) {
                    bits.signed()?;
                }
            }
            _ => {}
        }
        bits.unsigned()?; // max_num_ref_frames
        bits.take(1)?;
        let wide = bits.unsigned()?.checked_add(1)?;
        let high = bits.unsigned()?.checked_add(1)?;
        let frames_only = bits.take(1)? == 1;
        if !frames_only {
            bits.take(1)?;
        }
        bits.take(1)?;
        let mut crop = [0_u32; 4];
        if bits.take(1)? == 1 {
            for edge in &mut crop {
                *edge = bits.unsigned()?;
            }
        }
        let unit_x = if matches!(chroma_format, 1 | 2) { 2 } else { 1 };
        let unit_y = if chroma_format == 1 { 2 } else { 1 } * if frames_only { 1 } else { 2 };
        let cropped = |blocks: u32, unit: u32, low: u32, high: u32| {
            blocks
                .checked_mul(16)?
                .checked_sub(low.checked_add(high)?.checked_mul(unit)?)
        };
        let width = cropped(wide, unit_x, crop[0], crop[1])?;
        let rows = high.checked_mul(if frames_only { 1 } else { 2 })?;
        let height = cropped(rows, unit_y, crop[2], crop[3])?;
        // Usability information is a courtesy: a stream without it, or with a damaged one, has default colours.
        let colour = bits.colour().unwrap_or_default();
        Some(Sequence {
            profile,
            width,
            height,
            chroma_format,
            bit_depth,
            interlaced: !frames_only,
            colour,
        })
    }
}

/// Removes the bytes that keep start codes out of a NAL unit.
fn without_emulation(data: &[u8]) -> Vec<u8> {
    let mut clean = Vec::with_capacity(data.len());
    let mut zeros = 0;
    for &byte in data {
        if zeros >= 2 && byte == 3 {
            zeros = 0;
            continue;
        }
        zeros = if byte == 0 { zeros + 1 } else { 0 };
        clean.push(byte);
    }
    clean
}

struct Bits<'a> {
    data: &'a [u8],
    at: usize,
}

impl Bits<'_> {
    fn take(&mut self, count: usize) -> Option<u32> {
        let mut value = 0;
        for _ in 0..count {
            let byte = self.data.get(self.at / 8)?;
            value = value << 1 | u32::from(byte >> (7 - self.at % 8) & 1);
            self.at += 1;
        }
        Some(value)
    }

    /// Exponential Golomb code.
    fn unsigned(&mut self) -> Option<u32> {
        let mut zeros = 0;
        while self.take(1)? == 0 {
            zeros += 1;
            if zeros > 31 {
                return None;
            }
        }
        Some((1_u32 << zeros) - 1 + self.take(zeros)?)
    }

    fn signed(&mut self) -> Option<i64> {
        let code = i64::from(self.unsigned()?);
        Some(if code % 2 == 0 {
            -code / 2
        } else {
            (code + 1) / 2
        })
    }

    fn skip_scaling_list(&mut self, size: usize) -> Option<()> {
        let (mut last, mut next) = (8_i64, 8_i64);
        for _ in 0..size {
            if next != 0 {
                next = (last + self.signed()?).rem_euclid(256);
            }
            if next != 0 {
                last = next;
            }
        }
        Some(())
    }

    /// From `vui_parameters_present_flag` to the matrix coefficients.
    fn colour(&mut self) -> Option<ColourSpace> {
        if self.take(1)? == 0 {
            return None;
        }
        if self.take(1)? == 1 && self.take(8)? == 255 {
            self.take(32)?;
        }
        if self.take(1)? == 1 {
            self.take(1)?;
        }
        if self.take(1)? == 0 {
            return None;
        }
        self.take(3)?;
        let full_range = self.take(1)? == 1;
        let mut matrix = Matrix::Unspecified;
        if self.take(1)? == 1 {
            self.take(16)?;
            matrix = Matrix::from_code(self.take(8)?);
        }
        Some(ColourSpace { matrix, full_range })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn golomb_codes_read_as_in_the_standard() {
        // 1 | 010 | 011 | 00100 | padding
        let data = [0b1010_0110, 0b0100_0000];
        let mut bits = Bits { data: &data, at: 0 };
        assert_eq!(
            [0, 1, 2, 3].map(Some).as_slice(),
            (0..4).map(|_| bits.unsigned()).collect::<Vec<_>>()
        );
    }

    proptest! {
        #[test]
        fn no_configuration_makes_the_parser_panic(data in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = Configuration::parse(&data);
            let _ = Sequence::parse(&data);
        }
    }
}
