//! The metrics of one stage: `metrics.jsonl` (a line per recorded step) and a TensorBoard event file beside it.
//!
//! Both are buffered and reach the disk about once a second, at every checkpoint and at the end; a kill loses the last
//! second at most. A resumed stage records the steps after its checkpoint again: what was recorded for them is dropped.

use super::environment::{self, Stopwatch};
use super::error::{AtPath, RunError};
use super::tensorboard::{EventWriter, SessionStatus};
use serde_json::Value;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufRead, BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The name of the line file.
pub const METRICS: &str = "metrics.jsonl";

/// Records one stage. Files appear with the first record, so a stage without metrics leaves none.
#[derive(Debug)]
pub struct Metrics {
    directory: PathBuf,
    open: Option<Open>,
    /// The last step in the files, or in the part of them that still counts.
    last_step: Option<u64>,
    /// Whether a process before this one has recorded something here.
    resumed: bool,
    hparams: Vec<(String, Value)>,
    line: String,
}

#[derive(Debug)]
struct Open {
    lines: BufWriter<File>,
    events: EventWriter<BufWriter<File>>,
    flushed: Stopwatch,
}

const FLUSH_AFTER: Duration = Duration::from_secs(1);

impl Metrics {
    /// Continues the metrics in `directory`, or begins them. `hparams` are shown in TensorBoard's table of runs.
    pub fn open(directory: &Path, hparams: Vec<(String, Value)>) -> Result<Self, RunError> {
        let last_step = keep_whole_lines(&directory.join(METRICS))?;
        Ok(Self {
            directory: directory.to_path_buf(),
            open: None,
            last_step,
            resumed: last_step.is_some(),
            hparams,
            line: String::new(),
        })
    }

    /// The last step recorded.
    pub fn last_step(&self) -> Option<u64> {
        self.last_step
    }

    /// Records scalars of a step. A step before the last one (for the first record of a resumed stage: also the last one)
    /// drops that step and all after it first.
    pub fn scalars(&mut self, step: u64, scalars: &[(&str, f64)]) -> Result<(), RunError> {
        let time = environment::now();
        self.line.clear();
        let _ = write!(self.line, "{{\"step\":{step},\"time\":{time:.3}");
        for (name, value) in scalars {
            let _ = write!(self.line, ",{}", Value::from(*name));
            if value.is_finite() {
                let _ = write!(self.line, ":{value:?}");
            } else {
                // JSON has no NaN and no infinity; a reader must still see that there was one.
                let _ = write!(self.line, ":\"{value}\"");
            }
        }
        self.line.push_str("}\n");
        let line = std::mem::take(&mut self.line);
        let result = self.write(step, |open| {
            open.lines.write_all(line.as_bytes())?;
            open.events.scalars(time, step, scalars)
        });
        self.line = line;
        result
    }

    /// Records markdown text of a step, in TensorBoard only.
    pub fn text(&mut self, step: u64, name: &str, text: &str) -> Result<(), RunError> {
        let time = environment::now();
        self.write(step, |open| open.events.text(time, step, name, text))
    }

    /// Records a distribution, in TensorBoard only.
    pub fn histogram(&mut self, step: u64, name: &str, values: &[f32]) -> Result<(), RunError> {
        let time = environment::now();
        self.write(step, |open| open.events.histogram(time, step, name, values))
    }

    /// Brings everything to the disk.
    pub fn flush(&mut self) -> Result<(), RunError> {
        let Some(open) = &mut self.open else {
            return Ok(());
        };
        let flush = open.lines.flush().and_then(|()| open.events.flush());
        open.flushed = Stopwatch::start();
        flush.at("writing", &self.directory.join(METRICS))
    }

    /// Ends the session.
    pub fn finish(mut self, status: SessionStatus) -> Result<(), RunError> {
        let end = match &mut self.open {
            Some(open) => open.events.session_end(environment::now(), status),
            None => Ok(()),
        };
        end.at("writing", &self.directory)?;
        self.flush()?;
        match &self.open {
            Some(open) => open
                .lines
                .get_ref()
                .sync_all()
                .at("writing", &self.directory.join(METRICS)),
            None => Ok(()),
        }
    }

