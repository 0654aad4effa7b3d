//! The central directory of a zip archive, and what is checked before any member is read.

use super::{FormatError, Method, ZipEntry, malformed};
use std::io::{Read, Seek, SeekFrom};

/// No archive that this product reads has a directory larger than this.
const MAX_DIRECTORY: u64 = 256 << 20;
/// Deflate turns at most 1032 bytes into one (258 bytes from two bits); a small constant covers the block headers.
const MAX_RATIO: u64 = 1032;

/// All members of the archive, in directory order.
pub(super) fn read<R: Read + Seek>(
    reader: &mut R,
    length: u64,
) -> Result<Vec<ZipEntry>, FormatError> {
    let end = End::find(reader, length)?;
    if end.size > MAX_DIRECTORY {
        return Err(malformed(end.offset, "the directory is larger than 256 MB"));
    }
    let mut bytes = vec![0; end.size as usize];
    reader.seek(SeekFrom::Start(end.offset))?;
    reader.read_exact(&mut bytes)?;
    let mut records = Vec::new();
    let mut rest = Fields::new(&bytes, end.offset);
    while !rest.bytes.is_empty() {
        records.push(Record::parse(&mut rest)?);
    }
    if records.len() as u64 != end.count {
        let reason = format!("{} records, {} declared", records.len(), end.count);
        return Err(malformed(end.offset, reason));
    }
    let mut entries = Vec::with_capacity(records.len());
    for record in records {
        entries.push((record.local, record.locate(reader, end.offset)?));
    }
    let mut order: Vec<&(u64, ZipEntry)> = entries.iter().collect();
    order.sort_by_key(|(local, _)| *local);
    for pair in order.windows(2) {
        let (first, (local, second)) = (&pair[0].1, pair[1]);
        if *local < first.data_offset + first.compressed {
            let reason = format!("members `{}` and `{}` overlap", first.name, second.name);
            return Err(malformed(*local, reason));
        }
    }
    Ok(entries.into_iter().map(|(_, entry)| entry).collect())
}

/// Where the directory lies.
struct End {
    offset: u64,
    size: u64,
    count: u64,
}

impl End {
    /// Looks for the end record in the last 64 kB, and follows it to its zip64 form.
    fn find<R: Read + Seek>(reader: &mut R, length: u64) -> Result<Self, FormatError> {
        let tail = length.min(22 + 65_535);
        reader.seek(SeekFrom::Start(length - tail))?;
        let mut bytes = vec![0; tail as usize];
        reader.read_exact(&mut bytes)?;
        let at = (0..bytes.len().saturating_sub(21)).rev().find(|&i| {
            bytes[i..].starts_with(b"PK\x05\x06")
                && i + 22 + usize::from(u16::from_le_bytes([bytes[i + 20], bytes[i + 21]]))
                    == bytes.len()
        });
        let Some(at) = at else {
            return Err(malformed(length, without_end(reader)?));
        };
        let start = length - tail + at as u64;
        let mut f = Fields::new(&bytes[at + 4..], start + 4);
        let (disk, directory_disk, here) = (f.u16()?, f.u16()?, f.u16()?);
        let count = f.u16()?;
        let (size, offset) = (f.u32()?, f.u32()?);
        let mut end = Self {
            offset: offset.into(),
            size: size.into(),
            count: count.into(),
        };
        let mut limit = start;
        let zip64 = at >= 20 && bytes[at - 20..].starts_with(b"PK\x06\x07");
        if zip64 {
            let mut locator = Fields::new(&bytes[at - 12..at], start - 12);
            let record = locator.u64()?;
            limit = record;
            end = Self::zip64(reader, record, start)?;
        } else if disk != 0 || directory_disk != 0 || here != count {
            return Err(malformed(start, "archives in several parts are not read"));
        }
        if end.offset.checked_add(end.size) != Some(limit) {
            let reason = "the directory does not end where the end record starts";
            return Err(malformed(start, reason));
        }
        Ok(end)
    }

    fn zip64<R: Read + Seek>(reader: &mut R, at: u64, limit: u64) -> Result<Self, FormatError> {
        if at.checked_add(56).is_none_or(|end| end > limit) {
            return Err(malformed(limit, "the zip64 record is outside the file"));
        }
        let mut bytes = [0; 56];
        reader.seek(SeekFrom::Start(at))?;
        reader.read_exact(&mut bytes)?;
        if !bytes.starts_with(b"PK\x06\x06") {
            return Err(malformed(at, "the zip64 record is missing"));
        }
        let mut f = Fields::new(&bytes[16..], at + 16);
        if f.u32()? != 0 || f.u32()? != 0 {
            return Err(malformed(at, "archives in several parts are not read"));
        }
        let (here, count) = (f.u64()?, f.u64()?);
        if here != count {
            return Err(malformed(at, "archives in several parts are not read"));
        }
        let (size, offset) = (f.u64()?, f.u64()?);
        Ok(Self {
            offset,
            size,
            count,
        })
    }
}

