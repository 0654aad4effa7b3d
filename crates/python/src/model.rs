//! Models: opened, applied to clips, scored.

use crate::clips::{Clip, Clips, ids};
use crate::error::{Stopped, of_run, refused};
use crate::progress::Progress;
use crate::table::Table;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use reviv::decoding::DecodingSettings;
use reviv::engine::{DeviceChoice, Precision};
use reviv::evaluation::evaluate::EvaluationError;
use reviv::experiment::catalog::Catalog;
use reviv::experiment::load;
use reviv::model::EvaluateError;
use reviv::{Compute, EvaluateOptions};
use std::path::{Path, PathBuf};

/// A transformer with its tokenizers.
#[pyclass(frozen, module = "reviv._reviv")]
pub struct Model {
    pub model: reviv::Model,
    /// Where it was read from.
    #[pyo3(get)]
    pub place: String,
    #[pyo3(get)]
    device: String,
}

#[pymethods]
impl Model {
    #[getter]
    fn modalities(&self) -> Vec<&str> {
        self.model.names().collect()
    }

    #[getter]
    fn takes_pixels(&self) -> bool {
        self.model.takes_pixels()
    }

    /// Frames, Hz and pixels of the clips it takes.
    #[getter]
    fn format(&self) -> (usize, f64, usize) {
        let format = self.model.format();
        (format.frames, format.video_rate, format.size)
    }

    /// How many different tokens a modality has.
    fn vocabulary(&self, modality: &str) -> Option<usize> {
        Some(self.model.tokenizers().get(modality)?.vocabulary())
    }

    /// The tokens of a clip by modality, each in the shape of its grid.
    fn encode<'py>(&self, py: Python<'py>, clip: &Clip) -> PyResult<Bound<'py, PyDict>> {
        let tokens = py.detach(|| self.model.tokenizers().encode(&clip.clip));
        let found = PyDict::new(py);
        for (name, grid) in tokens.map_err(|error| refused(py, error, ""))? {
            found.set_item(name, ids(py, grid)?)?;
        }
        Ok(found)
    }
}

/// A model folder, or the model of a run; without a path that of the latest run.
#[pyfunction]
pub fn open_model(
    py: Python<'_>,
    path: Option<PathBuf>,
    device: &str,
    runs: PathBuf,
) -> PyResult<Model> {
    let compute = compute(py, device)?;
    let folder = reviv::cli::find_model(&runs, path.as_deref());
    let folder = folder.map_err(|error| of_run(py, &error))?;
    let model = py.detach(|| reviv::Model::open(&folder, &compute));
    Ok(Model {
        model: model.map_err(|error| refused(py, error, ""))?,
        place: folder.display().to_string(),
        device: device.to_owned(),
    })
}

/// `cpu`, `auto`, or a kind of GPU: `cuda`, `cuda:1`.
fn compute(py: Python<'_>, device: &str) -> PyResult<Compute> {
    let choice: DeviceChoice = device.parse().map_err(|error| refused(py, error, ""))?;
    Compute::new(choice, Precision::F32).map_err(|error| refused(py, error, ""))
}

/// How tokens are generated: an entry of the registry, the user's own beside this folder included; without a name, the default.
pub fn decoding(py: Python<'_>, name: Option<&str>) -> PyResult<DecodingSettings> {
    let Some(name) = name else {
        return Ok(DecodingSettings::default());
    };
    let catalog = Catalog::linked();
    load::entry(&catalog, Path::new("./x"), name).ok_or_else(|| {
        let message = format!("no decoding `{name}`");
        refused(py, message, "`reviv list decoding` shows all")
    })
}

/// Scores a model on clips beside the trivial baselines.
#[pyfunction]
pub fn evaluate(
    py: Python<'_>,
    model: &Model,
    clips: &Clips,
    inputs: Option<Vec<String>>,
    targets: Vec<String>,
    decoding_name: Option<&str>,
    seed: u64,
    system: String,
    progress: Option<Py<PyAny>>,
) -> PyResult<Table> {
    let defaults = EvaluateOptions::default();
    let options = EvaluateOptions {
        inputs: inputs.unwrap_or_else(|| {
            let tokens = model.model.names().any(|name| name == "rgb");
            vec![if tokens { "rgb" } else { "pixels" }.to_owned()]
        }),
        targets,
        decoding: decoding(py, decoding_name)?,
        seed,
        system,
        ..defaults
    };
    let mut heard = Progress::new(progress);
    let scores = py.detach(|| {
        reviv::evaluate(
            &model.model,
            clips.source.as_ref(),
            &options,
            |done, total| heard.tell(done, total, "clips"),
        )
    });
    if let Some(error) = heard.raised() {
        return Err(error);
    }
    let scores = scores.map_err(|error| match error {
        EvaluateError::Evaluation(EvaluationError::Interrupted) => {
            Stopped::new_err("stopped by its callback")
        }
        error => refused(py, error, ""),
    })?;
    let table = reviv::table(clips.source.name(), &[scores]);
    Ok(Table {
        table: table.map_err(|error| refused(py, error, ""))?,
    })
}
