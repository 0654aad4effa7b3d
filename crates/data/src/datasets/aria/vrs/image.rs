//! Pictures in VRS streams: jpeg, png, and raw pixels of the formats that Aria and its ground truth use.

use super::layout::Layout;
use super::{Entry, Kind, Record, StreamId, Vrs};
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Image;
use ndarray::Array2;

/// Pixels of one record.
#[derive(Debug, Clone, PartialEq)]
pub enum Pixels {
    /// Colour; grey of eight bits comes as three equal channels.
    Rgb(Image),
    /// Depth maps in millimetres.
    Grey16(Array2<u16>),
}

/// The pictures of one stream, in the order of time.
#[derive(Debug)]
pub struct Pictures {
    vrs: std::sync::Arc<Vrs>,
    stream: StreamId,
    entries: Vec<Entry>,
    /// Device time of capture per picture, nanoseconds.
    pub times: Vec<i64>,
    layout: Layout,
    version: u32,
    raw: RawFormat,
}

/// How raw pixels lie in memory, from the stream's configuration record.
#[derive(Debug, Clone, Copy, Default)]
struct RawFormat {
    width: usize,
    height: usize,
    /// Bytes per row; 0 when rows touch.
    stride: usize,
    pixel_format: i64,
}

impl Pictures {
    /// Finds the pictures of `stream` and when each was captured.
    ///
    /// # Errors
    /// When the stream is missing, does not describe itself, or holds something that is not read here.
    pub fn new(vrs: std::sync::Arc<Vrs>, stream: StreamId) -> Result<Self, ReadError> {
        let entries: Vec<Entry> = vrs.of(stream, Kind::Data).copied().collect();
        let first = entries.first().ok_or_else(|| {
            ReadError::missing(vrs.path(), format!("stream {stream} has no pictures"))
        })?;
        let first = vrs.read(first)?;
        let version = first.format_version;
        let layout = vrs.layout(stream, Kind::Data, version)?;
        match vrs.content(stream, Kind::Data, version) {
            "image/jpg" | "image/png" | "image/raw" | "image/jpeg" => {}
            video if video.starts_with("image/video") => {
                return Err(ReadError::unsupported(
                    vrs.path(),
                    format!(
                        "stream {stream} holds `{video}`, as Aria gen2 records; only gen1 recordings are read: \
                         convert it to mp4 with `vrs_to_mp4` of projectaria-tools and read it as a video"
                    ),
                ));
            }
            other => {
                return Err(ReadError::unsupported(
                    vrs.path(),
                    format!("stream {stream} holds `{other}`, not pictures that are read here"),
                ));
            }
        }
        let raw = match vrs.configuration(stream) {
            Ok((layout, record)) => {
                let fields = vrs.fields(&layout, &record)?;
                let size = |name: &str| fields.integer(name).unwrap_or(0).max(0) as usize;
                RawFormat {
                    width: size("image_width"),
                    height: size("image_height"),
                    stride: size("image_stride"),
                    pixel_format: fields.integer("image_pixel_format").unwrap_or(0),
                }
            }
            Err(ReadError::Missing { .. }) => RawFormat::default(),
            Err(error) => return Err(error),
        };
        let mut pictures = Pictures {
            vrs,
            stream,
            entries,
            times: Vec::new(),
            layout,
            version,
            raw,
        };
        pictures.times = pictures
            .entries
            .iter()
            .map(|entry| pictures.time(entry))
            .collect::<Result<_, _>>()?;
        if !pictures.times.is_sorted() {
            return Err(ReadError::malformed(
                pictures.vrs.path(),
                Position::File,
                format!("the pictures of stream {stream} are not in the order of time"),
            ));
        }
        Ok(pictures)
    }

    /// How many pictures the stream has.
    #[must_use]
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there is no picture; an opened stream has at least one.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// The stream that the pictures are of.
    #[must_use]
    pub fn stream(&self) -> StreamId {
        self.stream
    }

    /// Size in pixels by the configuration record, if it says so.
    #[must_use]
    pub fn size(&self) -> Option<(u32, u32)> {
        (self.raw.width > 0 && self.raw.height > 0)
            .then_some((self.raw.width as u32, self.raw.height as u32))
    }

    /// Capture time of a picture: the field of the record, read without the pixels.
    fn time(&self, entry: &Entry) -> Result<i64, ReadError> {
        let record = self
            .vrs
            .read_prefix(entry, self.layout.fixed_size() as u64)?;
        if record.format_version != self.version {
            return Err(self.damaged(
                &record,
                "the record format changes in the middle of the stream",
            ));
        }
        let fields = self.vrs.fields(&self.layout, &record)?;
        Ok(fields
            .integer("capture_timestamp_ns")
            .unwrap_or((entry.timestamp * 1e9).round() as i64))
    }

    /// Decodes picture number `index`.
    ///
    /// # Errors
    /// When it is damaged.
    pub fn read(&self, index: usize) -> Result<Pixels, ReadError> {
        let entry = self
            .entries
            .get(index)
            .ok_or_else(|| ReadError::OutOfRange {
                source_name: format!("{} stream {}", self.vrs.path().display(), self.stream),
                index,
                len: self.entries.len(),
            })?;
        let record = self.vrs.read(entry)?;
        let fields = self.vrs.fields(&self.layout, &record)?;
        let content = fields
            .rest()
            .ok_or_else(|| self.damaged(&record, "the record is shorter than its fields say"))?;
        let pixels = if self.vrs.content(self.stream, Kind::Data, self.version) == "image/raw" {
            self.raw(content)
        } else {
            Image::from_bytes(content).map(Pixels::Rgb)
        };
        pixels.map_err(|reason| self.damaged(&record, reason))
    }

    fn raw(&self, content: &[u8]) -> Result<Pixels, String> {
        let RawFormat {
            width,
            height,
            stride,
            pixel_format,
        } = self.raw;
        // 1 GREY8, 4 RGB8, 9 GREY10, 11 GREY16
        let pixel = match pixel_format {
            1 => 1,
            4 => 3,
            9 | 11 => 2,
            other => return Err(format!("raw pixels of format {other} are not read")),
        };
        let row = width.checked_mul(pixel).ok_or("too wide")?;
        let stride = if stride == 0 { row } else { stride };
        let size = stride.checked_mul(height);
        if row == 0 || height == 0 || stride < row || size.is_none_or(|size| size > content.len()) {
            return Err(format!(
                "{width} x {height} raw pixels do not fit into {} bytes",
                content.len()
            ));
        }
        let rows = content.chunks(stride).take(height).map(|line| &line[..row]);
        Ok(match pixel_format {
            1 => Pixels::Rgb(Image {
                width: width as u32,
                height: height as u32,
                data: rows
                    .flat_map(|line| line.iter().flat_map(|v| [*v; 3]))
                    .collect(),
            }),
            4 => Pixels::Rgb(Image {
                width: width as u32,
                height: height as u32,
                data: rows.flatten().copied().collect(),
            }),
            _ => {
                let values = rows
                    .flat_map(|line| {
                        line.chunks_exact(2)
                            .map(|b| u16::from_le_bytes([b[0], b[1]]))
                    })
                    .collect();
                Pixels::Grey16(
                    Array2::from_shape_vec((height, width), values)
                        .map_err(|error| error.to_string())?,
                )
            }
        })
    }

    fn damaged(&self, record: &Record, reason: impl Into<String>) -> ReadError {
        ReadError::malformed(
            self.vrs.path(),
            Position::Offset(record.entry.offset),
            reason,
        )
    }
}
