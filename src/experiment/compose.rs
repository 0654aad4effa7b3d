//! Files and what they extend, and `--set` arguments, as merged nodes.

use super::catalog::Catalog;
use super::diagnostic::{Diagnostic, Span};
use super::files::{canonical, read_bytes};
use super::merge;
use super::names;
use super::problem::Code;
use super::source::{Origin, Source, Sources};
use super::yaml::{self, Data, Item, Node};
use std::path::{Path, PathBuf};

/// Files that extend files that extend files...
const MAX_DEPTH: usize = 16;
/// ... and many at a time.
const MAX_READS: usize = 200;

/// Reads files into layers and merges them.
pub struct Composer<'a> {
    pub catalog: &'a Catalog,
    pub sources: &'a mut Sources,
    pub diagnostics: &'a mut Vec<Diagnostic>,
    /// Files that are being read: each extends the next.
    stack: Vec<PathBuf>,
    /// Files read so far, repetitions included.
    reads: usize,
}

impl<'a> Composer<'a> {
    pub fn new(
        catalog: &'a Catalog,
        sources: &'a mut Sources,
        diagnostics: &'a mut Vec<Diagnostic>,
    ) -> Self {
        Self {
            catalog,
            sources,
            diagnostics,
            stack: Vec::new(),
            reads: 0,
        }
    }

    /// The file that was asked for, with everything it extends.
    pub fn file(&mut self, path: &Path) -> Option<Node> {
        self.read(path, Origin::File, None)
    }

    /// A file that a place in another file names, relative to that file.
    pub fn named(&mut self, name: &str, asked: Span, origin: Origin) -> Option<Node> {
        let path = self.relative(name, asked);
        self.read(&path, origin, Some(asked))
    }

    /// The name of the text that a place is in.
    pub fn name_of(&self, span: Span) -> String {
        self.sources
            .get(span.layer)
            .map(|source| format!("`{}`", source.name))
            .unwrap_or_default()
    }

    /// A path written in a file, relative to where the reader stands.
    pub fn relative(&self, name: &str, asked: Span) -> PathBuf {
        self.sources
            .get(asked.layer)
            .and_then(|source| source.path.as_deref())
            .and_then(Path::parent)
            .filter(|folder| !folder.as_os_str().is_empty())
            .map_or_else(|| PathBuf::from(name), |folder| folder.join(name))
    }

