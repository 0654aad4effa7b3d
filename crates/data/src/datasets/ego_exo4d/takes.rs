//! `takes.json`: which takes there are, and where their files lie.

use crate::formats::read_error::Position;
use crate::formats::{ReadError, stays_inside};
use serde::Deserialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// What is used of a take.
#[derive(Debug, Clone, Deserialize)]
pub(super) struct Take {
    #[serde(rename = "take_name")]
    name: String,
    root_dir: Option<String>,
    capture_name: Option<String>,
    capture: Option<Capture>,
    timesync_start_idx: Option<u64>,
    timesync_end_idx: Option<u64>,
    #[serde(default)]
    frame_aligned_videos: BTreeMap<String, Value>,
    vrs_relative_path: Option<String>,
    is_dropped: Option<bool>,
}

#[derive(Debug, Clone, Deserialize)]
struct Capture {
    capture_name: Option<String>,
    #[serde(default)]
    cameras: Vec<CaptureCamera>,
}

#[derive(Debug, Clone, Deserialize)]
struct CaptureCamera {
    cam_id: String,
    #[serde(default)]
    is_ego: bool,
}

/// Reads all takes.
pub(super) fn read(path: &Path) -> Result<Vec<Take>, ReadError> {
    let file = File::open(path).map_err(|cause| ReadError::io(path, cause))?;
    let wrong = |error: serde_json::Error| {
        let place = Position::Line(error.line() as u64);
        ReadError::malformed(path, place, error.to_string())
    };
    let takes: Vec<Take> =
        serde_json::from_reader(BufReader::with_capacity(1 << 16, file)).map_err(wrong)?;
    for take in &takes {
        if !stays_inside(&take.folder()) || !stays_inside(Path::new(&take.capture())) {
            let reason = format!("take `{}` lies outside of the data set", take.name);
            return Err(ReadError::malformed(path, Position::File, reason));
        }
    }
    Ok(takes)
}

impl Take {
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The data set has withdrawn it.
    pub fn is_dropped(&self) -> bool {
        self.is_dropped.unwrap_or(false)
    }

    /// From the data set's folder.
    pub fn folder(&self) -> PathBuf {
        match &self.root_dir {
            Some(folder) => PathBuf::from(folder),
            None => Path::new("takes").join(&self.name),
        }
    }

    /// The capture that the take is a part of: named, or the take's name without its number.
    pub fn capture(&self) -> String {
        let named = self
            .capture
            .as_ref()
            .and_then(|capture| capture.capture_name.clone());
        named
            .or_else(|| self.capture_name.clone())
            .unwrap_or_else(|| {
                let name = self.name.as_str();
                name.rsplit_once('_')
                    .map_or(name, |(front, _)| front)
                    .to_owned()
            })
    }

    /// The rows of the capture's clock that the take spans, both ends as written.
    pub fn rows(&self) -> Option<Range<u64>> {
        let (start, end) = (self.timesync_start_idx?, self.timesync_end_idx?);
        (start < end).then_some(start..end)
    }

    /// The glasses' name: `aria01`.
    pub fn ego_camera(&self, folder: &Path) -> String {
        let listed = self.capture.iter().flat_map(|capture| &capture.cameras);
        let mut names: Vec<&str> = listed
            .filter(|camera| camera.is_ego)
            .map(|camera| camera.cam_id.as_str())
            .collect();
        names.extend(
            self.frame_aligned_videos
                .keys()
                .map(String::as_str)
                .filter(|name| name.starts_with("aria")),
        );
        let recorded = names
            .iter()
            .find(|name| self.video(folder, name).is_some())
            .or(names.first());
        recorded.map_or_else(|| "aria01".to_owned(), |name| (*name).to_owned())
    }

    /// The colour video of a camera: whole, or small.
    pub fn video(&self, folder: &Path, camera: &str) -> Option<PathBuf> {
        let streams = self.frame_aligned_videos.get(camera);
        let named = streams
            .and_then(|streams| streams.get("rgb"))
            .and_then(|stream| stream.get("relative_path"))
            .and_then(Value::as_str)
            .map(PathBuf::from)
            .filter(|path| stays_inside(path));
        let usual = PathBuf::from(format!("frame_aligned_videos/{camera}_214-1.mp4"));
        let small = PathBuf::from(format!(
            "frame_aligned_videos/downscaled/448/{camera}_214-1.mp4"
        ));
        [named, Some(usual), Some(small)]
            .into_iter()
            .flatten()
            .filter(|path| stays_inside(path))
            .map(|path| folder.join(path))
            .find(|path| path.is_file())
    }

    /// The recording of the glasses without its pictures.
    pub fn container(&self, folder: &Path, camera: &str) -> Option<PathBuf> {
        let named = self.vrs_relative_path.as_ref().map(PathBuf::from);
        [
            named,
            Some(PathBuf::from(format!("{camera}_noimagestreams.vrs"))),
            Some(PathBuf::from(format!("{camera}.vrs"))),
        ]
        .into_iter()
        .flatten()
        .filter(|path| stays_inside(path))
        .map(|path| folder.join(path))
        .find(|path| path.is_file())
    }
}
