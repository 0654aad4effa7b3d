//! One run of `ffmpeg`: pictures as raw bytes on its output, and on its errors, line by line, when each is shown.

use super::stamp::{Layout, Stamp};
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::video::colour::Planes;
use crate::video::image::Image;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;

const MOST_PIXELS: usize = 64_000_000;
/// Longer lines are cut; the data of a stream may be printed in one.
const LONGEST_LINE: u64 = 1 << 16;
/// Complaints that are kept, the last ones.
const COMPLAINTS: usize = 16;

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

/// What the container says, packet by packet.
#[derive(Debug, Default)]
pub(super) struct Packets {
    container: String,
    codec: String,
    /// Microseconds, ascending.
    pub stamps: Vec<i64>,
    /// Which of them start a group of pictures.
    pub keys: Vec<usize>,
    /// All have their own time, and none is to be left out.
    plain: bool,
}

impl Packets {
    /// Whether packets can be expected to be the frames.
    pub fn trusted(&self) -> bool {
        let known = self
            .container
            .split(',')
            .any(|name| super::CONTAINERS.contains(&name));
        self.plain
            && known
            && super::CODECS.contains(&self.codec.as_str())
            && self.stamps.is_sorted_by(|a, b| a + super::ROUNDED < *b)
    }
}

/// A file and its video track.
#[derive(Debug)]
pub(super) struct Source {
    path: PathBuf,
    track: String,
}

impl Source {
    pub fn new(path: &Path, track: Option<u32>) -> Self {
        Source {
            path: path.to_owned(),
            // `V` is a video that is no cover.
            track: track.map_or("0:V:0".to_owned(), |id| format!("0:i:{id}")),
        }
    }

    fn command(&self, keep_times: bool, seek: Option<i64>) -> Command {
        let mut command = Command::new("ffmpeg");
        command.args(["-nostdin", "-hide_banner", "-nostats"]);
        command.args(["-loglevel", "level+info"]);
        if keep_times {
            command.arg("-copyts");
        }
        if let Some(micros) = seek {
            command.arg("-noaccurate_seek").arg("-seek_timestamp");
            command.args(["1", "-ss"]).arg(format!("{micros}us"));
        }
        // `file:` keeps a name with a colon from being taken as a protocol; playlists may open nothing but files.
        command.args(["-protocol_whitelist", "file", "-i"]);
        let mut input = OsString::from("file:");
        input.push(&self.path);
        command.arg(input).arg("-map").arg(&self.track);
        command.stdin(Stdio::null()).stderr(Stdio::piped());
        command
    }

    /// What `ffmpeg` is asked to do with every frame: say when it is shown, upright and before colours are converted.
    fn with_stamps(&self, keep_times: bool, seek: Option<i64>) -> Command {
        let mut command = self.command(keep_times, seek);
        command.args(["-vf", "settb=AVTB,showinfo=checksum=0"]);
        command.args(["-fps_mode", "passthrough"]);
        command
    }

