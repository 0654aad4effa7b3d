//! `reviv data label-depth`: the depth of any video by Video Depth Anything, for people who only want that.

use super::super::run::{interruptible, progress};
use super::super::terminal::{Failure, Terminal};
use super::failure;
use crate::engine::{Compute, DeviceChoice, Precision};
use crate::formats::ReadError;
use crate::formats::png;
use crate::labelling::files::{DepthFiles, DepthFormat};
use crate::labelling::preprocess::{limited_size, shrunk, stride};
use crate::labelling::{DepthLabeller, LabelError, LabelOptions, Labelled, stored};
use crate::run::environment::Stopwatch;
use crate::video::image::Image;
use crate::video::{Video, VideoSettings};
use crate::view::depth_sheet::{DepthTile, depth_sheet};
use serde_json::json;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Frames on the contact sheet.
const TILES: usize = 8;

/// Label a video (or a folder of pictures) with depth, by imported weights of Video Depth Anything
///
/// Any length: memory is that of one window of 32 frames. Writes the depth, what it was made with (`depth.json`), and a
/// contact sheet (`preview.png`).
#[derive(Debug, clap::Args)]
pub(super) struct LabelDepth {
    /// The video, or a folder of pictures
    #[arg(value_name = "VIDEO|DIR")]
    video: PathBuf,
    /// A depth network, as `reviv import --depth KIND` makes it
    #[arg(short, long, value_name = "DIR")]
    model: PathBuf,
    /// The folder to make
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// npz (one array), png (16 bits per pixel) or exr (a file per frame)
    #[arg(long, default_value = "npz", value_name = "FORMAT")]
    format: DepthFormat,
    /// Pixels of the shorter side as the network sees it
    #[arg(long, default_value_t = 518, value_name = "PIXELS")]
    input_size: usize,
    /// Frames per second to label; the nearest whole step through the video's frames
    #[arg(long, value_name = "HZ")]
    fps: Option<f64>,
    /// Frames whose longer side exceeds this are made smaller first; the depth has their size
    #[arg(long, default_value_t = 1280, value_name = "PIXELS")]
    max_side: usize,
    /// Frames per second of a folder of pictures
    #[arg(long, default_value_t = 30.0, value_name = "HZ")]
    folder_fps: f64,
    /// Where the network runs: auto, cpu, cuda, vulkan, metal or wgpu, a GPU also with its number: `cuda:1`
    #[arg(long, default_value = "cpu", value_name = "DEVICE")]
    device: DeviceChoice,
    /// Write the result as JSON to stdout
    #[arg(long)]
    json: bool,
}

/// What may end the work.
enum Stop {
    Label(LabelError),
    Read(ReadError),
    Interrupted,
}

impl From<LabelError> for Stop {
    fn from(error: LabelError) -> Self {
        Self::Label(error)
    }
}

impl From<Stop> for Failure {
    fn from(stop: Stop) -> Self {
        match stop {
            Stop::Label(error @ LabelError::Files(_)) => Failure::machine(error),
            Stop::Label(error) => Failure::input(error.to_string(), ""),
            Stop::Read(error) => failure(error),
            Stop::Interrupted => Failure::Ended(130),
        }
    }
}

