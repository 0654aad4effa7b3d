//! Tar archives, read in place: where their members lie. Opening one reads headers only, and no size is believed before it was
//! compared with the length of the archive.

use super::{FormatError, place};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Where the contents of a member lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Member {
    /// Bytes from the start of the archive.
    pub offset: u64,
    /// Bytes.
    pub size: u64,
}

/// A header of an archive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Header {
    /// As it is written: a path with `/`, in any encoding.
    pub name: Vec<u8>,
    /// Whether it is a regular file: no folder and no link.
    pub is_file: bool,
    /// Its contents.
    pub member: Member,
}

impl Member {
    /// The contents.
    ///
    /// # Errors
    /// When the archive cannot be read, or has become shorter (`UnexpectedEof`).
    pub fn read(self, archive: &mut (impl Read + Seek)) -> std::io::Result<Vec<u8>> {
        archive.seek(SeekFrom::Start(self.offset))?;
        let mut bytes = Vec::with_capacity(self.size as usize);
        archive.take(self.size).read_to_end(&mut bytes)?;
        if bytes.len() as u64 == self.size {
            Ok(bytes)
        } else {
            Err(std::io::ErrorKind::UnexpectedEof.into())
        }
    }
}

/// The headers of a tar file, in their order.
///
/// # Errors
/// When it cannot be read, is no tar, or ends before its last member does.
pub fn headers(path: &Path) -> Result<Vec<Header>, FormatError> {
    let read = || {
        let (file, length) = place::open(path, place::JUMPS)?;
        headers_of(std::io::BufReader::new(file), length)
    };
    read().map_err(|error: FormatError| error.in_file(path))
}

/// The headers of an archive of `length` bytes, in their order.
///
/// # Errors
/// As [`headers`].
pub fn headers_of(archive: impl Read + Seek, length: u64) -> Result<Vec<Header>, FormatError> {
    let damaged = |offset: u64, reason: String| FormatError::malformed("tar", offset, reason);
    let mut archive = ::tar::Archive::new(archive);
    let mut headers = Vec::new();
    let (mut offset, mut end) = (0, 0);
    let entries = archive.entries_with_seek();
    for entry in entries.map_err(|error| damaged(0, error.to_string()))? {
        let entry = entry.map_err(|error| damaged(offset, error.to_string()))?;
        offset = entry.raw_file_position();
        let size = entry.size();
        if offset.checked_add(size).is_none_or(|end| end > length) {
            let reason = format!("a member of {size} bytes in a file of {length}");
            return Err(damaged(offset, reason));
        }
        end = offset + size;
        headers.push(Header {
            name: entry.path_bytes().into_owned(),
            is_file: entry.header().entry_type().is_file(),
            member: Member { offset, size },
        });
    }
    if !super::tar_has_end(length, end) {
        return Err(damaged(end, super::TAR_CUT.to_owned()));
    }
    Ok(headers)
}

/// The tar files in a folder and at most `depth` folders further down, sorted.
///
/// # Errors
/// When a folder cannot be listed.
pub fn below(folder: &Path, depth: usize) -> Result<Vec<PathBuf>, FormatError> {
    fn descend(folder: &Path, depth: usize, found: &mut Vec<PathBuf>) -> Result<(), FormatError> {
        let refuse = |error: std::io::Error| FormatError::from(error).in_file(folder);
        for (path, is_folder) in place::entries(folder).map_err(refuse)? {
            if is_folder {
                if depth > 0 {
                    descend(&path, depth - 1, found)?;
                }
            } else if path.extension().is_some_and(|extension| extension == "tar") {
                found.push(path);
            }
        }
        Ok(())
    }
    let mut found = Vec::new();
    descend(folder, depth, &mut found)?;
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn archive() -> Vec<u8> {
        let mut builder = ::tar::Builder::new(Vec::new());
        for (name, bytes) in [("a/b.json", vec![1; 700]), ("c", vec![2; 3])] {
            let mut header = ::tar::Header::new_ustar();
            header.set_size(bytes.len() as u64);
            builder
                .append_data(&mut header, name, bytes.as_slice())
                .unwrap();
        }
        builder.into_inner().unwrap()
    }

    #[test]
    fn members_are_found_and_read_in_any_order() {
        let bytes = archive();
        let mut file = std::io::Cursor::new(&bytes);
        let found = headers_of(&mut file, bytes.len() as u64).unwrap();
        let names: Vec<&[u8]> = found.iter().map(|it| it.name.as_slice()).collect();
        assert_eq!(names, [b"a/b.json".as_slice(), b"c"]);
        assert_eq!(found[1].member.read(&mut file).unwrap(), [2; 3]);
        assert_eq!(found[0].member.read(&mut file).unwrap(), [1; 700]);
        let mut cut = std::io::Cursor::new(&bytes[..1000]);
        let error = found[0].member.read(&mut cut).unwrap_err();
        assert_eq!(error.kind(), std::io::ErrorKind::UnexpectedEof);
    }

    #[test]
    fn a_damaged_archive_is_an_error_with_its_place_and_never_a_panic() {
        let good = archive();
        for cut in [1, 300, 512, 800, 1100] {
            let cut = &good[..cut];
            assert!(headers_of(std::io::Cursor::new(cut), cut.len() as u64).is_err());
        }
        for at in 0..600 {
            let mut bad = good.clone();
            bad[at] ^= 0x41;
            let mut file = std::io::Cursor::new(&bad);
            for it in headers_of(&mut file, bad.len() as u64).unwrap_or_default() {
                it.member.read(&mut file).unwrap();
            }
        }
    }
}
