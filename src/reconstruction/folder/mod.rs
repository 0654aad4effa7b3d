//! A reconstruction, built window by window, and the folder it is written to: arrays, exports, manifest and page.
//!
//! Here is what goes in and the scale fit; [`files`] writes arrays and exports, [`page`] puts the page together.

mod files;
mod page;

use self::files::write_file;
use super::cloud::lift;
use super::depth::{DepthSeam, DepthStitcher};
use super::export::files::sample_of;
use super::export::manifest::ArrayFacts;
use super::export::ply::Point;
use super::floor::{View, fit_floor, floor_height};
pub use super::folder_error::FolderError;
use super::frame_buffer::DepthFrames;
use super::predictions::ScaleStatus;
use super::result::{Depth, Reconstruction, ReconstructionInfo};
use super::scale::{DepthFit, DepthSpace, ScaleRefusal, fit_anchor};
use super::stitch::{Stitcher, Tracks, WindowBoundary, gravity_to_world};
use super::windows::Window;
use crate::clip::clock::SIGNAL_SAMPLES;
use crate::clip::depth_video::{DepthCoding, DepthKind, DepthRange};
use crate::clip::{Clip, Intrinsics};
use crate::geometry::rigid::Rigid;
use crate::geometry::skeleton::BODY;
use crate::modality::ClipFormat;
use crate::view::{VideoFrames, write_page};
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayView4, Axis};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;

/// The name of the folder inside an artifact.
pub const FOLDER: &str = "reconstruction";
/// Its page.
pub const PAGE: &str = "view.html";

/// Side of the depth grid that the page and the fits use; the file keeps the full resolution.
const GRID: usize = 64;
/// Points of the whole recording in `points.ply` and in the fits, at most.
const POINTS: usize = 2_000_000;
/// The file of the folder that says what is in it.
pub const MANIFEST: &str = "manifest.json";

/// What [`MANIFEST`] holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// The name of the recording.
    pub title: String,
    /// Label and value: what was assumed.
    pub assumptions: Vec<[String; 2]>,
    /// Where in the video it starts.
    #[serde(default)]
    pub start_seconds: f64,
    /// Length of the recording, seconds.
    pub seconds: f64,
    /// Of the square frames that the model saw, pixels.
    pub intrinsics: Intrinsics,
    /// Whether depth is metric, and by what.
    pub scale: ScaleStatus,
    /// The fit that made depth metric.
    pub fit: Option<DepthFit>,
    /// Why depth stayed relative.
    pub refused: Option<String>,
    /// What the arrays in the folder's files are.
    pub arrays: Vec<ArrayFacts>,
    /// How well neighbouring windows agree, in the order of time.
    pub seams: Vec<WindowBoundary>,
    /// How the depth of each window was brought to the scale of the one before it.
    pub depth_seams: Vec<DepthSeam>,
    /// Mean certainty by modality: from token entropies, 0 (a guess) to 1 (certain). Not an accuracy.
    pub certainty: BTreeMap<String, f64>,
    /// The files of the folder, this one included, relative to it and sorted.
    pub files: Vec<String>,
}

impl Manifest {
    /// The manifest of a folder that [`Reconstruction::write`] made.
    ///
    /// # Errors
    /// When there is none, or it is damaged.
    pub fn read(folder: &Path) -> Result<Self, FolderError> {
        let path = folder.join(MANIFEST);
        let text = std::fs::read(&path).map_err(FolderError::io(&path))?;
        Ok(serde_json::from_slice(&text)?)
    }
}

/// Builds a reconstruction window by window.
#[derive(Debug)]
pub struct Builder {
    info: ReconstructionInfo,
    stitcher: Stitcher,
    samples: Vec<Stitcher>,
    depth: DepthStitcher,
    frames: DepthFrames,
    grids: Vec<Array2<f32>>,
    video: VideoFrames,
    /// Colours of the frames on the depth grid, for the points.
    colors: Vec<Array3<u8>>,
    certainty: BTreeMap<String, Vec<f32>>,
    /// What the depth of the windows means; `None`: up to scale and shift.
    coding: Option<DepthCoding>,
}

impl Builder {
    /// Starts a reconstruction whose depth goes into `frames`.
    #[must_use]
    pub fn new(info: ReconstructionInfo, frames: DepthFrames) -> Self {
        Self {
            frames,
            stitcher: Stitcher::new(info.first),
            samples: Vec::new(),
            video: VideoFrames::new(info.video_rate),
            info,
            depth: DepthStitcher::default(),
            grids: Vec::new(),
            colors: Vec::new(),
            certainty: BTreeMap::new(),
            coding: None,
        }
    }