    fn start(&self, mut command: Command) -> Result<Child, ReadError> {
        command
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|cause| ReadError::io(&self.path, cause))
    }

    /// Reads the packets without decoding them.
    pub fn packets(&self) -> Result<Packets, ReadError> {
        let mut command = self.command(true, None);
        command.args(["-c", "copy", "-copyinkf", "-f", "framecrc", "-"]);
        let mut reader = Reader::new(&self.path, self.start(command)?, Layout::Rgb, false);
        let mut packets = Packets {
            plain: true,
            ..Packets::default()
        };
        let mut base = (0_i64, 1_i64);
        let mut found = Vec::new();
        let mut line = String::new();
        let Some(mut pipe) = reader.pipe.take() else {
            return Err(self.nothing());
        };
        loop {
            line.clear();
            let read = pipe.read_line(&mut line);
            if read.map_err(|cause| ReadError::io(&self.path, cause))? == 0 {
                break;
            }
            if let Some(text) = line.strip_prefix("#tb 0:") {
                let parts = text.trim().split_once('/');
                base = parts
                    .and_then(|(n, d)| Some((n.parse().ok()?, d.parse().ok()?)))
                    .filter(|(n, d)| *n > 0 && *d > 0)
                    .unwrap_or(base);
            } else if let Some(text) = line.strip_prefix("#codec_id 0:") {
                text.trim().clone_into(&mut packets.codec);
            } else if !line.starts_with('#') {
                // stream, dts, pts, duration, size, checksum; then flags where they are not those of a key frame
                let mut fields = line.split(',').map(str::trim);
                let pts = fields.nth(2).and_then(|pts| pts.parse::<i64>().ok());
                let size = fields.nth(1);
                let flags = fields
                    .find_map(|field| field.strip_prefix("F=0x"))
                    .map_or(Some(1), |flags| u32::from_str_radix(flags, 16).ok())
                    .unwrap_or(0);
                let sound = flags & 0b110 == 0 && size != Some("0");
                match pts.filter(|pts| *pts > i64::MIN / 4 && sound) {
                    Some(pts) => found.push((micros(pts, base), flags & 1 != 0)),
                    None => packets.plain = false,
                }
            }
        }
        packets.container = reader.input();
        found.sort_unstable();
        packets.keys = (0..found.len()).filter(|&at| found[at].1).collect();
        packets.stamps = found.into_iter().map(|(stamp, _)| stamp).collect();
        Ok(packets)
    }

    /// Decodes from the start, without pictures; to the end, or so many frames.
    pub fn decoded(&self, most: Option<usize>, keep_times: bool) -> Result<Vec<Stamp>, ReadError> {
        let mut command = self.with_stamps(keep_times, None);
        if let Some(most) = most {
            command.arg("-frames:v").arg(most.to_string());
        }
        command.args(["-f", "null", "-"]);
        let mut reader = Reader::new(&self.path, self.start(command)?, Layout::Rgb, true);
        let frames: Vec<Stamp> = std::iter::from_fn(|| reader.take_stamp())
            .take(most.unwrap_or(usize::MAX))
            .collect();
        if frames.is_empty() {
            return Err(reader.failure_of(Position::File, "ffmpeg finds no video in it"));
        }
        Ok(frames)
    }

    /// Starts reading pictures, from the start or about `seek` microseconds.
    pub fn read(
        &self,
        layout: Layout,
        keep_times: bool,
        seek: Option<i64>,
    ) -> Result<Reader, ReadError> {
        let mut command = self.with_stamps(keep_times, seek);
        command.args(["-pix_fmt", layout.name(), "-f", "rawvideo", "-"]);
        let colours = layout != Layout::Rgb;
        let mut reader = Reader::new(&self.path, self.start(command)?, layout, colours);
        reader.sought = seek.is_some();
        Ok(reader)
    }

    pub fn nothing(&self) -> ReadError {
        ReadError::malformed(&self.path, Position::File, "ffmpeg finds no video in it")
    }
}

/// Ticks as microseconds, rounded to the nearest.
fn micros(ticks: i64, (numerator, denominator): (i64, i64)) -> i64 {
    let scaled = i128::from(ticks) * i128::from(numerator) * 1_000_000;
    let half = i128::from(denominator) / 2;
    let rounded = (scaled + half * scaled.signum()) / i128::from(denominator);
    rounded.clamp(i64::MIN.into(), i64::MAX.into()) as i64
}

/// A process that hands over pictures.
#[derive(Debug)]
pub(super) struct Reader {
    path: PathBuf,
    child: Child,
    pipe: Option<BufReader<ChildStdout>>,
    stamps: Receiver<Stamp>,
    /// Reads what ffmpeg says all along: it stops when nobody does.
    listener: Option<JoinHandle<Said>>,
    next: Option<Stamp>,
    /// The frame that comes next.
    pub position: usize,
    /// It started in the middle of the file.
    pub sought: bool,
    pub layout: Layout,
    scratch: Vec<u8>,
}

