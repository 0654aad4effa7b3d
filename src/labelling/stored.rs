//! A depth network as a folder: `weights.safetensors`, whose metadata say the sizes, the kind and where it came from.

use std::collections::BTreeMap;
use std::path::Path;

use super::{DepthLabelKind, DepthLabeller, DepthNetwork, LabelError, NetworkSettings};
use crate::engine::{Compute, Initialise, Parameters, Weights};

/// What the file says it is.
pub const FORMAT: &str = "reviv depth network 1";
/// The file of the folder.
pub const FILE: &str = "weights.safetensors";

/// The metadata of a file of these weights.
#[must_use]
pub fn describe(kind: DepthLabelKind, settings: &NetworkSettings) -> BTreeMap<String, String> {
    [
        ("format", FORMAT.to_owned()),
        ("kind", kind.name().to_owned()),
        (
            "settings",
            serde_json::to_string(settings).unwrap_or_default(),
        ),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}

/// The most bytes of a header: names and shapes of a few hundred tensors.
const MAX_HEADER: u64 = 1 << 24;

/// Kind and sizes of the network in a folder; its weights are not read.
///
/// # Errors
/// When there is no depth network.
pub fn described(folder: &Path) -> Result<(DepthLabelKind, NetworkSettings), LabelError> {
    use std::io::Read;
    let path = folder.join(FILE);
    let mut file = std::fs::File::open(&path).map_err(|_| absent(&path))?;
    let mut length = [0; 8];
    let mut header = Vec::new();
    let read = file.read_exact(&mut length).and_then(|()| {
        let length = u64::from_le_bytes(length).min(MAX_HEADER);
        file.take(length).read_to_end(&mut header)
    });
    let refuse = |reason: &dyn std::fmt::Display| {
        LabelError::Settings(format!("{}: {reason}", path.display()))
    };
    read.map_err(|error| refuse(&error))?;
    let header: serde_json::Value = serde_json::from_slice(&header)
        .map_err(|_| refuse(&"these are no weights of a depth network"))?;
    let metadata: BTreeMap<String, String> =
        serde_json::from_value(header["__metadata__"].clone()).unwrap_or_default();
    parsed(&path, &metadata)
}

fn absent(path: &Path) -> LabelError {
    LabelError::Settings(format!(
        "{} does not exist; `reviv import` makes a folder of a depth network from the released file",
        path.display()
    ))
}

fn parsed(
    path: &Path,
    metadata: &BTreeMap<String, String>,
) -> Result<(DepthLabelKind, NetworkSettings), LabelError> {
    let refuse = |reason: String| LabelError::Settings(format!("{}: {reason}", path.display()));
    let text = |key: &str| metadata.get(key).map(String::as_str).unwrap_or_default();
    if text("format") != FORMAT {
        return Err(refuse("these are no weights of a depth network".to_owned()));
    }
    let kind: DepthLabelKind = text("kind").parse().map_err(&refuse)?;
    let settings: NetworkSettings =
        serde_json::from_str(text("settings")).map_err(|error| refuse(error.to_string()))?;
    settings.check()?;
    Ok((kind, settings))
}

/// The SHA-256 of the weights of a folder.
///
/// # Errors
/// When they cannot be read.
pub fn fingerprint(folder: &Path) -> Result<String, LabelError> {
    let path = folder.join(FILE);
    crate::formats::sha256_of(&path)
        .map_err(|error| LabelError::Files(format!("{}: {error}", path.display())))
}

impl DepthLabeller {
    /// Opens a folder that `reviv import` or [`DepthLabeller::write`] made.
    ///
    /// # Errors
    /// When there is no such file, or it does not hold a depth network of these sizes.
    pub fn open(folder: &Path, compute: &Compute) -> Result<Self, LabelError> {
        let path = folder.join(FILE);
        let refuse = |reason: String| LabelError::Settings(format!("{}: {reason}", path.display()));
        if !path.is_file() {
            return Err(absent(&path));
        }
        let mut weights = Weights::read(&path)?;
        let metadata = std::mem::take(&mut weights.metadata);
        let (kind, settings) = parsed(&path, &metadata)?;
        let unfit = |error: crate::engine::EngineError| refuse(error.to_string());
        DepthNetwork::new(&Initialise::meta(compute), &settings)?
            .check_shapes(&weights)
            .map_err(unfit)?;
        let mut network = DepthNetwork::new(&Initialise::empty(compute), &settings)?;
        network.load(&weights).map_err(unfit)?;
        Ok(Self::new(network, kind, compute))
    }

    /// Writes the folder's file; equal networks give equal bytes.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), LabelError> {
        let mut weights = self.network().weights();
        weights.metadata = describe(self.kind(), self.network().settings());
        Ok(weights.write(&folder.join(FILE))?)
    }
}
