//! A moving picture on disk: Motion JPEG in AVI, which needs nobody, or H.264 in MP4 by the user's `ffmpeg`.

use super::canvas::Canvas;
use jpeg_encoder::{ColorType, Encoder};
use std::fs::File;
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// Of the pictures in an AVI.
const QUALITY: u8 = 90;
/// What players without large-file extensions read.
const LARGEST: u64 = 1 << 30;

/// Why a movie cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum MovieError {
    /// The file cannot be written.
    #[error("{}: {error}", path.display())]
    Io {
        /// The movie.
        path: PathBuf,
        /// What the system says.
        error: std::io::Error,
    },
    /// The name ends in neither.
    #[error("{}: a movie is `.mp4` (by `ffmpeg`) or `.avi`", .0.display())]
    Kind(PathBuf),
    /// The pictures exceed what the container can hold.
    #[error("{}: more than a gigabyte of pictures does not fit an AVI; name an `.mp4`", .0.display())]
    TooLarge(PathBuf),
    /// `ffmpeg` refused or was cut off.
    #[error("{}: `ffmpeg` did not write it: {reason}", path.display())]
    Ffmpeg {
        /// The movie.
        path: PathBuf,
        /// Its last words.
        reason: String,
    },
    /// A picture differs in size from the first.
    #[error("{}: a picture of {found:?} pixels after {expected:?}", path.display())]
    Size {
        /// The movie.
        path: PathBuf,
        /// Width and height of the first.
        expected: (usize, usize),
        /// Width and height of this one.
        found: (usize, usize),
    },
}

/// Whether an `ffmpeg` that can write MP4 is there to be asked.
#[must_use]
pub fn ffmpeg() -> bool {
    let mut version = Command::new("ffmpeg");
    version
        .arg("-version")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    version.status().is_ok_and(|status| status.success())
}

/// A movie that is being written, picture by picture.
#[derive(Debug)]
pub struct Movie {
    path: PathBuf,
    size: (usize, usize),
    writer: Writer,
}

#[derive(Debug)]
enum Writer {
    Avi(Avi),
    Ffmpeg(Child),
}

impl Movie {
    /// Starts a movie of so many pictures a second; the name says which kind.
    ///
    /// # Errors
    /// When the name is of no kind that is known, the disk refuses, or `ffmpeg` cannot be started.
    pub fn create(path: &Path, size: (usize, usize), rate: u32) -> Result<Self, MovieError> {
        let io = |error| MovieError::Io {
            path: path.to_owned(),
            error,
        };
        let writer =
            match path.extension().and_then(|e| e.to_str()) {
                Some("avi") => Writer::Avi(Avi::create(path, size, rate).map_err(io)?),
                Some("mp4") => Writer::Ffmpeg(encoder(path, size, rate).map_err(|error| {
                    MovieError::Ffmpeg {
                        path: path.to_owned(),
                        reason: error.to_string(),
                    }
                })?),
                _ => return Err(MovieError::Kind(path.to_owned())),
            };
        Ok(Self {
            path: path.to_owned(),
            size,
            writer,
        })
    }

    /// Adds a picture.
    ///
    /// # Errors
    /// When it has another size, the disk is full, or `ffmpeg` has ended.
    pub fn push(&mut self, picture: &Canvas) -> Result<(), MovieError> {
        if picture.size() != self.size {
            return Err(MovieError::Size {
                path: self.path.clone(),
                expected: self.size,
                found: picture.size(),
            });
        }
        let io = |error| MovieError::Io {
            path: self.path.clone(),
            error,
        };
        match &mut self.writer {
            Writer::Avi(avi) => {
                avi.push(picture.rgb()).map_err(io)?;
                if avi.bytes > LARGEST {
                    return Err(MovieError::TooLarge(self.path.clone()));
                }
                Ok(())
            }
            Writer::Ffmpeg(child) => {
                let input = child.stdin.as_mut();
                let sent = input.map_or(Ok(()), |input| input.write_all(picture.rgb()));
                // Why it ended stands on its stderr.
                sent.or_else(|_| ended(child, &self.path))
            }
        }
    }

