//! A reconstruction in memory, and the call that makes one.

use crate::arrays::{owned, view};
use crate::error::{Stopped, refused};
use crate::model::{Model, decoding};
use crate::progress::Progress;
use ndarray::{ArrayView1, ArrayView2, ArrayView3, IxDyn};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use reviv::geometry::rigid::Rigid;
use reviv::geometry::skeleton::{BODY, HAND, JOINTS, Joints};
use reviv::reconstruction::camera::CameraSettings;
use reviv::reconstruction::frame_buffer::DepthFrames;
use reviv::reconstruction::stitch::Tracks;
use reviv::reconstruction::tracks::SignalTrack;
use reviv::reconstruction::{
    Anchor, Part, ReconstructError, ReconstructOptions, Recording, reconstruct_recording,
};
use reviv::{Video, clip::clock::SIGNAL_RATE};
use std::path::PathBuf;

/// The names of the joints, and of each the one nearer to the root.
#[pyfunction]
pub fn skeleton(modality: &str) -> (Vec<&'static str>, Vec<usize>) {
    let found = if modality == "body" { BODY } else { HAND };
    (found.joints.to_vec(), found.parents.to_vec())
}

/// The wearer and the world of one video.
#[pyclass(frozen, module = "reviv._reviv")]
pub struct Reconstruction {
    made: reviv::Reconstruction,
}

#[pymethods]
impl Reconstruction {
    /// The manifest that its folder would have, without files.
    fn manifest(&self, py: Python<'_>) -> PyResult<String> {
        serde_json::to_string(&self.made.manifest()).map_err(|error| refused(py, error, ""))
    }

    /// `[T, 21, 3]` of `body`, `left_hand` or `right_hand`: a view.
    fn joints<'py>(slf: &Bound<'py, Self>, modality: &str) -> PyResult<Option<Bound<'py, PyAny>>> {
        let made = &slf.get().made;
        let poses: &[Joints] = match modality {
            "body" => made.body().positions(),
            "left_hand" => made.left_hand().positions(),
            "right_hand" => made.right_hand().positions(),
            _ => &[],
        };
        if poses.is_empty() {
            return Ok(None);
        }
        let flat = poses.as_flattened().as_flattened();
        let values = ArrayView3::from_shape((poses.len(), JOINTS, 3), flat);
        let values = values.map_err(|error| refused(slf.py(), error, ""))?;
        view(values, slf.as_any()).map(Some)
    }

    /// `[T, 4, 4]`.
    fn camera<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let poses = self.made.camera();
        if poses.is_empty() {
            return Ok(None);
        }
        let rows = poses.iter().flat_map(matrix).collect();
        owned(py, IxDyn(&[poses.len(), 4, 4]), rows).map(Some)
    }

    /// `[T, 2]`: a view.
    fn gaze<'py>(slf: &Bound<'py, Self>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let points = slf.get().made.gaze();
        if points.is_empty() {
            return Ok(None);
        }
        let values = ArrayView2::from_shape((points.len(), 2), points.as_flattened());
        let values = values.map_err(|error| refused(slf.py(), error, ""))?;
        view(values, slf.as_any()).map(Some)
    }

    /// `[F, H, W]`, and frames per second.
    fn depth<'py>(&self, py: Python<'py>) -> PyResult<Option<(Bound<'py, PyAny>, f64)>> {
        let depth = self.made.depth();
        if depth.is_empty() {
            return Ok(None);
        }
        let read = py.detach(|| -> std::io::Result<(Vec<f32>, [usize; 2])> {
            let (mut values, mut size) = (Vec::new(), [0, 0]);
            for frame in depth.frames() {
                let frame = frame?;
                size = [frame.nrows(), frame.ncols()];
                if values.is_empty() {
                    values.reserve_exact(depth.len() * frame.len());
                }
                values.extend(frame);
            }
            Ok((values, size))
        });
        let (values, [height, width]) = read.map_err(|error| refused(py, error, ""))?;
        let array = owned(py, IxDyn(&[depth.len(), height, width]), values)?;
        Ok(Some((array, self.made.video_rate())))
    }

    /// By modality, one number per sample: views.
    fn certainty<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyDict>> {
        let found = PyDict::new(slf.py());
        for (name, values) in slf.get().made.certainty() {
            let values = ArrayView1::from(values.as_slice());
            found.set_item(name, view(values, slf.as_any())?)?;
        }
        Ok(found)
    }

    /// The modalities without a type of their own: values `[T, C]`, rate, names of channels, units.
    fn signals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = PyDict::new(py);
        for (name, _) in self.made.tracks().iter() {
            let Some(track) = self.made.tracks().get::<SignalTrack>(name) else {
                continue;
            };
            let width = track.rows.first().map_or(0, Vec::len);
            let rows = track.rows.concat();
            let values = owned(py, IxDyn(&[track.rows.len(), width]), rows)?;
            let about = &track.description;
            found.set_item(
                name,
                (
                    values,
                    track.rate,
                    about.channels.clone(),
                    about.units.clone(),
                ),
            )?;
        }
        Ok(found)
    }

    /// Every sample by modality, `[N, T, ...]`; empty where none were asked for.
    fn samples<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = self.made.samples();
        let found = PyDict::new(py);
        let least = |count: fn(&Tracks) -> usize| all.iter().map(count).min().unwrap_or(0);
        let moments = least(|tracks| tracks.camera().len());
        if moments > 0 {
            let poses = all.iter().flat_map(|tracks| &tracks.camera()[..moments]);
            let rows = poses.flat_map(matrix).collect();
            let shape = IxDyn(&[all.len(), moments, 4, 4]);
            found.set_item("camera", owned(py, shape, rows)?)?;
        }
        let moments = least(|tracks| tracks.gaze().len());
        if moments > 0 {
            let points = all.iter().flat_map(|tracks| &tracks.gaze()[..moments]);
            let rows = points.flatten().copied().collect();
            let shape = IxDyn(&[all.len(), moments, 2]);
            found.set_item("gaze", owned::<f32>(py, shape, rows)?)?;
        }
        type Motion = fn(&Tracks) -> &[Joints];
        let motions: [(&str, Motion); 3] = [
            ("body", Tracks::body),
            ("left_hand", Tracks::left_hand),
            ("right_hand", Tracks::right_hand),
        ];
        for (name, of) in motions {
            let moments = all.iter().map(|tracks| of(tracks).len()).min().unwrap_or(0);
            if moments > 0 {
                let poses = all.iter().flat_map(|tracks| &of(tracks)[..moments]);
                let rows = poses.flatten().flatten().copied().collect();
                let shape = IxDyn(&[all.len(), moments, JOINTS, 3]);
                found.set_item(name, owned::<f32>(py, shape, rows)?)?;
            }
        }
        Ok(found)
    }

    /// How far samples are from their mean, by modality `[T, points]`.
    fn spread<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = PyDict::new(py);
        for (name, values) in self.made.spread() {
            let shape = IxDyn(values.shape());
            let values = values.into_iter().collect();
            found.set_item(name, owned::<f32>(py, shape, values)?)?;
        }
        Ok(found)
    }

    /// Hz of everything that moves.
    #[getter]
    fn rate(&self) -> f64 {
        SIGNAL_RATE
    }

    /// The page, as HTML.
    fn page(&self, py: Python<'_>) -> PyResult<String> {
        let mut html = Vec::new();
        let written = py.detach(|| self.made.write_view(&mut html));
        written.map_err(|error| refused(py, error, ""))?;
        String::from_utf8(html).map_err(|error| refused(py, error, ""))
    }

    /// Writes the folder.
    fn write(&self, py: Python<'_>, folder: PathBuf) -> PyResult<()> {
        let written = py.detach(|| self.made.write(&folder));
        written.map_err(|error| refused(py, error, ""))?;
        Ok(())
    }
}

