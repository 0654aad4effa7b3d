//! Small VRS files of our own, so that the reader is tested where no recording is at hand.

use std::io::Write;

type Tags = Vec<(String, String)>;

/// A VRS file in memory: streams with layouts, records, an index.
#[derive(Debug, Default)]
pub struct VrsWriter {
    file_tags: Vec<(String, String)>,
    streams: Vec<((i32, u16), Tags)>,
    records: Vec<(RecordHead, Vec<u8>)>,
}

#[derive(Debug, Clone, Copy)]
struct RecordHead {
    stream: (i32, u16),
    kind: u8,
    timestamp: f64,
    compression: u8,
    uncompressed: u32,
}

pub const DATA: u8 = 3;
pub const CONFIGURATION: u8 = 2;

impl VrsWriter {
    pub fn file_tag(&mut self, key: &str, value: &str) {
        self.file_tags.push((key.to_owned(), value.to_owned()));
    }

    pub fn stream(&mut self, stream: (i32, u16), vrs_tags: &[(&str, &str)]) {
        let tags = vrs_tags
            .iter()
            .map(|(k, v)| ((*k).to_owned(), (*v).to_owned()))
            .collect();
        self.streams.push((stream, tags));
    }

    /// Compression: 0 none, 1 an LZ4 frame, 2 zstd.
    pub fn record(
        &mut self,
        stream: (i32, u16),
        kind: u8,
        timestamp: f64,
        payload: &[u8],
        compression: u8,
    ) {
        let (stored, uncompressed) = match compression {
            1 => {
                let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
                encoder.write_all(payload).unwrap();
                (encoder.finish().unwrap(), payload.len() as u32)
            }
            2 => (zstd(payload), payload.len() as u32),
            _ => (payload.to_vec(), 0),
        };
        let head = RecordHead {
            stream,
            kind,
            timestamp,
            compression,
            uncompressed,
        };
        self.records.push((head, stored));
    }

    /// The bytes of the file, with or without an index, which may be compressed.
    pub fn finish(&self, index: bool, compress_index: bool) -> Vec<u8> {
        let description = {
            let mut bytes = (self.streams.len() as u32).to_le_bytes().to_vec();
            for ((kind, instance), tags) in &self.streams {
                bytes.extend(kind.to_le_bytes());
                bytes.extend(instance.to_le_bytes());
                bytes.extend(map(&[]));
                bytes.extend(map(tags));
            }
            bytes.extend(map(&self.file_tags));
            record(
                RecordHead {
                    stream: (2, 0),
                    kind: DATA,
                    timestamp: f64::MAX,
                    compression: 0,
                    uncompressed: 0,
                },
                2,
                &bytes,
            )
        };
        let records: Vec<Vec<u8>> = self
            .records
            .iter()
            .map(|(head, payload)| record(*head, 2, payload))
            .collect();
        let index_record = if index {
            let mut bytes = (self.streams.len() as u32).to_le_bytes().to_vec();
            for ((kind, instance), _) in &self.streams {
                bytes.extend(kind.to_le_bytes());
                bytes.extend(instance.to_le_bytes());
            }
            bytes.extend((records.len() as u32).to_le_bytes());
            let mut table = Vec::new();
            for ((head, _), bytes) in self.records.iter().zip(&records) {
                table.extend(head.timestamp.to_le_bytes());
                table.extend((bytes.len() as u32).to_le_bytes());
                table.push(head.kind);
                table.extend(head.stream.0.to_le_bytes());
                table.extend(head.stream.1.to_le_bytes());
            }
            let uncompressed = if compress_index {
                table.len() as u32
            } else {
                0
            };
            bytes.extend(if compress_index { zstd(&table) } else { table });
            // Space reserved beyond the table, as real recorders leave it.
            bytes.extend([0; 37]);
            record(
                RecordHead {
                    stream: (1, 0),
                    kind: DATA,
                    timestamp: f64::MAX,
                    compression: if compress_index { 2 } else { 0 },
                    uncompressed,
                },
                2,
                &bytes,
            )
        } else {
            Vec::new()
        };
        let mut file = Vec::new();
        file.extend(b"VisionRe");
        file.extend(7_u64.to_le_bytes());
        file.extend(80_u32.to_le_bytes());
        file.extend(32_u32.to_le_bytes());
        let index_at = if index {
            80 + description.len() as u64
        } else {
            0
        };
        file.extend(index_at.to_le_bytes());
        file.extend(80_u64.to_le_bytes());
        file.extend((80 + description.len() as u64 + index_record.len() as u64).to_le_bytes());
        file.extend([0; 24]);
        file.extend(b"cordVRS2");
        file.extend(description);
        file.extend(index_record);
        for bytes in records {
            file.extend(bytes);
        }
        file
    }
}

fn map(pairs: &[(String, String)]) -> Vec<u8> {
    let mut bytes = (pairs.len() as u32).to_le_bytes().to_vec();
    for text in pairs.iter().flat_map(|(key, value)| [key, value]) {
        bytes.extend((text.len() as u32).to_le_bytes());
        bytes.extend(text.as_bytes());
    }
    bytes
}

fn record(head: RecordHead, version: u32, payload: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    bytes.extend((32 + payload.len() as u32).to_le_bytes());
    bytes.extend(0_u32.to_le_bytes());
    bytes.extend(head.stream.0.to_le_bytes());
    bytes.extend(version.to_le_bytes());
    bytes.extend(head.timestamp.to_le_bytes());
    bytes.extend(head.stream.1.to_le_bytes());
    bytes.push(head.kind);
    bytes.push(head.compression);
    bytes.extend(head.uncompressed.to_le_bytes());
    bytes.extend(payload);
    bytes
}

/// A zstd frame of raw blocks.
fn zstd(data: &[u8]) -> Vec<u8> {
    ruzstd::encoding::compress_to_vec(data, ruzstd::encoding::CompressionLevel::Fastest)
}