    /// With what the modalities of the decoded clips say of themselves: channels, units, rates.
    #[must_use]
    pub fn with_format(mut self, format: &ClipFormat) -> Self {
        self.stitcher = self.stitcher.with_format(format);
        self.coding = Some(format.depth);
        self
    }

    /// Adds a window: its frames `[T, S, S, 3]`, the decoded clip, and per modality the certainty of its samples, at any
    /// rate, over the whole window.
    ///
    /// # Errors
    /// When a frame cannot be stored or the disk is full.
    pub fn push(
        &mut self,
        window: &Window,
        rgb: ArrayView4<u8>,
        decoded: &Clip,
        certainty: &BTreeMap<String, Vec<f32>>,
    ) -> Result<(), FolderError> {
        let start = window.start_frame(self.info.video_rate);
        for (index, frame) in rgb.axis_iter(Axis(0)).enumerate() {
            if start + index == self.video.len() && self.video.len() < self.info.frames {
                self.video.push(frame)?;
                self.colors.push(sample_colors(frame));
            }
        }
        self.stitcher.push(window, decoded);
        for (name, values) in certainty {
            if values.is_empty() {
                continue;
            }
            // Signals have rates of their own: spread over the motion samples of the window.
            let at = |sample: usize| values[sample * values.len() / SIGNAL_SAMPLES];
            let held = self.certainty.entry(name.clone()).or_default();
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

    /// Adds other samples of a window: as many for every window, each beside its own of the window before.
    pub fn push_samples<'c>(
        &mut self,
        window: &Window,
        samples: impl IntoIterator<Item = &'c Clip>,
    ) {
        for (index, clip) in samples.into_iter().enumerate() {
            if index == self.samples.len() {
                self.samples.push(self.stitcher.another());
            }
            self.samples[index].push(window, clip);
        }
    }

    /// Fits the scale.
    ///
    /// # Errors
    /// When the disk that depth is held on is full.
    pub fn finish(mut self) -> Result<Reconstruction, FolderError> {
        let (rest, depth_boundaries) = std::mem::take(&mut self.depth).finish();
        self.take_depth(&rest)?;
        self.frames.flush().map_err(disk())?;
        let fresh = self.stitcher.another();
        let truth = self.info.truth.as_ref().map(|clip| {
            let whole = Window {
                index: 0,
                start: 0,
                inside: self.info.samples,
                overlap: 0,
            };
            let mut stitcher = fresh.another();
            stitcher.push(&whole, clip);
            stitcher.finish().0
        });
        let (tracks, boundaries) = std::mem::replace(&mut self.stitcher, fresh).finish();
        let feet = foot_heights(&tracks);
        let floor = floor_height(&feet, self.info.floor_fit.rule);
        let (scale, fit, refused) = self.fit_scale(&tracks, floor.clone());
        if let Some(fit) = &fit {
            for grid in &mut self.grids {
                grid.mapv_inplace(|d| fit.apply(d));
            }
        }
        let cloud = self.cloud(&tracks);
        Ok(Reconstruction {
            info: self.info,
            tracks,
            truth,
            samples: (self.samples.into_iter().map(|s| s.finish().0)).collect(),
            boundaries,
            depth: Depth {
                frames: self.frames,
                scale,
                fit,
                refused,
                boundaries: depth_boundaries,
            },
            certainty: self.certainty,
            video: self.video,
            grids: self.grids,
            cloud,
            floor: floor.ok(),
        })
    }

    fn take_depth(&mut self, frames: &[Array2<f32>]) -> Result<(), FolderError> {
        for frame in frames {
            if self.frames.frames() < self.info.frames {
                self.frames.push(frame).map_err(disk())?;
                self.grids.push(thin(frame.view()));
            }
        }
        Ok(())
    }

    fn fit_scale(
        &self,
        tracks: &Tracks,
        floor: Result<f64, ScaleRefusal>,
    ) -> (ScaleStatus, Option<DepthFit>, Option<String>) {
        if self.grids.is_empty() {
            return (ScaleStatus::None, None, None);
        }
        let (by, fit) = match &self.info.anchor {
            Some(anchor) => ("anchor depth", self.fit_to_anchor(anchor)),
            None if self.is_metric() => {
                let by = "learning from metric data".into();
                return (ScaleStatus::Metric { by }, None, None);
            }
            None if tracks.camera().is_empty() => ("floor fit", Err(ScaleRefusal::NoCamera)),
            None if tracks.body().is_empty() => ("floor fit", Err(ScaleRefusal::NoBody)),
            None => (
                "floor fit",
                floor.and_then(|floor| self.fit_to_floor(tracks, floor)),
            ),
        };
        match fit {
            Ok(fit) => (ScaleStatus::Metric { by: by.into() }, Some(fit), None),
            Err(refusal) => (ScaleStatus::Relative, None, Some(refusal.to_string())),
        }
    }

    /// Whether the model's depth has metres of its own, as that of the 512 pathway.
    fn is_metric(&self) -> bool {
        self.coding.is_some_and(|c| c.range == DepthRange::Fixed)
    }

    fn fit_to_floor(&self, tracks: &Tracks, floor: f64) -> Result<DepthFit, ScaleRefusal> {
        let mut views = Vec::new();
        for (frame, grid) in self.grids.iter().enumerate().step_by(self.stride()) {
            let sample = self.sample_of(frame, tracks.camera().len());
            let hands = [tracks.left_hand(), tracks.right_hand()];
            let hands = hands.into_iter().filter_map(|hand| hand.get(sample));
            views.push(View {
                depth: grid.view(),
                T_world_camera: tracks.camera()[sample],
                hands: hands.flatten().copied().collect(),
                picture: self.colors.get(frame).map(|colors| colors.view()),
                second: frame as f64 / self.info.video_rate,
            });
        }
        let space = match self.coding {
            Some(coding) if coding.depth_kind == DepthKind::Disparity => DepthSpace::Disparity,
            _ => DepthSpace::Depth,
        };
        let intrinsics = &self.info.intrinsics;
        fit_floor(&views, intrinsics, floor, space, &self.info.floor_fit)
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
        sample_of(frame, self.info.video_rate, samples)
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
                &self.info.intrinsics,
                pose,
                1,
            ));
        }
        points
    }
}

