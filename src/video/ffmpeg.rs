//! Videos through the user's own `ffmpeg`: any container and codec it knows. It is started as a separate program and hands over
//! its pictures through a pipe as self-describing PPM images; nothing is linked.

use super::choice::FrameTimes;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::image::Image;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::OnceLock;
use std::thread::JoinHandle;

const MOST_PIXELS: usize = 64_000_000;
/// Bytes of what ffmpeg complains about that are kept, the last ones.
const COMPLAINTS: usize = 1 << 16;
/// More frames than this are not named one by one: Linux takes no argument of more than 128 KiB.
const MOST_NAMED: usize = 1000;

/// Whether there is an `ffmpeg` to call; asked once per process.
pub fn available() -> bool {
    static FOUND: OnceLock<bool> = OnceLock::new();
    *FOUND.get_or_init(|| {
        Command::new("ffmpeg")
            .arg("-version")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .status()
            .is_ok_and(|status| status.success())
    })
}

/// A file that `ffmpeg` reads.
#[derive(Debug, Clone)]
pub struct Index {
    path: PathBuf,
    /// Presentation time of the first frame on ffmpeg's own clock, seconds.
    first: f64,
}

fn command(path: &Path, before_input: &[String]) -> Command {
    let mut command = Command::new("ffmpeg");
    command
        .args(["-nostdin", "-v", "error"])
        .args(before_input)
        .arg("-i")
        // `file:` keeps a name with a colon from being taken as a protocol, and protocols out altogether.
        .arg({
            let mut input = std::ffi::OsString::from("file:");
            input.push(path);
            input
        })
        .args(["-map", "0:v:0"])
        .stdin(Stdio::null())
        .stderr(Stdio::piped());
    command
}

/// Reads when every frame is shown, without decoding.
pub fn open(path: &Path) -> Result<(Index, FrameTimes), ReadError> {
    let output = command(path, &[])
        .args(["-c", "copy", "-f", "framecrc", "-"])
        .output()
        .map_err(|cause| ReadError::io(path, cause))?;
    let text = String::from_utf8_lossy(&output.stdout);
    let mut tick = None;
    let mut ticks = Vec::new();
    for line in text.lines() {
        if let Some(base) = line.strip_prefix("#tb 0:") {
            tick = base
                .trim()
                .split_once('/')
                .and_then(|(n, d)| Some((n.parse::<f64>().ok()?, d.parse::<f64>().ok()?)));
        } else if !line.starts_with('#') {
            // stream, dts, pts, duration, size, checksum
            if let Some(pts) = line
                .split(',')
                .nth(2)
                .and_then(|pts| pts.trim().parse::<i64>().ok())
            {
                ticks.push(pts);
            }
        }
    }
    ticks.sort_unstable();
    let (Some((numerator, denominator)), Some(&first)) = (tick, ticks.first()) else {
        return Err(ReadError::malformed(
            path,
            Position::File,
            format!("ffmpeg finds no video in it{}", complaint(&output.stderr)),
        ));
    };
    let scale = numerator / denominator;
    // FrameTimes works on integer ticks per second: microseconds are fine enough for any camera.
    let micros: Vec<i64> = ticks
        .iter()
        .map(|pts| ((pts - first) as f64 * scale * 1e6).round() as i64)
        .collect();
    let index = Index {
        path: path.to_owned(),
        first: first as f64 * scale,
    };
    Ok((index, FrameTimes::from_ticks(&micros, 1_000_000)))
}

fn complaint(stderr: &[u8]) -> String {
    let text = String::from_utf8_lossy(stderr);
    match text.lines().rev().find(|line| !line.trim().is_empty()) {
        Some(line) => format!(": {}", line.trim()),
        None => String::new(),
    }
}

/// Reads to the end and keeps the last [`COMPLAINTS`] bytes.
fn last_bytes(mut pipe: impl Read) -> Vec<u8> {
    let mut kept = Vec::new();
    let mut block = [0; 4096];
    loop {
        match pipe.read(&mut block) {
            Ok(0) => return kept,
            Ok(read) => kept.extend_from_slice(&block[..read]),
            Err(cause) if cause.kind() == std::io::ErrorKind::Interrupted => {}
            Err(_) => return kept,
        }
        kept.drain(..kept.len().saturating_sub(COMPLAINTS));
    }
}

/// The filter that lets only `frames` through, counted from `first`; none where every frame is wanted or too many are.
fn filter(frames: &[usize], first: usize, last: usize) -> Option<String> {
    let every = frames.len() == last - first + 1;
    (!every && frames.len() <= MOST_NAMED).then(|| {
        let named = frames
            .iter()
            .map(|frame| format!("eq(n\\,{})", frame - first));
        format!("select={}", named.collect::<Vec<_>>().join("+"))
    })
}

/// The wanted frames, decoded and turned upright by `ffmpeg`.
#[derive(Debug)]
pub struct Wanted {
    path: PathBuf,
    child: Child,
    pipe: BufReader<ChildStdout>,
    /// Reads what ffmpeg complains about all along: it stops when nobody does.
    complaints: Option<JoinHandle<Vec<u8>>>,
    frames: Vec<usize>,
    delivered: usize,
    /// The frame that comes next out of the pipe; none where only wanted ones come.
    coming: Option<usize>,
}