/// What an archive without its end record is.
fn without_end<R: Read + Seek>(reader: &mut R) -> Result<&'static str, FormatError> {
    let mut magic = Vec::new();
    reader.seek(SeekFrom::Start(0))?;
    reader.take(4).read_to_end(&mut magic)?;
    Ok(if magic == b"PK\x03\x04" {
        "the archive is cut off: its directory, which stands at the end, is missing"
    } else {
        "not a zip archive: no end record"
    })
}

/// A directory record before its local header has been seen.
struct Record {
    name: String,
    method: Method,
    compressed: u64,
    size: u64,
    crc32: u32,
    local: u64,
}

impl Record {
    fn parse(f: &mut Fields) -> Result<Self, FormatError> {
        let start = f.offset;
        if f.take(4)? != b"PK\x01\x02" {
            return Err(malformed(start, "a directory record is missing"));
        }
        f.take(4)?;
        let flags = f.u16()?;
        let method = f.u16()?;
        f.take(4)?;
        let crc32 = f.u32()?;
        let mut compressed = u64::from(f.u32()?);
        let mut size = u64::from(f.u32()?);
        let (name, extra, comment) = (f.u16()?, f.u16()?, f.u16()?);
        f.take(8)?;
        let mut local = u64::from(f.u32()?);
        let name = std::str::from_utf8(f.take(name.into())?)
            .map_err(|_| malformed(start + 46, "a member's name is not UTF-8"))?
            .to_owned();
        let mut extra = Fields::new(f.take(extra.into())?, start + 46 + name.len() as u64);
        f.take(comment.into())?;
        while extra.bytes.len() >= 4 {
            let (id, length) = (extra.u16()?, extra.u16()?);
            let mut field = Fields::new(extra.take(length.into())?, extra.offset);
            if id == 1 {
                for value in [&mut size, &mut compressed, &mut local] {
                    if *value == u64::from(u32::MAX) {
                        *value = field.u64()?;
                    }
                }
            }
        }
        if flags & 1 != 0 {
            return Err(malformed(start, format!("member `{name}` is encrypted")));
        }
        let method = match method {
            0 => Method::Stored,
            8 => Method::Deflated,
            other => {
                let reason = format!("member `{name}` uses compression method {other}");
                return Err(malformed(start, reason));
            }
        };
        let possible = match method {
            Method::Stored => size == compressed,
            Method::Deflated => size <= compressed.saturating_mul(MAX_RATIO).saturating_add(64),
        };
        if !possible {
            let reason =
                format!("member `{name}` cannot hold {size} bytes in {compressed}: a zip bomb");
            return Err(malformed(start, reason));
        }
        Ok(Self {
            name,
            method,
            compressed,
            size,
            crc32,
            local,
        })
    }

    /// Reads the local header to learn where the data starts. Data must end before `limit`.
    fn locate<R: Read + Seek>(&self, reader: &mut R, limit: u64) -> Result<ZipEntry, FormatError> {
        let outside = || {
            malformed(
                self.local.min(limit),
                format!("member `{}` lies outside the archive", self.name),
            )
        };
        let header_end = self.local.checked_add(30).ok_or_else(outside)?;
        if header_end > limit {
            return Err(outside());
        }
        let mut header = [0; 30];
        reader.seek(SeekFrom::Start(self.local))?;
        reader.read_exact(&mut header)?;
        let name_length = u64::from(u16::from_le_bytes([header[26], header[27]]));
        let extra_length = u64::from(u16::from_le_bytes([header[28], header[29]]));
        let data_offset = header_end + name_length + extra_length;
        if data_offset
            .checked_add(self.compressed)
            .is_none_or(|end| end > limit)
        {
            return Err(outside());
        }
        let mut name = vec![0; name_length as usize];
        reader.read_exact(&mut name)?;
        let method = u16::from_le_bytes([header[8], header[9]]);
        let same = header.starts_with(b"PK\x03\x04")
            && name == self.name.as_bytes()
            && method == if self.method == Method::Stored { 0 } else { 8 };
        if !same {
            let reason = format!("the directory and the header of `{}` disagree", self.name);
            return Err(malformed(self.local, reason));
        }
        Ok(ZipEntry {
            name: self.name.clone(),
            method: self.method,
            compressed: self.compressed,
            size: self.size,
            crc32: self.crc32,
            data_offset,
        })
    }
}

/// Little-endian fields of a byte slice.
struct Fields<'a> {
    bytes: &'a [u8],
    offset: u64,
}

impl<'a> Fields<'a> {
    fn new(bytes: &'a [u8], offset: u64) -> Self {
        Self { bytes, offset }
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], FormatError> {
        if count > self.bytes.len() {
            return Err(malformed(self.offset, "the directory is cut short"));
        }
        let (taken, rest) = self.bytes.split_at(count);
        self.bytes = rest;
        self.offset += count as u64;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], FormatError> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N)?);
        Ok(out)
    }

    fn u16(&mut self) -> Result<u16, FormatError> {
        Ok(u16::from_le_bytes(self.array()?))
    }

    fn u32(&mut self) -> Result<u32, FormatError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    fn u64(&mut self) -> Result<u64, FormatError> {
        Ok(u64::from_le_bytes(self.array()?))
    }
}
