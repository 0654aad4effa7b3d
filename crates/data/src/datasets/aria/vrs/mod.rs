//! VRS containers, the recordings of Project Aria: records of several streams in one file, with an index.
//!
//! Layout after the public documentation of the format (`vrs/FileFormat.h` and relatives): a file header, a description record
//! with tags per stream, an index record, then records in the order of time. Every record is compressed on its own, or not.
//! Files cut into chunks (`a.vrs`, `a.vrs_1`, ...) are one file here. Read next: [`layout`] (typed fields of a record), [`image`].

pub mod image;
mod index;
pub mod layout;
mod stored;

use crate::formats::ReadError;
use crate::formats::read_error::Position;
use layout::{Fields, Layout};
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};
use stored::{chunks, u32_at, u64_at};

/// `"VisionRe"` and `"cord"`, little-endian.
const MAGIC: [u8; 8] = *b"VisionRe";
const MAGIC_END: [u8; 4] = *b"cord";
const FILE_HEADER: u64 = 80;
const RECORD_HEADER: u64 = 32;
/// Payload of the largest record that is read, uncompressed: four times the largest picture of any Aria stream.
const MOST_UNCOMPRESSED: u64 = 64 << 20;
/// Zstd frames ask for a window of memory; Aria's compressor asks for at most 8 MiB.
const ZSTD_WINDOW: u64 = 64 << 20;
/// Index entry: f64 timestamp, u32 size, u8 kind, i32 stream type, u16 stream instance.
const INDEX_ENTRY: usize = 19;

/// A stream: the kind of device and which one of that kind. Written `214-1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct StreamId {
    /// The kind of device, as VRS numbers them: 214 is Aria's colour camera.
    pub kind: i32,
    /// Which one of that kind, from 1.
    pub instance: u16,
}

impl StreamId {
    /// Aria's colour camera.
    pub const RGB: StreamId = StreamId::new(214, 1);
    /// The left tracking camera of Aria and Quest.
    pub const SLAM_LEFT: StreamId = StreamId::new(1201, 1);
    /// The map from the device's clock to the studio's timecode.
    pub const TIMECODE: StreamId = StreamId::new(285, 2);

    /// The stream written `kind-instance`.
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
    /// Inner state of the device; not read here.
    State,
    /// How the device is set: of a camera the size and format of its pixels.
    Configuration,
    /// What the device measured: one picture, some samples of a sensor, or a pair of clock times.
    Data,
    /// The stream's tags, in files that do not have them in the description.
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
    /// The stream it belongs to.
    pub stream: StreamId,
    /// What it is for.
    pub kind: Kind,
}

/// A record's header and payload.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Where it was found.
    pub entry: Entry,
    /// Which layout the payload has: the version in the names of the `DL:` and `RF:` tags.
    pub format_version: u32,
    /// Uncompressed.
    pub payload: Vec<u8>,
}

/// Tags of one stream.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Tags {
    /// Written by the program that recorded: serial numbers, calibration, names of devices.
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
    /// Of the file as a whole, by name.
    pub tags: BTreeMap<String, String>,
    /// Tags by stream: of every stream in the description, those whose index is not kept included.
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
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        Self::open_streams(path, |_| true)
    }

    /// Opens a file and keeps only the index of the streams that `keep` wants: motion sensors have a thousand records a second.
    ///
    /// # Errors
    /// As [`Vrs::open`].
    pub fn open_streams(path: &Path, keep: impl Fn(StreamId) -> bool) -> Result<Self, ReadError> {
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

    /// The file that was opened, the first where it is cut into chunks.
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
    pub fn read(&self, entry: &Entry) -> Result<Record, ReadError> {
        if u64::from(entry.size) > MOST_UNCOMPRESSED + self.record_header {
            let reason = format!("a record of {} bytes", entry.size);
            return Err(self.damaged(entry.offset, reason));
        }
        self.read_prefix(entry, MOST_UNCOMPRESSED)
    }

    /// Reads at most the first `most` bytes of a record's payload.
    fn read_prefix(&self, entry: &Entry, most: u64) -> Result<Record, ReadError> {
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
    pub fn layout(&self, stream: StreamId, kind: Kind, version: u32) -> Result<Layout, ReadError> {
        let key = format!("DL:{}:{version}:0", kind.name());
        let text = self
            .streams
            .get(&stream)
            .and_then(|tags| tags.vrs.get(&key))
            .ok_or_else(|| {
                ReadError::missing(&self.path, format!("stream {stream} has no layout `{key}`"))
            })?;
        Layout::parse(text).map_err(|reason| {
            ReadError::malformed(
                &self.path,
                Position::File,
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
    ) -> Result<Fields<'a>, ReadError> {
        Fields::new(layout, &record.payload)
            .map_err(|reason| self.damaged(record.entry.offset, reason))
    }

    /// A stream's first configuration record and its layout.
    ///
    /// # Errors
    /// When the stream has no configuration record, does not describe it, or it is damaged.
    pub fn configuration(&self, stream: StreamId) -> Result<(Layout, Record), ReadError> {
        let entry = *self.of(stream, Kind::Configuration).next().ok_or_else(|| {
            ReadError::missing(
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
    pub fn time_map(&self, stream: StreamId) -> Result<Vec<(i64, i64)>, ReadError> {
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
}
