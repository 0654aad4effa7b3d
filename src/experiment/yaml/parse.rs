//! Events of the parser to nodes: anchors, tags, duplicate keys, and the bounds.

use super::{Data, Directive, Item, MAX_DEPTH, MAX_WEIGHT, Node, plain};
use crate::experiment::diagnostic::{Diagnostic, Span};
use crate::experiment::names;
use crate::experiment::problem::Code;
use granit_parser::{Event, Parser, ScalarStyle, Tag};
use std::collections::BTreeMap;

/// Parses one document.
///
/// Duplicate keys are reported and the first one is kept, so that a single pass finds everything.
///
/// # Errors
/// The diagnostics of a text that has no tree.
pub fn parse(text: &str, layer: u32, diagnostics: &mut Vec<Diagnostic>) -> Option<Node> {
    parse_from(text, 0, layer, diagnostics)
}

/// Parses the value that follows the first `offset` bytes of a text; it may be nothing.
pub fn parse_value(
    text: &str,
    offset: usize,
    layer: u32,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Node> {
    parse_from(text, offset, layer, diagnostics)
}

fn parse_from(
    text: &str,
    offset: usize,
    layer: u32,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Node> {
    let mut options = granit_parser::Options::default();
    options.block_nesting_limit = MAX_DEPTH;
    options.flow_nesting_limit = MAX_DEPTH;
    options.emit_comments = false;
    let offset = if text[offset..].starts_with('\u{feff}') {
        offset + 3
    } else {
        offset
    };
    let mut builder = Builder {
        parser: Parser::new_from_str_with_options(&text[offset..], options),
        layer,
        offset,
        anchors: BTreeMap::new(),
        nodes: 0,
        diagnostics,
        text,
    };
    match builder.document() {
        Ok(node) => node,
        Err(diagnostic) => {
            builder.diagnostics.push(*diagnostic);
            None
        }
    }
}

struct Builder<'t, 'd> {
    parser: Parser<'t, granit_parser::StrInput<'t>>,
    layer: u32,
    offset: usize,
    anchors: BTreeMap<usize, Node>,
    nodes: usize,
    diagnostics: &'d mut Vec<Diagnostic>,
    text: &'t str,
}

type Step<T> = Result<T, Box<Diagnostic>>;

impl<'t> Builder<'t, '_> {
    fn document(&mut self) -> Step<Option<Node>> {
        let mut root = None;
        loop {
            let (event, span) = self.next()?;
            match event {
                Event::StreamStart | Event::DocumentEnd => {}
                Event::DocumentStart(..) => {
                    if root.is_some() {
                        return Err(Box::new(
                            Diagnostic::new(Code::E0103, span, "a second document starts here")
                                .help("one file holds one experiment: remove everything from `---` on"),
                        ));
                    }
                    let (event, span) = self.next()?;
                    root = Some(if event == Event::DocumentEnd {
                        Node::new(Data::Null, span)
                    } else {
                        self.node(event, span, 0)?
                    });
                }
                Event::StreamEnd => break,
                _ => {
                    return Err(Box::new(Diagnostic::new(
                        Code::E0102,
                        span,
                        "unexpected content",
                    )));
                }
            }
        }
        let empty = root.as_ref().is_none_or(|node| node.data == Data::Null);
        if empty && self.offset < 4 {
            return Err(Box::new(
                Diagnostic::new(Code::E0101, Span::point(self.layer, 0), "the file is empty")
                    .help("an experiment starts with `experiment: NAME` and has `stages:`"),
            ));
        }
        Ok(root)
    }

    fn next(&mut self) -> Step<(Event<'t>, Span)> {
        match self.parser.next_event() {
            None => Ok((Event::StreamEnd, Span::point(self.layer, self.text.len()))),
            Some(Ok((event, span))) => {
                let range = span.byte_range().unwrap_or(0..0);
                let span = Span::new(
                    self.layer,
                    self.offset + range.start,
                    self.offset + range.end,
                );
                Ok((event, span))
            }
            Some(Err(error)) => {
                let at = self.offset + error.marker().byte_offset().unwrap_or(0);
                let message = error.info().clone();
                let tab = self.text[..at.min(self.text.len())]
                    .rsplit('\n')
                    .next()
                    .is_some_and(|line| line.trim_start_matches(' ').starts_with('\t'))
                    || self.text[at.min(self.text.len())..].starts_with('\t');
                let nesting = message.contains("recursion") || message.contains("nest");
                let mut diagnostic = Diagnostic::new(
                    if nesting { Code::E0103 } else { Code::E0102 },
                    Span::point(self.layer, at),
                    if nesting {
                        format!("nested more than {MAX_DEPTH} levels deep")
                    } else {
                        message
                    },
                );
                let line_start = self.text[..at.min(self.text.len())]
                    .rfind('\n')
                    .map_or(0, |at| at + 1);
                let substitution = self.text[line_start..]
                    .lines()
                    .next()
                    .is_some_and(|line| line.contains("${"));
                if substitution {
                    diagnostic =
                        diagnostic.help("inside `{ }` and `[ ]`, quote it: `\"${params.x}\"`");
                }
                if tab {
                    diagnostic = diagnostic.help("YAML indents with spaces, never with tabs");
                }
                Err(Box::new(diagnostic))
            }
        }
    }

    fn grow(&mut self, by: usize, span: Span) -> Step<()> {
        self.nodes += by;
        if self.nodes > MAX_WEIGHT {
            return Err(Box::new(
                Diagnostic::new(
                    Code::E0103,
                    span,
                    format!("more than {MAX_WEIGHT} values after aliases are expanded"),
                )
                .help("no experiment needs that many: check the anchors and aliases"),
            ));
        }
        Ok(())
    }

    fn node(&mut self, event: Event<'t>, span: Span, depth: usize) -> Step<Node> {
        self.grow(1, span)?;
        if depth > MAX_DEPTH {
            return Err(Box::new(Diagnostic::new(
                Code::E0103,
                span,
                format!("nested more than {MAX_DEPTH} levels deep"),
            )));
        }
        let (node, anchor) = match event {
            Event::Alias(id) => {
                let Some(weight) = self.anchors.get(&id).map(Node::weight) else {
                    return Err(Box::new(Diagnostic::new(
                        Code::E0102,
                        span,
                        "an alias inside the value it stands for",
                    )));
                };
                self.grow(weight, span)?;
                (self.anchors[&id].clone(), 0)
            }
            Event::Scalar(text, style, anchor, tag) => {
                let directive = self.directive(tag.as_deref(), span);
                let data = if style == ScalarStyle::Plain {
                    plain(&text)
                } else {
                    Data::Text(text.into_owned())
                };
                let mut node = Node::new(data, span);
                node.directive = directive;
                (node, anchor)
            }
            Event::SequenceStart(_, anchor, tag) => {
                let directive = self.directive(tag.as_deref(), span);
                let mut nodes = Vec::new();
                let end = loop {
                    let (event, span) = self.next()?;
                    if event == Event::SequenceEnd {
                        break span;
                    }
                    nodes.push(self.node(event, span, depth + 1)?);
                };
                let mut node = Node::new(Data::List(nodes), self.cover(span, end));
                node.directive = directive;
                (node, anchor)
            }
            Event::MappingStart(_, anchor, tag) => {
                let directive = self.directive(tag.as_deref(), span);
                let (items, end) = self.mapping(depth)?;
                let mut node = Node::new(Data::Map(items), self.cover(span, end));
                node.directive = directive;
                (node, anchor)
            }
            _ => {
                return Err(Box::new(Diagnostic::new(
                    Code::E0102,
                    span,
                    "unexpected content",
                )));
            }
        };
        if anchor != 0 {
            self.anchors.insert(anchor, node.clone());
        }
        Ok(node)
    }

    fn mapping(&mut self, depth: usize) -> Step<(Vec<Item>, Span)> {
        let mut items: Vec<Item> = Vec::new();
        let mut seen: BTreeMap<String, Span> = BTreeMap::new();
        loop {
            let (event, key_span) = self.next()?;
            if event == Event::MappingEnd {
                return Ok((items, key_span));
            }
            let key = self.node(event, key_span, depth + 1)?;
            let (event, span) = self.next()?;
            let value = self.node(event, span, depth + 1)?;
            let name = match &key.data {
                Data::Text(text) => text.clone(),
                Data::List(_) | Data::Map(_) | Data::Null => {
                    self.diagnostics.push(
                        Diagnostic::new(Code::E0102, key_span, "a key must be a plain name")
                            .label(format!("this is {}", key.what())),
                    );
                    continue;
                }
                _ => key.to_json().to_string(),
            };
            if name == "<<" {
                self.diagnostics.push(
                    Diagnostic::new(Code::E0103, key_span, "merge keys are not YAML 1.2")
                        .help("use `extends:` or `${params.x}`"),
                );
                continue;
            }
            if let Some(first) = seen.get(&name) {
                self.diagnostics.push(
                    Diagnostic::new(Code::E0201, key_span, format!("duplicate key `{name}`"))
                        .label("again here")
                        .also(*first, "first here")
                        .help("keep one of the two"),
                );
                continue;
            }
            seen.insert(name.clone(), key_span);
            items.push(Item {
                key: name,
                key_span,
                value,
            });
        }
    }

    fn directive(&mut self, tag: Option<&Tag>, span: Span) -> Option<Directive> {
        let tag = tag?;
        match tag.original().as_str() {
            "!append" => Some(Directive::Append),
            "!replace" => Some(Directive::Replace),
            "!unset" => Some(Directive::Unset),
            other => {
                let mut diagnostic =
                    Diagnostic::new(Code::E0103, span, format!("unknown tag `{other}`"))
                        .help("the language has three tags: `!append`, `!replace` and `!unset`");
                if let Some(near) =
                    names::nearest(other, ["!append", "!replace", "!unset"].into_iter())
                {
                    diagnostic = diagnostic.help(format!("did you mean `{near}`?"));
                }
                self.diagnostics.push(diagnostic);
                None
            }
        }
    }

    /// From the start of a collection to the end of its last line of content.
    fn cover(&self, start: Span, end: Span) -> Span {
        let start_at = start.start as usize;
        let end_at = (end.end as usize)
            .max(start.end as usize)
            .min(self.text.len());
        let trimmed = self.text[start_at..end_at].trim_end().len();
        Span::new(self.layer, start_at, start_at + trimmed.max(1))
    }
}