impl Reconstruction {
    /// What is known of it as a whole, before any file is written: the manifest of the folder, without `arrays` and `files`.
    #[must_use]
    pub fn manifest(&self) -> Manifest {
        let assumptions = self.info.assumptions.iter();
        let certainty = self.certainty.iter();
        Manifest {
            title: self.info.title.clone(),
            assumptions: assumptions
                .map(|f| [f.label.clone(), f.value.clone()])
                .collect(),
            start_seconds: self.info.start,
            seconds: self.seconds(),
            intrinsics: self.info.intrinsics,
            scale: self.depth.scale.clone(),
            fit: self.depth.fit,
            refused: self.depth.refused.clone(),
            arrays: Vec::new(),
            seams: self.boundaries.clone(),
            depth_seams: self.depth.boundaries.clone(),
            certainty: certainty.map(|(k, v)| (k.clone(), mean(v))).collect(),
            files: Vec::new(),
        }
    }

    /// The page alone: one HTML file that needs no network.
    ///
    /// # Errors
    /// When writing fails.
    pub fn write_view(&self, out: &mut impl Write) -> Result<(), FolderError> {
        Ok(write_page(&self.page(&self.manifest()), out)?)
    }

    /// Writes arrays, exports, manifest and page into `folder`, which is made where it is missing; the files are the same for
    /// the same reconstruction, wherever its depth was held.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, folder: impl AsRef<Path>) -> Result<Manifest, FolderError> {
        let path = folder.as_ref();
        std::fs::create_dir_all(path).map_err(FolderError::io(path))?;
        let mut manifest = self.manifest();
        self.write_tracks(path, &mut manifest)?;
        self.write_scene(path, &mut manifest)?;
        self.write_samples(path, &mut manifest)?;
        self.write_points(path, &mut manifest)?;
        write_file(path, PAGE, &mut manifest.files, |out| self.write_view(out))?;
        self.write_depth(path, &mut manifest)?;
        manifest.files.push(MANIFEST.into());
        manifest.files.sort();
        let json = serde_json::to_vec_pretty(&manifest)?;
        write_file(path, MANIFEST, &mut Vec::new(), |out| {
            out.write_all(&json).map_err(FolderError::io(path))
        })?;
        Ok(manifest)
    }
}

fn disk() -> impl FnOnce(std::io::Error) -> FolderError {
    FolderError::io(Path::new("depth frames"))
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