impl Wanted {
    /// `frames` in ascending order without repetition.
    pub fn new(
        index: &Index,
        schedule: &FrameTimes,
        frames: Vec<usize>,
    ) -> Result<Self, ReadError> {
        let first = frames.first().copied().unwrap_or(0);
        let last = frames.last().copied().unwrap_or(0);
        let mut seek = Vec::new();
        if first > 0 {
            // Half a frame early: times are rounded on their way through the container.
            let early = f64::midpoint(schedule.seconds(first), schedule.seconds(first - 1));
            seek = vec!["-ss".to_owned(), format!("{:.6}", index.first + early)];
        }
        let mut command = command(&index.path, &seek);
        let (count, coming) = match filter(&frames, first, last) {
            Some(filter) => {
                command.args(["-vf", &filter]);
                (frames.len().max(1), None)
            }
            None => (last - first + 1, Some(first)),
        };
        command
            .args(["-fps_mode", "passthrough", "-frames:v"])
            .arg(count.to_string())
            .args(["-pix_fmt", "rgb24", "-c:v", "ppm", "-f", "image2pipe", "-"])
            .stdout(Stdio::piped());
        let mut child = command
            .spawn()
            .map_err(|cause| ReadError::io(&index.path, cause))?;
        let pipe = child
            .stdout
            .take()
            .ok_or_else(|| ReadError::unsupported(&index.path, "ffmpeg gave no pipe"))?;
        let stderr = child.stderr.take();
        let complaints = stderr.map(|pipe| std::thread::spawn(move || last_bytes(pipe)));
        Ok(Wanted {
            path: index.path.clone(),
            child,
            pipe: BufReader::with_capacity(1 << 16, pipe),
            complaints,
            frames,
            delivered: 0,
            coming,
        })
    }

    /// The picture of `frame`; those that come before it are left out.
    fn picture(&mut self, frame: usize) -> Result<Option<Image>, String> {
        loop {
            let image = self.read()?;
            let Some(coming) = &mut self.coming else {
                return Ok(image);
            };
            *coming += 1;
            if *coming > frame || image.is_none() {
                return Ok(image);
            }
        }
    }

    fn read(&mut self) -> Result<Option<Image>, String> {
        let mut header = Vec::new();
        // "P6\n1920 1080\n255\n"
        for _ in 0..3 {
            let mut limited = (&mut self.pipe).take(64);
            let read = limited
                .read_until(b'\n', &mut header)
                .map_err(|cause| cause.to_string())?;
            if read == 0 && header.is_empty() {
                return Ok(None);
            }
        }
        let text = String::from_utf8_lossy(&header);
        let mut words = text.split_ascii_whitespace();
        let (Some("P6"), Some(width), Some(height), Some("255")) = (
            words.next(),
            words.next().and_then(|word| word.parse::<usize>().ok()),
            words.next().and_then(|word| word.parse::<usize>().ok()),
            words.next(),
        ) else {
            return Err("ffmpeg sent something that is no picture".to_owned());
        };
        if width == 0 || height == 0 || width.saturating_mul(height) > MOST_PIXELS {
            return Err(format!("a picture of {width} x {height} pixels"));
        }
        let mut data = vec![0; width * height * 3];
        self.pipe
            .read_exact(&mut data)
            .map_err(|_| "ffmpeg stopped in the middle of a picture".to_owned())?;
        Ok(Some(Image {
            width: width as u32,
            height: height as u32,
            data,
        }))
    }

    fn failure(&mut self, frame: usize, reason: &str) -> ReadError {
        let _ = self.child.kill();
        let complaints = self.complaints.take();
        let stderr = complaints.and_then(|thread| thread.join().ok());
        let stderr = stderr.unwrap_or_default();
        ReadError::malformed(
            &self.path,
            Position::Frame(frame as u64),
            format!("{reason}{}", complaint(&stderr)),
        )
    }
}

impl Iterator for Wanted {
    type Item = Result<(usize, Image), ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        let frame = *self.frames.get(self.delivered)?;
        self.delivered += 1;
        Some(match self.picture(frame) {
            Ok(Some(image)) => Ok((frame, image)),
            Ok(None) => {
                self.delivered = self.frames.len();
                Err(self.failure(frame, "ffmpeg decodes no such frame"))
            }
            Err(reason) => {
                self.delivered = self.frames.len();
                Err(self.failure(frame, &reason))
            }
        })
    }
}

impl Drop for Wanted {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_complaints_are_read_and_the_last_of_them_kept() {
        let said = [vec![b'a'; 3 * COMPLAINTS], b"the end".to_vec()].concat();
        let kept = last_bytes(said.as_slice());
        assert_eq!(kept.len(), COMPLAINTS);
        assert!(kept.ends_with(b"aathe end"));
        assert_eq!(last_bytes(&b"short"[..]), b"short");
    }

    #[test]
    fn frames_are_named_only_where_they_are_few_and_have_gaps() {
        assert_eq!(filter(&[4, 6], 4, 6).unwrap(), "select=eq(n\\,0)+eq(n\\,2)");
        assert_eq!(filter(&[4, 5, 6], 4, 6), None);
        let many: Vec<usize> = (0..=MOST_NAMED).map(|k| 2 * k).collect();
        assert_eq!(filter(&many, 0, 2 * MOST_NAMED), None);
    }
}