impl LabelDepth {
    pub(super) fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        if self.output.exists() {
            return Err(Failure::input(
                format!("`{}` exists already", self.output.display()),
                "name a folder that does not exist yet, or remove this one",
            ));
        }
        if self.max_side == 0 {
            return Err(Failure::input("`--max-side` is 0", ""));
        }
        let compute = Compute::new(self.device, Precision::F32)
            .map_err(|error| Failure::input(error.to_string(), ""))?;
        let settings = VideoSettings {
            folder_fps: self.folder_fps,
            ..VideoSettings::default()
        };
        let video = Video::open_with(&self.video, &settings).map_err(failure)?;
        let labeller = DepthLabeller::open(&self.model, &compute).map_err(Stop::from)?;
        let parent = match self.output.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
            _ => PathBuf::from("."),
        };
        std::fs::create_dir_all(&parent).map_err(Failure::machine)?;
        let temporary = tempfile::Builder::new()
            .prefix(".depth-")
            .tempdir_in(&parent)
            .map_err(Failure::machine)?;
        let folder = temporary.path().join("depth");
        std::fs::create_dir(&folder).map_err(Failure::machine)?;
        let summary = self.label(terminal, &video, &labeller, &folder)?;
        std::fs::rename(&folder, &self.output).map_err(Failure::machine)?;
        if self.json {
            terminal.json(&summary);
        } else {
            terminal.data(format_args!("{}\n", self.output.display()));
        }
        Ok(())
    }

    /// Labels into `folder`; what `depth.json` says.
    fn label(
        &self,
        terminal: &Terminal,
        video: &Video,
        labeller: &DepthLabeller,
        folder: &std::path::Path,
    ) -> Result<serde_json::Value, Failure> {
        let info = video.info();
        let step = stride(info.fps, self.fps);
        let chosen: Vec<usize> = (0..info.frames).step_by(step).collect();
        let total = chosen.len();
        let size = limited_size(info.height as usize, info.width as usize, self.max_side);
        let kind = labeller.kind();
        let mut files = DepthFiles::create(folder, self.format, kind, size).map_err(Stop::from)?;
        // Small frames for the contact sheet, until their depth is there.
        let shown: Vec<usize> = (0..TILES.min(total))
            .map(|i| i * total / TILES.min(total))
            .collect();
        let kept: RefCell<BTreeMap<usize, Image>> = RefCell::default();
        let mut tiles = Vec::new();
        let interrupt = interruptible(terminal)?;
        let progress = progress(terminal);
        let mut task = progress.task("depth");
        let watch = Stopwatch::start();
        let frames = video.chosen(chosen).map_err(failure)?;
        let frames = frames.enumerate().map(|(index, frame)| {
            let image = frame.map_err(Stop::Read)?.image;
            let image = shrunk(image, size);
            if shown.contains(&index) {
                kept.borrow_mut().insert(index, image.clone());
            }
            if interrupt.requested() {
                return Err(Stop::Interrupted);
            }
            Ok(image)
        });
        let options = LabelOptions {
            input_size: self.input_size,
        };
        let labelled = labeller.label(frames, &options, &mut |frame, depth| {
            files.push(&depth)?;
            if let Some(image) = kept.borrow_mut().remove(&frame) {
                tiles.push(DepthTile::new(frame * step, &image, &depth));
            }
            task.update(frame as u64 + 1, total as u64, "frames");
            if interrupt.requested() {
                return Err(Stop::Interrupted);
            }
            Ok(())
        })?;
        drop(task);
        let seconds = watch.seconds();
        let written = files.finish().map_err(Stop::from)?;
        let name = labeller
            .network()
            .settings()
            .name()
            .unwrap_or("of other sizes");
        let title = format!(
            "{}   {} depth, Video Depth Anything {name}, {} frames",
            self.video.display(),
            kind.name(),
            written.frames
        );
        let sheet = depth_sheet(&title, &tiles).into_picture();
        png::write(&folder.join("preview.png"), &sheet)
            .map_err(|error| Failure::machine(error.to_string()))?;
        let summary = self.summary(
            video,
            labeller,
            &labelled,
            [step, size[0], size[1]],
            written.range,
        )?;
        let mut text = serde_json::to_string_pretty(&summary).map_err(Failure::machine)?;
        text.push('\n');
        std::fs::write(folder.join("depth.json"), text).map_err(Failure::machine)?;
        terminal.note(format_args!(
            "{} frames of {} x {} in {seconds:.1} s: {:.2} frames per second ({name}, seen at {} x {})\n",
            labelled.frames,
            size[1],
            size[0],
            labelled.frames as f64 / seconds.max(1e-9),
            labelled.network_size[1],
            labelled.network_size[0],
        ));
        Ok(summary)
    }

    fn summary(
        &self,
        video: &Video,
        labeller: &DepthLabeller,
        labelled: &Labelled,
        [step, height, width]: [usize; 3],
        range: [f32; 2],
    ) -> Result<serde_json::Value, Failure> {
        let info = video.info();
        let sha256 = stored::fingerprint(&self.model).map_err(Stop::from)?;
        Ok(json!({
            "video": self.video,
            "frames": labelled.frames,
            "fps": info.fps / step as f64,
            "step": step,
            "height": height,
            "width": width,
            "kind": labeller.kind(),
            "unit": DepthFiles::unit(self.format, labeller.kind()),
            "range": range,
            "network": labeller.network().settings().name(),
            "weights_sha256": sha256,
            "input_size": self.input_size,
            "network_height": labelled.network_size[0],
            "network_width": labelled.network_size[1],
            "windows": labelled.windows,
            "precision": "f32",
        }))
    }
}
