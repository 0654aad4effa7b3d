//! Bytes of a file, or of its chunks: bounded reads, record headers, payloads.

use super::{Chunk, RECORD_HEADER, StreamId, Vrs, ZSTD_WINDOW};
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

impl Vrs {
    pub(super) fn damaged(&self, offset: u64, reason: impl Into<String>) -> ReadError {
        ReadError::malformed(&self.path, Position::Offset(offset), reason)
    }

    pub(super) fn len(&self) -> u64 {
        self.chunks
            .last()
            .map_or(0, |chunk| chunk.start + chunk.len)
    }

    /// A reader at `offset` of the joined file; a record never spans chunks.
    pub(super) fn reader(
        &self,
        offset: u64,
        size: u64,
    ) -> Result<std::io::Take<BufReader<File>>, ReadError> {
        let chunk = self
            .chunks
            .iter()
            .find(|chunk| offset >= chunk.start && offset < chunk.start + chunk.len)
            .filter(|chunk| size <= chunk.start + chunk.len - offset)
            .ok_or_else(|| {
                self.damaged(
                    offset,
                    format!(
                        "{size} bytes wanted here, but the file ends at {}: truncated?",
                        self.len()
                    ),
                )
            })?;
        let fail = |cause| ReadError::io(&chunk.path, cause);
        let mut file = File::open(&chunk.path).map_err(fail)?;
        file.seek(SeekFrom::Start(offset - chunk.start))
            .map_err(fail)?;
        let buffer = size.clamp(64, 1 << 16) as usize;
        Ok(BufReader::with_capacity(buffer, file).take(size))
    }

    pub(super) fn bytes(&self, offset: u64, size: u64) -> Result<Vec<u8>, ReadError> {
        let mut reader = self.reader(offset, size)?;
        let mut bytes = vec![0; size as usize];
        reader
            .read_exact(&mut bytes)
            .map_err(|cause| ReadError::io(&self.path, cause))?;
        Ok(bytes)
    }

    pub(super) fn header(&self, offset: u64) -> Result<Header, ReadError> {
        let bytes = self.bytes(offset, RECORD_HEADER)?;
        let header = Header::parse(&bytes);
        if u64::from(header.size) < self.record_header
            || offset + u64::from(header.size) > self.len()
        {
            return Err(self.damaged(
                offset,
                format!(
                    "a record claims {} bytes, {} are left: truncated?",
                    header.size,
                    self.len() - offset
                ),
            ));
        }
        Ok(header)
    }

    pub(super) fn uncompress(
        &self,
        offset: u64,
        stored: u64,
        how: u8,
        size: u64,
    ) -> Result<Vec<u8>, ReadError> {
        let reader = self.reader(offset, stored)?;
        let fail =
            |reason: String| self.damaged(offset, format!("cannot be uncompressed: {reason}"));
        let mut payload = Vec::new();
        let read = if how == 1 {
            lz4_flex::frame::FrameDecoder::new(reader)
                .take(size)
                .read_to_end(&mut payload)
        } else {
            ruzstd::decoding::StreamingDecoder::new_with_max_window_size(reader, ZSTD_WINDOW)
                .map_err(|error| fail(error.to_string()))?
                .take(size)
                .read_to_end(&mut payload)
        };
        read.map_err(|error| fail(error.to_string()))?;
        if payload.len() as u64 != size {
            return Err(fail(format!("{} bytes of {size}", payload.len())));
        }
        Ok(payload)
    }
}

pub(super) struct Header {
    pub(super) size: u32,
    pub(super) format_version: u32,
    pub(super) timestamp: f64,
    pub(super) stream: StreamId,
    pub(super) kind: u8,
    pub(super) compression: u8,
    pub(super) uncompressed: u32,
}

impl Header {
    /// From the 32 bytes of a record header.
    pub(super) fn parse(bytes: &[u8]) -> Self {
        Header {
            size: u32_at(bytes, 0),
            stream: StreamId {
                kind: u32_at(bytes, 8) as i32,
                instance: u16::from_le_bytes([bytes[24], bytes[25]]),
            },
            format_version: u32_at(bytes, 12),
            timestamp: f64::from_bits(u64_at(bytes, 16)),
            kind: bytes[26],
            compression: bytes[27],
            uncompressed: u32_at(bytes, 28),
        }
    }
}

/// The file and its further chunks.
pub(super) fn chunks(path: &Path) -> Result<Vec<Chunk>, ReadError> {
    let mut chunks: Vec<Chunk> = Vec::new();
    for number in 0.. {
        let mut name = path.as_os_str().to_owned();
        if number > 0 {
            name.push(format!("_{number}"));
        }
        let part = PathBuf::from(name);
        let len = match std::fs::metadata(&part) {
            Ok(metadata) => metadata.len(),
            Err(_) if number > 0 => break,
            Err(cause) => return Err(ReadError::io(&part, cause)),
        };
        let start = chunks.last().map_or(0, |chunk| chunk.start + chunk.len);
        chunks.push(Chunk {
            path: part,
            start,
            len,
        });
    }
    Ok(chunks)
}

/// Bounded reading of counted strings.
pub(super) struct Cursor<'a> {
    pub data: &'a [u8],
    pub at: usize,
}

impl<'a> Cursor<'a> {
    pub(super) fn take(&mut self, size: usize) -> Option<&'a [u8]> {
        let bytes = self.data.get(self.at..self.at.checked_add(size)?)?;
        self.at += size;
        Some(bytes)
    }

    pub(super) fn u16(&mut self) -> Option<u16> {
        self.take(2).map(|b| u16::from_le_bytes([b[0], b[1]]))
    }

    pub fn u32(&mut self) -> Option<u32> {
        self.take(4)
            .map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
    }

    pub fn text(&mut self) -> Option<String> {
        let size = self.u32()? as usize;
        self.take(size)
            .map(|bytes| String::from_utf8_lossy(bytes).into_owned())
    }

    /// Counted pairs of strings.
    pub(super) fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let count = self.u32()?;
        let mut map = BTreeMap::new();
        for _ in 0..count {
            map.insert(self.text()?, self.text()?);
        }
        Some(map)
    }
}

/// Callers have checked the length.
pub(super) fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes
        .get(at..at + 4)
        .map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

pub(super) fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from(u32_at(bytes, at)) | u64::from(u32_at(bytes, at + 4)) << 32
}