    fn read(&mut self, path: &Path, origin: Origin, asked: Option<Span>) -> Option<Node> {
        let identity = canonical(path);
        if let Some(at) = self.stack.iter().position(|other| *other == identity) {
            let circle: Vec<String> = self.stack[at..]
                .iter()
                .chain(std::iter::once(&identity))
                .map(|path| {
                    format!(
                        "`{}`",
                        path.file_name().unwrap_or_default().to_string_lossy()
                    )
                })
                .collect();
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0104,
                    asked.unwrap_or(Span::point(0, 0)),
                    "files extend each other in a circle",
                )
                .label("this closes it")
                .note(circle.join(" extends ")),
            );
            return None;
        }
        self.reads += 1;
        if self.stack.len() >= MAX_DEPTH || self.reads > MAX_READS {
            self.diagnostics.push(Diagnostic::new(
                Code::E0104,
                asked.unwrap_or(Span::point(0, 0)),
                "too many files extend each other",
            ));
            return None;
        }
        let (layer, text) = self.text(path, origin, asked)?;
        let before = self.diagnostics.len();
        let node = yaml::parse(&text, layer, self.diagnostics)?;
        if !matches!(node.data, Data::Map(_)) {
            self.diagnostics.push(
                Diagnostic::new(
                    Code::E0102,
                    node.span,
                    format!("an experiment is a map of keys, this is {}", node.what()),
                )
                .help("start with `experiment: NAME`"),
            );
            return None;
        }
        // A file that is broken is not merged: what follows would be noise.
        let broken = self.diagnostics[before..]
            .iter()
            .any(|d| matches!(d.code, Code::E0101 | Code::E0102));
        self.stack.push(identity);
        let whole = self.extend(node);
        self.stack.pop();
        whole.filter(|_| !broken)
    }

    fn extend(&mut self, node: Node) -> Option<Node> {
        let span = node.span;
        let Data::Map(mut items) = node.data else {
            return None;
        };
        let Some(at) = items.iter().position(|item| item.key == "extends") else {
            return Some(Node::new(Data::Map(items), span));
        };
        let item = items.remove(at);
        let names: Vec<&Node> = match &item.value.data {
            Data::List(nodes) => nodes.iter().collect(),
            _ => vec![&item.value],
        };
        let mut below: Option<Node> = None;
        let mut whole = true;
        let asking = self.name_of(span);
        for name in names {
            let Some(text) = name.text() else {
                self.diagnostics.push(
                    Diagnostic::new(
                        Code::E0202,
                        name.span,
                        format!("`extends` names files, not {}", name.what()),
                    )
                    .help("`extends: base.yaml`, or a list of files"),
                );
                whole = false;
                continue;
            };
            match self.named(text, name.span, Origin::Extended(asking.clone())) {
                Some(node) => {
                    below = Some(match below {
                        Some(below) => merge::merge(below, node, self.diagnostics),
                        None => node,
                    });
                }
                None => whole = false,
            }
        }
        if !whole {
            return None;
        }
        let own = Node::new(Data::Map(items), span);
        Some(match below {
            Some(below) => merge::merge(below, own, self.diagnostics),
            None => own,
        })
    }

    /// The text of a file, or of the shipped experiment of that name.
    fn text(&mut self, path: &Path, origin: Origin, asked: Option<Span>) -> Option<(u32, String)> {
        if let Some(layer) = self.sources.find(path) {
            let text = self.sources.get(layer).map(|source| source.text.clone())?;
            return Some((layer, text));
        }
        match read_bytes(path) {
            Ok(bytes) => {
                let layer = self.sources.add(Source {
                    name: path.display().to_string(),
                    path: Some(path.to_owned()),
                    text: String::new(),
                    origin,
                });
                match yaml::decode(&bytes, layer) {
                    Ok(text) => {
                        let text = text.into_owned();
                        self.sources.set_text(layer, text.clone());
                        Some((layer, text))
                    }
                    Err(diagnostic) => {
                        self.diagnostics.push(*diagnostic);
                        None
                    }
                }
            }
            Err(error) => {
                if error.kind() == std::io::ErrorKind::NotFound
                    && let Some((shipped, text)) = self.shipped(path)
                {
                    let layer = self.sources.add(Source {
                        name: format!("{shipped} (built in)"),
                        path: Some(path.to_owned()),
                        text: text.to_owned(),
                        origin,
                    });
                    return Some((layer, text.to_owned()));
                }
                self.missing(path, &error, asked);
                None
            }
        }
    }

    fn shipped(&self, path: &Path) -> Option<(&'static str, &'static str)> {
        let wanted = path.to_string_lossy().replace('\\', "/");
        let wanted = wanted.trim_start_matches("./");
        self.catalog
            .experiments()
            .iter()
            .find(|(name, _)| *name == wanted || name.strip_prefix("experiments/") == Some(wanted))
            .copied()
    }

    fn missing(&mut self, path: &Path, error: &std::io::Error, asked: Option<Span>) {
        let shown = path.display();
        let message = if error.kind() == std::io::ErrorKind::NotFound {
            format!("there is no file `{shown}`")
        } else {
            format!("cannot read `{shown}`: {error}")
        };
        let span = asked.unwrap_or_else(|| {
            Span::point(
                self.sources.add(Source {
                    name: shown.to_string(),
                    path: None,
                    text: String::new(),
                    origin: Origin::File,
                }),
                0,
            )
        });
        let mut files: Vec<String> = path
            .parent()
            .map(|folder| {
                if folder.as_os_str().is_empty() {
                    Path::new(".")
                } else {
                    folder
                }
            })
            .and_then(|folder| std::fs::read_dir(folder).ok())
            .map(|listing| {
                listing
                    .flatten()
                    .take(1000)
                    .map(|item| item.file_name().to_string_lossy().into_owned())
                    .filter(|name| {
                        Path::new(name)
                            .extension()
                            .is_some_and(|extension| extension == "yaml")
                    })
                    .collect()
            })
            .unwrap_or_default();
        files.sort();
        let wrong = path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        let help = names::nearest(&wrong, files.iter().map(String::as_str))
            .map(|near| format!("did you mean `{near}`?"))
            .unwrap_or_default();
        self.diagnostics
            .push(Diagnostic::new(Code::E0101, span, message).help(help));
    }

    /// `--set a.b=c` arguments as patches, each its own layer.
    pub fn overrides(&mut self, arguments: &[String]) -> Vec<Node> {
        let mut patches = Vec::new();
        for argument in arguments {
            let layer = self.sources.add(Source {
                name: "--set".to_owned(),
                path: None,
                text: argument.clone(),
                origin: Origin::Set,
            });
            let whole = Span::new(layer, 0, argument.len());
            let Some((key, _)) = argument.split_once('=') else {
                self.diagnostics.push(
                    Diagnostic::new(Code::E0102, whole, "`--set` takes KEY=VALUE")
                        .help("`--set stages.mget.steps=10`"),
                );
                continue;
            };
            if argument.len() > yaml::MAX_BYTES {
                continue;
            }
            let key_span = Span::new(layer, 0, key.len());
            let value = if argument.len() == key.len() + 1 {
                Some(Node::new(Data::Null, whole))
            } else {
                yaml::parse_value(argument, key.len() + 1, layer, self.diagnostics)
            };
            if let Some(value) = value {
                patches.push(Node::new(
                    Data::Map(vec![Item {
                        key: key.trim().to_owned(),
                        key_span,
                        value,
                    }]),
                    whole,
                ));
            }
        }
        patches
    }
}