    fn write(
        &mut self,
        step: u64,
        put: impl FnOnce(&mut Open) -> std::io::Result<()>,
    ) -> Result<(), RunError> {
        self.ready(step)?;
        let Some(open) = &mut self.open else {
            return Ok(());
        };
        put(open).at("writing", &self.directory.join(METRICS))?;
        if open.flushed.elapsed() >= FLUSH_AFTER {
            self.flush()?;
        }
        Ok(())
    }

    /// Opens the files, and goes back to before `step` where a resumed stage does a step again.
    fn ready(&mut self, step: u64) -> Result<(), RunError> {
        let first_of_process = self.open.is_none();
        let back = self.last_step.is_some_and(|last| {
            if first_of_process {
                step <= last
            } else {
                step < last
            }
        });
        if back {
            self.flush()?;
            self.open = None;
            drop_from(&self.directory.join(METRICS), step)?;
        }
        if self.open.is_none() {
            self.open = Some(self.open_files(step)?);
        }
        self.last_step = Some(step);
        Ok(())
    }

    fn open_files(&self, step: u64) -> Result<Open, RunError> {
        let path = self.directory.join(METRICS);
        let lines = File::options()
            .create(true)
            .append(true)
            .open(&path)
            .at("writing", &path)?;
        let time = environment::now();
        // Readers take the files of a directory in the order of their names: several in one second need a counter.
        let host = environment::host();
        let pid = environment::pid();
        let mut number = 0;
        let (path, file) = loop {
            let name = format!(
                "events.out.tfevents.{:010}.{host}.{pid}.{number}",
                time as u64
            );
            let path = self.directory.join(name);
            match File::options().create_new(true).append(true).open(&path) {
                Ok(file) => break (path, file),
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => number += 1,
                Err(error) => return Err(error).at("writing", &path),
            }
        };
        let begin = || {
            let mut events = EventWriter::new(BufWriter::new(file), time)?;
            if self.resumed || self.last_step.is_some() {
                events.rewind(time, step)?;
            }
            if !self.hparams.is_empty() {
                events.hparams(time, "", &self.hparams, &[])?;
            }
            Ok(events)
        };
        Ok(Open {
            lines: BufWriter::new(lines),
            events: begin().at("writing", &path)?,
            flushed: Stopwatch::start(),
        })
    }
}

/// The step of a line, if the line is whole.
fn step_of(line: &str) -> Option<u64> {
    let value: Value = serde_json::from_str(line).ok()?;
    value.get("step")?.as_u64()
}

/// Cuts off a last line that a kill left half written, and gives the last step.
fn keep_whole_lines(path: &Path) -> Result<Option<u64>, RunError> {
    cut_where(path, |_| false)
}

/// Cuts off the first line of `step` or later, and all after it.
fn drop_from(path: &Path, step: u64) -> Result<(), RunError> {
    cut_where(path, |seen| seen >= step).map(|_| ())
}

fn cut_where(path: &Path, cut: impl Fn(u64) -> bool) -> Result<Option<u64>, RunError> {
    match std::fs::metadata(path) {
        Ok(meta) if meta.is_file() => {}
        // A device or a pipe in its place has nothing to read back.
        Ok(_) => return Ok(None),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error).at("reading", path),
    }
    let file = File::options()
        .read(true)
        .write(true)
        .open(path)
        .at("reading", path)?;
    let mut reader = BufReader::new(&file);
    let (mut kept, mut last) = (0, None);
    let mut line = Vec::new();
    loop {
        line.clear();
        let read = reader.read_until(b'\n', &mut line).at("reading", path)?;
        let whole = std::str::from_utf8(&line)
            .ok()
            .filter(|text| text.ends_with('\n'));
        match whole.and_then(step_of) {
            Some(step) if !cut(step) => {
                kept += read as u64;
                last = Some(step);
            }
            _ => break,
        }
    }
    file.set_len(kept).at("writing", path)?;
    Ok(last)
}

/// One line of `metrics.jsonl`, read back.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// The step that was recorded, as the op counts.
    pub step: u64,
    /// When it was recorded, in seconds since 1970; 0 where the line does not say.
    pub time: f64,
    /// Name and value, in the order of the line; NaN and infinities are read back.
    pub scalars: Vec<(String, f64)>,
}

