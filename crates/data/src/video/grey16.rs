//! Videos of 16-bit grey pictures (depth) through the user's own `ffmpeg`, which hands them over as PGM images.

use crate::formats::ReadError;
use crate::formats::read_error::Position;
use ndarray::Array2;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const MOST_PIXELS: usize = 64_000_000;
/// More frames than this are not named one by one.
const MOST_NAMED: usize = 1000;

/// A video of 16-bit pictures that `ffmpeg` reads.
#[derive(Debug, Clone)]
pub struct Grey16Video {
    path: PathBuf,
    /// Number of frames.
    pub frames: usize,
    /// Frames per second as the file has it; frames are asked for by number, so that only seeking needs it.
    rate: f64,
}

fn ffmpeg(path: &Path, before: &[String]) -> Command {
    let mut command = Command::new("ffmpeg");
    let mut input = std::ffi::OsString::from("file:");
    input.push(path);
    command
        .args(["-nostdin", "-v", "error"])
        .args(before)
        .arg("-i")
        .arg(input)
        .args(["-map", "0:v:0"])
        .stdin(Stdio::null())
        .stderr(Stdio::piped());
    command
}

fn complaint(stderr: &[u8]) -> String {
    let text = String::from_utf8_lossy(stderr);
    let last = text.lines().rev().find(|line| !line.trim().is_empty());
    last.map_or_else(String::new, |line| format!(": {}", line.trim()))
}

impl Grey16Video {
    /// Counts the frames, without decoding.
    ///
    /// # Errors
    /// When there is no `ffmpeg`, or it finds no video.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let output = ffmpeg(path, &[])
            .args(["-c", "copy", "-f", "framecrc", "-"])
            .output()
            .map_err(|cause| match cause.kind() {
                std::io::ErrorKind::NotFound => ReadError::unsupported(
                    path,
                    "depth in a video needs `ffmpeg` on the PATH, and there is none",
                ),
                _ => ReadError::io(path, cause),
            })?;
        let text = String::from_utf8_lossy(&output.stdout);
        let mut seconds_per_tick = None;
        let mut times = Vec::new();
        for line in text.lines() {
            if let Some(base) = line.strip_prefix("#tb 0:") {
                let base = base.trim().split_once('/');
                seconds_per_tick =
                    base.and_then(|(n, d)| Some(n.parse::<f64>().ok()? / d.parse::<f64>().ok()?));
            } else if !line.starts_with('#')
                && let Some(Ok(time)) = line.split(',').nth(2).map(|t| t.trim().parse::<i64>())
            {
                times.push(time);
            }
        }
        let (Some(tick), [first, .., last]) = (seconds_per_tick, times.as_slice()) else {
            return Err(ReadError::malformed(
                path,
                Position::File,
                format!("ffmpeg finds no video in it{}", complaint(&output.stderr)),
            ));
        };
        let length = (last - first) as f64 * tick;
        let rate = (times.len() - 1) as f64 / length;
        if !(rate.is_finite() && rate > 0.0) {
            return Err(ReadError::malformed(
                path,
                Position::File,
                "its frames have no times",
            ));
        }
        Ok(Grey16Video {
            path: path.to_owned(),
            frames: times.len(),
            rate,
        })
    }

    /// Decodes the frames `wanted`, ascending and distinct, one at a time.
    ///
    /// # Errors
    /// When one cannot be decoded.
    pub fn read(
        &self,
        wanted: &[usize],
        each: &mut dyn FnMut(usize, Array2<u16>),
    ) -> Result<(), ReadError> {
        let (Some(&first), Some(&last)) = (wanted.first(), wanted.last()) else {
            return Ok(());
        };
        let wrong = |frame: usize, reason: String| {
            ReadError::malformed(&self.path, Position::Frame(frame as u64), reason)
        };
        let mut seek = Vec::new();
        if first > 0 {
            // Half a frame early: times are rounded on their way through the container.
            let early = (first as f64 - 0.5) / self.rate;
            seek = vec!["-ss".to_owned(), format!("{early:.6}")];
        }
        let named = wanted.len() <= MOST_NAMED;
        let mut command = ffmpeg(&self.path, &seek);
        let mut count = last - first + 1;
        if named {
            let terms: Vec<String> = wanted
                .iter()
                .map(|frame| format!("eq(n\\,{})", frame - first))
                .collect();
            command
                .arg("-vf")
                .arg(format!("select={}", terms.join("+")));
            count = wanted.len();
        }
        command
            .args(["-fps_mode", "passthrough", "-frames:v"])
            .arg(count.to_string())
            .args([
                "-pix_fmt",
                "gray16be",
                "-c:v",
                "pgm",
                "-f",
                "image2pipe",
                "-",
            ])
            .stdout(Stdio::piped());
        let mut child = command
            .spawn()
            .map_err(|cause| ReadError::io(&self.path, cause))?;
        let complaints = child.stderr.take().map(|mut pipe| {
            std::thread::spawn(move || {
                let mut said = Vec::new();
                // ffmpeg stops when nobody reads what it says.
                let _ = pipe.read_to_end(&mut said);
                said
            })
        });
        let mut pictures = || -> Result<(), (usize, String)> {
            let pipe = child.stdout.take().ok_or((first, String::new()))?;
            let mut pipe = BufReader::with_capacity(1 << 16, pipe);
            if named {
                for &frame in wanted {
                    each(frame, picture(&mut pipe).map_err(|reason| (frame, reason))?);
                }
            } else {
                for frame in first..=last {
                    let picture = picture(&mut pipe).map_err(|reason| (frame, reason))?;
                    if wanted.binary_search(&frame).is_ok() {
                        each(frame, picture);
                    }
                }
            }
            Ok(())
        };
        let read = pictures();
        let _ = child.kill();
        let _ = child.wait();
        let said = complaints.and_then(|thread| thread.join().ok());
        read.map_err(|(frame, reason)| {
            wrong(
                frame,
                format!("{reason}{}", complaint(&said.unwrap_or_default())),
            )
        })
    }
}