    /// Completes the file.
    ///
    /// # Errors
    /// When the disk is full, or `ffmpeg` failed.
    pub fn finish(self) -> Result<(), MovieError> {
        match self.writer {
            Writer::Avi(avi) => avi.finish().map_err(|error| MovieError::Io {
                path: self.path,
                error,
            }),
            Writer::Ffmpeg(mut child) => ended(&mut child, &self.path),
        }
    }
}

/// `ffmpeg`, waiting for pictures.
fn encoder(path: &Path, (width, height): (usize, usize), rate: u32) -> std::io::Result<Child> {
    let size = format!("{width}x{height}");
    Command::new("ffmpeg")
        .args([
            "-nostdin", "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24",
        ])
        .args(["-s", &size, "-r", &rate.to_string(), "-i", "pipe:0"])
        .args([
            "-c:v",
            "libx264",
            "-crf",
            "20",
            "-pix_fmt",
            "yuv420p",
            "-movflags",
            "+faststart",
        ])
        // A name that begins with a dash is a name.
        .arg(Path::new(".").join(path))
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
}

/// Waits for `ffmpeg`; what it said is the reason where it failed.
fn ended(child: &mut Child, path: &Path) -> Result<(), MovieError> {
    drop(child.stdin.take());
    let mut said = String::new();
    let read = child.stderr.take().map(|mut e| e.read_to_string(&mut said));
    let status = child.wait();
    let failed = |reason: String| MovieError::Ffmpeg {
        path: path.to_owned(),
        reason,
    };
    if let Some(Err(error)) = read {
        return Err(failed(error.to_string()));
    }
    match status {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(failed(match said.lines().next_back() {
            Some(line) => line.to_owned(),
            None => status.to_string(),
        })),
        Err(error) => Err(failed(error.to_string())),
    }
}

/// Motion JPEG in AVI (RIFF): headers, one chunk `00dc` per picture, and an index.
#[derive(Debug)]
struct Avi {
    out: BufWriter<File>,
    size: (usize, usize),
    rate: u32,
    /// Offset from the start of `movi`, and length, of every picture.
    pictures: Vec<(u32, u32)>,
    bytes: u64,
}

/// Bytes before the first picture's chunk.
const HEADERS: u64 = 224;
/// Where the list `movi` counts from.
const MOVI: u64 = HEADERS - 4;

impl Avi {
    fn create(path: &Path, size: (usize, usize), rate: u32) -> std::io::Result<Self> {
        let mut avi = Self {
            out: BufWriter::new(File::create(path)?),
            size,
            rate,
            pictures: Vec::new(),
            bytes: HEADERS,
        };
        avi.headers(0)?;
        Ok(avi)
    }

    fn push(&mut self, rgb: &[u8]) -> std::io::Result<()> {
        let mut jpeg = Vec::new();
        let (width, height) = (self.size.0 as u16, self.size.1 as u16);
        Encoder::new(&mut jpeg, QUALITY)
            .encode(rgb, width, height, ColorType::Rgb)
            .map_err(std::io::Error::other)?;
        let length = jpeg.len() as u32;
        self.pictures.push(((self.bytes - MOVI) as u32, length));
        self.out.write_all(b"00dc")?;
        self.out.write_all(&length.to_le_bytes())?;
        self.out.write_all(&jpeg)?;
        // Chunks start at even places.
        self.out.write_all(&[0][..jpeg.len() % 2])?;
        self.bytes += 8 + jpeg.len().next_multiple_of(2) as u64;
        Ok(())
    }

