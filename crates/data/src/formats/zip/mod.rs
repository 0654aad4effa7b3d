//! Zip archives: members stored or deflated, read through the central directory, written stored and deterministic.
//!
//! Refused at [`ZipArchive::open`]: overlapping members, members outside the file, encrypted or multi-disk archives,
//! duplicate names, and sizes that no deflate stream of that length could produce. Zip64 is understood.

mod directory;
mod writer;

pub use writer::ZipWriter;

use super::FormatError;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// How a member's bytes lie in the archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// As they are.
    Stored,
    /// Compressed by deflate.
    Deflated,
}

/// One member, as the central directory and its local header agree on it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ZipEntry {
    /// As the archive writes it, folders included; no other member has it.
    pub name: String,
    /// How its bytes are stored.
    pub method: Method,
    /// Bytes in the archive.
    pub compressed: u64,
    /// Bytes after decompression, as declared (enforced while reading).
    pub size: u64,
    /// Of the uncompressed bytes, as declared (compared once the member has been read to its end).
    pub crc32: u32,
    /// Where the member's data starts in the file.
    pub data_offset: u64,
}

/// An archive over any seekable reader.
#[derive(Debug)]
pub struct ZipArchive<R> {
    reader: R,
    length: u64,
    entries: Vec<ZipEntry>,
    by_name: BTreeMap<String, usize>,
}

impl ZipArchive<BufReader<File>> {
    /// Opens the archive at `path` and checks its directory.
    pub fn open(path: &Path) -> Result<Self, FormatError> {
        let file = File::open(path).map_err(|e| FormatError::from(e).in_file(path))?;
        Self::new(BufReader::new(file)).map_err(|e| e.in_file(path))
    }
}

impl<R: Read + Seek> ZipArchive<R> {
    /// Reads and checks the directory of an archive.
    pub fn new(mut reader: R) -> Result<Self, FormatError> {
        let length = reader.seek(SeekFrom::End(0))?;
        let entries = directory::read(&mut reader, length)?;
        let mut by_name = BTreeMap::new();
        for (index, entry) in entries.iter().enumerate() {
            if by_name.insert(entry.name.clone(), index).is_some() {
                let reason = format!("two members are called `{}`", entry.name);
                return Err(malformed(entry.data_offset, reason));
            }
        }
        Ok(Self {
            reader,
            length,
            entries,
            by_name,
        })
    }

    /// The members, in the order of the central directory.
    pub fn entries(&self) -> &[ZipEntry] {
        &self.entries
    }

    /// The size of the whole archive in bytes.
    pub fn length(&self) -> u64 {
        self.length
    }

    /// The member of this name.
    pub fn find(&self, name: &str) -> Option<&ZipEntry> {
        self.by_name.get(name).map(|&i| &self.entries[i])
    }

    /// The whole member, checked against its size and CRC.
    ///
    /// # Errors
    /// Also when the member is larger than `limit` bytes: nothing is then read.
    pub fn read(&mut self, name: &str, limit: u64) -> Result<Vec<u8>, FormatError> {
        let entry = self.entry(name)?.clone();
        if entry.size > limit {
            let reason = format!(
                "member `{name}` has {} bytes, more than the {limit} accepted here",
                entry.size
            );
            return Err(malformed(entry.data_offset, reason));
        }
        // A deflated member grows as it is read, so that a lying size costs no memory.
        let capacity = entry.size.min(entry.compressed.saturating_mul(4)) as usize;
        let mut bytes = Vec::with_capacity(capacity);
        self.stream(&entry)?
            .read_to_end(&mut bytes)
            .map_err(|e| member_error(&entry, e))?;
        Ok(bytes)
    }

    /// A reader over the uncompressed bytes of a member; the last read fails when size or CRC do not agree.
    pub fn reader(&mut self, name: &str) -> Result<EntryReader<'_>, FormatError> {
        let entry = self.entry(name)?.clone();
        self.stream(&entry)
    }

    fn entry(&self, name: &str) -> Result<&ZipEntry, FormatError> {
        self.find(name)
            .ok_or_else(|| missing(name, self.entries.iter().map(|e| e.name.as_str())))
    }

    fn stream(&mut self, entry: &ZipEntry) -> Result<EntryReader<'_>, FormatError> {
        self.reader.seek(SeekFrom::Start(entry.data_offset))?;
        let raw = (&mut self.reader as &mut dyn ReadSeek).take(entry.compressed);
        let source = match entry.method {
            Method::Stored => Source::Stored(raw),
            Method::Deflated => Source::Deflated(Box::new(flate2::read::DeflateDecoder::new(raw))),
        };
        Ok(EntryReader {
            source,
            left: entry.size,
            crc: flate2::Crc::new(),
            expected: Some(entry.crc32),
            data_offset: entry.data_offset,
            done: false,
        })
    }
}

