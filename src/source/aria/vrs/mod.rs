//! VRS containers, the recordings of Project Aria: records of several streams in one file, with an index.
//!
//! Layout after the public documentation of the format (`vrs/FileFormat.h` and relatives): a file header, a description record
//! with tags per stream, an index record, then records in the order of time. Every record is compressed on its own, or not.
//! Files cut into chunks (`a.vrs`, `a.vrs_1`, ...) are one file here. Read next: [`layout`] (typed fields of a record), [`image`].

pub mod image;
pub mod layout;

use crate::source::SourceError;
use crate::source::error::Place;
use layout::{Fields, Layout};
use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// `"VisionRe"` and `"cord"`, little-endian.
const MAGIC: [u8; 8] = *b"VisionRe";
const MAGIC_END: [u8; 4] = *b"cord";
const FILE_HEADER: u64 = 80;
const RECORD_HEADER: u64 = 32;
/// Largest uncompressed record that is read: four times the largest picture of any Aria stream.
const MOST_UNCOMPRESSED: u64 = 64 << 20;
/// Zstd frames ask for a window of memory; Aria's compressor asks for at most 8 MiB.
const ZSTD_WINDOW: u64 = 64 << 20;
/// Index entry: f64 timestamp, u32 size, u8 kind, i32 stream type, u16 stream instance.
const INDEX_ENTRY: usize = 19;

/// A stream: the kind of device and which one of that kind. Written `214-1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct StreamId {
    pub kind: i32,
    pub instance: u16,
}

impl StreamId {
    /// Aria's colour camera.
    pub const RGB: StreamId = StreamId::new(214, 1);
    /// Aria's left and right tracking cameras.
    pub const SLAM_LEFT: StreamId = StreamId::new(1201, 1);
    pub const SLAM_RIGHT: StreamId = StreamId::new(1201, 2);
    /// The map from the device's clock to the studio's timecode.
    pub const TIMECODE: StreamId = StreamId::new(285, 2);

    #[must_use]
    pub const fn new(kind: i32, instance: u16) -> Self {
        StreamId { kind, instance }
    }
}

impl fmt::Display for StreamId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.kind, self.instance)
    }
}

/// What a record is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    State,
    Configuration,
    Data,
    Tags,
}

impl Kind {
    fn from_code(code: u8) -> Option<Self> {
        match code {
            1 => Some(Kind::State),
            2 => Some(Kind::Configuration),
            3 => Some(Kind::Data),
            4 => Some(Kind::Tags),
            _ => None,
        }
    }

    /// As in the tags that describe record formats.
    fn name(self) -> &'static str {
        match self {
            Kind::State => "State",
            Kind::Configuration => "Configuration",
            Kind::Data => "Data",
            Kind::Tags => "Tags",
        }
    }
}

/// Where a record is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// Bytes from the start of the (joined) file.
    pub offset: u64,
    /// Seconds on the device's clock.
    pub timestamp: f64,
    /// Bytes, header included.
    pub size: u32,
    pub stream: StreamId,
    pub kind: Kind,
}

/// A record's header and payload.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    pub entry: Entry,
    pub format_version: u32,
    /// Uncompressed.
    pub payload: Vec<u8>,
}

/// Tags of one stream.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Tags {
    pub user: BTreeMap<String, String>,
    /// Written by the library: how records are laid out.
    pub vrs: BTreeMap<String, String>,
}

/// An opened file: its tags and the index of the streams that were asked for.
#[derive(Debug)]
pub struct Vrs {
    path: PathBuf,
    chunks: Vec<Chunk>,
    record_header: u64,
    pub tags: BTreeMap<String, String>,
    pub streams: BTreeMap<StreamId, Tags>,
    /// In the order of the file, which is the order of time.
    pub entries: Vec<Entry>,
}

#[derive(Debug)]
struct Chunk {
    path: PathBuf,
    start: u64,
    len: u64,
}

impl Vrs {
    /// Opens a file and keeps the index of every stream.
    ///
    /// # Errors
    /// When the file is no VRS file, truncated or damaged.
    pub fn open(path: &Path) -> Result<Self, SourceError> {
        Self::open_streams(path, |_| true)
    }

