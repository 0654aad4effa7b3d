//! Parameter sets and other NAL units of H.264, as far as a reader of videos has to look into them (ITU-T H.264, 7.3.2, annexes
//! D and E).

/// 8192 x 4608 and the like. Beyond this a small hostile file could ask for gigabytes of picture buffers.
const MOST_PIXELS: u64 = 40_000_000;

/// What the first sequence parameter set says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sequence {
    /// `profile_idc`: 66 Baseline, 77 Main, 100 High, ...
    pub profile: u8,
    /// Pixels, without what is cropped.
    pub width: u32,
    /// Pixels, without what is cropped.
    pub height: u32,
    /// 0 grey, 1 4:2:0, 2 4:2:2, 3 4:4:4.
    pub chroma_format: u32,
    /// Bits of a luma or a chroma sample, whichever has more.
    pub bit_depth: u32,
    /// Interlaced coding is possible.
    pub interlaced: bool,
    /// Residuals may be coded without a transform.
    pub lossless: bool,
    /// Matrix coefficients, where the stream says them.
    pub matrix: Option<u8>,
    /// Whether luma goes from 0 to 255, where the stream says it.
    pub full_range: Option<bool>,
    /// Width to height of a pixel, where the stream says it.
    pub pixel_aspect: Option<[u32; 2]>,
}

impl Sequence {
    /// Parses a sequence parameter set (ITU-T H.264, 7.3.2.1.1 and annex E), its NAL header included.
    pub(super) fn parse(unit: &[u8]) -> Result<Self, String> {
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
        let (mut chroma_format, mut bit_depth, mut lossless) = (1, 8, false);
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
            lossless = bits.take(1)? == 1;
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
        let mut usability = Usability::default();
        let _ = bits.usability(&mut usability);
        Some(Sequence {
            profile,
            width,
            height,
            chroma_format,
            bit_depth,
            interlaced: !frames_only,
            lossless,
            matrix: usability.matrix,
            full_range: usability.full_range,
            pixel_aspect: usability.pixel_aspect,
        })
    }
}

/// Removes the bytes that keep start codes out of a NAL unit.
pub(super) fn without_emulation(data: &[u8]) -> Vec<u8> {
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

pub(super) struct Bits<'a> {
    pub(super) data: &'a [u8],
    pub(super) at: usize,
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
    pub(super) fn unsigned(&mut self) -> Option<u32> {
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

    /// From `vui_parameters_present_flag` to the matrix coefficients (annex E); as far as it is there.
    fn usability(&mut self, found: &mut Usability) -> Option<()> {
        if self.take(1)? == 0 {
            return None;
        }
        if self.take(1)? == 1 {
            let aspect = match self.take(8)? {
                255 => [self.take(16)?, self.take(16)?],
                code => *PIXEL_ASPECTS.get(code as usize).unwrap_or(&[0, 0]),
            };
            found.pixel_aspect = (!aspect.contains(&0)).then_some(aspect);
        }
        if self.take(1)? == 1 {
            self.take(1)?;
        }
        if self.take(1)? == 0 {
            return None;
        }
        self.take(3)?;
        found.full_range = Some(self.take(1)? == 1);
        if self.take(1)? == 1 {
            self.take(16)?;
            found.matrix = Some(self.take(8)? as u8);
        }
        Some(())
    }
}

/// What the video usability information says.
#[derive(Debug, Default)]
struct Usability {
    matrix: Option<u8>,
    full_range: Option<bool>,
    pixel_aspect: Option<[u32; 2]>,
}

/// Width to height of a pixel (table E-1).
const PIXEL_ASPECTS: [[u32; 2]; 17] = [
    [0, 0],
    [1, 1],
    [12, 11],
    [10, 11],
    [16, 11],
    [40, 33],
    [24, 11],
    [20, 11],
    [32, 11],
    [80, 33],
    [18, 11],
    [15, 11],
    [64, 33],
    [160, 99],
    [4, 3],
    [3, 2],
    [2, 1],
];

/// Whether supplemental information marks a point from which every picture can be decoded (annex D: recovery point, no frames).
pub(super) fn recovers_at_once(unit: &[u8]) -> bool {
    let payload = without_emulation(&unit[1..]);
    let mut at = 0;
    let number = |at: &mut usize| {
        let mut value = 0_usize;
        loop {
            let byte = *payload.get(*at)?;
            *at += 1;
            value += usize::from(byte);
            if byte != 255 {
                return Some(value);
            }
        }
    };
    while let (Some(kind), Some(size)) = (number(&mut at), number(&mut at)) {
        if kind == 6 {
            return payload.get(at).is_some_and(|byte| byte & 0x80 != 0);
        }
        at += size;
        // Trailing bits are no message.
        if payload.len().saturating_sub(at) < 3 {
            break;
        }
    }
    false
}

/// A coding tool of a picture parameter set (7.3.2.2) that the embedded decoder lacks.
pub(super) fn tool_beyond(unit: &[u8]) -> Option<&'static str> {
    let payload = without_emulation(unit.get(1..)?);
    let mut bits = Bits {
        data: &payload,
        at: 0,
    };
    bits.unsigned()?;
    bits.unsigned()?;
    bits.take(2)?;
    if bits.unsigned()? > 0 {
        return Some("slice groups");
    }
    bits.unsigned()?;
    bits.unsigned()?;
    bits.take(1)?;
    (bits.take(2)? == 1).then_some("weights of its own for pictures of two references")
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
        fn no_unit_makes_the_parsers_panic(data in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = Sequence::parse(&data);
            let _ = tool_beyond(&data);
            let _ = recovers_at_once(&[&[6], data.as_slice()].concat());
        }
    }
}