/// Streams one member; see [`ZipArchive::reader`].
pub struct EntryReader<'a> {
    source: Source<'a>,
    left: u64,
    crc: flate2::Crc,
    /// `None` once bytes have been skipped: the checksum cannot be compared then.
    expected: Option<u32>,
    data_offset: u64,
    done: bool,
}

trait ReadSeek: Read + Seek {}
impl<R: Read + Seek> ReadSeek for R {}

enum Source<'a> {
    Stored(std::io::Take<&'a mut dyn ReadSeek>),
    Deflated(Box<flate2::read::DeflateDecoder<std::io::Take<&'a mut dyn ReadSeek>>>),
}

impl Read for Source<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        match self {
            Self::Stored(raw) => raw.read(buffer),
            Self::Deflated(decoder) => decoder.read(buffer),
        }
    }
}

impl Read for EntryReader<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        if buffer.is_empty() || self.done {
            return Ok(0);
        }
        if self.left == 0 {
            return self.finish();
        }
        let want = buffer
            .len()
            .min(usize::try_from(self.left).unwrap_or(usize::MAX));
        let got = self.source.read(&mut buffer[..want])?;
        if got == 0 {
            let reason = format!("the data ends {} bytes early", self.left);
            return Err(std::io::Error::new(
                std::io::ErrorKind::UnexpectedEof,
                reason,
            ));
        }
        self.crc.update(&buffer[..got]);
        self.left -= got as u64;
        Ok(got)
    }
}

impl EntryReader<'_> {
    /// Moves on by `count` bytes of a stored member without reading them; its checksum is then not compared.
    pub fn skip_stored(&mut self, count: u64) -> Result<(), FormatError> {
        let Source::Stored(raw) = &mut self.source else {
            return Err(malformed(self.data_offset, "the member is not stored"));
        };
        if count > self.left {
            let reason = format!("{count} bytes skipped of {}", self.left);
            return Err(malformed(self.data_offset, reason));
        }
        let limit = raw.limit() - count;
        raw.get_mut().seek_relative(count as i64)?;
        raw.set_limit(limit);
        self.left -= count;
        self.expected = None;
        Ok(())
    }

    /// The declared number of bytes has been read: nothing may follow, and the checksum must agree.
    fn finish(&mut self) -> std::io::Result<usize> {
        let invalid = |reason| Err(std::io::Error::new(std::io::ErrorKind::InvalidData, reason));
        if self.source.read(&mut [0])? != 0 {
            return invalid("more data than the directory declares".to_owned());
        }
        if let Some(expected) = self.expected
            && self.crc.sum() != expected
        {
            let sum = self.crc.sum();
            return invalid(format!(
                "checksum {sum:08x}, the directory says {expected:08x}"
            ));
        }
        self.done = true;
        Ok(0)
    }
}

fn malformed(offset: u64, reason: impl Into<String>) -> FormatError {
    FormatError::malformed("zip", offset, reason)
}

fn member_error(entry: &ZipEntry, error: std::io::Error) -> FormatError {
    match error.kind() {
        std::io::ErrorKind::InvalidData
        | std::io::ErrorKind::InvalidInput
        | std::io::ErrorKind::UnexpectedEof => malformed(
            entry.data_offset,
            format!("member `{}`: {error}", entry.name),
        ),
        _ => error.into(),
    }
}