/// What ffmpeg said beside its frames.
#[derive(Debug, Default)]
struct Said {
    /// Names of the container's format.
    container: String,
    complaints: Vec<String>,
}

impl Said {
    fn hear(&mut self, line: &str) {
        if let Some((_, rest)) = line.split_once("Input #0, ")
            && let Some((names, _)) = rest.split_once(", from ")
            && self.container.is_empty()
        {
            names.clone_into(&mut self.container);
        }
        let wrong = ["[error] ", "[fatal] ", "[panic] "];
        if let Some((_, what)) = wrong.iter().find_map(|level| line.split_once(level)) {
            if self.complaints.len() == COMPLAINTS {
                self.complaints.remove(0);
            }
            self.complaints.push(what.trim().to_owned());
        }
    }
}

/// Hands on the stamp of every frame; with `colours` once these are said, or where they are not, with the next frame.
fn listen(pipe: impl Read, stamps: &Sender<Stamp>, colours: bool) -> Said {
    let mut pipe = BufReader::new(pipe);
    let mut said = Said::default();
    let mut line = Vec::new();
    let mut held: Option<Stamp> = None;
    // Nobody waits for frames any more: what is said is still worth hearing.
    let send = |stamp: Option<Stamp>| {
        if let Some(stamp) = stamp {
            let _ = stamps.send(stamp);
        }
    };
    loop {
        line.clear();
        match (&mut pipe).take(LONGEST_LINE).read_until(b'\n', &mut line) {
            Ok(0) | Err(_) => {
                send(held);
                return said;
            }
            Ok(_) => {}
        }
        let line = String::from_utf8_lossy(&line);
        if let Some(stamp) = Stamp::parse(&line) {
            send(held.replace(stamp));
            if !colours {
                send(held.take());
            }
        } else if held.as_mut().is_some_and(|stamp| stamp.add_colours(&line)) {
            send(held.take());
        } else {
            said.hear(&line);
        }
    }
}

impl Reader {
    fn new(path: &Path, mut child: Child, layout: Layout, colours: bool) -> Self {
        let (sender, stamps) = channel();
        let pipe = child.stdout.take();
        let stderr = child.stderr.take();
        let listener =
            stderr.map(|pipe| std::thread::spawn(move || listen(pipe, &sender, colours)));
        Reader {
            path: path.to_owned(),
            child,
            pipe: pipe.map(|pipe| BufReader::with_capacity(1 << 16, pipe)),
            stamps,
            listener,
            next: None,
            position: 0,
            sought: false,
            layout,
            scratch: Vec::new(),
        }
    }

    /// The frame that comes next.
    pub fn peek(&mut self) -> Option<Stamp> {
        if self.next.is_none() {
            self.next = self.stamps.recv().ok();
        }
        self.next
    }

    fn take_stamp(&mut self) -> Option<Stamp> {
        self.peek();
        self.next.take()
    }

    /// The next picture.
    pub fn image(&mut self) -> Result<Image, String> {
        let stamp = self.take_stamp().ok_or("ffmpeg decodes no more frames")?;
        if self.layout == Layout::Rgb {
            let mut data = Vec::new();
            self.pixels(stamp, &mut data)?;
            return Ok(Image {
                width: stamp.width,
                height: stamp.height,
                data,
            });
        }
        let mut scratch = std::mem::take(&mut self.scratch);
        let read = self.pixels(stamp, &mut scratch);
        self.scratch = scratch;
        read?;
        let planes = Planes::packed(stamp.width as usize, stamp.height as usize, &self.scratch);
        Ok(planes.to_rgb(stamp.colours()))
    }

    /// Leaves the next picture out.
    pub fn skip(&mut self) -> Result<(), String> {
        let stamp = self.take_stamp().ok_or("ffmpeg decodes no more frames")?;
        let mut scratch = std::mem::take(&mut self.scratch);
        let read = self.pixels(stamp, &mut scratch);
        self.scratch = scratch;
        read
    }

