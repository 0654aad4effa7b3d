//! Where the records are: the description, the index, and the walk where there is no index.

use super::layout::Layout;
use super::stored::{Cursor, Header, u32_at, u64_at};
use super::{Entry, INDEX_ENTRY, Kind, RECORD_HEADER, StreamId, Tags, Vrs, ZSTD_WINDOW};
use crate::formats::ReadError;
use std::collections::BTreeMap;
use std::io::{BufReader, Read};

impl Vrs {
    pub(super) fn describe(&mut self, offset: u64, header: &Header) -> Result<(), ReadError> {
        let size = u64::from(header.size) - self.record_header;
        let bytes = self.bytes(offset + self.record_header, size)?;
        let mut cursor = Cursor {
            data: &bytes,
            at: 0,
        };
        let parsed = (|| {
            let count = cursor.u32()?;
            let mut streams = BTreeMap::new();
            for _ in 0..count {
                let kind = cursor.u32()? as i32;
                let instance = cursor.u16()?;
                let user = cursor.map()?;
                let vrs = cursor.map()?;
                streams.insert(StreamId { kind, instance }, Tags { user, vrs });
            }
            Some((streams, cursor.map()?))
        })();
        let (streams, tags) =
            parsed.ok_or_else(|| self.damaged(offset, "the description record is cut off"))?;
        self.streams = streams;
        self.tags = tags;
        Ok(())
    }

    /// Reads the index record; `false` when it cannot be used and the records have to be walked.
    pub(super) fn read_index(
        &mut self,
        offset: u64,
        first: u64,
        keep: &impl Fn(StreamId) -> bool,
    ) -> Result<bool, ReadError> {
        let header = self.header(offset)?;
        let at = offset + self.record_header;
        let stored = u64::from(header.size) - self.record_header;
        if header.format_version != 2 {
            return Ok(false);
        }
        // Streams, then the number of records.
        let streams = u64::from(u32_at(&self.bytes(at, stored.min(4))?, 0));
        let table = 8 + 6 * streams;
        if table > stored {
            return Ok(false);
        }
        let count = u64::from(u32_at(&self.bytes(at + table - 4, 4)?, 0));
        // Every record of the index has a header in the file.
        if count > self.len() / RECORD_HEADER {
            return Err(self.damaged(offset, format!("an index of {count} records")));
        }
        let wanted = count * INDEX_ENTRY as u64;
        let mut reader: Box<dyn Read> = if header.uncompressed != 0 {
            let reader = self.reader(at + table, stored - table)?;
            Box::new(
                ruzstd::decoding::StreamingDecoder::new_with_max_window_size(reader, ZSTD_WINDOW)
                    .map_err(|error| {
                    self.damaged(offset, format!("the index cannot be uncompressed: {error}"))
                })?,
            )
        } else if wanted <= stored - table {
            Box::new(BufReader::new(self.reader(at + table, wanted)?))
        } else {
            return Err(self.damaged(offset, "the index is cut off"));
        };
        let mut entries = Vec::new();
        let mut here = first;
        let mut raw = [0; INDEX_ENTRY];
        for number in 0..count {
            reader
                .read_exact(&mut raw)
                .map_err(|error| self.damaged(offset, format!("index entry {number}: {error}")))?;
            let stream = StreamId {
                kind: u32_at(&raw, 13) as i32,
                instance: u16::from_le_bytes([raw[17], raw[18]]),
            };
            let size = u32_at(&raw, 8);
            if u64::from(size) < self.record_header || here + u64::from(size) > self.len() {
                return Err(self.damaged(
                    here,
                    format!("record {number} of {size} bytes does not fit: truncated?"),
                ));
            }
            if let (true, Some(kind)) = (keep(stream), Kind::from_code(raw[12])) {
                entries.push(Entry {
                    offset: here,
                    timestamp: f64::from_bits(u64_at(&raw, 0)),
                    size,
                    stream,
                    kind,
                });
            }
            here += u64::from(size);
        }
        self.entries = entries;
        Ok(true)
    }

    /// Rebuilds the index from the record headers.
    pub(super) fn walk(
        &mut self,
        first: u64,
        keep: &impl Fn(StreamId) -> bool,
    ) -> Result<(), ReadError> {
        let mut here = first;
        let mut entries = Vec::new();
        while here < self.len() {
            let header = self.header(here)?;
            if let (true, Some(kind)) = (keep(header.stream), Kind::from_code(header.kind)) {
                // Types below 16 are the library's own records (index, description).
                if header.stream.kind >= 16 {
                    entries.push(Entry {
                        offset: here,
                        timestamp: header.timestamp,
                        size: header.size,
                        stream: header.stream,
                        kind,
                    });
                }
            }
            here += u64::from(header.size);
        }
        self.entries = entries;
        Ok(())
    }

    /// Old files keep the tags of a stream in a record of their own.
    pub(super) fn late_tags(&mut self) -> Result<(), ReadError> {
        let tags: Vec<Entry> = self
            .entries
            .iter()
            .filter(|entry| entry.kind == Kind::Tags)
            .copied()
            .collect();
        for entry in tags {
            let record = self.read(&entry)?;
            let layout = Layout::tags();
            let fields = self.fields(&layout, &record)?;
            let slot = self.streams.entry(entry.stream).or_default();
            for name in ["user_tags", "vrs_tags"] {
                for (key, value) in fields.string_map(name).unwrap_or_default() {
                    let own = ["RF:", "DL:", "VRS_"]
                        .iter()
                        .any(|prefix| key.starts_with(prefix));
                    let map = if own { &mut slot.vrs } else { &mut slot.user };
                    map.insert(key, value);
                }
            }
        }
        Ok(())
    }
}
