//! Tables in text: columns by name, numbers with the line they stand in, one row in memory at a time.

use super::ReadError;
use crate::formats::read_error::Position;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

/// No table that is read here has longer lines; a file without line ends must not become one string.
const LONGEST_LINE: u64 = 1 << 20;

/// Lines of a text file, each with its number (from 1), with bounded memory.
#[derive(Debug)]
pub struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    number: u64,
    longest: u64,
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
        })
    }
}

impl Iterator for Lines {
    type Item = Result<(u64, String), ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut bytes = Vec::new();
        let read = (&mut self.reader)
            .take(self.longest)
            .read_until(b'\n', &mut bytes);
        self.number += 1;
        match read {
            Err(cause) => Some(Err(ReadError::io(&self.path, cause))),
            Ok(0) => None,
            Ok(read) if read as u64 == self.longest => Some(Err(ReadError::malformed(
                &self.path,
                Position::Line(self.number),
                "this line never ends",
            ))),
            Ok(_) => {
                while bytes
                    .last()
                    .is_some_and(|byte| matches!(byte, b'\n' | b'\r'))
                {
                    bytes.pop();
                }
                Some(
                    String::from_utf8(bytes)
                        .map(|line| (self.number, line))
                        .map_err(|_| {
                            ReadError::malformed(
                                &self.path,
                                Position::Line(self.number),
                                "not text (UTF-8)",
                            )
                        }),
                )
            }
        }
    }
}

/// A table with a header line.
#[derive(Debug)]
pub struct Table {
    lines: Lines,
    names: Vec<String>,
}

/// A column that was found in the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Column(usize);

impl Table {
    /// Reads the header.
    ///
    /// # Errors
    /// When the file cannot be read or is empty.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let mut lines = Lines::open(path)?;
        let (_, header) = lines
            .next()
            .ok_or_else(|| ReadError::malformed(path, Position::Line(1), "the file is empty"))??;
        let names = header
            .trim_start_matches('\u{feff}')
            .split(',')
            .map(|name| name.trim().trim_matches('"').to_owned())
            .collect();
        Ok(Table { lines, names })
    }

    /// The column of this name.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<Column> {
        self.names
            .iter()
            .position(|known| known == name)
            .map(Column)
    }

    /// The column of this name, which has to be there.
    ///
    /// # Errors
    /// When it is not.
    pub fn column(&self, name: &str) -> Result<Column, ReadError> {
        self.find(name).ok_or_else(|| {
            ReadError::malformed(
                &self.lines.path,
                Position::Line(1),
                format!("there is no column `{name}`"),
            )
        })
    }

    /// Several columns of a pattern: `{}` in `pattern` stands for each of `parts`.
    ///
    /// # Errors
    /// When one of them is missing.
    pub fn columns<const N: usize>(
        &self,
        pattern: &str,
        parts: [&str; N],
    ) -> Result<[Column; N], ReadError> {
        let mut found = [Column(0); N];
        for (slot, part) in found.iter_mut().zip(parts) {
            *slot = self.column(&pattern.replace("{}", part))?;
        }
        Ok(found)
    }

    /// The next row; empty lines are passed over.
    pub fn next_row(&mut self) -> Option<Result<Row, ReadError>> {
        loop {
            match self.lines.next()? {
                Ok((_, line)) if line.trim().is_empty() => {}
                Ok((number, text)) => {
                    let found = text.split(',').count();
                    if found != self.names.len() {
                        return Some(Err(ReadError::malformed(
                            &self.lines.path,
                            Position::Line(number),
                            format!("{found} columns instead of {}", self.names.len()),
                        )));
                    }
                    return Some(Ok(Row {
                        path: self.lines.path.clone(),
                        number,
                        text,
                    }));
                }
                Err(error) => return Some(Err(error)),
            }
        }
    }
}

/// One row of a [`Table`].
#[derive(Debug, Clone)]
pub struct Row {
    path: PathBuf,
    number: u64,
    text: String,
}

impl Row {
    /// The text of a cell.
    #[must_use]
    pub fn text(&self, column: Column) -> &str {
        self.text
            .split(',')
            .nth(column.0)
            .unwrap_or("")
            .trim()
            .trim_matches('"')
    }

    /// A number; empty cells and `nan` are NaN.
    ///
    /// # Errors
    /// When the cell holds something else.
    pub fn number(&self, column: Column) -> Result<f64, ReadError> {
        let text = self.text(column);
        if text.is_empty() {
            return Ok(f64::NAN);
        }
        text.parse().map_err(|_| self.wrong(text, "a number"))
    }

    /// A whole number.
    ///
    /// # Errors
    /// When the cell holds something else.
    pub fn integer(&self, column: Column) -> Result<i64, ReadError> {
        let text = self.text(column);
        text.parse().map_err(|_| self.wrong(text, "a whole number"))
    }

    /// Several numbers at once.
    ///
    /// # Errors
    /// When one of the cells is no number.
    pub fn numbers<const N: usize>(&self, columns: [Column; N]) -> Result<[f64; N], ReadError> {
        let mut values = [0.0; N];
        for (value, column) in values.iter_mut().zip(columns) {
            *value = self.number(column)?;
        }
        Ok(values)
    }

    fn wrong(&self, found: &str, wanted: &str) -> ReadError {
        let found: String = found.chars().take(40).collect();
        self.error(format!("`{found}` is not {wanted}"))
    }

    /// An error in this row.
    #[must_use]
    pub fn error(&self, reason: String) -> ReadError {
        ReadError::malformed(&self.path, Position::Line(self.number), reason)
    }
}
