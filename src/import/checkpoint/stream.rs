//! Values of entries, in pieces.

use super::{Checkpoint, Source};
use crate::formats::pickle::{Scalar, TensorView};
use crate::import::ImportError;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// Values are handed out in pieces of at most this many.
const CHUNK: usize = 1 << 18;

impl Checkpoint {
    /// Hands the values of an entry to `sink` in pieces, in C order, widened to f32 (64-bit numbers are rounded).
    pub fn stream(
        &mut self,
        index: usize,
        sink: &mut dyn FnMut(&[f32]) -> Result<(), ImportError>,
    ) -> Result<(), ImportError> {
        let view = self.entries[index].view.clone();
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
            return reader.finish();
        }
        // A strided view: read the piece of storage it spans, gather in C order.
        let span = view.end() - view.offset;
        if span > view.elements().saturating_mul(4).max(1 << 24) {
            return Err(ImportError::refused(
                &self.path,
                format!(
                    "`{}` picks {} of {span} elements of its storage: too sparse to be a weight",
                    self.entries[index].name,
                    view.elements()
                ),
            ));
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
    pub fn values(&mut self, index: usize) -> Result<Vec<f32>, ImportError> {
        let mut all = Vec::with_capacity(self.entries[index].view.elements() as usize);
        self.stream(index, &mut |piece| {
            all.extend_from_slice(piece);
            Ok(())
        })?;
        Ok(all)
    }

    /// A reader over a contiguous view. The member's checksum is verified on the way, or once beforehand.
    fn reader(&mut self, view: &TensorView) -> Result<Bytes<'_>, ImportError> {
        let width = view.storage.scalar.width() as u64;
        let path = self.path.as_path();
        match &mut self.source {
            Source::Flat { file, start } => {
                file.seek(SeekFrom::Start(*start + view.offset * width))
                    .map_err(ImportError::io(path))?;
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
                    let mut reader = zip.reader(&member)?;
                    std::io::copy(&mut reader, &mut std::io::sink())
                        .map_err(ImportError::io(path))?;
                }
                let mut reader = zip.reader(&member)?;
                if !whole {
                    reader.skip_stored(view.offset * width)?;
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
    fn fill(&mut self, buffer: &mut [u8]) -> Result<(), ImportError> {
        self.source
            .read_exact(buffer)
            .map_err(ImportError::io(self.path))
    }

    fn finish(mut self) -> Result<(), ImportError> {
        if self.to_end {
            self.source
                .read(&mut [0])
                .map_err(ImportError::io(self.path))?;
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
        Scalar::U8 | Scalar::Bool => each(bytes, out, |b: [u8; 1]| f32::from(b[0])),
    }
}
