//! What a callback of a long computation answers.

/// Whether to go on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Flow {
    /// Go on.
    #[default]
    Continue,
    /// Stop at the next place where nothing is lost.
    Stop,
}
