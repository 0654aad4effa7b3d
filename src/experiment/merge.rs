//! One layer over another: maps merge, scalars and lists replace, and three tags say otherwise.
//!
//! A map that names another op (`op:`) or another registry entry (`use:`) than the map below replaces it: settings of
//! `dirichlet` do not leak into `uniform`.

use super::diagnostic::Diagnostic;
use super::problem::Code;
use super::yaml::{Data, Directive, Item, Node};

/// The value that `over` makes of `base`.
pub fn merge(base: Node, mut over: Node, diagnostics: &mut Vec<Diagnostic>) -> Node {
    let directive = over.directive;
    let history = over.before.take();
    match (base.data, over.data) {
        (Data::List(below), Data::List(above)) if directive == Some(Directive::Append) => {
            let mut nodes = below;
            nodes.extend(above);
            Node {
                data: Data::List(nodes),
                span: over.span,
                directive: None,
                before: base.before,
            }
        }
        (below, above) if directive == Some(Directive::Append) => {
            let below = Node::new(below, base.span);
            diagnostics.push(
                Diagnostic::new(
                    Code::E0103,
                    over.span,
                    "`!append` needs a list here and a list below",
                )
                .label(format!("this is {}", Node::new(above, over.span).what()))
                .also(below.span, format!("and this is {}", below.what())),
            );
            below
        }
        (Data::Map(below), Data::Map(above)) if directive.is_none() && same(&below, &above) => {
            Node {
                data: Data::Map(merge_items(below, above, diagnostics)),
                span: over.span,
                directive: None,
                before: base.before,
            }
        }
        // `masking: dirichlet` below, `masking: {alpha: 0.1}` above.
        (Data::Text(name), Data::Map(above))
            if directive.is_none() && !above.iter().any(|item| item.key == "use") =>
        {
            let mut items = vec![Item {
                key: "use".to_owned(),
                key_span: base.span,
                value: Node::new(Data::Text(name), base.span),
            }];
            items.extend(above.into_iter().map(clean_item));
            Node {
                data: Data::Map(items),
                span: over.span,
                directive: None,
                before: base.before,
            }
        }
        (below, above) => {
            let mut node = clean(Node::new(above, over.span));
            node.before = history;
            let mut oldest = &mut node.before;
            while let Some(earlier) = oldest {
                oldest = &mut earlier.before;
            }
            *oldest = Some(Box::new(Node {
                data: below,
                span: base.span,
                directive: None,
                before: base.before,
            }));
            node
        }
    }
}

/// Whether two maps speak of the same op and entry, as far as both say.
fn same(below: &[Item], above: &[Item]) -> bool {
    ["use", "op"].iter().all(|key| {
        let find = |items: &[Item]| {
            items
                .iter()
                .find(|item| item.key == *key)
                .map(|item| item.value.data.clone())
        };
        match (find(below), find(above)) {
            (Some(below), Some(above)) => below == above,
            // A map with `use` over one without describes something else.
            (None, Some(_)) => *key == "op" || below.is_empty(),
            _ => true,
        }
    })
}

fn merge_items(below: Vec<Item>, above: Vec<Item>, diagnostics: &mut Vec<Diagnostic>) -> Vec<Item> {
    let mut items = below;
    for item in above {
        let position = items.iter().position(|other| other.key == item.key);
        match (position, item.value.directive) {
            (Some(position), Some(Directive::Unset)) => {
                items.remove(position);
            }
            (None, Some(Directive::Unset)) => diagnostics.push(
                Diagnostic::new(
                    Code::E0201,
                    item.key_span,
                    format!("`!unset` of `{}`, which no layer below has", item.key),
                )
                .help(
                    super::names::suggest(
                        &item.key,
                        &items
                            .iter()
                            .map(|item| item.key.as_str())
                            .collect::<Vec<_>>(),
                    )
                    .unwrap_or_default(),
                ),
            ),
            (Some(position), _) => {
                let slot = &mut items[position];
                let below =
                    std::mem::replace(&mut slot.value, Node::new(Data::Null, item.key_span));
                slot.value = merge(below, item.value, diagnostics);
                slot.key_span = item.key_span;
            }
            (None, _) => items.push(clean_item(item)),
        }
    }
    items
}

fn clean_item(mut item: Item) -> Item {
    item.value = clean(item.value);
    item
}

/// Forgets the tags of a value that has nothing below it: `!append` and `!replace` then change nothing.
pub fn clean(mut node: Node) -> Node {
    node.directive = None;
    node.data = match node.data {
        Data::List(nodes) => Data::List(nodes.into_iter().map(clean).collect()),
        Data::Map(items) => Data::Map(
            items
                .into_iter()
                .filter(|item| item.value.directive != Some(Directive::Unset))
                .map(clean_item)
                .collect(),
        ),
        other => other,
    };
    node
}

/// A patch with dotted keys as nested maps: `{stages.mget.masking: uniform}` becomes `{stages: {mget: {masking: uniform}}}`.
/// Earlier keys come first; a later one is a layer over them.
pub fn expand(patch: &Node, diagnostics: &mut Vec<Diagnostic>) -> Node {
    let mut root = Node::new(Data::Map(Vec::new()), patch.span);
    for item in patch.items() {
        let mut value = item.value.clone();
        let keys: Vec<&str> = item.key.split('.').collect();
        if keys.iter().any(|key| key.is_empty()) {
            diagnostics.push(Diagnostic::new(
                Code::E0201,
                item.key_span,
                format!("`{}` is no key path", item.key),
            ));
            continue;
        }
        for key in keys.iter().rev() {
            value = Node::new(
                Data::Map(vec![Item {
                    key: (*key).to_owned(),
                    key_span: item.key_span,
                    value,
                }]),
                item.key_span,
            );
        }
        root = join(root, value);
    }
    root
}

/// Puts patches side by side, tags kept.
fn join(base: Node, over: Node) -> Node {
    match (base.data, over.data) {
        (Data::Map(mut below), Data::Map(above)) if over.directive.is_none() => {
            for item in above {
                match below.iter().position(|other| other.key == item.key) {
                    Some(position) => {
                        let slot = &mut below[position];
                        let earlier = std::mem::replace(
                            &mut slot.value,
                            Node::new(Data::Null, item.key_span),
                        );
                        slot.value = join(earlier, item.value);
                    }
                    None => below.push(item),
                }
            }
            Node {
                data: Data::Map(below),
                span: base.span,
                directive: base.directive,
                before: None,
            }
        }
        (_, above) => Node {
            data: above,
            span: over.span,
            directive: over.directive,
            before: None,
        },
    }
}
