//! YAML 1.2 text to nodes with spans, with bounded time and memory whatever the text is.

use super::diagnostic::{Diagnostic, Span};
use super::problem::Code;
use granit_parser::{Event, Parser, ScalarStyle, Tag};
use std::collections::BTreeMap;

/// Experiments are written by people: a larger file is a mistake.
pub const MAX_BYTES: usize = 1 << 20;
/// Nesting that no experiment needs.
pub const MAX_DEPTH: usize = 64;
/// Values (and their text, by the sixteen bytes) after aliases are expanded.
pub const MAX_WEIGHT: usize = 200_000;

/// A value and the place it was written at.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    pub data: Data,
    pub span: Span,
    /// One of the three tags of the language.
    pub directive: Option<Directive>,
    /// The value that an earlier layer gave and this one replaced.
    pub before: Option<Box<Node>>,
}

/// What a node holds.
#[derive(Debug, Clone, PartialEq)]
pub enum Data {
    Null,
    Bool(bool),
    Int(i64),
    Float(f64),
    Text(String),
    List(Vec<Node>),
    Map(Vec<Item>),
}

/// A key and its value, in the order of the text.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    pub key: String,
    pub key_span: Span,
    pub value: Node,
}

/// `!append`, `!replace`, `!unset`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Directive {
    /// The list continues the list of the layers below.
    Append,
    /// The map replaces the map of the layers below.
    Replace,
    /// The key goes away.
    Unset,
}

impl Node {
    /// A node without tag or history.
    pub fn new(data: Data, span: Span) -> Self {
        Self {
            data,
            span,
            directive: None,
            before: None,
        }
    }

    /// The entries of a map; none for anything else.
    pub fn items(&self) -> &[Item] {
        match &self.data {
            Data::Map(items) => items,
            _ => &[],
        }
    }

    /// The elements of a list; none for anything else.
    pub fn list(&self) -> &[Node] {
        match &self.data {
            Data::List(nodes) => nodes,
            _ => &[],
        }
    }

    /// The entry of a key.
    pub fn item(&self, key: &str) -> Option<&Item> {
        self.items().iter().find(|item| item.key == key)
    }

    /// The value of a key.
    pub fn get(&self, key: &str) -> Option<&Node> {
        self.item(key).map(|item| &item.value)
    }

    /// The text of a string.
    pub fn text(&self) -> Option<&str> {
        match &self.data {
            Data::Text(text) => Some(text),
            _ => None,
        }
    }

    /// The value at a dotted path.
    pub fn at(&self, path: &str) -> Option<&Node> {
        if path.is_empty() {
            return Some(self);
        }
        let mut node = self;
        for key in path.split('.') {
            node = match &node.data {
                Data::Map(_) => node.get(key)?,
                Data::List(nodes) => nodes.get(key.parse::<usize>().ok()?)?,
                _ => return None,
            };
        }
        Some(node)
    }

    /// What kind of value it is, in words.
    pub fn what(&self) -> &'static str {
        match &self.data {
            Data::Null => "nothing",
            Data::Bool(_) => "true or false",
            Data::Int(_) => "a whole number",
            Data::Float(_) => "a number",
            Data::Text(_) => "text",
            Data::List(_) => "a list",
            Data::Map(_) => "a map",
        }
    }

    /// How much it takes: one for each value, one for each sixteen bytes of text.
    pub fn weight(&self) -> usize {
        1 + match &self.data {
            Data::Text(text) => text.len() / 16,
            Data::List(nodes) => nodes.iter().map(Node::weight).sum(),
            Data::Map(items) => items
                .iter()
                .map(|item| 1 + item.key.len() / 16 + item.value.weight())
                .sum(),
            _ => 0,
        }
    }

    /// The value as JSON, spans dropped.
    pub fn to_json(&self) -> serde_json::Value {
        use serde_json::Value;
        match &self.data {
            Data::Null => Value::Null,
            Data::Bool(value) => Value::Bool(*value),
            Data::Int(value) => Value::from(*value),
            Data::Float(value) => Value::from(*value),
            Data::Text(text) => Value::String(text.clone()),
            Data::List(nodes) => Value::Array(nodes.iter().map(Node::to_json).collect()),
            Data::Map(items) => Value::Object(
                items
                    .iter()
                    .map(|item| (item.key.clone(), item.value.to_json()))
                    .collect(),
            ),
        }
    }

    /// The value on one line, as YAML flow.
    pub fn inline(&self) -> String {
        match &self.data {
            Data::Text(text) => text.clone(),
            Data::List(nodes) => {
                let parts: Vec<String> = nodes.iter().map(Node::inline).collect();
                format!("[{}]", parts.join(", "))
            }
            Data::Map(items) => {
                let parts: Vec<String> = items
                    .iter()
                    .map(|item| format!("{}: {}", item.key, item.value.inline()))
                    .collect();
                format!("{{{}}}", parts.join(", "))
            }
            _ => self.to_json().to_string(),
        }
    }
}