/// Reads the metrics of a stage; half a line at the end is left out.
pub fn read(directory: &Path) -> Result<Vec<Row>, RunError> {
    let path = directory.join(METRICS);
    let file = match File::open(&path) {
        Ok(file) if file.metadata().is_ok_and(|meta| meta.is_file()) => file,
        Ok(_) => return Ok(Vec::new()),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(error).at("reading", &path),
    };
    let mut rows = Vec::new();
    for line in BufReader::new(file).split(b'\n') {
        let line = line.at("reading", &path)?;
        let Ok(Value::Object(map)) = serde_json::from_slice(&line) else {
            break;
        };
        let Some(step) = map.get("step").and_then(Value::as_u64) else {
            break;
        };
        let time = map.get("time").and_then(Value::as_f64).unwrap_or(0.0);
        let scalars = map
            .iter()
            .filter(|(name, _)| *name != "step" && *name != "time");
        let scalars = scalars.filter_map(|(name, value)| {
            let number = value.as_f64().or_else(|| value.as_str()?.parse().ok())?;
            Some((name.clone(), number))
        });
        rows.push(Row {
            step,
            time,
            scalars: scalars.collect(),
        });
    }
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps(directory: &Path) -> Vec<u64> {
        read(directory)
            .unwrap()
            .iter()
            .map(|row| row.step)
            .collect()
    }

    #[test]
    fn what_is_recorded_is_read_back_with_every_bit_and_without_losing_nan() {
        let dir = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::open(dir.path(), Vec::new()).unwrap();
        metrics
            .scalars(1, &[("loss", 0.1 + 0.2), ("a \"quoted\\name\"\n", -0.0)])
            .unwrap();
        metrics
            .scalars(2, &[("loss", f64::NAN), ("grad", f64::NEG_INFINITY)])
            .unwrap();
        metrics.finish(SessionStatus::Success).unwrap();
        let rows = read(dir.path()).unwrap();
        assert_eq!(rows[0].scalars[0], ("loss".into(), 0.1 + 0.2));
        assert_eq!(rows[0].scalars[1].0, "a \"quoted\\name\"\n");
        assert!(rows[1].scalars[0].1.is_nan());
        assert_eq!(rows[1].scalars[1].1, f64::NEG_INFINITY);
    }

    #[test]
    fn a_resumed_stage_replaces_the_steps_after_its_checkpoint() {
        let dir = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::open(dir.path(), Vec::new()).unwrap();
        for step in 1..=10 {
            metrics.scalars(step, &[("loss", step as f64)]).unwrap();
        }
        drop(metrics);
        let mut metrics = Metrics::open(dir.path(), Vec::new()).unwrap();
        assert_eq!(metrics.last_step(), Some(10));
        for step in 6..=12 {
            metrics.scalars(step, &[("loss", -(step as f64))]).unwrap();
        }
        metrics.finish(SessionStatus::Success).unwrap();
        assert_eq!(steps(dir.path()), (1..=12).collect::<Vec<_>>());
        assert_eq!(read(dir.path()).unwrap()[5].scalars[0].1, -6.0);
    }

    #[test]
    fn several_records_of_one_step_all_stay() {
        let dir = tempfile::tempdir().unwrap();
        let mut metrics = Metrics::open(dir.path(), Vec::new()).unwrap();
        metrics.scalars(1, &[("loss", 1.0)]).unwrap();
        metrics.histogram(1, "weights", &[1.0, 2.0]).unwrap();
        metrics.scalars(1, &[("validation", 2.0)]).unwrap();
        metrics.finish(SessionStatus::Success).unwrap();
        assert_eq!(steps(dir.path()), [1, 1]);
    }

    #[test]
    fn a_line_that_a_kill_cut_short_is_dropped() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(METRICS);
        std::fs::write(&path, "{\"step\":1,\"loss\":1.0}\n{\"step\":2,\"lo").unwrap();
        assert_eq!(steps(dir.path()), [1]);
        let mut metrics = Metrics::open(dir.path(), Vec::new()).unwrap();
        metrics.scalars(2, &[("loss", 2.0)]).unwrap();
        metrics.finish(SessionStatus::Success).unwrap();
        assert_eq!(steps(dir.path()), [1, 2]);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_disk_is_an_error_that_says_so() {
        let dir = tempfile::tempdir().unwrap();
        std::os::unix::fs::symlink("/dev/full", dir.path().join(METRICS)).unwrap();
        let mut metrics = Metrics::open(dir.path(), Vec::new()).unwrap();
        metrics.scalars(1, &[("loss", 1.0)]).unwrap();
        assert_eq!(metrics.flush().unwrap_err().code(), "E0502");
    }
}
