//! Opening a tokenizer's directory without knowing its family.

use std::path::Path;

use super::trained::{self, VqTokenizer};
use super::video::VideoTokenizer;
use super::video::stored;
use super::{Tokenizer, TokenizerError};
use crate::engine::{Compute, Weights};

/// The tokenizer in `directory`, of whichever family, on a device.
///
/// # Errors
/// When there is no `tokenizer.safetensors`, or it is damaged or of an unknown format.
pub fn open(directory: &Path, compute: &Compute) -> Result<Box<dyn Tokenizer>, TokenizerError> {
    let path = directory.join(trained::FILE);
    let weights = Weights::read(&path).map_err(|error| TokenizerError::Other(error.to_string()))?;
    let format = weights.metadata.get("format").map(String::as_str);
    if format == Some(stored::FORMAT) {
        return Ok(Box::new(VideoTokenizer::from_weights(weights, compute)?));
    }
    Ok(Box::new(VqTokenizer::from_weights(weights, compute)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_tokenizer_is_refused_with_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let missing = open(folder.path(), &Compute::cpu())
            .err()
            .unwrap()
            .to_string();
        assert!(missing.contains("tokenizer.safetensors"), "{missing}");
        Weights::default()
            .write(&folder.path().join(trained::FILE))
            .unwrap();
        let unknown = open(folder.path(), &Compute::cpu())
            .err()
            .unwrap()
            .to_string();
        assert!(unknown.contains("format"), "{unknown}");
    }
}