    /// Opens a file and keeps only the index of the streams that `keep` wants: motion sensors have a thousand records a second.
    ///
    /// # Errors
    /// As [`Vrs::open`].
    pub fn open_streams(path: &Path, keep: impl Fn(StreamId) -> bool) -> Result<Self, SourceError> {
        let mut vrs = Vrs {
            path: path.to_owned(),
            chunks: chunks(path)?,
            record_header: RECORD_HEADER,
            tags: BTreeMap::new(),
            streams: BTreeMap::new(),
            entries: Vec::new(),
        };
        let head = vrs.bytes(0, FILE_HEADER)?;
        if head[..8] != MAGIC || head[72..76] != MAGIC_END {
            return Err(vrs.damaged(0, "not a VRS file"));
        }
        let header_size = u64::from(u32_at(&head, 16));
        vrs.record_header = u64::from(u32_at(&head, 20));
        if header_size < FILE_HEADER || !(RECORD_HEADER..=4096).contains(&vrs.record_header) {
            return Err(vrs.damaged(16, "header sizes that no VRS file has"));
        }
        let index_at = u64_at(&head, 24);
        let description_at = u64_at(&head, 32);
        let description = vrs.header(description_at)?;
        vrs.describe(description_at, &description)?;
        let first = match u64_at(&head, 40) {
            0 => description_at + u64::from(description.size),
            offset => offset,
        };
        let indexed = index_at != 0 && vrs.read_index(index_at, first, &keep)?;
        if !indexed {
            vrs.walk(first, &keep)?;
        }
        vrs.late_tags()?;
        Ok(vrs)
    }

    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Records of a stream of one kind, in order.
    pub fn of(&self, stream: StreamId, kind: Kind) -> impl Iterator<Item = &Entry> {
        self.entries
            .iter()
            .filter(move |entry| entry.stream == stream && entry.kind == kind)
    }

    /// Streams that have records of a kind, as often as they have them.
    pub fn of_kind(&self, kind: Kind) -> impl Iterator<Item = StreamId> {
        self.entries
            .iter()
            .filter(move |entry| entry.kind == kind)
            .map(|entry| entry.stream)
    }

    /// Reads and uncompresses a record.
    ///
    /// # Errors
    /// When it is damaged or larger than any picture.
    pub fn read(&self, entry: &Entry) -> Result<Record, SourceError> {
        self.read_prefix(entry, MOST_UNCOMPRESSED)
    }

    /// Reads at most the first `most` bytes of a record's payload.
    fn read_prefix(&self, entry: &Entry, most: u64) -> Result<Record, SourceError> {
        let header = self.header(entry.offset)?;
        if header.size != entry.size || header.stream != entry.stream {
            return Err(self.damaged(entry.offset, "the index and the record disagree"));
        }
        let stored = u64::from(header.size) - self.record_header;
        let at = entry.offset + self.record_header;
        let payload = match header.compression {
            0 => self.bytes(at, stored.min(most))?,
            1 | 2 => {
                let size = u64::from(header.uncompressed);
                if size > MOST_UNCOMPRESSED {
                    return Err(self.damaged(
                        entry.offset,
                        format!("a record of {size} bytes uncompressed"),
                    ));
                }
                self.uncompress(at, stored, header.compression, size.min(most))?
            }
            other => {
                return Err(self.damaged(
                    entry.offset,
                    format!("compression {other}, which is not known"),
                ));
            }
        };
        Ok(Record {
            entry: *entry,
            format_version: header.format_version,
            payload,
        })
    }

    /// The layout of the first block of records of this stream, kind and version.
    ///
    /// # Errors
    /// When the stream does not describe itself.
    pub fn layout(
        &self,
        stream: StreamId,
        kind: Kind,
        version: u32,
    ) -> Result<Layout, SourceError> {
        let key = format!("DL:{}:{version}:0", kind.name());
        let text = self
            .streams
            .get(&stream)
            .and_then(|tags| tags.vrs.get(&key))
            .ok_or_else(|| {
                SourceError::missing(&self.path, format!("stream {stream} has no layout `{key}`"))
            })?;
        Layout::parse(text).map_err(|reason| {
            SourceError::malformed(
                &self.path,
                Place::File,
                format!("stream {stream}, `{key}`: {reason}"),
            )
        })
    }

    /// What follows the layout in records of this stream and kind: `image/jpg`, `image/raw`, ...; empty for plain fields.
    #[must_use]
    pub fn content(&self, stream: StreamId, kind: Kind, version: u32) -> &str {
        let key = format!("RF:{}:{version}", kind.name());
        self.streams
            .get(&stream)
            .and_then(|tags| tags.vrs.get(&key))
            .and_then(|format| format.split_once('+'))
            .map_or("", |(_, content)| content)
    }