/// Reads bytes as text: size, encoding.
///
/// # Errors
/// One diagnostic that says what the file is instead.
pub fn decode(bytes: &[u8], layer: u32) -> Result<&str, Box<Diagnostic>> {
    let start = Span::point(layer, 0);
    if bytes.len() > MAX_BYTES {
        return Err(Box::new(
            Diagnostic::new(
                Code::E0101,
                start,
                format!(
                    "the file has {} bytes or more; an experiment has at most {MAX_BYTES}",
                    bytes.len()
                ),
            )
            .help("data does not belong in an experiment: name a file or a data set"),
        ));
    }
    let text = std::str::from_utf8(bytes).map_err(|error| {
        Box::new(
            Diagnostic::new(
                Code::E0101,
                start,
                format!(
                    "the file is not UTF-8: byte {} is no part of a character",
                    error.valid_up_to()
                ),
            )
            .help("save it as UTF-8, or name a YAML file"),
        )
    })?;
    if let Some(position) = bytes.iter().position(|&byte| byte == 0) {
        return Err(Box::new(
            Diagnostic::new(
                Code::E0101,
                start,
                format!("the file is binary: byte {position} is zero"),
            )
            .help("name a YAML file"),
        ));
    }
    Ok(text)
}

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
                    super::names::nearest(other, ["!append", "!replace", "!unset"].into_iter())
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

/// A plain scalar by the YAML 1.2 core schema.
pub fn plain(text: &str) -> Data {
    match text {
        "" | "~" | "null" | "Null" | "NULL" => return Data::Null,
        "true" | "True" | "TRUE" => return Data::Bool(true),
        "false" | "False" | "FALSE" => return Data::Bool(false),
        ".inf" | ".Inf" | ".INF" | "+.inf" | "+.Inf" | "+.INF" => {
            return Data::Float(f64::INFINITY);
        }
        "-.inf" | "-.Inf" | "-.INF" => return Data::Float(f64::NEG_INFINITY),
        ".nan" | ".NaN" | ".NAN" => return Data::Float(f64::NAN),
        _ => {}
    }
    let digits = text.strip_prefix(['-', '+']).unwrap_or(text);
    if !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit()) {
        if let Ok(value) = text.parse::<i64>() {
            return Data::Int(value);
        }
        return text
            .parse::<f64>()
            .map_or_else(|_| Data::Text(text.to_owned()), Data::Float);
    }
    for (prefix, radix) in [("0x", 16), ("0o", 8)] {
        if let Some(digits) = text.strip_prefix(prefix)
            && let Ok(value) = i64::from_str_radix(digits, radix)
        {
            return Data::Int(value);
        }
    }
    let numeric = digits
        .bytes()
        .all(|byte| byte.is_ascii_digit() || matches!(byte, b'.' | b'e' | b'E' | b'-' | b'+'))
        && digits
            .bytes()
            .next()
            .is_some_and(|byte| byte.is_ascii_digit() || byte == b'.')
        && digits.bytes().any(|byte| byte.is_ascii_digit());
    if numeric && let Ok(value) = text.parse::<f64>() {
        return Data::Float(value);
    }
    Data::Text(text.to_owned())
}