/// Row by row.
fn matrix(pose: &Rigid) -> impl Iterator<Item = f64> + use<> {
    let matrix = pose.to_homogeneous();
    (0..16).map(move |k| matrix[(k / 4, k % 4)])
}

/// Reconstructs a video.
#[pyfunction]
pub fn reconstruct(
    py: Python<'_>,
    video: PathBuf,
    model: &Model,
    decoding_name: Option<String>,
    start: f64,
    seconds: Option<f64>,
    inputs: Vec<String>,
    targets: Vec<String>,
    overlap: f64,
    field_of_view: Option<f64>,
    anchor: Option<PathBuf>,
    seed: u64,
    samples: usize,
    progress: Option<Py<PyAny>>,
) -> PyResult<Reconstruction> {
    let mut camera = CameraSettings::default();
    if let Some(degrees) = field_of_view {
        camera.field_of_view = degrees;
    }
    let options = ReconstructOptions {
        start,
        seconds,
        inputs,
        targets,
        decoding: decoding(py, decoding_name.as_deref())?,
        decoding_name: decoding_name.unwrap_or_else(|| "default".to_owned()),
        overlap,
        camera,
        anchor: anchor.map(Anchor::Maps),
        seed,
        samples,
        ..ReconstructOptions::default()
    };
    let mut heard = Progress::new(progress);
    let made = py.detach(|| {
        let video = Video::open(&video)?;
        let range = [Some(options.start), options.seconds];
        let recording = Recording::of_video(video, range, &options.camera, model.model.format())?;
        let depth = DepthFrames::in_memory();
        reconstruct_recording(&recording, &model.model, &options, depth, &mut |at| {
            let done = at.window + usize::from(at.part == Part::Stitch);
            heard.tell(done, at.windows, "windows")
        })
    });
    if let Some(error) = heard.raised() {
        return Err(error);
    }
    let made = made.map_err(|error| match error {
        ReconstructError::Stopped => Stopped::new_err("stopped by its callback"),
        error => refused(py, error, ""),
    })?;
    Ok(Reconstruction { made })
}