    /// The typed fields at the start of a record.
    ///
    /// # Errors
    /// When the record is shorter than its layout.
    pub fn fields<'a>(
        &self,
        layout: &'a Layout,
        record: &'a Record,
    ) -> Result<Fields<'a>, SourceError> {
        Fields::new(layout, &record.payload)
            .map_err(|reason| self.damaged(record.entry.offset, reason))
    }

    /// The value of a string field in a stream's first configuration record.
    ///
    /// # Errors
    /// When the stream has no configuration record.
    pub fn configuration(&self, stream: StreamId) -> Result<(Layout, Record), SourceError> {
        let entry = *self.of(stream, Kind::Configuration).next().ok_or_else(|| {
            SourceError::missing(
                &self.path,
                format!("stream {stream} has no configuration record"),
            )
        })?;
        let record = self.read(&entry)?;
        let layout = self.layout(stream, Kind::Configuration, record.format_version)?;
        Ok((layout, record))
    }

    /// The time map of a clock stream: pairs of device time and clock time in nanoseconds, ascending.
    ///
    /// # Errors
    /// When a record is damaged.
    pub fn time_map(&self, stream: StreamId) -> Result<Vec<(i64, i64)>, SourceError> {
        let mut map = Vec::new();
        let mut layout: Option<(u32, Layout)> = None;
        for entry in self.of(stream, Kind::Data) {
            let record = self.read(entry)?;
            let layout = match &layout {
                Some((version, layout)) if *version == record.format_version => layout,
                _ => {
                    let found = self.layout(stream, Kind::Data, record.format_version)?;
                    &layout.insert((record.format_version, found)).1
                }
            };
            let fields = self.fields(layout, &record)?;
            if let (Some(device), Some(clock)) = (
                fields.integer("monotonic_timestamp_ns"),
                fields.integer("real_timestamp_ns"),
            ) {
                map.push((device, clock));
            }
        }
        map.sort_unstable();
        map.dedup_by_key(|pair| pair.0);
        Ok(map)
    }

    fn damaged(&self, offset: u64, reason: impl Into<String>) -> SourceError {
        SourceError::malformed(&self.path, Place::Offset(offset), reason)
    }

    fn len(&self) -> u64 {
        self.chunks
            .last()
            .map_or(0, |chunk| chunk.start + chunk.len)
    }

    /// A reader at `offset` of the joined file; a record never spans chunks.
    fn reader(
        &self,
        offset: u64,
        size: u64,
    ) -> Result<std::io::Take<BufReader<File>>, SourceError> {
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
        let fail = |cause| SourceError::io(&chunk.path, cause);
        let mut file = File::open(&chunk.path).map_err(fail)?;
        file.seek(SeekFrom::Start(offset - chunk.start))
            .map_err(fail)?;
        let buffer = size.clamp(64, 1 << 16) as usize;
        Ok(BufReader::with_capacity(buffer, file).take(size))
    }

    fn bytes(&self, offset: u64, size: u64) -> Result<Vec<u8>, SourceError> {
        let mut reader = self.reader(offset, size)?;
        let mut bytes = vec![0; size as usize];
        reader
            .read_exact(&mut bytes)
            .map_err(|cause| SourceError::io(&self.path, cause))?;
        Ok(bytes)
    }

    fn header(&self, offset: u64) -> Result<Header, SourceError> {
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

    fn uncompress(
        &self,
        offset: u64,
        stored: u64,
        how: u8,
        size: u64,
    ) -> Result<Vec<u8>, SourceError> {
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

    fn describe(&mut self, offset: u64, header: &Header) -> Result<(), SourceError> {
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
    fn read_index(
        &mut self,
        offset: u64,
        first: u64,
        keep: &impl Fn(StreamId) -> bool,
    ) -> Result<bool, SourceError> {
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
    fn walk(&mut self, first: u64, keep: &impl Fn(StreamId) -> bool) -> Result<(), SourceError> {
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
    fn late_tags(&mut self) -> Result<(), SourceError> {
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

struct Header {
    size: u32,
    format_version: u32,
    timestamp: f64,
    stream: StreamId,
    kind: u8,
    compression: u8,
    uncompressed: u32,
}

impl Header {
    /// From the 32 bytes of a record header.
    fn parse(bytes: &[u8]) -> Self {
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
fn chunks(path: &Path) -> Result<Vec<Chunk>, SourceError> {
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
            Err(cause) => return Err(SourceError::io(&part, cause)),
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
    fn take(&mut self, size: usize) -> Option<&'a [u8]> {
        let bytes = self.data.get(self.at..self.at.checked_add(size)?)?;
        self.at += size;
        Some(bytes)
    }

    fn u16(&mut self) -> Option<u16> {
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
    fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let count = self.u32()?;
        let mut map = BTreeMap::new();
        for _ in 0..count {
            map.insert(self.text()?, self.text()?);
        }
        Some(map)
    }
}

/// Callers have checked the length.
fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes
        .get(at..at + 4)
        .map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from(u32_at(bytes, at)) | u64::from(u32_at(bytes, at + 4)) << 32
}
