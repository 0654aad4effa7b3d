//! A reconstruction as a data set for view synthesis: pictures of the video with their cameras, for NerfStudio.

use super::export::nerfstudio::{TRANSFORMS, picture, transforms};
use super::overlay::{Overlay, OverlayError, SIDE};
use super::predictions::ScaleStatus;
use crate::clip::clock::SIGNAL_RATE;
use crate::geometry::rigid::Rigid;
use crate::video::Video;
use crate::view::movie::MovieError;
use jpeg_encoder::{ColorType, Encoder};
use std::path::Path;

/// Pictures a second.
const RATE: f64 = 8.0;
const QUALITY: u8 = 92;

/// Writes `transforms.json` and `images/` into `out`, from the reconstruction folder `folder` and its video. Metric points are named
/// where the folder has them.
///
/// # Errors
/// When the folder has no camera, the video cannot be read, or a file cannot be written.
pub fn write_nerfstudio(folder: &Path, video: &Video, out: &Path) -> Result<(), OverlayError> {
    let made = Overlay::open(folder)?;
    if made.camera.is_empty() {
        return Err(OverlayError::Folder {
            path: folder.to_owned(),
            reason: "it has no camera path".to_owned(),
        });
    }
    let io = |path: &Path| {
        let path = path.to_owned();
        move |error| OverlayError::Movie(MovieError::Io { path, error })
    };
    let images = out.join("images");
    std::fs::create_dir_all(&images).map_err(io(&images))?;
    let count = (made.manifest.seconds * RATE).ceil() as usize;
    let schedule = video.schedule();
    // A frame may be shown longer than one picture: every frame is taken once.
    let mut chosen: Vec<(usize, &Rigid)> = Vec::new();
    for index in 0..count {
        let seconds = index as f64 / RATE;
        let frame = schedule.nearest(made.manifest.start_seconds + seconds);
        let sample = (seconds * SIGNAL_RATE).round_ties_even() as usize;
        let pose = &made.camera[sample.min(made.camera.len() - 1)];
        if chosen.last().is_none_or(|(last, _)| *last < frame) {
            chosen.push((frame, pose));
        }
    }
    let frames = chosen.iter().map(|(frame, _)| *frame).collect();
    let squares = video.squares(frames, SIDE, rayon::current_num_threads())?;
    let mut poses = Vec::new();
    for (square, (_, pose)) in squares.zip(&chosen) {
        let (_, image) = square?;
        let path = out.join(picture(poses.len()));
        let (width, height) = (image.width as u16, image.height as u16);
        Encoder::new_file(&path, QUALITY)
            .and_then(|encoder| encoder.encode(&image.data, width, height, ColorType::Rgb))
            .map_err(|error| io(&path)(std::io::Error::other(error)))?;
        poses.push(**pose);
    }
    let metric = matches!(made.manifest.scale, ScaleStatus::Metric { .. });
    let cloud = folder.join("points.ply");
    let mut points = None;
    if metric && cloud.is_file() {
        let copy = out.join("points.ply");
        std::fs::copy(&cloud, &copy).map_err(io(&copy))?;
        points = Some("points.ply");
    }
    let data = transforms(&poses, &made.manifest.intrinsics, SIDE, points);
    let path = out.join(TRANSFORMS);
    std::fs::write(&path, format!("{data:#}\n")).map_err(io(&path))
}
