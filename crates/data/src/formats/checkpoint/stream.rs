//! Values of entries, in pieces.

use super::{Checkpoint, CheckpointError, Source};
use crate::formats::pickle::{Scalar, TensorView};
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Values are handed out in pieces of at most this many.
const CHUNK: usize = 1 << 18;

impl Checkpoint {
    /// Hands the values of an entry to `sink` in pieces, in C order, widened to f32 (64-bit numbers are rounded).
    ///
    /// # Errors
    /// When the entry cannot be read as numbers, and what `sink` says.
    pub fn stream<E: From<CheckpointError>>(
        &mut self,
        index: usize,
        sink: &mut dyn FnMut(&[f32]) -> Result<(), E>,
    ) -> Result<(), E> {
        let view = self.entries[index].view.clone();
        if let Some(what) = view.storage.scalar.unreadable() {
            let name = &self.entries[index].name;
            let reason = format!("`{name}` holds {what}");
            return Err(CheckpointError::refused(&self.path, reason).into());
        }
        let width = view.storage.scalar.width();
        let mut floats = vec![0f32; CHUNK];
        let mut bytes = vec![0u8; CHUNK * width];
        if view.elements() == 0 {
            return Ok(());
        }
        if view.is_contiguous() {
            let mut reader = self.reader(&view)?;
            let mut left = view.elements() as usize;
            while left > 0 {
                let count = left.min(CHUNK);
                let piece = &mut bytes[..count * width];
                reader.fill(piece)?;
                widen(piece, view.storage.scalar, &mut floats[..count]);
                sink(&floats[..count])?;
                left -= count;
            }
            return Ok(reader.finish()?);
        }
        // A strided view: read the piece of storage it spans, gather in C order.
        let span = view.end() - view.offset;
        if span > view.elements().saturating_mul(4).max(1 << 24) {
            let reason = format!(
                "`{}` picks {} of {span} elements of its storage: too sparse to be a weight",
                self.entries[index].name,
                view.elements()
            );
            return Err(CheckpointError::refused(&self.path, reason).into());
        }
        let mut dense = vec![0u8; span as usize * width];
        let whole = TensorView {
            shape: vec![span],
            strides: vec![1],
            ..view.clone()
        };
        let mut reader = self.reader(&whole)?;
        reader.fill(&mut dense)?;
        reader.finish()?;
        let mut filled = 0;
        for at in positions(&view) {
            let from = at as usize * width;
            bytes[filled * width..(filled + 1) * width].copy_from_slice(&dense[from..from + width]);
            filled += 1;
            if filled == CHUNK {
                widen(&bytes, view.storage.scalar, &mut floats);
                sink(&floats)?;
                filled = 0;
            }
        }
        widen(
            &bytes[..filled * width],
            view.storage.scalar,
            &mut floats[..filled],
        );
        sink(&floats[..filled])
    }

    /// All values of an entry at once (for small ones).
    ///
    /// # Errors
    /// As [`Checkpoint::stream`].
    pub fn values(&mut self, index: usize) -> Result<Vec<f32>, CheckpointError> {
        let mut all = Vec::with_capacity(self.entries[index].view.elements() as usize);
        self.stream::<CheckpointError>(index, &mut |piece| {
            all.extend_from_slice(piece);
            Ok(())
        })?;
        Ok(all)
    }

    /// A reader over a contiguous view. The member's checksum is verified on the way, or once beforehand.
    fn reader(&mut self, view: &TensorView) -> Result<Bytes<'_>, CheckpointError> {
        let width = view.storage.scalar.width() as u64;
        let path = self.path.as_path();
        match &mut self.source {
            Source::Flat { file, start } => {
                file.seek(SeekFrom::Start(*start + view.offset * width))
                    .map_err(CheckpointError::io(path))?;
                Ok(Bytes {
                    path,
                    source: Box::new(file),
                    to_end: false,
                })
            }
            Source::Legacy { file, places } => {
                let start = places
                    .get(&view.storage.key)
                    .copied()
                    .unwrap_or(u64::MAX / 2);
                file.seek(SeekFrom::Start(start + view.offset * width))
                    .map_err(CheckpointError::io(path))?;
                Ok(Bytes {
                    path,
                    source: Box::new(file),
                    to_end: false,
                })
            }
            Source::Archive { zip, root } => {
                let member = format!("{root}/data/{}", view.storage.key);
                let size = zip.find(&member).map_or(0, |e| e.size);
                let whole = view.offset == 0 && view.elements() * width == size;
                if !whole && self.verified.insert(member.clone()) {
                    let mut reader = zip.reader(&member).map_err(|e| e.in_file(path))?;
                    std::io::copy(&mut reader, &mut std::io::sink())
                        .map_err(CheckpointError::io(path))?;
                }
                let mut reader = zip.reader(&member).map_err(|e| e.in_file(path))?;
                if !whole {
                    reader
                        .skip_stored(view.offset * width)
                        .map_err(|e| e.in_file(path))?;
                }
                Ok(Bytes {
                    path,
                    source: Box::new(reader),
                    to_end: whole,
                })
            }
        }
    }
}

/// The bytes of a view.
struct Bytes<'a> {
    path: &'a Path,
    source: Box<dyn Read + 'a>,
    /// Whether the end of the view is the end of the source, where the checksum is compared.
    to_end: bool,
}

