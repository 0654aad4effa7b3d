//! One folder with everything: arrays, exports, manifest and page, built window by window.
//!
//! Here is what goes in and the scale fit; [`files`] writes arrays and exports, [`page`] puts the page together.

mod files;
mod page;

use self::files::write_file;
use super::cloud::{lift, ray};
use super::depth::{DepthSeam, DepthStitcher};
use super::export::files::sample_of;
use super::export::manifest::ArrayFacts;
use super::export::ply::Point;
pub use super::folder_error::FolderError;
use super::frame_buffer::DepthSpool;
use super::predictions::ScaleStatus;
use super::scale::{
    DepthFit, DepthRay, FloorFit, ScaleRefusal, fit_anchor, fit_floor, floor_height,
};
use super::stitch::{Stitcher, Tracks, WindowBoundary, gravity_to_world};
use super::windows::Window;
use crate::clip::clock::{SIGNAL_RATE, SIGNAL_SAMPLES};
use crate::clip::{Clip, Intrinsics};
use crate::geometry::rigid::Rigid;
use crate::geometry::skeleton::BODY;
use crate::modality::ClipFormat;
use crate::view::{Badge, Fact, VideoFrames, write_page};
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayView4, Axis};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

/// The name of the folder inside an artifact.
pub const FOLDER: &str = "reconstruction";
/// Its page.
pub const PAGE: &str = "view.html";

/// Side of the depth grid that the page and the fits use; the file keeps the full resolution.
const GRID: usize = 64;
/// Points of the whole recording in `points.ply` and in the fits, at most.
const POINTS: usize = 2_000_000;
/// Depth is never nearer than this, metres.
const NEAREST: f32 = 0.01;

/// What is known, or assumed, before the first window.
#[derive(Debug, Clone)]
pub struct ReconstructionInfo {
    pub title: String,
    /// Hz of the model's video.
    pub video_rate: f64,
    /// Video frames and motion samples of the whole reconstruction.
    pub frames: usize,
    pub samples: usize,
    /// Of the square frames that are pushed.
    pub intrinsics: Intrinsics,
    /// World pose of the first camera.
    pub first: Rigid,
    pub floor_fit: FloorFit,
    /// `[T, S, S]` metric depth of another model at the frames of this video; NaN where unknown.
    pub anchor: Option<Array3<f32>>,
    /// What was assumed and where it came from, with the flag that overrides it.
    pub assumptions: Vec<Fact>,
    /// Beside the scale status: `synthetic`, ...
    pub badges: Vec<Badge>,
    /// The true clip, where it is known and the video is one clip.
    pub truth: Option<Clip>,
}

/// What `manifest.json` of the folder holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    pub title: String,
    /// Label and value: what was assumed.
    pub assumptions: Vec<[String; 2]>,
    pub seconds: f64,
    pub intrinsics: Intrinsics,
    pub scale: ScaleStatus,
    /// The fit that made depth metric.
    pub fit: Option<DepthFit>,
    /// Why depth stayed relative.
    pub refused: Option<String>,
    pub arrays: Vec<ArrayFacts>,
    pub seams: Vec<WindowBoundary>,
    pub depth_seams: Vec<DepthSeam>,
    /// Mean confidence by modality: from token entropies, 0 (a guess) to 1 (certain). Not an accuracy.
    pub confidence: BTreeMap<String, f64>,
    pub files: Vec<String>,
}

/// Builds the folder window by window.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    setting: ReconstructionInfo,
    stitcher: Stitcher,
    depth: DepthStitcher,
    spool: DepthSpool,
    grids: Vec<Array2<f32>>,
    video: VideoFrames,
    /// Colours of the frames on the depth grid, for the points.
    colors: Vec<Array3<u8>>,
    confidence: BTreeMap<String, Vec<f32>>,
}

impl Folder {
    /// Starts the folder `path`.
    ///
    /// # Errors
    /// When it cannot be made or written to.
    pub fn new(path: &Path, setting: ReconstructionInfo) -> Result<Self, FolderError> {
        let io = |error| FolderError::Io {
            path: path.to_owned(),
            error,
        };
        std::fs::create_dir_all(path).map_err(io)?;
        Ok(Self {
            spool: DepthSpool::new(path).map_err(io)?,
            path: path.to_owned(),
            stitcher: Stitcher::new(setting.first),
            video: VideoFrames::new(setting.video_rate),
            setting,
            depth: DepthStitcher::default(),
            grids: Vec::new(),
            colors: Vec::new(),
            confidence: BTreeMap::new(),
        })
    }

    /// With what the modalities of the decoded clips say of themselves: channels, units, rates.
    #[must_use]
    pub fn with_format(mut self, format: &ClipFormat) -> Self {
        self.stitcher = self.stitcher.with_format(format);
        self
    }

