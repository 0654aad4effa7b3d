//! Tables in text: columns by name, numbers with the line they stand in, one row in memory at a time.
//!
//! Cells are separated by commas, semicolons or tabs, whichever the header has most of, and may stand in quotes. Empty lines and
//! lines that start with `#` are passed over; a header may be such a line, where numbers follow it.

use super::ReadError;
use crate::formats::read_error::Position;
use crate::formats::text::trim;
use std::ops::Range;
use std::path::{Path, PathBuf};

pub use crate::formats::text::Lines;

/// A table with a header line.
#[derive(Debug)]
pub struct Table {
    lines: Lines,
    path: PathBuf,
    names: Vec<String>,
    delimiter: u8,
    /// The first row, where it had to be read to recognise the header.
    first: Option<(u64, String)>,
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
        let mut comment = None;
        let (number, line) = loop {
            let Some(line) = lines.next() else {
                return Err(ReadError::malformed(
                    path,
                    Position::Line(1),
                    "the file is empty",
                ));
            };
            let (number, line) = line?;
            match trim(&line).strip_prefix('#') {
                Some(text) => comment = Some(text.to_owned()),
                None if trim(&line).is_empty() => {}
                None => break (number, line),
            }
        };
        let starts_with_a_number = || {
            let cell = line.split([',', ';', '\t']).next().unwrap_or("");
            trim(cell).parse::<f64>().is_ok()
        };
        let (header, first) = match comment {
            Some(comment) if starts_with_a_number() => (comment, Some((number, line))),
            _ => (line, None),
        };
        let count = |delimiter: &u8| header.bytes().filter(|byte| byte == delimiter).count();
        // The comma where there is none of them.
        let delimiter = [b'\t', b';', b',']
            .into_iter()
            .max_by_key(count)
            .unwrap_or(b',');
        let mut names: Vec<String> = cells(&header, delimiter)
            .into_iter()
            .map(|cell| trim(&header[cell]).to_owned())
            .collect();
        while names.pop_if(|name| name.is_empty()).is_some() {}
        Ok(Table {
            lines,
            path: path.to_owned(),
            names,
            delimiter,
            first,
        })
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
    /// When it is not, or there are two.
    pub fn column(&self, name: &str) -> Result<Column, ReadError> {
        let wrong = |reason| ReadError::malformed(&self.path, Position::Line(1), reason);
        if self.names.iter().filter(|known| *known == name).count() > 1 {
            return Err(wrong(format!("there are two columns `{name}`")));
        }
        self.find(name)
            .ok_or_else(|| wrong(format!("there is no column `{name}`")))
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

    /// [`Table::columns`] of the first of several patterns that the table has any column of; `None` where it has none at all.
    ///
    /// # Errors
    /// When it has some columns of that pattern, but not all.
    pub fn columns_of_any<const N: usize>(
        &self,
        patterns: &[&str],
        parts: [&str; N],
    ) -> Result<Option<[Column; N]>, ReadError> {
        let has = |pattern: &&&str| {
            let name = |part: &str| pattern.replace("{}", part);
            parts.iter().any(|part| self.find(&name(part)).is_some())
        };
        match patterns.iter().find(has) {
            Some(pattern) => self.columns(pattern, parts).map(Some),
            None => Ok(None),
        }
    }

    /// The names of all columns.
    #[must_use]
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The next row; empty lines and comments are passed over.
    pub fn next_row(&mut self) -> Option<Result<Row, ReadError>> {
        loop {
            let (number, text) = match self.first.take().map(Ok).or_else(|| self.lines.next())? {
                Ok(line) => line,
                Err(error) => return Some(Err(error)),
            };
            if trim(&text).is_empty() || trim(&text).starts_with('#') {
                continue;
            }
            let mut cells = cells(&text, self.delimiter);
            // A comma at the end of every line makes no column.
            while cells.len() > self.names.len()
                && cells
                    .pop_if(|cell| trim(&text[cell.clone()]).is_empty())
                    .is_some()
            {}
            if cells.len() != self.names.len() {
                return Some(Err(ReadError::malformed(
                    &self.path,
                    Position::Line(number),
                    format!("{} columns instead of {}", cells.len(), self.names.len()),
                )));
            }
            return Some(Ok(Row {
                path: self.path.clone(),
                number,
                text,
                cells,
            }));
        }
    }
}

/// Where the cells of a line lie, without the quotes around them.
fn cells(line: &str, delimiter: u8) -> Vec<Range<usize>> {
    let mut cells = Vec::new();
    let (mut start, mut quoted) = (0, false);
    let mut push = |mut cell: Range<usize>| {
        let text = &line[cell.clone()];
        cell.start += text.len()
            - text
                .trim_start_matches(crate::formats::text::is_space)
                .len();
        cell.end = cell.start + trim(text).len();
        if cell.len() >= 2
            && line[cell.clone()].starts_with('"')
            && line[cell.clone()].ends_with('"')
        {
            cell = cell.start + 1..cell.end - 1;
        }
        cells.push(cell);
    };
    for (at, byte) in line.bytes().enumerate() {
        if byte == b'"' {
            quoted = !quoted;
        } else if byte == delimiter && !quoted {
            push(start..at);
            start = at + 1;
        }
    }
    push(start..line.len());
    cells
}

/// One row of a [`Table`].
#[derive(Debug, Clone)]
pub struct Row {
    path: PathBuf,
    number: u64,
    text: String,
    cells: Vec<Range<usize>>,
}

impl Row {
    /// The text of a cell.
    #[must_use]
    pub fn text(&self, column: Column) -> &str {
        self.cells
            .get(column.0)
            .map_or("", |cell| trim(&self.text[cell.clone()]))
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

    /// A whole number, also where a spreadsheet wrote it as `12.0` or `1.2e1`.
    ///
    /// # Errors
    /// When the cell holds something else.
    pub fn integer(&self, column: Column) -> Result<i64, ReadError> {
        /// Up to here every whole number is a double.
        const EXACT: f64 = 9_007_199_254_740_992.0;
        let text = self.text(column);
        if let Ok(number) = text.parse() {
            return Ok(number);
        }
        match text.parse::<f64>() {
            Ok(number) if number.fract() == 0.0 && number.abs() < EXACT => Ok(number as i64),
            _ => Err(self.wrong(text, "a whole number")),
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// All rows of two columns, `t` and `x`, of a file.
    fn rows(text: &str) -> Result<Vec<(i64, f64)>, String> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        let read = || -> Result<_, ReadError> {
            let mut table = Table::open(file.path())?;
            let (t, x) = (table.column("t")?, table.column("x")?);
            let mut rows = Vec::new();
            while let Some(row) = table.next_row() {
                let row = row?;
                rows.push((row.integer(t)?, row.number(x)?));
            }
            Ok(rows)
        };
        read().map_err(|error| error.to_string())
    }

    #[test]
    fn a_table_is_the_same_however_an_editor_saved_it() {
        for text in [
            "t,x\n1,0.5\n2,-3\n",
            "\u{feff}t,x\r\n1,0.5\r\n\r\n2,-3\r\n",
            "t,x\r1,0.5\r2,-3\r",
            "\u{a0}t , x\u{a0}\n1\u{a0},\u{a0}0.5\n2,-3\u{200b}\n",
            "t,x,\n1,0.5,\n2,-3,\n",
            "t,x\n1,0.5,,\n2,-3,\n",
            "# made by hand\nt,x\n1,0.5\n# a comment\n2,-3\n",
            "#t,x\n1,0.5\n2,-3\n",
            "\"t\",\"x\"\n\"1\",\"0.5\"\n2.0,-3\n",
            "t;x\n1;0.5\n2;-3\n",
            "name\tt\tx\n\"a\tb\"\t1\t0.5\nc\t2\t-3\n",
        ] {
            assert_eq!(rows(text).unwrap(), [(1, 0.5), (2, -3.0)], "{text:?}");
        }
        assert!(rows("t,x\n1,\n").unwrap()[0].1.is_nan());
    }

    #[test]
    fn what_is_wrong_with_a_table_is_said_with_its_line() {
        for (text, reason) in [
            ("", "empty"),
            ("\n# nothing\n", "empty"),
            ("t\n1\n", "no column `x`"),
            ("t,x,x\n1,2,3\n", "two columns `x`"),
            ("t,x\n1,2\n3\n", "line 3: 1 columns instead of 2"),
            ("t,x\n1,2,3\n", "line 2: 3 columns instead of 2"),
            ("t;x\n1;0,5\n", "line 2: `0,5` is not a number"),
            ("t,x\n1.5,2\n", "line 2: `1.5` is not a whole number"),
        ] {
            let error = rows(text).unwrap_err();
            assert!(error.contains(reason), "{text:?}: {error}");
        }
    }

    #[test]
    fn a_pattern_of_columns_is_there_completely_or_not_at_all() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let found = |header: &str| {
            std::fs::write(file.path(), header).unwrap();
            let table = Table::open(file.path()).unwrap();
            let found = table.columns_of_any(&["g_{}_w", "g_{}"], ["x", "y", "z"]);
            found.map_err(|error| error.to_string())
        };
        assert_eq!(found("a,b\n").unwrap(), None);
        assert_eq!(found("g_x,g_y,g_z\n").unwrap(), Some([0, 1, 2].map(Column)));
        assert_eq!(
            found("g_z_w,g_y_w,g_x_w,g_x\n").unwrap(),
            Some([2, 1, 0].map(Column))
        );
        let error = found("g_x,g_z\n").unwrap_err();
        assert!(error.contains("no column `g_y`"), "{error}");
    }

    proptest! {
        #[test]
        fn no_text_makes_it_panic(text in "[tx,;\t\"#0-9.\u{a0}\u{feff}\r\n-]{0,60}") {
            let _ = rows(&text);
        }
    }
}
