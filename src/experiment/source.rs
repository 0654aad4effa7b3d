//! The texts an experiment is made of: files, registry entries, `--set` arguments, each with its name and its role.

use std::ops::Range;
use std::path::{Path, PathBuf};

/// A range of bytes in one layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Span {
    /// Index of the layer.
    pub layer: u32,
    /// The first byte.
    pub start: u32,
    /// One past the last byte.
    pub end: u32,
}

impl Span {
    /// Bytes `start..end` of a layer.
    pub fn new(layer: u32, start: usize, end: usize) -> Self {
        Self {
            layer,
            start: start as u32,
            end: end as u32,
        }
    }

    /// A place without extent.
    pub fn point(layer: u32, at: usize) -> Self {
        Self::new(layer, at, at)
    }
}

/// How a text came to take part.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// The file that was asked for.
    File,
    /// A file that another one extends, or the base of a sweep: the name of the one that asked.
    Extended(String),
    /// An experiment whose stage another one reads.
    Imported,
    /// A registry entry: built in, the project's, or linked in.
    Registry,
    /// A `--set` argument.
    Set,
    /// `data.yaml`: where data sets lie on this machine.
    Environment,
}

/// One text.
#[derive(Debug, Clone)]
pub struct Source {
    /// As shown: `experiments/a.yaml`, `registry/masking/uniform.yaml (built in)`, `--set`.
    pub name: String,
    /// Where it lies, for files; relative paths in it are relative to its folder.
    pub path: Option<PathBuf>,
    /// All of it; what a [`Span`] of this layer counts bytes in.
    pub text: String,
    /// How it takes part in the experiment.
    pub origin: Origin,
}

impl Source {
    /// The lines around some places: text, its first byte, its first line number.
    pub fn window(&self, spans: impl Iterator<Item = Span>) -> (&str, usize, usize) {
        let (mut low, mut high) = (self.text.len(), 0);
        for span in spans {
            let range = self.mark(span);
            low = low.min(range.start);
            high = high.max(range.end);
        }
        let low = low.min(high);
        let start = self.text[..low].rfind('\n').map_or(0, |at| at + 1);
        let end = self.text[high..]
            .find('\n')
            .map_or(self.text.len(), |at| high + at);
        // A minified or binary text has no lines to speak of: show a piece.
        let start = if low - start > 400 {
            floor(&self.text, low - 80)
        } else {
            start
        };
        let end = if end - high > 400 {
            floor(&self.text, high + 80)
        } else {
            end
        };
        let line = 1 + self.text[..start].matches('\n').count();
        (&self.text[start..end], start, line)
    }

    /// The bytes to mark for a span: within the text, on character boundaries, of the first line only.
    pub fn mark(&self, span: Span) -> Range<usize> {
        let start = floor(&self.text, (span.start as usize).min(self.text.len()));
        let end = floor(&self.text, (span.end as usize).min(self.text.len())).max(start);
        let line_end = self.text[start..end]
            .find('\n')
            .map_or(end, |at| start + at);
        start..line_end.min(floor(&self.text, start + 200)).max(start)
    }
}

/// The nearest character boundary at or before `at`.
fn floor(text: &str, at: usize) -> usize {
    let mut at = at.min(text.len());
    while !text.is_char_boundary(at) {
        at -= 1;
    }
    at
}

/// All texts, numbered: a [`Span`] names one by its number.
#[derive(Debug, Clone, Default)]
pub struct Sources {
    list: Vec<Source>,
}

impl Sources {
    /// Adds a text and gives its number.
    pub fn add(&mut self, source: Source) -> u32 {
        self.list.push(source);
        (self.list.len() - 1) as u32
    }

    /// The text of a number.
    pub fn get(&self, layer: u32) -> Option<&Source> {
        self.list.get(layer as usize)
    }

    /// Replaces the text of a source (a file that could not be read has none at first).
    pub fn set_text(&mut self, layer: u32, text: String) {
        if let Some(source) = self.list.get_mut(layer as usize) {
            source.text = text;
        }
    }

    /// All texts in order.
    pub fn iter(&self) -> impl Iterator<Item = &Source> {
        self.list.iter()
    }

    /// The number of a file that has been read already.
    pub fn find(&self, path: &Path) -> Option<u32> {
        self.list
            .iter()
            .position(|source| source.path.as_deref() == Some(path))
            .map(|index| index as u32)
    }

    /// File, line and column (from 1, in characters) of the start of a span.
    pub fn place(&self, span: Span) -> (&str, usize, usize) {
        let Some(source) = self.get(span.layer) else {
            return ("", 1, 1);
        };
        let at = floor(&source.text, span.start as usize);
        let line_start = source.text[..at].rfind('\n').map_or(0, |at| at + 1);
        let line = 1 + source.text[..at].matches('\n').count();
        let column = 1 + source.text[line_start..at].chars().count();
        (&source.name, line, column)
    }

    /// The text of a span (its first line, where there are more).
    pub fn slice(&self, span: Span) -> &str {
        self.get(span.layer)
            .map_or("", |source| &source.text[source.mark(span)])
    }

    /// `file:line` of a span.
    pub fn cite(&self, span: Span) -> String {
        let (file, line, _) = self.place(span);
        match self.get(span.layer).map(|source| &source.origin) {
            Some(Origin::Set) => format!("--set {}", self.list[span.layer as usize].text),
            Some(Origin::Environment) => self.list[span.layer as usize].name.clone(),
            _ => format!("{file}:{line}"),
        }
    }
}