    /// Adds a window: its frames `[T, S, S, 3]`, the decoded clip, and per modality the confidence of its samples, at any
    /// rate, over the whole window.
    ///
    /// # Errors
    /// When a frame cannot be stored or the disk is full.
    pub fn push(
        &mut self,
        window: &Window,
        rgb: ArrayView4<u8>,
        decoded: &Clip,
        confidence: &BTreeMap<String, Vec<f32>>,
    ) -> Result<(), FolderError> {
        let start = window.start_frame(self.setting.video_rate);
        for (index, frame) in rgb.axis_iter(Axis(0)).enumerate() {
            if start + index == self.video.len() && self.video.len() < self.setting.frames {
                self.video.push(frame)?;
                self.colors.push(sample_colors(frame));
            }
        }
        self.stitcher.push(window, decoded);
        for (name, values) in confidence {
            if values.is_empty() {
                continue;
            }
            // Signals have rates of their own: spread over the motion samples of the window.
            let at = |sample: usize| values[sample * values.len() / SIGNAL_SAMPLES];
            let held = self.confidence.entry(name.clone()).or_default();
            held.truncate(window.start + window.overlap / 2);
            held.resize(window.start.max(held.len()), f32::NAN);
            let from = held.len() - window.start;
            held.extend((from..window.inside).map(at));
        }
        if let Some(depth) = decoded.depth() {
            let done = self.depth.push(window.index, start, depth.metres.view());
            self.take_depth(&done)?;
        }
        Ok(())
    }

    /// Fits the scale and writes everything.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn finish(mut self) -> Result<Manifest, FolderError> {
        let (rest, depth_seams) = std::mem::take(&mut self.depth).finish();
        self.take_depth(&rest)?;
        let fresh = self.stitcher.another();
        let (tracks, seams) = std::mem::replace(&mut self.stitcher, fresh).finish();
        let feet = foot_heights(&tracks);
        let floor = floor_height(&feet, self.setting.floor_fit.rule).ok();
        let (scale, fit, refused) = self.fit_scale(&tracks, floor);
        if let Some(fit) = &fit {
            for grid in &mut self.grids {
                grid.mapv_inplace(|d| (fit.scale as f32 * d + fit.shift as f32).max(NEAREST));
            }
        }
        let cloud = self.cloud(&tracks);
        let mut manifest = Manifest {
            title: self.setting.title.clone(),
            assumptions: self
                .setting
                .assumptions
                .iter()
                .map(|f| [f.label.clone(), f.value.clone()])
                .collect(),
            seconds: self.setting.samples as f64 / SIGNAL_RATE,
            intrinsics: self.setting.intrinsics,
            scale,
            fit,
            refused,
            arrays: Vec::new(),
            seams,
            depth_seams,
            confidence: self
                .confidence
                .iter()
                .map(|(k, v)| (k.clone(), mean(v)))
                .collect(),
            files: Vec::new(),
        };
        self.write_tracks(&tracks, &mut manifest)?;
        self.write_points(&cloud, &mut manifest)?;
        let page = self.page(&tracks, cloud, floor, &manifest);
        let path = self.path.clone();
        write_file(&path, PAGE, &mut manifest.files, |out| {
            Ok(write_page(&page, out)?)
        })?;
        self.write_depth(&mut manifest)?;
        manifest.files.push("manifest.json".into());
        manifest.files.sort();
        let json = serde_json::to_vec_pretty(&manifest)?;
        write_file(&path, "manifest.json", &mut Vec::new(), |out| {
            out.write_all(&json).map_err(|error| FolderError::Io {
                path: path.clone(),
                error,
            })
        })?;
        Ok(manifest)
    }

    fn take_depth(&mut self, frames: &[Array2<f32>]) -> Result<(), FolderError> {
        for frame in frames {
            if self.spool.frames() < self.setting.frames {
                self.spool.push(frame).map_err(|error| FolderError::Io {
                    path: self.path.clone(),
                    error,
                })?;
                self.grids.push(thin(frame.view()));
            }
        }
        Ok(())
    }

    fn fit_scale(
        &self,
        tracks: &Tracks,
        floor: Option<f64>,
    ) -> (ScaleStatus, Option<DepthFit>, Option<String>) {
        if self.grids.is_empty() {
            return (ScaleStatus::None, None, None);
        }
        let (by, fit) = match &self.setting.anchor {
            Some(anchor) => ("anchor depth", self.fit_to_anchor(anchor)),
            None if tracks.camera().is_empty() => ("floor fit", Err(ScaleRefusal::NoCamera)),
            None if tracks.body().is_empty() => ("floor fit", Err(ScaleRefusal::NoBody)),
            None => ("floor fit", self.fit_to_floor(tracks, floor)),
        };
        match fit {
            Ok(fit) => (ScaleStatus::Metric { by: by.into() }, Some(fit), None),
            Err(refusal) => (ScaleStatus::Relative, None, Some(refusal.to_string())),
        }
    }

    fn fit_to_floor(&self, tracks: &Tracks, floor: Option<f64>) -> Result<DepthFit, ScaleRefusal> {
        let floor = floor.ok_or(ScaleRefusal::NoFeet { found: 0 })?;
        let mut rays = Vec::new();
        for (frame, grid) in self.grids.iter().enumerate().step_by(self.stride()) {
            let pose = tracks.camera()[self.sample_of(frame, tracks.camera().len())];
            for ((row, column), &depth) in grid.indexed_iter() {
                let [x, y] = ray(
                    &self.setting.intrinsics,
                    [grid.nrows(), grid.ncols()],
                    row,
                    column,
                );
                rays.push(DepthRay::new(f64::from(depth), &pose, x, y));
            }
        }
        fit_floor(&rays, floor, &self.setting.floor_fit)
    }

    fn fit_to_anchor(&self, anchor: &Array3<f32>) -> Result<DepthFit, ScaleRefusal> {
        let mut pairs = Vec::new();
        let both = self.grids.iter().zip(anchor.axis_iter(Axis(0)));
        for (grid, metric) in both.step_by(self.stride()) {
            let (rows, columns) = metric.dim();
            for ((row, column), &depth) in grid.indexed_iter() {
                let at = [
                    centre(row, grid.nrows(), rows),
                    centre(column, grid.ncols(), columns),
                ];
                pairs.push((f64::from(depth), f64::from(metric[at])));
            }
        }
        fit_anchor(&pairs)
    }

    /// Every how many frames are taken, so that no more than [`POINTS`] cells are.
    fn stride(&self) -> usize {
        let cells: usize = self.grids.iter().map(Array2::len).sum();
        cells.div_ceil(POINTS).max(1)
    }

    fn sample_of(&self, frame: usize, samples: usize) -> usize {
        sample_of(frame, self.setting.video_rate, samples)
    }

    fn cloud(&self, tracks: &Tracks) -> Vec<Point> {
        if tracks.camera().is_empty() || self.grids.is_empty() {
            return Vec::new();
        }
        let frames = self.grids.iter().zip(&self.colors).enumerate();
        let mut points = Vec::new();
        for (frame, (grid, colors)) in frames.step_by(self.stride()) {
            let pose = &tracks.camera()[self.sample_of(frame, tracks.camera().len())];
            points.extend(lift(
                grid.view(),
                colors.view(),
                &self.setting.intrinsics,
                pose,
                1,
            ));
        }
        points
    }
}

