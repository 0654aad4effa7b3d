//! Modalities whose values a plug-in crate computes: [`SignalCode`], linked in and named by `source: {code: NAME}`.
//!
//! The code runs once per clip, when clips are made. From there on the values travel in the clip, so that everything
//! after it (tokenizers, masking, MGET, decoding, metrics) treats the modality like any declared one.

use super::{ClipFormat, DeclaredSettings, ModalityError};
use crate::clip::{Clip, Signal};

/// Computes the values of a declared modality from a clip's other signals; `None` where the clip lacks what it needs.
///
/// The settings are those of the entry: channels, rate and units. A sample that cannot be computed is NaN or invalid, never zero.
pub type Derive = fn(&Clip, &DeclaredSettings) -> Result<Option<Signal>, ModalityError>;

/// Code of a plug-in crate: `inventory::submit! { SignalCode { name: "head_turn", about: "...", derive } }`.
///
/// Clips in the cache are known by the name of the code: when what it computes changes, give it another one.
pub struct SignalCode {
    /// What `source: {code: NAME}` says.
    pub name: &'static str,
    /// One line about what it computes.
    pub about: &'static str,
    /// The function that makes the values of a clip.
    pub derive: Derive,
}

inventory::collect!(SignalCode);

/// All linked code, by name.
#[must_use]
pub fn linked() -> Vec<&'static SignalCode> {
    let mut all: Vec<&SignalCode> = inventory::iter::<SignalCode>().collect();
    all.sort_by_key(|code| code.name);
    all
}

/// The code of this name; `None` where it is not linked in, or where two crates bring one of this name.
#[must_use]
pub fn find(name: &str) -> Option<&'static SignalCode> {
    let mut found = linked().into_iter().filter(|code| code.name == name);
    found.next().filter(|_| found.next().is_none())
}

/// Computes what the declared modalities of `format` leave to code, and puts it into the clip.
///
/// # Errors
/// When the code is not there, fails, or gives another shape than the entry declares.
pub fn fill(clip: &mut Clip, format: &ClipFormat) -> Result<(), ModalityError> {
    for settings in &format.declared {
        let Some(name) = &settings.source.code else {
            continue;
        };
        let code = find(name).ok_or_else(|| ModalityError::Degenerate {
            clip: clip.id.clone(),
            modality: settings.name.clone(),
            reason: format!("no code `{name}` is linked into this binary"),
        })?;
        if let Some(signal) = (code.derive)(clip, settings)? {
            super::put(settings, format, signal, clip)?;
        }
    }
    Ok(())
}