    fn finish(mut self) -> std::io::Result<()> {
        self.out.write_all(b"idx1")?;
        let length = 16 * self.pictures.len() as u32;
        self.out.write_all(&length.to_le_bytes())?;
        for (offset, length) in &self.pictures {
            self.out.write_all(b"00dc")?;
            // Every picture is a key frame.
            for number in [0x10, *offset, *length] {
                self.out.write_all(&number.to_le_bytes())?;
            }
        }
        self.out.seek(SeekFrom::Start(0))?;
        self.headers(8 + length)?;
        self.out.flush()
    }

    /// The headers, with what is known of the pictures so far; `index` is the length of the index.
    fn headers(&mut self, index: u32) -> std::io::Result<()> {
        let (width, height) = (self.size.0 as u32, self.size.1 as u32);
        let count = self.pictures.len() as u32;
        let largest = self.pictures.iter().map(|(_, n)| *n).max().unwrap_or(0);
        let end = self.bytes as u32;
        let mut head = Vec::with_capacity(HEADERS as usize);
        let mut put = |name: &[u8; 4], numbers: &[u32]| {
            head.extend_from_slice(name);
            head.extend(numbers.iter().flat_map(|n| n.to_le_bytes()));
        };
        put(b"RIFF", &[end - 8 + index]);
        put(b"AVI ", &[]);
        put(b"LIST", &[192]);
        put(b"hdrl", &[]);
        let per_picture = 1_000_000 / self.rate.max(1);
        let main = [
            per_picture,
            largest * self.rate,
            0,
            0x10,
            count,
            0,
            1,
            largest,
        ];
        put(
            b"avih",
            &[&[56], &main[..], &[width, height, 0, 0, 0, 0]].concat(),
        );
        put(b"LIST", &[116]);
        put(b"strl", &[]);
        put(b"strh", &[56]);
        put(b"vids", &[]);
        let rectangle = width | height << 16;
        let timing = [
            0,
            0,
            0,
            1,
            self.rate,
            0,
            count,
            largest,
            u32::MAX,
            0,
            0,
            rectangle,
        ];
        put(b"MJPG", &timing);
        put(b"strf", &[40, 40, width, height, 1 | 24 << 16]);
        put(b"MJPG", &[width * height * 3, 0, 0, 0, 0]);
        put(b"LIST", &[end - MOVI as u32]);
        put(b"movi", &[]);
        self.out.write_all(&head)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::video::image::Image;

    #[test]
    fn pictures_come_back_out_of_the_file_where_its_index_says() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.avi");
        let mut movie = Movie::create(&path, (32, 16), 30).unwrap();
        for shade in [0, 100, 200] {
            movie.push(&Canvas::new(32, 16, [shade; 3])).unwrap();
        }
        assert!(movie.push(&Canvas::new(8, 8, [0; 3])).is_err());
        movie.finish().unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let number = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!((&bytes[..4], &bytes[8..12]), (&b"RIFF"[..], &b"AVI "[..]));
        assert_eq!(number(4) as usize + 8, bytes.len());
        let movi = MOVI as usize;
        assert_eq!(&bytes[movi..movi + 4], b"movi");
        let index = movi + number(movi - 4) as usize;
        assert_eq!(
            (&bytes[index..index + 4], number(index + 4)),
            (&b"idx1"[..], 48)
        );
        for (entry, shade) in [0_u8, 100, 200].into_iter().enumerate() {
            let at = index + 8 + 16 * entry;
            let (chunk, length) = (movi + number(at + 8) as usize, number(at + 12) as usize);
            assert_eq!(&bytes[chunk..chunk + 4], b"00dc");
            let image = Image::from_jpeg(&bytes[chunk + 8..chunk + 8 + length]).unwrap();
            assert!(image.data[0].abs_diff(shade) < 3);
        }
    }

    #[test]
    fn a_name_of_no_kind_is_refused() {
        let error = Movie::create(Path::new("a.mkv"), (8, 8), 30).unwrap_err();
        assert!(error.to_string().contains("`.mp4` (by `ffmpeg`) or `.avi`"));
    }
}
