//! Text files as people have them: with a byte order mark, with the line ends of Windows or of the old Mac, with no-break spaces
//! that an editor or a web page left behind.
//!
//! [`Lines`] reads any length with bounded memory, [`read`] a small file at once. Text is UTF-8; UTF-16 is refused by its name,
//! because its bytes would otherwise look like damage.

use super::read_error::Position;
use super::{FormatError, ReadError};
use std::borrow::Cow;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

/// No text that is read here has longer lines; a file without line ends must not become one string.
const LONGEST_LINE: u64 = 1 << 20;
/// Descriptions of recordings, calibrations and profiles have kilobytes.
const LARGEST: u64 = 64 << 20;
const UTF16: &str = "UTF-16 text, and only UTF-8 is read: save it as UTF-8";
const NOT_TEXT: &str = "not text (UTF-8)";

/// Whether a character is nothing but room: white space, no-break spaces, byte order marks, and those of no width.
#[must_use]
pub fn is_space(c: char) -> bool {
    c.is_whitespace()
        || matches!(
            c,
            '\u{feff}' | '\u{200b}'..='\u{200d}' | '\u{2060}' | '\u{180e}'
        )
}

/// `text` without what is nothing but room on either side.
#[must_use]
pub fn trim(text: &str) -> &str {
    text.trim_matches(is_space)
}

/// A line of a file with one JSON value per line: without the comma of a list that was cut into lines; `None` for an empty line
/// or a comment.
#[must_use]
pub fn json_line(line: &str) -> Option<&str> {
    let line = trim(line);
    let line = trim(line.strip_suffix(',').unwrap_or(line));
    (!line.is_empty() && !line.starts_with('#') && !line.starts_with("//")).then_some(line)
}

/// YAML whose indentation and separators are spaces: a no-break space that stands where YAML wants a space becomes one. Inside of
/// words it stays.
#[must_use]
pub fn yaml(text: &str) -> Cow<'_, str> {
    if !text.contains(['\u{a0}', '\u{feff}', '\r']) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len());
    let mut separates = true;
    let mut characters = text.chars().peekable();
    while let Some(c) = characters.next() {
        match c {
            '\u{feff}' if separates => continue,
            '\u{a0}' if separates => {
                out.push(' ');
                continue;
            }
            // The line end of the old Mac.
            '\r' if characters.peek() != Some(&'\n') => out.push('\n'),
            c => out.push(c),
        }
        separates = matches!(c, '\n' | '\r' | ':' | '-' | ',' | '[' | '{')
            || (separates && c.is_whitespace());
    }
    Cow::Owned(out)
}

/// A path as text that goes into JSON: as it is where it is UTF-8, with `\\xff` for every byte that is none, so that two paths are
/// two texts.
#[must_use]
pub fn of_path(path: &Path) -> String {
    use std::fmt::Write as _;
    let mut text = String::new();
    for chunk in path.as_os_str().as_encoded_bytes().utf8_chunks() {
        text.push_str(chunk.valid());
        for byte in chunk.invalid() {
            let _ = write!(text, "\\x{byte:02x}");
        }
    }
    text
}

/// Serialises a path by [`of_path`]: a name that is not UTF-8 is no error of the file it is written into.
///
/// # Errors
/// Those of the serialiser.
pub fn serialize_path<S: serde::Serializer>(path: &Path, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&of_path(path))
}

/// As [`serialize_path`], of several.
///
/// # Errors
/// Those of the serialiser.
pub fn serialize_paths<S: serde::Serializer>(paths: &[PathBuf], to: S) -> Result<S::Ok, S::Error> {
    to.collect_seq(paths.iter().map(|path| of_path(path)))
}

/// A whole text file of at most 64 MB, without its byte order mark.
///
/// # Errors
/// When it cannot be read, is no regular file, is larger, or is not UTF-8.
pub fn read(path: &Path) -> Result<String, ReadError> {
    let bytes = super::read_whole(path, LARGEST).map_err(|error| match error {
        FormatError::File { path, source } => match *source {
            FormatError::Io(cause) => ReadError::io(&path, cause),
            source => source.in_file(&path).into(),
        },
        error => error.into(),
    })?;
    decode(bytes).map_err(|reason| ReadError::malformed(path, Position::File, reason))
}

