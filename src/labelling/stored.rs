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

/// The SHA-256 of the weights of a folder.
///
/// # Errors
/// When they cannot be read.
pub fn fingerprint(folder: &Path) -> Result<String, LabelError> {
    use sha2::{Digest, Sha256};
    use std::fmt::Write as _;
    use std::io::Read;
    let path = folder.join(FILE);
    let failed = |error: std::io::Error| LabelError::Files(format!("{}: {error}", path.display()));
    let mut file = std::fs::File::open(&path).map_err(failed)?;
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        let count = file.read(&mut buffer).map_err(failed)?;
        if count == 0 {
            break;
        }
        hasher.update(&buffer[..count]);
    }
    let mut text = String::new();
    for byte in hasher.finalize() {
        let _ = write!(text, "{byte:02x}");
    }
    Ok(text)
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
            return Err(refuse(
                "does not exist; `reviv import` makes a folder of a depth network from the released file".to_owned(),
            ));
        }
        let mut weights = Weights::read(&path)?;
        let metadata = std::mem::take(&mut weights.metadata);
        let text = |key: &str| metadata.get(key).map(String::as_str).unwrap_or_default();
        if text("format") != FORMAT {
            return Err(refuse(format!(
                "these are no weights of a depth network (`{}`)",
                text("format").escape_debug()
            )));
        }
        let kind: DepthLabelKind = text("kind").parse().map_err(&refuse)?;
        let settings: NetworkSettings =
            serde_json::from_str(text("settings")).map_err(|error| refuse(error.to_string()))?;
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