/// One picture out of a pipe: `P5\n640 480\n65535\n`, then two bytes a pixel, the high one first.
fn picture(pipe: &mut impl BufRead) -> Result<Array2<u16>, String> {
    let mut header = Vec::new();
    for _ in 0..3 {
        let mut limited = pipe.by_ref().take(64);
        let read = limited
            .read_until(b'\n', &mut header)
            .map_err(|cause| cause.to_string())?;
        if read == 0 {
            return Err("ffmpeg decodes no such frame".to_owned());
        }
    }
    let text = String::from_utf8_lossy(&header);
    let mut words = text.split_ascii_whitespace();
    let (Some("P5"), Some(width), Some(height), Some("65535")) = (
        words.next(),
        words.next().and_then(|word| word.parse::<usize>().ok()),
        words.next().and_then(|word| word.parse::<usize>().ok()),
        words.next(),
    ) else {
        return Err("ffmpeg sent something that is no 16-bit picture".to_owned());
    };
    if width == 0 || height == 0 || width.saturating_mul(height) > MOST_PIXELS {
        return Err(format!("a picture of {width} x {height} pixels"));
    }
    let mut bytes = vec![0; width * height * 2];
    pipe.read_exact(&mut bytes)
        .map_err(|_| "ffmpeg stopped in the middle of a picture".to_owned())?;
    let values = bytes
        .chunks_exact(2)
        .map(|pair| u16::from_be_bytes([pair[0], pair[1]]))
        .collect();
    Array2::from_shape_vec((height, width), values).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_of_a_pipe_come_one_after_the_other_and_a_cut_one_is_an_error() {
        let bytes = [b"P5\n2 1\n65535\n\x01\x02\x00\x03".as_slice(); 2].concat();
        let mut pipe = BufReader::new(&bytes[..bytes.len() - 1]);
        assert_eq!(picture(&mut pipe).unwrap(), ndarray::arr2(&[[258u16, 3]]));
        assert!(picture(&mut pipe).unwrap_err().contains("middle"));
        assert!(picture(&mut pipe).unwrap_err().contains("no such frame"));
    }
}