/// A whole JSON file, as [`read`].
///
/// # Errors
/// Also when it is no such JSON; the line is named.
pub fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, ReadError> {
    serde_json::from_str(&read(path)?).map_err(|error| json_error(path, &error))
}

/// What is wrong with a JSON file, and in which line.
#[must_use]
pub fn json_error(path: &Path, error: &serde_json::Error) -> ReadError {
    let place = match error.line() {
        0 => Position::File,
        line => Position::Line(line as u64),
    };
    ReadError::malformed(path, place, error.to_string())
}

/// The text of bytes, without its byte order mark.
///
/// # Errors
/// A sentence that says what the bytes are instead.
pub fn decode(bytes: Vec<u8>) -> Result<String, String> {
    if is_utf16(&bytes) {
        return Err(UTF16.to_owned());
    }
    let mut text = String::from_utf8(bytes).map_err(|error| {
        format!(
            "{NOT_TEXT}: byte {} is no part of a character",
            error.utf8_error().valid_up_to()
        )
    })?;
    if text.starts_with('\u{feff}') {
        text.drain(..'\u{feff}'.len_utf8());
    }
    Ok(text)
}

/// A text file to be streamed, its byte order mark passed over.
///
/// # Errors
/// When it cannot be opened or read.
pub fn open(path: &Path) -> Result<BufReader<File>, ReadError> {
    let fail = |cause| ReadError::io(path, cause);
    let mut reader = BufReader::with_capacity(1 << 16, File::open(path).map_err(fail)?);
    let head = reader.fill_buf().map_err(fail)?;
    if is_utf16(head) {
        return Err(ReadError::malformed(path, Position::Line(1), UTF16));
    }
    if head.starts_with("\u{feff}".as_bytes()) {
        reader.consume('\u{feff}'.len_utf8());
    }
    Ok(reader)
}

/// Whether bytes begin as UTF-16 does: with its mark, or with ASCII between zeros.
fn is_utf16(bytes: &[u8]) -> bool {
    match bytes {
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => true,
        [a, 0, b, 0, ..] | [0, a, 0, b, ..] => a.is_ascii() && b.is_ascii() && *a != 0 && *b != 0,
        _ => false,
    }
}

/// Lines of a text file, each with its number (from 1), with bounded memory. They end with a line feed, a carriage return, or both.
#[derive(Debug)]
pub struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    number: u64,
    longest: u64,
    /// The line before ended with a carriage return: a line feed that follows belongs to it.
    returned: bool,
}

impl Lines {
    /// # Errors
    /// When the file cannot be opened.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        Self::open_longest(path, LONGEST_LINE)
    }

    /// As [`Lines::open`], with another limit on the length of a line.
    ///
    /// # Errors
    /// When the file cannot be opened.
    pub fn open_longest(path: &Path, longest: u64) -> Result<Self, ReadError> {
        let file = File::open(path).map_err(|cause| ReadError::io(path, cause))?;
        Ok(Lines {
            path: path.to_owned(),
            reader: BufReader::new(file),
            number: 0,
            longest,
            returned: false,
        })
    }

    /// The bytes up to the next line end; `None` at the end of the file.
    fn bytes(&mut self) -> Result<Option<Vec<u8>>, ReadError> {
        let mut line = Vec::new();
        let mut started = false;
        loop {
            let buffer = match self.reader.fill_buf() {
                Ok(buffer) => buffer,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
                Err(cause) => return Err(ReadError::io(&self.path, cause)),
            };
            if std::mem::take(&mut self.returned) && buffer.first() == Some(&b'\n') {
                self.reader.consume(1);
                continue;
            }
            if buffer.is_empty() {
                return Ok(started.then_some(line));
            }
            started = true;
            let end = buffer.iter().position(|byte| matches!(byte, b'\n' | b'\r'));
            line.extend_from_slice(&buffer[..end.unwrap_or(buffer.len())]);
            let used = end.map_or(buffer.len(), |end| {
                self.returned = buffer[end] == b'\r';
                end + 1
            });
            self.reader.consume(used);
            if line.len() as u64 >= self.longest {
                return Err(self.wrong("this line never ends"));
            }
            if end.is_some() {
                return Ok(Some(line));
            }
        }
    }

    fn wrong(&self, reason: &str) -> ReadError {
        ReadError::malformed(&self.path, Position::Line(self.number), reason)
    }
}

