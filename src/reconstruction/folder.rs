//! One folder with everything: arrays, exports, manifest and page, built window by window.

use super::cloud::{lift, ray};
use super::depth::{DepthSeam, DepthStitcher};
use super::export::bvh::{from_camera, from_z_up, write_bvh};
use super::export::camera::{write_colmap, write_tum};
use super::export::manifest::{ArrayFacts, ArrayFile};
use super::export::ply::{Point, write_ply};
use super::export::write_gaze;
use super::predictions::ScaleStatus;
use super::scale::{
    DepthFit, DepthRay, FloorFit, ScaleRefusal, fit_anchor, fit_floor, floor_height,
};
use super::spool::DepthSpool;
use super::stitch::{Joints, Seam, Stitcher, Tracks, gravity_to_world};
use super::windows::Window;
use crate::clip::clock::SIGNAL_RATE;
use crate::clip::{Clip, Intrinsics};
use crate::formats::FormatError;
use crate::geometry::rigid::{Rigid, to_row_major};
use crate::geometry::skeleton::{BODY, HAND, JOINTS};
use crate::view::scene::Tone;
use crate::view::{
    Badge, Confidence, DepthGrids, Fact, Scene, Track, VideoFrames, ViewError, write_page,
};
use nalgebra::Point3;
use ndarray::{Array2, Array3, ArrayView3, ArrayView4, Axis, s};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// Side of the depth grid that the page and the fits use; the file keeps the full resolution.
const GRID: usize = 64;
/// Points of the whole recording in `points.ply`, at most.
const POINTS: usize = 2_000_000;
/// Depth is never nearer than this, metres.
const NEAREST: f32 = 0.01;

/// What is known, or assumed, before the first window.
#[derive(Debug, Clone)]
pub struct Setting {
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
    /// `[T, h, w]` metric depth of another model at the frames of this video; NaN where unknown.
    pub anchor: Option<Array3<f32>>,
    /// What was assumed and where it came from, with the flag that overrides it.
    pub assumptions: Vec<Fact>,
    /// Beside the scale status: `synthetic`, ...
    pub badges: Vec<Badge>,
    /// The true clip, where it is known and the video is one clip.
    pub truth: Option<Clip>,
}

