//! A diagnostic: what is wrong, where it was written, which layer wrote it, and the way out.
//!
//! Codes: E01 YAML, E02 keys, types, ranges and names, E03 edges and artifact types, E04 shapes and vocabularies, E05
//! budgets, E06 inputs missing or changed, W07 smells. Rendering follows rustc; meaning is never carried by colour alone.

use super::problem::Code;
use super::source::Sources;
pub use super::source::Span;
use annotate_snippets::{AnnotationKind, Level, Renderer, Snippet, renderer::DecorStyle};
use serde::Serialize;

/// One error or warning.
#[derive(Debug, Clone, PartialEq)]
pub struct Diagnostic {
    /// What kind of mistake it is; says too whether it is an error or a warning.
    pub code: Code,
    /// Where it was written.
    pub span: Span,
    /// What is wrong, with the user's own words in backticks.
    pub message: String,
    /// A few words under the marked source.
    pub label: String,
    /// Other places that matter.
    pub also: Vec<(Span, String)>,
    /// What to know: which layer set it, which arm it is in.
    pub notes: Vec<String>,
    /// The way out.
    pub help: Vec<String>,
}

impl Diagnostic {
    /// A diagnostic at a place.
    pub fn new(code: Code, span: Span, message: impl Into<String>) -> Self {
        Self {
            code,
            span,
            message: message.into(),
            label: String::new(),
            also: Vec::new(),
            notes: Vec::new(),
            help: Vec::new(),
        }
    }

    /// A few words under the marked source.
    #[must_use]
    pub fn label(mut self, label: impl Into<String>) -> Self {
        self.label = label.into();
        self
    }

    /// Another place that matters.
    #[must_use]
    pub fn also(mut self, span: Span, label: impl Into<String>) -> Self {
        self.also.push((span, label.into()));
        self
    }

    /// What to know.
    #[must_use]
    pub fn note(mut self, note: impl Into<String>) -> Self {
        self.notes.push(note.into());
        self
    }

    /// The way out; empty text adds nothing.
    #[must_use]
    pub fn help(mut self, help: impl Into<String>) -> Self {
        let help = help.into();
        if !help.is_empty() {
            self.help.push(help);
        }
        self
    }
}

/// Everything that was said about an experiment, with the texts it was said about.
#[derive(Debug, Clone, Default)]
pub struct Report {
    /// As found; after [`Report::tidy`] without repetitions, errors first, by place.
    pub diagnostics: Vec<Diagnostic>,
    /// The texts that the spans of the diagnostics lie in.
    pub sources: Sources,
}

/// A diagnostic for machines.
#[derive(Debug, Serialize)]
pub struct Record<'a> {
    /// As in [`Diagnostic::code`].
    pub code: Code,
    /// `error` or `warning`.
    pub severity: &'static str,
    /// What is wrong.
    pub message: &'a str,
    /// Name of the text it was written in: a file, a registry entry, `--set`.
    pub file: &'a str,
    /// From 1.
    pub line: usize,
    /// From 1, in characters.
    pub column: usize,
    /// A few words about the marked place.
    pub label: &'a str,
    /// What to know: which layer set it, which arm it is in.
    pub notes: &'a [String],
    /// Ways out.
    pub help: &'a [String],
}

impl Report {
    /// Whether anything in it is an error.
    pub fn failed(&self) -> bool {
        self.errors() > 0
    }

    /// How many errors there are.
    pub fn errors(&self) -> usize {
        self.diagnostics
            .iter()
            .filter(|diagnostic| !diagnostic.code.is_warning())
            .count()
    }

    /// For people: all diagnostics, one after the other.
    pub fn render(&self, colour: bool) -> String {
        let renderer = if colour {
            Renderer::styled()
        } else {
            Renderer::plain()
        }
        .decor_style(DecorStyle::Ascii);
        let mut text = String::new();
        for diagnostic in &self.diagnostics {
            text.push_str(&self.render_one(diagnostic, &renderer));
            text.push_str("\n\n");
        }
        text
    }

    fn render_one(&self, diagnostic: &Diagnostic, renderer: &Renderer) -> String {
        let level = if diagnostic.code.is_warning() {
            Level::WARNING
        } else {
            Level::ERROR
        };
        let id = diagnostic.code.to_string();
        let mut group = level
            .primary_title(diagnostic.message.as_str())
            .id(id.as_str())
            .elements(Vec::<annotate_snippets::Element<'_>>::new());
        let mut places = vec![(
            diagnostic.span,
            diagnostic.label.as_str(),
            AnnotationKind::Primary,
        )];
        for (span, label) in &diagnostic.also {
            places.push((*span, label.as_str(), AnnotationKind::Context));
        }
        let mut layers: Vec<u32> = Vec::new();
        for (span, ..) in &places {
            if !layers.contains(&span.layer) {
                layers.push(span.layer);
            }
        }
        for layer in layers {
            let Some(source) = self.sources.get(layer) else {
                continue;
            };
            let (window, offset, line) = source.window(
                places
                    .iter()
                    .filter(|(span, ..)| span.layer == layer)
                    .map(|(span, ..)| *span),
            );
            let mut snippet = Snippet::source(window)
                .line_start(line)
                .path(source.name.as_str());
            for (span, label, kind) in &places {
                if span.layer == layer {
                    let range = source.mark(*span);
                    let mut annotation = kind.span(range.start - offset..range.end - offset);
                    if !label.is_empty() {
                        annotation = annotation.label(*label);
                    }
                    snippet = snippet.annotation(annotation);
                }
            }
            group = group.element(snippet);
        }
        for note in &diagnostic.notes {
            group = group.element(Level::NOTE.message(note.as_str()));
        }
        for help in &diagnostic.help {
            group = group.element(Level::HELP.message(help.as_str()));
        }
        renderer.render(&[group])
    }

    /// For machines.
    pub fn records(&self) -> Vec<Record<'_>> {
        self.diagnostics
            .iter()
            .map(|diagnostic| {
                let (file, line, column) = self.sources.place(diagnostic.span);
                Record {
                    code: diagnostic.code,
                    severity: if diagnostic.code.is_warning() {
                        "warning"
                    } else {
                        "error"
                    },
                    message: &diagnostic.message,
                    file,
                    line,
                    column,
                    label: &diagnostic.label,
                    notes: &diagnostic.notes,
                    help: &diagnostic.help,
                }
            })
            .collect()
    }

    /// Drops repetitions (every arm and seed finds the same mistakes) and orders by place.
    pub fn tidy(&mut self) {
        let mut kept: Vec<Diagnostic> = Vec::new();
        let mut seen = std::collections::BTreeSet::new();
        for diagnostic in self.diagnostics.drain(..) {
            if seen.insert((diagnostic.code, diagnostic.span, diagnostic.message.clone())) {
                kept.push(diagnostic);
            }
        }
        kept.sort_by_key(|diagnostic| {
            (
                diagnostic.code.is_warning(),
                diagnostic.span.layer,
                diagnostic.span.start,
            )
        });
        self.diagnostics = kept;
    }
}