impl Iterator for Lines {
    type Item = Result<(u64, String), ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.number += 1;
        let bytes = match self.bytes() {
            Ok(bytes) => bytes?,
            Err(error) => return Some(Err(error)),
        };
        if self.number == 1 && is_utf16(&bytes) {
            return Some(Err(self.wrong(UTF16)));
        }
        Some(match String::from_utf8(bytes) {
            Ok(mut line) => {
                // Also within a file: two of them were put together.
                if line.starts_with('\u{feff}') {
                    line.drain(..'\u{feff}'.len_utf8());
                }
                Ok((self.number, line))
            }
            Err(_) => Err(self.wrong(NOT_TEXT)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn lines(bytes: &[u8]) -> Result<Vec<String>, String> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        Lines::open(file.path())
            .unwrap()
            .map(|line| line.map(|(_, text)| text).map_err(|e| e.to_string()))
            .collect()
    }

    #[test]
    fn lines_end_as_on_any_machine() {
        let expected = ["a", "", "b", "c"].map(str::to_owned).to_vec();
        for text in [
            "a\n\nb\nc\n",
            "a\r\n\r\nb\r\nc",
            "a\r\rb\rc\r",
            "\u{feff}a\n\n\u{feff}b\r\nc",
        ] {
            assert_eq!(lines(text.as_bytes()).unwrap(), expected, "{text:?}");
        }
        // A line end that lies across two buffers.
        let long = format!("{}\r\nb\r\n", "x".repeat(8191));
        assert_eq!(lines(long.as_bytes()).unwrap()[1..], ["b"]);
        assert!(lines(b"").unwrap().is_empty());
    }

    #[test]
    fn utf_16_is_named() {
        for text in [
            &b"\xff\xfea\0,\0b\0\n\0"[..],
            b"\xfe\xff\0a\0,\0b",
            b"a\0,\0b\0",
            b"\x10\0\x10\0",
        ] {
            assert!(lines(text).unwrap_err().contains("UTF-16"), "{text:?}");
            assert!(decode(text.to_vec()).unwrap_err().contains("UTF-16"));
        }
        assert!(decode(b"a\xa0b".to_vec()).unwrap_err().contains("byte 1"));
        assert_eq!(decode(b"\xef\xbb\xbfa".to_vec()).unwrap(), "a");
    }

    #[test]
    fn no_break_spaces_are_spaces_where_yaml_wants_one() {
        let text = "\u{feff}a:\n\u{a0} b:\u{a0}1\r\n  c: two\u{a0}words\n";
        assert_eq!(yaml(text), "a:\n  b: 1\r\n  c: two\u{a0}words\n");
        assert_eq!(yaml("a: 1\rb: 2\r"), "a: 1\nb: 2\n");
        assert!(matches!(yaml("a: 1\n"), Cow::Borrowed(_)));
    }

    #[cfg(unix)]
    #[test]
    fn paths_that_are_not_text_are_told_apart() {
        use std::os::unix::ffi::OsStrExt;
        let text = |bytes| of_path(Path::new(std::ffi::OsStr::from_bytes(bytes)));
        assert_eq!(text(b"a/v\xff.mp4"), "a/v\\xff.mp4");
        assert_eq!(text("a/\u{e9}.mp4".as_bytes()), "a/\u{e9}.mp4");
        assert_ne!(text(b"v\xfe"), text(b"v\xff"));
    }

    #[test]
    fn a_line_of_json_may_be_one_of_a_list() {
        assert_eq!(json_line("\u{a0}{\"a\": 1},\u{feff}"), Some("{\"a\": 1}"));
        for nothing in ["", " \u{a0}", "# a comment", "// another"] {
            assert_eq!(json_line(nothing), None);
        }
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..100)) {
            let _ = lines(&bytes);
            if let Ok(text) = decode(bytes) {
                let _ = yaml(&text);
            }
        }
    }
}
