//! Lines of numbers between tabs, without a header.

use crate::datasets::csv::Lines;
use crate::datasets::track::SECOND;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use std::path::{Path, PathBuf};

/// The shared clock of all tables, Hz.
const CLOCK: f64 = 30.0;
/// A time this near to one of the clock's is that one (seconds): some exports round.
const SNAP: f64 = 5e-6;
/// No session lasts longer (seconds).
const LONGEST: f64 = 1e6;

/// One line, cut at its tabs.
pub(super) struct Row<'a> {
    path: &'a Path,
    number: u64,
    fields: Vec<&'a str>,
}

impl Row<'_> {
    pub fn len(&self) -> usize {
        self.fields.len()
    }

    /// A number; `NaN` where the stream had none.
    pub fn number(&self, column: usize) -> Result<f64, ReadError> {
        let text = self.text(column)?;
        match text {
            // As .NET and C write what is no number.
            "\u{221e}" | "-\u{221e}" | "-nan(ind)" | "-nan" => Ok(f64::NAN),
            text => text
                .parse()
                .map_err(|_| self.error(format!("`{}` is not a number", short(text)))),
        }
    }

    pub fn numbers<const N: usize>(&self, first: usize) -> Result<[f64; N], ReadError> {
        let mut values = [0.0; N];
        for (k, value) in values.iter_mut().enumerate() {
            *value = self.number(first + k)?;
        }
        Ok(values)
    }

    /// A tick: too large for a float.
    pub fn tick(&self, column: usize) -> Result<i64, ReadError> {
        let text = self.text(column)?;
        text.parse()
            .map_err(|_| self.error(format!("`{}` is not a whole number of ticks", short(text))))
    }

    /// A truth value: a number, or .NET's words.
    pub fn flag(&self, column: usize) -> Result<bool, ReadError> {
        match self.text(column)? {
            "True" | "true" => Ok(true),
            "False" | "false" => Ok(false),
            _ => Ok(self.number(column)? != 0.0),
        }
    }

    /// Column 0, the time on the shared clock, in nanoseconds.
    pub fn time(&self) -> Result<i64, ReadError> {
        let seconds = self.number(0)?;
        if !(seconds.is_finite() && seconds.abs() < LONGEST) {
            return Err(self.error(format!("`{seconds}` is no time in seconds")));
        }
        let on_clock = (seconds * CLOCK).round() / CLOCK;
        let seconds = if (seconds - on_clock).abs() < SNAP {
            on_clock
        } else {
            seconds
        };
        Ok((seconds * SECOND as f64).round() as i64)
    }

    fn text(&self, column: usize) -> Result<&str, ReadError> {
        self.fields.get(column).copied().ok_or_else(|| {
            self.error(format!(
                "{} columns, and column {column} is needed",
                self.fields.len()
            ))
        })
    }

    /// An error in this line.
    pub fn error(&self, reason: String) -> ReadError {
        ReadError::malformed(self.path, Position::Line(self.number), reason)
    }
}

fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

/// Hands each line that is not empty to `each`, with its place in time; all lines must have as many columns as the first, and times must
/// ascend.
///
/// # Errors
/// When the file cannot be read, has no line, or `each` fails.
pub(super) fn each_row(
    path: &Path,
    columns: &dyn Fn(usize) -> bool,
    mut each: impl FnMut(i64, &Row<'_>) -> Result<(), ReadError>,
) -> Result<(), ReadError> {
    let mut before: Option<(i64, usize)> = None;
    each_line(path, |row| {
        let time = row.time()?;
        if let Some((last, count)) = before {
            if row.len() != count {
                return Err(row.error(format!("{} columns instead of {count}", row.len())));
            }
            if time <= last {
                return Err(row.error("its time is not after that of the row before".to_owned()));
            }
        } else if !columns(row.len()) {
            return Err(row.error(format!(
                "{} columns, which no table of this kind has",
                row.len()
            )));
        }
        before = Some((time, row.len()));
        each(time, row)
    })?;
    if before.is_none() {
        return Err(ReadError::malformed(
            path,
            Position::Line(1),
            "the file is empty",
        ));
    }
    Ok(())
}

/// Hands each line that is not empty to `each`.
pub(super) fn each_line(
    path: &Path,
    mut each: impl FnMut(&Row<'_>) -> Result<(), ReadError>,
) -> Result<(), ReadError> {
    let own: PathBuf = path.to_owned();
    for line in Lines::open(path)? {
        let (number, text) = line?;
        let text = text.trim_start_matches('\u{feff}').trim_end();
        if text.is_empty() {
            continue;
        }
        each(&Row {
            path: &own,
            number,
            fields: text.split('\t').map(str::trim).collect(),
        })?;
    }
    Ok(())
}