/// Why a reconstruction folder cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    #[error("{path}: {error}")]
    Io {
        path: PathBuf,
        error: std::io::Error,
    },
    #[error(transparent)]
    Format(#[from] FormatError),
    #[error(transparent)]
    View(#[from] ViewError),
    #[error("{0}")]
    Manifest(#[from] serde_json::Error),
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
    pub seams: Vec<Seam>,
    pub depth_seams: Vec<DepthSeam>,
    /// Mean confidence by modality: from token entropies, 0 (a guess) to 1 (certain). Not an accuracy.
    pub confidence: BTreeMap<String, f64>,
    pub files: Vec<String>,
}

/// Builds the folder window by window.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    setting: Setting,
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
    pub fn new(path: &Path, setting: Setting) -> Result<Self, FolderError> {
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

    /// Adds a window: its frames `[T, S, S, 3]`, the decoded clip, and per modality a confidence per motion sample.
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
            let held = self.confidence.entry(name.clone()).or_default();
            held.truncate(window.start + window.overlap / 2);
            held.resize(window.start.max(held.len()), f32::NAN);
            let from = held.len() - window.start;
            held.extend(values.iter().take(window.inside).skip(from));
        }
        if let Some(depth) = &decoded.depth {
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
        let (tracks, seams) =
            std::mem::replace(&mut self.stitcher, Stitcher::new(Rigid::identity())).finish();
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
        let page = self.page(tracks, cloud, floor, &manifest);
        let path = self.path.clone();
        write_file(&path, "view.html", &mut manifest.files, |out| {
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
                self.grids.push(thin(frame));
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
            None if tracks.camera.is_empty() || tracks.body.is_empty() => {
                ("floor fit", Err(ScaleRefusal::NoBody))
            }
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
        for (frame, grid) in self.grids.iter().enumerate() {
            let pose = tracks.camera[self.sample_of(frame, tracks.camera.len())];
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
        for (grid, metric) in self.grids.iter().zip(anchor.axis_iter(Axis(0))) {
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

    fn sample_of(&self, frame: usize, samples: usize) -> usize {
        let sample = (frame as f64 / self.setting.video_rate * SIGNAL_RATE).round_ties_even();
        (sample as usize).min(samples.saturating_sub(1))
    }

    fn cloud(&self, tracks: &Tracks) -> Vec<Point> {
        if tracks.camera.is_empty() || self.grids.is_empty() {
            return Vec::new();
        }
        let cells: usize = self.grids.iter().map(Array2::len).sum();
        let every = cells.div_ceil(POINTS).max(1);
        let mut points = Vec::new();
        for (frame, (grid, colors)) in self.grids.iter().zip(&self.colors).enumerate() {
            if frame.is_multiple_of(every) {
                let pose = &tracks.camera[self.sample_of(frame, tracks.camera.len())];
                points.extend(lift(
                    grid.view(),
                    colors.view(),
                    &self.setting.intrinsics,
                    pose,
                    1,
                ));
            }
        }
        points
    }

    fn write_tracks(&self, tracks: &Tracks, manifest: &mut Manifest) -> Result<(), FolderError> {
        let path = &self.path;
        let learned = ScaleStatus::Metric {
            by: "learning from metric data".into(),
        };
        let facts =
            |name: &str, unit: &str, frame: &str, scale: &ScaleStatus, validity: Option<&str>| {
                ArrayFacts {
                    file: String::new(),
                    name: name.into(),
                    shape: Vec::new(),
                    unit: unit.into(),
                    frame: frame.into(),
                    rate: Some(SIGNAL_RATE),
                    scale: scale.clone(),
                    validity: validity.map(Into::into),
                }
            };
        let world = "world: z up, origin and heading of the first camera";
        let io = |error| FolderError::Io {
            path: path.clone(),
            error,
        };
        if !tracks.camera.is_empty() {
            let matrices: Vec<f64> = tracks.camera.iter().flat_map(to_row_major).collect();
            let array = Array3::from_shape_vec((tracks.camera.len(), 4, 4), matrices)
                .expect("sixteen numbers a pose");
            let note = facts("T_world_camera", "m", world, &learned, None);
            manifest.files.push("camera.npz".into());
            manifest.arrays.extend(
                ArrayFile::default()
                    .with(&array, note)
                    .write(path, "camera.npz")?,
            );
            write_file(path, "camera.tum", &mut manifest.files, |out| {
                write_tum(SIGNAL_RATE, &tracks.camera, out).map_err(io)
            })?;
            let at_frames: Vec<Rigid> = (0..self.video.len())
                .map(|frame| tracks.camera[self.sample_of(frame, tracks.camera.len())])
                .collect();
            write_colmap(&path.join("colmap"), &at_frames, &self.setting.intrinsics).map_err(io)?;
            for name in ["cameras.txt", "images.txt", "points3D.txt"] {
                manifest.files.push(format!("colmap/{name}"));
            }
        }
        if !tracks.gaze.is_empty() {
            write_file(path, "gaze.csv", &mut manifest.files, |out| {
                write_gaze(SIGNAL_RATE, &tracks.gaze, out).map_err(io)
            })?;
        }
        let camera = "camera of the same sample, OpenCV axes";
        let mut hands = ArrayFile::default();
        for (name, joints) in [
            ("left_hand", &tracks.left_hand),
            ("right_hand", &tracks.right_hand),
        ] {
            if joints.is_empty() {
                continue;
            }
            let (values, valid) = joint_arrays(joints);
            let validity = format!("{name}_valid");
            hands = hands
                .with(&values, facts(name, "m", camera, &learned, Some(&validity)))
                .with(
                    &valid,
                    facts(&validity, "true or false", camera, &ScaleStatus::None, None),
                );
            // A hand that is never seen whole has no motion to write.
            if joints
                .iter()
                .any(|pose| pose.iter().flatten().all(|v| v.is_finite()))
            {
                write_file(path, &format!("{name}.bvh"), &mut manifest.files, |out| {
                    write_bvh(&HAND, joints, SIGNAL_RATE, &from_camera(), out).map_err(io)
                })?;
            }
        }
        let written = hands.write(path, "hands.npz")?;
        if !written.is_empty() {
            manifest.files.push("hands.npz".into());
            manifest.arrays.extend(written);
        }
        if !tracks.body.is_empty() {
            let (values, valid) = joint_arrays(&tracks.body);
            let body = ArrayFile::default()
                .with(
                    &values,
                    facts("body", "m", world, &learned, Some("body_valid")),
                )
                .with(
                    &valid,
                    facts(
                        "body_valid",
                        "true or false",
                        world,
                        &ScaleStatus::None,
                        None,
                    ),
                );
            manifest.files.push("body.npz".into());
            manifest.arrays.extend(body.write(path, "body.npz")?);
            write_file(path, "body.bvh", &mut manifest.files, |out| {
                write_bvh(&BODY, &tracks.body, SIGNAL_RATE, &from_z_up(), out).map_err(io)
            })?;
        }
        Ok(())
    }

    fn write_points(&self, cloud: &[Point], manifest: &mut Manifest) -> Result<(), FolderError> {
        if cloud.is_empty() {
            return Ok(());
        }
        let note = format!("reviv: world, z up, {}", manifest.scale.words());
        write_file(&self.path, "points.ply", &mut manifest.files, |out| {
            write_ply(cloud, &note, out).map_err(|error| FolderError::Io {
                path: self.path.clone(),
                error,
            })
        })
    }

    fn write_depth(self, manifest: &mut Manifest) -> Result<(), FolderError> {
        if self.spool.frames() == 0 {
            return Ok(());
        }
        let (scale, shift) = manifest
            .fit
            .map_or((1.0, 0.0), |f| (f.scale as f32, f.shift as f32));
        let name = if manifest.fit.is_some() {
            "metres"
        } else {
            "relative"
        };
        let shape =
            self.spool
                .write_npz(&self.path.join("depth.npz"), name, [scale, shift], NEAREST)?;
        manifest.files.push("depth.npz".into());
        manifest.arrays.push(ArrayFacts {
            file: "depth.npz".into(),
            name: name.into(),
            shape: shape.to_vec(),
            unit: if manifest.fit.is_some() {
                "m"
            } else {
                "unknown scale and shift"
            }
            .into(),
            frame: "along the optical axis of the frame's camera, over the square image".into(),
            rate: Some(self.setting.video_rate),
            scale: manifest.scale.clone(),
            validity: None,
        });
        Ok(())
    }

    fn page(
        &self,
        tracks: Tracks,
        cloud: Vec<Point>,
        floor: Option<f64>,
        manifest: &Manifest,
    ) -> Scene {
        let mut badges = self.setting.badges.clone();
        let tone = if matches!(manifest.scale, ScaleStatus::Metric { .. }) {
            Tone::Good
        } else {
            Tone::Warn
        };
        if !self.grids.is_empty() {
            badges.push(Badge {
                text: format!("depth: {}", manifest.scale.words()),
                tone,
            });
        }
        let mut facts = self.setting.assumptions.clone();
        facts.push(fact(
            "World",
            "z up, metres, origin and heading of the first camera",
        ));
        if let Some(fit) = &manifest.fit {
            let value = format!(
                "depth x {:.3} + {:.3} m, residual {:.3} m over {} points",
                fit.scale, fit.shift, fit.residual, fit.points
            );
            facts.push(fact("Scale fit", &value));
        }
        if let Some(reason) = &manifest.refused {
            facts.push(fact("No metric depth", reason));
        }
        for (name, value) in &manifest.confidence {
            facts.push(fact(
                &format!("Confidence, {name}"),
                &format!("{value:.2} (token entropy)"),
            ));
        }
        if let Some(seam) = worst_seam(&manifest.seams) {
            facts.push(fact("Largest seam", &seam));
        }
        let mut list = vec![track_of("prediction", false, &tracks)];
        if let Some(truth) = &self.setting.truth {
            let window = Window {
                index: 0,
                start: 0,
                inside: self.setting.samples,
                overlap: 0,
            };
            let mut stitcher = Stitcher::new(self.setting.first);
            stitcher.push(&window, truth);
            list.push(track_of("truth", true, &stitcher.finish().0));
        }
        for track in &mut list {
            fit_length(track, self.setting.samples);
        }
        let frames = self.grids.len().min(self.video.len());
        let depth = (frames > 0 && frames == self.video.len()).then(|| DepthGrids {
            metres: super::depth::stack(&self.grids[..frames]),
        });
        Scene {
            title: self.setting.title.clone(),
            badges,
            facts,
            rate: SIGNAL_RATE,
            samples: self.setting.samples,
            intrinsics: self.setting.intrinsics,
            video: (!self.video.is_empty()).then(|| self.video.clone()),
            depth,
            cloud,
            floor,
            tracks: list,
            confidence: self
                .confidence
                .iter()
                .map(|(name, values)| Confidence {
                    name: name.clone(),
                    values: values.clone(),
                })
                .collect(),
        }
    }
}

fn fact(label: &str, value: &str) -> Fact {
    Fact {
        label: label.into(),
        value: value.into(),
    }
}

fn worst_seam(seams: &[Seam]) -> Option<String> {
    let worst = seams
        .iter()
        .max_by(|a, b| a.body_m.unwrap_or(0.0).total_cmp(&b.body_m.unwrap_or(0.0)))?;
    let part =
        |name: &str, value: Option<f64>| value.map(|v| format!("{name} {:.0} mm", v * 1000.0));
    let parts = [
        part("body", worst.body_m),
        part("camera", worst.camera_m),
        part("hands", worst.hands_m),
    ];
    let parts: Vec<String> = parts.into_iter().flatten().collect();
    (!parts.is_empty()).then(|| format!("at {:.1} s: {}", worst.at_seconds, parts.join(", ")))
}

/// A track of the page: hands are moved to the world, gaze stays in the image.
fn track_of(name: &str, truth: bool, tracks: &Tracks) -> Track {
    let array = |joints: &[Joints], in_camera: bool| {
        (!joints.is_empty()).then(|| {
            Array3::from_shape_fn((joints.len(), JOINTS, 3), |(t, j, k)| {
                let p = joints[t][j];
                match tracks.camera.get(t) {
                    Some(pose) if in_camera => (pose * Point3::from(p.map(f64::from)))[k] as f32,
                    _ => p[k],
                }
            })
        })
    };
    Track {
        name: name.into(),
        truth,
        camera: (!tracks.camera.is_empty())
            .then(|| tracks.camera.iter().copied().map(Some).collect()),
        gaze: (!tracks.gaze.is_empty())
            .then(|| Array2::from_shape_fn((tracks.gaze.len(), 2), |(t, k)| tracks.gaze[t][k])),
        body: array(&tracks.body, false),
        left_hand: array(&tracks.left_hand, true),
        right_hand: array(&tracks.right_hand, true),
    }
}

/// Cuts or fills (with unknown) every part of a track to the timeline.
fn fit_length(track: &mut Track, samples: usize) {
    if let Some(camera) = &mut track.camera {
        camera.resize(samples, None);
    }
    if let Some(gaze) = &mut track.gaze {
        let held = std::mem::replace(gaze, Array2::from_elem((samples, 2), f32::NAN));
        let n = held.nrows().min(samples);
        gaze.slice_mut(s![..n, ..]).assign(&held.slice(s![..n, ..]));
    }
    for part in [&mut track.body, &mut track.left_hand, &mut track.right_hand] {
        if let Some(joints) = part {
            let held = std::mem::replace(joints, Array3::from_elem((samples, JOINTS, 3), f32::NAN));
            let n = held.shape()[0].min(samples);
            joints
                .slice_mut(s![..n, .., ..])
                .assign(&held.slice(s![..n, .., ..]));
        }
    }
}

fn joint_arrays(joints: &[Joints]) -> (Array3<f32>, Array2<bool>) {
    let values = Array3::from_shape_fn((joints.len(), JOINTS, 3), |(t, j, k)| joints[t][j][k]);
    let valid = Array2::from_shape_fn((joints.len(), JOINTS), |(t, j)| {
        joints[t][j].iter().all(|v| v.is_finite())
    });
    (values, valid)
}

/// Heights of both feet and toes over all samples.
fn foot_heights(tracks: &Tracks) -> Vec<f64> {
    let feet: Vec<usize> = ["left_foot", "right_foot"]
        .iter()
        .filter_map(|name| BODY.joint(name))
        .collect();
    tracks
        .body
        .iter()
        .flat_map(|pose| feet.iter().map(|&j| f64::from(pose[j][2])))
        .collect()
}

/// At most [`GRID`] cells a side: the values at the cells' centres.
fn thin(frame: &Array2<f32>) -> Array2<f32> {
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

fn write_file(
    folder: &Path,
    name: &str,
    files: &mut Vec<String>,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), FolderError>,
) -> Result<(), FolderError> {
    let path = folder.join(name);
    let io = |error| FolderError::Io {
        path: path.clone(),
        error,
    };
    let mut out = BufWriter::new(File::create(&path).map_err(io)?);
    write(&mut out)?;
    out.flush().map_err(io)?;
    files.push(name.into());
    Ok(())
}

/// World pose of the first camera that puts a known first camera at the origin, heading along its right axis.
pub fn first_camera(T_world_camera: &Rigid) -> Rigid {
    gravity_to_world(T_world_camera).inverse() * T_world_camera
}
