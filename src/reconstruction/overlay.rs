//! A reconstruction drawn into its own video: made from the folder and the video, so that it can be asked for at any time.

use super::folder::Manifest;
use crate::clip::clock::SIGNAL_RATE;
use crate::formats::npz::Npz;
use crate::formats::{FormatError, ReadError};
use crate::geometry::rigid::{self, Rigid};
use crate::geometry::skeleton::{JOINTS, Joints};
use crate::video::Video;
use crate::view::canvas::Canvas;
use crate::view::movie::{Movie, MovieError};
use crate::view::overlay::{Moment, draw};
use ndarray::{Array2, Array3};
use std::path::{Path, PathBuf};

/// Side of the movie's square pictures, pixels.
pub const SIDE: u32 = 512;

/// Why there is no overlay.
#[derive(Debug, thiserror::Error)]
pub enum OverlayError {
    /// The folder holds no reconstruction that can be drawn.
    #[error("{}: no reconstruction: {reason}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What is lacking or wrong.
        reason: String,
    },
    /// An array of the folder cannot be read.
    #[error(transparent)]
    Arrays(#[from] FormatError),
    /// The video that was reconstructed cannot be read.
    #[error(transparent)]
    Video(#[from] ReadError),
    /// The movie cannot be written.
    #[error(transparent)]
    Movie(#[from] MovieError),
}

/// What is drawn, read from a reconstruction folder.
#[derive(Debug)]
pub struct Overlay {
    pub(super) manifest: Manifest,
    pub(super) camera: Vec<Rigid>,
    body: Vec<Joints>,
    hands: [Vec<Joints>; 2],
    gaze: Vec<[f32; 2]>,
}

impl Overlay {
    /// Reads a reconstruction folder; what it does not have is not drawn.
    ///
    /// # Errors
    /// When it is none, or a file of it is damaged.
    pub fn open(folder: &Path) -> Result<Self, OverlayError> {
        let refuse = |reason: String| OverlayError::Folder {
            path: folder.to_owned(),
            reason,
        };
        let manifest = Manifest::read(folder).map_err(|e| refuse(e.to_string()))?;
        let has = |file: &str| manifest.files.iter().any(|name| name == file);
        let arrays = |file: &str| {
            if has(file) {
                Npz::read(&folder.join(file))
            } else {
                Ok(Npz::default())
            }
        };
        let joints = |npz: &Npz, name: &str| -> Result<Vec<Joints>, OverlayError> {
            let Ok(array) = npz.get(name) else {
                return Ok(Vec::new());
            };
            let values: Array3<f32> = array.to_dim()?;
            if values.shape()[1..] != [JOINTS, 3] {
                return Err(refuse(format!("`{name}` of shape {:?}", values.shape())));
            }
            let pose = |t| std::array::from_fn(|j| std::array::from_fn(|k| values[[t, j, k]]));
            Ok((0..values.shape()[0]).map(pose).collect())
        };
        let hands = arrays("hands.npz")?;
        let mut camera = Vec::new();
        if let Ok(array) = arrays("camera.npz")?.get("T_world_camera") {
            let values: Array3<f64> = array.to_dim()?;
            for pose in values.outer_iter() {
                let flat: Vec<f64> = pose.iter().copied().collect();
                let numbers = flat
                    .try_into()
                    .map_err(|_| refuse("`T_world_camera` is not 4 x 4".to_owned()))?;
                let pose = rigid::from_row_major(&numbers).map_err(|e| refuse(e.to_string()))?;
                camera.push(pose);
            }
        }
        let mut gaze = Vec::new();
        if let Ok(array) = arrays("gaze.npz")?.get("gaze") {
            let values: Array2<f32> = array.to_dim()?;
            gaze.extend(values.rows().into_iter().map(|p| [p[0], p[1]]));
        }
        Ok(Self {
            camera,
            body: joints(&arrays("body.npz")?, "body")?,
            hands: [joints(&hands, "left_hand")?, joints(&hands, "right_hand")?],
            gaze,
            manifest,
        })
    }

    fn moment(&self, sample: usize) -> Moment<'_> {
        Moment {
            T_world_camera: self.camera.get(sample),
            body: self.body.get(sample),
            hands: [self.hands[0].get(sample), self.hands[1].get(sample)],
            gaze: self.gaze.get(sample).copied(),
        }
    }

    /// Draws every motion sample into the frame of `video` that was shown then, and writes the movie to `path`: an `.avi` (Motion
    /// JPEG), or an `.mp4` by `ffmpeg`. Memory does not grow with the video.
    ///
    /// # Errors
    /// When the video cannot be read or the movie cannot be written.
    pub fn write(&self, video: &Video, path: &Path) -> Result<(), OverlayError> {
        let samples = (self.manifest.seconds * SIGNAL_RATE).round() as usize;
        let schedule = video.schedule();
        let start = self.manifest.start_seconds;
        let frame_of = |sample: usize| schedule.nearest(start + sample as f64 / SIGNAL_RATE);
        let chosen: Vec<usize> = (0..samples).map(frame_of).collect();
        let threads = rayon::current_num_threads();
        let mut frames = video.squares(chosen.clone(), SIDE, threads)?;
        let size = (SIDE as usize, SIDE as usize);
        let mut movie = Movie::create(path, size, SIGNAL_RATE as u32)?;
        let mut shown = None;
        for (sample, wanted) in chosen.into_iter().enumerate() {
            while shown.as_ref().is_none_or(|(number, _)| *number < wanted) {
                let Some(next) = frames.next() else { break };
                shown = Some(next?);
            }
            // A video that ends early ends the movie.
            let Some((_, image)) = &shown else { break };
            let mut canvas = Canvas::of(image.clone());
            draw(&mut canvas, &self.manifest.intrinsics, &self.moment(sample));
            movie.push(&canvas)?;
        }
        Ok(movie.finish()?)
    }
}
