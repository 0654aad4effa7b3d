//! When the frames of a take were captured: rows of the capture's `timesync.csv`.

use crate::datasets::csv::Table;
use crate::formats::ReadError;
use std::ops::Range;
use std::path::Path;

/// The times of the rows `rows` and of the next one, of the colour camera, nanoseconds of the glasses' clock; `None` where the cell is
/// empty: the camera had not started.
pub(super) fn read(
    path: &Path,
    camera: &str,
    rows: &Range<u64>,
) -> Result<Vec<Option<i64>>, ReadError> {
    let mut table = Table::open(path)?;
    let column = table.column(&format!("{camera}_214-1_capture_timestamp_ns"))?;
    let mut times = Vec::new();
    let mut last = i64::MIN;
    let mut number = 0;
    // One row more than the exclusive end: some takes count it in.
    while number <= rows.end
        && let Some(row) = table.next_row()
    {
        let row = row?;
        if number >= rows.start {
            let text = row.text(column);
            // A column with empty cells is written as floats.
            let whole = text.strip_suffix(".0").unwrap_or(text);
            let time = match whole.parse::<i64>() {
                Ok(time) => Some(time),
                Err(_) if text.is_empty() || text.eq_ignore_ascii_case("nan") => None,
                Err(_) => return Err(row.error(format!("`{}` is no time", short(text)))),
            };
            if let Some(time) = time {
                if time <= last || time.unsigned_abs() > super::LATEST.unsigned_abs() {
                    return Err(
                        row.error(format!("time {time} is not after that of the row before"))
                    );
                }
                last = time;
            }
            times.push(time);
        }
        number += 1;
    }
    Ok(times)
}

/// How many rows a take has, its exclusive end left out.
pub(super) fn rows_of(rows: &Range<u64>) -> usize {
    usize::try_from(rows.end - rows.start).unwrap_or(usize::MAX)
}

fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

/// The frames of a video with their times.
#[derive(Debug, Default, PartialEq)]
pub(super) struct FrameRows {
    pub times: Vec<i64>,
    /// Which frames of the video these are.
    pub indices: Vec<usize>,
    pub note: Option<&'static str>,
}

/// Gives `frames` frames of a video the times of their rows. The official tutorials begin at the row after the first and end before
/// the last; takes whose video has one frame more begin at the first row: how many frames there are decides.
pub(super) fn frames(frames: usize, rows: &Range<u64>, times: &[Option<i64>]) -> FrameRows {
    let between = rows_of(rows);
    let (first, note) = if frames >= between {
        let note = (frames > between)
            .then_some("the video has more frames than the take has rows in `timesync.csv`: its end has no pictures");
        (0, note)
    } else {
        let note = (frames + 1 < between)
            .then_some("the video has fewer frames than the take has rows in `timesync.csv`");
        (1, note)
    };
    let known: Vec<(usize, i64)> = (0..frames.min(between))
        .filter_map(|frame| Some((frame, (*times.get(first + frame)?)?)))
        .collect();
    FrameRows {
        times: known.iter().map(|(_, time)| *time).collect(),
        indices: known.iter().map(|(frame, _)| *frame).collect(),
        note,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_number_of_frames_decides_where_a_take_begins() {
        // Rows 10 to 14, both ends as written.
        let times: Vec<Option<i64>> = (0..5).map(|k| (k != 2).then_some(100 * k)).collect();
        let begin = |count| frames(count, &(10..14), &times);
        assert_eq!(begin(3).times, [100, 300]);
        assert_eq!(begin(3).indices, [0, 2]);
        assert_eq!(begin(3).note, None);
        assert_eq!(begin(4).times, [0, 100, 300]);
        assert_eq!(begin(4).indices, [0, 1, 3]);
        assert!(begin(2).note.is_some() && begin(2).indices == [0]);
        assert!(begin(6).note.is_some() && begin(6).times == [0, 100, 300]);
    }
}