    fn pixels(&mut self, stamp: Stamp, data: &mut Vec<u8>) -> Result<(), String> {
        let (width, height) = (stamp.width as usize, stamp.height as usize);
        if width == 0 || height == 0 || width.saturating_mul(height) > MOST_PIXELS {
            return Err(format!("a picture of {width} x {height} pixels"));
        }
        let bytes = match self.layout {
            Layout::Rgb => width * height * 3,
            Layout::Planes | Layout::FullRangePlanes => Planes::bytes(width, height),
        };
        data.resize(bytes, 0);
        let pipe = self.pipe.as_mut().ok_or("ffmpeg gave no pipe")?;
        pipe.read_exact(data)
            .map_err(|_| "ffmpeg stopped in the middle of a picture".to_owned())
    }

    /// Waits for the end; what was said until then.
    fn said(&mut self) -> Said {
        self.pipe = None;
        let _ = self.child.kill();
        let said = self.listener.take().and_then(|thread| thread.join().ok());
        said.unwrap_or_default()
    }

    /// Names of the container's format, once the output has ended.
    fn input(&mut self) -> String {
        let _ = self.child.wait();
        self.said().container
    }

    /// Why a frame cannot be had, in ffmpeg's words where it has some.
    pub fn failure(&mut self, frame: usize, reason: &str) -> ReadError {
        self.failure_of(Position::Frame(frame as u64), reason)
    }

    fn failure_of(&mut self, place: Position, reason: &str) -> ReadError {
        let said = self.said();
        let complaint = said
            .complaints
            .last()
            .map_or(String::new(), |words| format!(": {words}"));
        ReadError::malformed(&self.path, place, format!("{reason}{complaint}"))
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_complaints_are_kept() {
        let lines: Vec<String> = (0..100)
            .map(|number| format!("[h264 @ 0x1] [error] error {number}\n"))
            .collect();
        let head = "[info] Input #0, mov,mp4, from 'file:x':\n";
        let text = format!("{head}{}", lines.concat());
        let (sender, _stamps) = channel();
        let said = listen(text.as_bytes(), &sender, true);
        assert_eq!(said.container, "mov,mp4");
        assert_eq!(said.complaints.len(), COMPLAINTS);
        assert_eq!(said.complaints.last().unwrap(), "error 99");
    }

    #[test]
    fn a_stamp_waits_for_its_colours_where_they_count() {
        let frame = |n: usize| {
            format!(
                "[Parsed_showinfo_1 @ 0x5] [info] n:{n} pts:{n} fmt:yuv420p sar:1/1 s:4x4 i:P\n"
            )
        };
        let colours = "[Parsed_showinfo_1 @ 0x5] [info] color_range:tv color_space:bt709\n";
        let text = format!("{}{colours}{}{}{colours}", frame(0), frame(1), frame(2));
        for (wait, layouts) in [
            (true, [Layout::Planes, Layout::Rgb, Layout::Planes]),
            (false, [Layout::Rgb; 3]),
        ] {
            let (sender, stamps) = channel();
            listen(text.as_bytes(), &sender, wait);
            drop(sender);
            let heard: Vec<_> = stamps.iter().map(|s| (s.time, s.layout())).collect();
            let right: Vec<_> = (0..3).map(|n| (Some(n as i64), layouts[n])).collect();
            assert_eq!(heard, right);
        }
    }

    #[test]
    fn ticks_are_rounded_as_ffmpeg_rounds_them() {
        assert_eq!(micros(1, (1, 30)), 33_333);
        assert_eq!(micros(2, (1, 30)), 66_667);
        assert_eq!(micros(-2, (1, 30)), -66_667);
        assert_eq!(micros(i64::MAX / 8, (1, 1)), i64::MAX);
    }
}