impl Bytes<'_> {
    fn fill(&mut self, buffer: &mut [u8]) -> Result<(), CheckpointError> {
        self.source
            .read_exact(buffer)
            .map_err(CheckpointError::io(self.path))
    }

    fn finish(mut self) -> Result<(), CheckpointError> {
        if self.to_end {
            self.source
                .read(&mut [0])
                .map_err(CheckpointError::io(self.path))?;
        }
        Ok(())
    }
}

/// Offsets of the elements of a view in C order, relative to its start.
fn positions(view: &TensorView) -> impl Iterator<Item = u64> {
    let axes: Vec<(u64, u64)> = view
        .shape
        .iter()
        .copied()
        .zip(view.strides.iter().copied())
        .collect();
    (0..view.elements()).map(move |mut i| {
        let mut at = 0;
        for (d, stride) in axes.iter().rev() {
            at += i % d * stride;
            i /= d;
        }
        at
    })
}

/// Little-endian elements as f32. `bytes` holds exactly `out.len()` of them.
fn widen(bytes: &[u8], scalar: Scalar, out: &mut [f32]) {
    fn each<const N: usize>(bytes: &[u8], out: &mut [f32], value: impl Fn([u8; N]) -> f32) {
        for (out, chunk) in out.iter_mut().zip(bytes.as_chunks::<N>().0) {
            *out = value(*chunk);
        }
    }
    match scalar {
        Scalar::F64 => each(bytes, out, |b| f64::from_le_bytes(b) as f32),
        Scalar::F32 => each(bytes, out, f32::from_le_bytes),
        Scalar::F16 => each(bytes, out, |b| half::f16::from_le_bytes(b).to_f32()),
        Scalar::BF16 => each(bytes, out, |b| half::bf16::from_le_bytes(b).to_f32()),
        Scalar::I64 => each(bytes, out, |b| i64::from_le_bytes(b) as f32),
        Scalar::I32 => each(bytes, out, |b| i32::from_le_bytes(b) as f32),
        Scalar::I16 => each(bytes, out, |b| f32::from(i16::from_le_bytes(b))),
        Scalar::I8 => each(bytes, out, |b: [u8; 1]| f32::from(b[0] as i8)),
        Scalar::U64 => each(bytes, out, |b| u64::from_le_bytes(b) as f32),
        Scalar::U32 => each(bytes, out, |b| u32::from_le_bytes(b) as f32),
        Scalar::U16 => each(bytes, out, |b| f32::from(u16::from_le_bytes(b))),
        Scalar::U8 | Scalar::Bool => each(bytes, out, |b: [u8; 1]| f32::from(b[0])),
        Scalar::F8E4M3 => each(bytes, out, |b: [u8; 1]| eight_bits(b[0], 3)),
        Scalar::F8E5M2 => each(bytes, out, |b: [u8; 1]| eight_bits(b[0], 2)),
        // Refused before anything is read.
        Scalar::F8Other
        | Scalar::C128
        | Scalar::C64
        | Scalar::C32
        | Scalar::QI32
        | Scalar::QI8
        | Scalar::QU8 => out.fill(f32::NAN),
    }
}

/// A number of eight bits, `mantissa` of them mantissa: E4M3 without infinity (two mantissas fewer), or E5M2 with it.
fn eight_bits(byte: u8, mantissa: u32) -> f32 {
    let exponent_bits = 7 - mantissa;
    let bias = (1 << (exponent_bits - 1)) - 1;
    let exponent = i32::from((byte & 0x7f) >> mantissa);
    let fraction = f32::from(byte & ((1 << mantissa) - 1)) / f32::from(1u8 << mantissa);
    let largest = (1 << exponent_bits) - 1;
    let size = match exponent {
        0 => fraction * f32::powi(2.0, 1 - bias),
        _ if mantissa == 2 && exponent == largest && fraction == 0.0 => f32::INFINITY,
        _ if mantissa == 2 && exponent == largest => f32::NAN,
        _ if mantissa == 3 && byte & 0x7f == 0x7f => f32::NAN,
        _ => (1.0 + fraction) * f32::powi(2.0, exponent - bias),
    };
    if byte & 0x80 == 0 { size } else { -size }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_eight_bits_are_those_of_torch() {
        // torch 2.x: torch.tensor([..], dtype=torch.uint8).view(torch.float8_e4m3fn).float()
        for (byte, value) in [
            (0x00, 0.0),
            (0x01, 0.001_953_125),
            (0x38, 1.0),
            (0xb9, -1.125),
            (0x7e, 448.0),
        ] {
            assert_eq!(eight_bits(byte, 3), value, "e4m3 {byte:#x}");
        }
        assert!(eight_bits(0x7f, 3).is_nan());
        for (byte, value) in [
            (0x01, 1.525_878_9e-5),
            (0x3c, 1.0),
            (0xbd, -1.25),
            (0x7b, 57344.0),
            (0x7c, f32::INFINITY),
        ] {
            assert_eq!(eight_bits(byte, 2), value, "e5m2 {byte:#x}");
        }
        assert!(eight_bits(0x7d, 2).is_nan());
    }
}
