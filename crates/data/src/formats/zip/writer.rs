//! Writing zip archives: members stored, no times, so that equal content gives equal bytes.

use super::FormatError;
use std::io::{Read, Seek, SeekFrom, Write};

/// Writes an archive member by member. Members start at multiples of 64 bytes, so that arrays can be mapped in place.
#[derive(Debug)]
pub struct ZipWriter<W> {
    out: W,
    written: u64,
    directory: Vec<u8>,
    names: std::collections::BTreeSet<String>,
}

const ALIGNMENT: u64 = 64;
/// 1980-01-01, the first day a zip archive can express.
const DATE: u16 = 0x21;

impl<W: Write> ZipWriter<W> {
    /// Starts an archive.
    pub fn new(out: W) -> Self {
        Self {
            out,
            written: 0,
            directory: Vec::new(),
            names: std::collections::BTreeSet::new(),
        }
    }

    /// Adds a member.
    ///
    /// # Errors
    /// When the name was used before or is longer than 4096 bytes, there are 65534 members already, the archive would reach 4 GB
    /// (zip64 is read, but not written), or writing fails.
    pub fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), FormatError> {
        let mut crc = flate2::Crc::new();
        crc.update(bytes);
        self.begin(name, bytes.len() as u64, crc.sum())?;
        self.out.write_all(bytes)?;
        Ok(())
    }

    /// Adds a member from a file that need not fit in memory; it is read twice.
    ///
    /// # Errors
    /// As [`ZipWriter::add`], and when reading fails or the file changes in between.
    pub fn add_file(&mut self, name: &str, file: &mut std::fs::File) -> Result<(), FormatError> {
        let mut buffer = vec![0; 1 << 16];
        let mut crc = flate2::Crc::new();
        let mut length = 0;
        file.seek(SeekFrom::Start(0))?;
        loop {
            let n = file.read(&mut buffer)?;
            if n == 0 {
                break;
            }
            crc.update(&buffer[..n]);
            length += n as u64;
        }
        self.begin(name, length, crc.sum())?;
        file.seek(SeekFrom::Start(0))?;
        let copied = std::io::copy(&mut file.take(length), &mut self.out)?;
        if copied != length {
            let reason = format!("member `{name}`: the file became shorter while it was copied");
            return Err(super::malformed(copied, reason));
        }
        Ok(())
    }

    /// Writes the header of a member whose `length` bytes follow, and remembers it for the directory.
    fn begin(&mut self, name: &str, length: u64, crc: u32) -> Result<(), FormatError> {
        let refuse = |reason: &str| Err(super::malformed(0, format!("member `{name}`: {reason}")));
        if !self.names.insert(name.to_owned()) {
            return refuse("there is one of this name already");
        }
        if name.len() > 4096 || self.names.len() >= usize::from(u16::MAX) {
            return refuse("the name is too long or there are too many members");
        }
        let header_end = self.written + 30 + name.len() as u64;
        // Padding travels in an extra field, which needs four bytes of its own.
        let mut padding = (ALIGNMENT - header_end % ALIGNMENT) % ALIGNMENT;
        if (1..4).contains(&padding) {
            padding += ALIGNMENT;
        }
        let end = header_end + padding + length;
        if end + self.directory.len() as u64 + 8192 > u64::from(u32::MAX) {
            return refuse("the archive would exceed 4 GB");
        }

        let mut common = Vec::with_capacity(26);
        for field in [20, if name.is_ascii() { 0 } else { 0x800 }, 0, 0, DATE] {
            common.extend(u16::to_le_bytes(field));
        }
        for field in [crc, length as u32, length as u32] {
            common.extend(field.to_le_bytes());
        }
        common.extend((name.len() as u16).to_le_bytes());

        let mut header = b"PK\x03\x04".to_vec();
        header.extend(&common);
        header.extend((padding as u16).to_le_bytes());
        header.extend(name.as_bytes());
        if padding > 0 {
            header.extend(b"FB");
            header.extend((padding as u16 - 4).to_le_bytes());
            header.resize(30 + name.len() + padding as usize, 0);
        }
        self.out.write_all(&header)?;

        self.directory.extend(b"PK\x01\x02\x14\x00");
        self.directory.extend(&common);
        self.directory.extend([0; 12]);
        self.directory.extend((self.written as u32).to_le_bytes());
        self.directory.extend(name.as_bytes());
        self.written = end;
        Ok(())
    }

    /// Writes the directory and gives the output back, flushed.
    pub fn finish(mut self) -> Result<W, FormatError> {
        let count = self.names.len() as u16;
        self.out.write_all(&self.directory)?;
        let mut end = b"PK\x05\x06\0\0\0\0".to_vec();
        end.extend(count.to_le_bytes());
        end.extend(count.to_le_bytes());
        end.extend((self.directory.len() as u32).to_le_bytes());
        end.extend((self.written as u32).to_le_bytes());
        end.extend([0, 0]);
        self.out.write_all(&end)?;
        self.out.flush()?;
        Ok(self.out)
    }
}