/// Heights of both feet and toes over all samples.
fn foot_heights(tracks: &Tracks) -> Vec<f64> {
    let feet: Vec<usize> = ["left_foot", "right_foot"]
        .iter()
        .filter_map(|name| BODY.joint(name))
        .collect();
    tracks
        .body()
        .iter()
        .flat_map(|pose| feet.iter().map(|&j| f64::from(pose[j][2])))
        .collect()
}

/// At most [`GRID`] cells a side: the values at the cells' centres.
pub(super) fn thin(frame: ArrayView2<'_, f32>) -> Array2<f32> {
    let (rows, columns) = (frame.nrows().min(GRID), frame.ncols().min(GRID));
    Array2::from_shape_fn((rows, columns), |(row, column)| {
        frame[[
            centre(row, rows, frame.nrows()),
            centre(column, columns, frame.ncols()),
        ]]
    })
}

fn sample_colors(frame: ArrayView3<u8>) -> Array3<u8> {
    let (height, width, _) = frame.dim();
    let (rows, columns) = (height.min(GRID), width.min(GRID));
    Array3::from_shape_fn((rows, columns, 3), |(row, column, c)| {
        frame[[centre(row, rows, height), centre(column, columns, width), c]]
    })
}

/// The index among `many` under the centre of cell `index` of `few`.
fn centre(index: usize, few: usize, many: usize) -> usize {
    (((index as f64 + 0.5) / few as f64 * many as f64) as usize).min(many - 1)
}

fn mean(values: &[f32]) -> f64 {
    let known: Vec<f64> = values
        .iter()
        .filter(|v| v.is_finite())
        .map(|&v| f64::from(v))
        .collect();
    if known.is_empty() {
        f64::NAN
    } else {
        known.iter().sum::<f64>() / known.len() as f64
    }
}

/// World pose of the first camera that puts a known first camera at the origin, heading along its right axis.
pub fn first_camera(T_world_camera: &Rigid) -> Rigid {
    gravity_to_world(T_world_camera).inverse() * T_world_camera
}
