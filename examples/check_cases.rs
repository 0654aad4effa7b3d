//! Runs folders of difficult inputs through the readers: `cargo run --example check_cases DIR [NAME]`.
//!
//! `DIR` holds one folder per case. Frames of its videos and pictures carry their number as a bar code (eight cells of a dark
//! or bright top row, most significant first), so that what was read can be told from what should have been.

use reviv::formats::ReadError;
use reviv::video::Video;
use reviv::video::image::Image;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

type Check = fn(&Path) -> Result<(), String>;

/// What each case has to give.
const CASES: &[(&str, Check)] = &[
    ("anamorphic", |folder| {
        let video = open(&folder.join("sar.mp4"))?;
        let info = video.info();
        same("size", (info.width, info.height), (96, 64))?;
        numbers(&video, (0..120).collect())
    }),
    ("appledouble", |folder| frames(&folder.join("pictures"), 6)),
    ("avc3", |folder| frames(&folder.join("avc3.mp4"), 120)),
    ("avi-mjpeg", |folder| frames(&folder.join("mjpg.avi"), 120)),
    ("avi-xvid", |folder| frames(&folder.join("xvid.avi"), 120)),
    (
        "color-and-depth-in-one-folder",
        |folder| match Video::open(folder.join("pictures")) {
            Err(error) if error.to_string().contains("more than one series") => Ok(()),
            other => Err(format!("{:?}", other.map(|video| video.info().clone()))),
        },
    ),
    ("colr-nclx", |folder| {
        let path = folder.join("colr709.mp4");
        frames(&path, 120)?;
        let image = first(&open(&path)?)?;
        same("red block", pixel(&image, 2, 20), [212, 45, 27])
    }),
    ("cover-first", |folder| {
        frames(&folder.join("hevc_cover0.mp4"), 120)
    }),
    ("edit-hevc-two", |folder| {
        let video = open(&folder.join("hevc_edit_two.mp4"))?;
        numbers(&video, (0..30).chain(90..120).collect())
    }),
    ("edit-two-segments", |folder| {
        let video = open(&folder.join("edit_two.mp4"))?;
        same("seconds", video.info().seconds(), 2.0)?;
        numbers(&video, (0..30).chain(90..120).collect())
    }),
    ("exif-6", |folder| frames(&folder.join("pictures"), 12)),
    ("long-hevc", |folder| {
        let video = open(&folder.join("long14.mp4"))?;
        // These frames carry no number.
        same("frames", video.info().frames, 420)?;
        let read = video.frames(0..420).map_err(|error| error.to_string())?;
        let read = read.collect::<Result<Vec<_>, _>>();
        same(
            "frames read",
            read.map_err(|error| error.to_string())?.len(),
            420,
        )
    }),
    ("lossless-420", |folder| {
        frames(&folder.join("lossless.mp4"), 120)
    }),
    ("mirror-h", |folder| {
        let video = open(&folder.join("hflip.mp4"))?;
        let image = first(&video)?;
        let [yellow, blue] = [8, 24].map(|x| pixel(&image, x, 24));
        let right = yellow[0] > 128 && yellow[1] > 128 && yellow[2] < 96 && blue[2] > 128;
        right.then_some(()).ok_or(format!("{yellow:?} {blue:?}"))
    }),
    ("raw-h264", |folder| frames(&folder.join("raw.h264"), 120)),
    ("trailer", |folder| frames(&folder.join("trailer.mp4"), 120)),
    ("two-descriptions", |folder| {
        frames(&folder.join("multi_qp.mp4"), 120)
    }),
];

fn open(path: &Path) -> Result<Video, String> {
    Video::open(path).map_err(|error| error.to_string())
}

fn frames(path: &Path, count: usize) -> Result<(), String> {
    numbers(&open(path)?, (0..count).collect())
}

/// All frames carry these numbers: read from the first on, each half by itself, and every fourth one.
fn numbers(video: &Video, expected: Vec<usize>) -> Result<(), String> {
    let count = expected.len();
    same("frames", video.info().frames, count)?;
    let half = (count / 2..count).collect();
    for chosen in [(0..count).collect(), half, (1..count).step_by(4).collect()] {
        let found: Result<Vec<(usize, usize)>, ReadError> =
            video.chosen(chosen).and_then(|frames| {
                frames
                    .map(|f| f.map(|f| (f.index, number(&f.image))))
                    .collect()
            });
        for (index, number) in found.map_err(|error| error.to_string())? {
            same(&format!("frame {index}"), number, expected[index])?;
        }
    }
    Ok(())
}

/// The bar code of the top row.
fn number(image: &Image) -> usize {
    let row = (image.height / 16).max(1);
    (0..8).fold(0, |number, cell| {
        let [_, green, _] = pixel(image, (2 * cell + 1) * image.width / 16, row);
        number << 1 | usize::from(green > 127)
    })
}

fn first(video: &Video) -> Result<Image, String> {
    let mut frames = video.frames(0..1).map_err(|error| error.to_string())?;
    let frame = frames.next().ok_or("no frame")?;
    Ok(frame.map_err(|error| error.to_string())?.image)
}

fn pixel(image: &Image, x: u32, y: u32) -> [u8; 3] {
    let at = 3 * (y * image.width + x) as usize;
    [image.data[at], image.data[at + 1], image.data[at + 2]]
}

fn same<T: PartialEq + std::fmt::Debug>(what: &str, found: T, right: T) -> Result<(), String> {
    if found == right {
        return Ok(());
    }
    Err(format!("{what}: {found:?} instead of {right:?}"))
}

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let Some(root) = arguments.next().map(PathBuf::from) else {
        eprintln!("usage: check_cases DIR [NAME]");
        return ExitCode::from(2);
    };
    let only = arguments.next();
    let (mut passed, mut total) = (0, 0);
    for (name, check) in CASES {
        let folder = root.join(name);
        if only.as_ref().is_some_and(|only| only != name) || !folder.is_dir() {
            continue;
        }
        total += 1;
        match check(&folder) {
            Ok(()) => passed += 1,
            Err(reason) => println!("{name}: {reason}"),
        }
    }
    println!("{passed}/{total} passed");
    if passed == total {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}