/// The error for a name that is not there, with the first few that are.
pub fn missing<'a>(name: &str, present: impl Iterator<Item = &'a str>) -> FormatError {
    let mut names: Vec<&str> = present.take(9).collect();
    if names.len() > 8 {
        names[8] = "...";
    }
    let present = if names.is_empty() {
        "nothing".to_owned()
    } else {
        names.join(", ")
    };
    FormatError::Missing {
        name: name.to_owned(),
        present,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::io::{Cursor, Write};

    fn archive(bytes: Vec<u8>) -> Result<ZipArchive<Cursor<Vec<u8>>>, FormatError> {
        ZipArchive::new(Cursor::new(bytes))
    }

    fn two_members() -> Vec<u8> {
        let mut writer = ZipWriter::new(Vec::new());
        writer.add("a.txt", b"hello").unwrap();
        writer.add("folder/b.bin", &[7; 1000]).unwrap();
        writer.finish().unwrap()
    }

    /// One deflated member, put together by hand from the format's description.
    fn deflated(content: &[u8], declared: u32) -> Vec<u8> {
        let mut encoder =
            flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::best());
        encoder.write_all(content).unwrap();
        let data = encoder.finish().unwrap();
        let mut crc = flate2::Crc::new();
        crc.update(content);
        let mut fields = Vec::new();
        for v in [20u16, 0, 8, 0, 0] {
            fields.extend(v.to_le_bytes());
        }
        fields.extend(crc.sum().to_le_bytes());
        fields.extend((data.len() as u32).to_le_bytes());
        fields.extend(declared.to_le_bytes());
        fields.extend([1, 0, 0, 0]);
        let mut out = b"PK\x03\x04".to_vec();
        out.extend(&fields);
        out.push(b'x');
        out.extend(&data);
        let directory = out.len() as u32;
        out.extend(b"PK\x01\x02\x14\x00");
        out.extend(&fields);
        out.extend([0; 14]);
        out.push(b'x');
        let size = out.len() as u32 - directory;
        out.extend(b"PK\x05\x06\0\0\0\0\x01\0\x01\0");
        out.extend(size.to_le_bytes());
        out.extend(directory.to_le_bytes());
        out.extend([0, 0]);
        out
    }

    #[test]
    fn what_is_written_is_read_back_and_bytes_depend_on_content_alone() {
        let bytes = two_members();
        assert_eq!(bytes, two_members());
        let mut zip = archive(bytes).unwrap();
        assert_eq!(zip.entries().len(), 2);
        assert_eq!(zip.read("a.txt", 5).unwrap(), b"hello");
        assert_eq!(zip.read("folder/b.bin", 1 << 20).unwrap(), [7; 1000]);
        let mut rest = String::new();
        let mut reader = zip.reader("a.txt").unwrap();
        reader.skip_stored(2).unwrap();
        assert!(reader.skip_stored(4).is_err());
        reader.read_to_string(&mut rest).unwrap();
        assert_eq!(rest, "llo");
        assert!(zip.read("a.txt", 4).is_err());
        let missing = zip.read("c", 1).unwrap_err().to_string();
        assert!(missing.contains("a.txt, folder/b.bin"), "{missing}");
    }

    #[test]
    fn deflated_members_are_read_and_lies_about_their_size_are_refused() {
        let content = b"abcabcabc".repeat(100);
        let mut zip = archive(deflated(&content, content.len() as u32)).unwrap();
        assert_eq!(zip.read("x", 1 << 20).unwrap(), content);
        for lie in [content.len() as u32 - 1, content.len() as u32 + 1] {
            let mut zip = archive(deflated(&content, lie)).unwrap();
            assert!(zip.read("x", 1 << 20).is_err());
        }
        // More than deflate's best ratio: refused before anything is inflated.
        assert!(archive(deflated(&content, u32::MAX - 1)).is_err());
    }

    #[test]
    fn a_changed_byte_of_data_is_noticed() {
        let mut bytes = two_members();
        let at = bytes.windows(5).position(|w| w == b"hello").unwrap();
        bytes[at] ^= 1;
        let error = archive(bytes).unwrap().read("a.txt", 10).unwrap_err();
        assert!(error.to_string().contains("checksum"), "{error}");
    }

    #[test]
    fn overlapping_members_are_refused() {
        let mut inner = ZipWriter::new(Vec::new());
        inner.add("b", b"payload").unwrap();
        let inner = inner.finish().unwrap();
        let mut outer = ZipWriter::new(Vec::new());
        outer.add("a", &inner).unwrap();
        outer.add("b", b"payload").unwrap();
        let mut bytes = outer.finish().unwrap();
        let find = |what: &[u8], bytes: &[u8]| -> Vec<usize> {
            (0..bytes.len() - 4)
                .filter(|&i| bytes[i..].starts_with(what))
                .collect()
        };
        // The last directory record is that of `b`: point it at the header of `b` inside the data of `a`.
        let record = *find(b"PK\x01\x02", &bytes).last().unwrap();
        let inside = find(b"PK\x03\x04", &bytes)[1] as u32;
        bytes[record + 42..record + 46].copy_from_slice(&inside.to_le_bytes());
        let error = archive(bytes).unwrap_err().to_string();
        assert!(error.contains("overlap"), "{error}");
    }

    proptest! {
        #[test]
        fn no_bytes_make_the_reader_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            let _ = archive(bytes);
        }

        #[test]
        fn no_damage_to_an_archive_makes_the_reader_panic(
            changes in proptest::collection::vec((0usize..1300, any::<u8>()), 1..6),
            cut in 0usize..1300,
        ) {
            let mut bytes = two_members();
            for (at, value) in changes {
                let at = at % bytes.len();
                bytes[at] = value;
            }
            bytes.truncate(bytes.len().min(1300 - cut / 4));
            if let Ok(mut zip) = archive(bytes) {
                let names: Vec<String> = zip.entries().iter().map(|e| e.name.clone()).collect();
                for name in names {
                    if let Ok(read) = zip.read(&name, 1 << 20) {
                        prop_assert!(read.len() <= 1 << 20);
                    }
                }
            }
        }
    }
}
