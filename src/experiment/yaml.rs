//! YAML 1.2 text to nodes with spans, with bounded time and memory whatever the text is.

mod parse;
mod text;

pub use parse::{parse, parse_value};
pub use text::{decode, plain};

use super::diagnostic::Span;

/// Experiments are written by people: a larger file is a mistake.
pub const MAX_BYTES: usize = 1 << 20;
/// Nesting that no experiment needs.
pub const MAX_DEPTH: usize = 64;
/// Values (and their text, by the sixteen bytes) after aliases are expanded.
pub const MAX_WEIGHT: usize = 200_000;

/// A value and the place it was written at.
#[derive(Debug, Clone, PartialEq)]
pub struct Node {
    /// The value itself.
    pub data: Data,
    /// Where it was written.
    pub span: Span,
    /// One of the three tags of the language.
    pub directive: Option<Directive>,
    /// The value that an earlier layer gave and this one replaced.
    pub before: Option<Box<Node>>,
}

/// What a node holds.
#[derive(Debug, Clone, PartialEq)]
pub enum Data {
    /// Nothing, `~` or `null`.
    Null,
    /// `true` or `false`.
    Bool(bool),
    /// A whole number: decimal, `0x` or `0o`.
    Int(i64),
    /// Any other number, `.inf` and `.nan` included; also a whole number that an `i64` does not hold.
    Float(f64),
    /// A string, quoted or plain.
    Text(String),
    /// Elements in the order of the text.
    List(Vec<Node>),
    /// Keys with their values, in the order of the text; no key comes twice.
    Map(Vec<Item>),
}

/// A key and its value, in the order of the text.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// The key; one that is no string stands as its text.
    pub key: String,
    /// Where the key was written.
    pub key_span: Span,
    /// What the key stands for.
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

    /// How much it takes, with what it replaced: one for each value, one for each sixteen bytes of text.
    pub fn weight(&self) -> usize {
        let earlier = self.before.as_deref().map_or(0, Node::weight);
        1 + earlier
            + match &self.data {
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

/// The text of a scalar, whatever its type: names may look like numbers.
pub fn scalar(node: &Node) -> Option<String> {
    match &node.data {
        Data::Text(text) => Some(text.clone()),
        Data::Int(_) | Data::Float(_) | Data::Bool(_) => Some(node.inline()),
        _ => None,
    }
}
