//! Something wrong with what the user wrote, before it has a place in a file: a code, a key path, words.
//!
//! The language turns a [`Problem`] into a [`super::diagnostic::Diagnostic`] by looking the key path up in the span table.

use serde::Serialize;
use std::fmt;

/// Stable codes of diagnostics. The first two digits are the family.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
pub enum Code {
    /// E0101: the file cannot be read, is empty, too large, binary or not UTF-8.
    E0101,
    /// E0102: not YAML.
    E0102,
    /// E0103: YAML that the language does not take: several documents, unknown tags, nesting, aliases that explode.
    E0103,
    /// E0104: files extend each other in a circle, or too deeply.
    E0104,
    /// E0105: `${...}` that cannot be resolved.
    E0105,
    /// E0201: unknown or duplicate key.
    E0201,
    /// E0202: wrong type, or out of range.
    E0202,
    /// E0203: unknown name: op, registry entry, modality, arm, ...
    E0203,
    /// E0204: a value that must be given is missing.
    E0204,
    /// E0205: two entries of one name.
    E0205,
    /// E0206: settings that contradict each other.
    E0206,
    /// E0301: an edge to a stage that does not exist, or none where one is needed.
    E0301,
    /// E0302: stages that wait for each other.
    E0302,
    /// E0303: an edge to an artifact of the wrong type.
    E0303,
    /// E0401: a vocabulary, a shape, a token grid or a modality that does not fit.
    E0401,
    /// E0501: more memory, disk or tokens than there are.
    E0501,
    /// E0601: an input file or data set is missing or has changed.
    E0601,
    /// W0701: allowed, and probably not what was meant.
    W0701,
    /// W0702: a data set is not on this machine; the experiment can be planned here, not run.
    W0702,
}

impl Code {
    /// Warnings do not fail a check.
    pub const fn is_warning(self) -> bool {
        matches!(self, Self::W0701 | Self::W0702)
    }
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self:?}")
    }
}

/// One thing wrong (or suspicious) with a stage's settings or edges.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// What kind of mistake it is; says too whether it is an error or a warning.
    pub code: Code,
    /// Where, relative to the stage: `tokenizer.codebook`, `tokenizers.1`; empty for the stage as a whole.
    pub key: String,
    /// What is wrong, with the user's own words in backticks.
    pub message: String,
    /// A few words under the marked source; empty for none.
    pub label: String,
    /// The way out; empty for none.
    pub help: String,
}

impl Problem {
    /// A problem at `key` (dotted, relative to the stage).
    pub fn new(code: Code, key: impl Into<String>, message: impl Into<String>) -> Self {
        Self {
            code,
            key: key.into(),
            message: message.into(),
            label: String::new(),
            help: String::new(),
        }
    }

    /// A few words under the marked source.
    #[must_use]
    pub fn label(mut self, label: impl Into<String>) -> Self {
        self.label = label.into();
        self
    }

    /// The way out.
    #[must_use]
    pub fn help(mut self, help: impl Into<String>) -> Self {
        self.help = help.into();
        self
    }
}
