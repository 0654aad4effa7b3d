//! Ops that stand for several stages: one of another op for every entry of a map.
//!
//! A group is opened when an experiment is read, after layers are merged and parameters are put in. From then on each of its
//! stages is one like any other: an artifact with the key that it has when it is written by hand, a line of a plan, a record.

use super::catalog::Catalog;
use super::diagnostic::Diagnostic;
use super::graph::Group;
use super::merge;
use super::problem::Code;
use super::stage::GroupEntry;
use super::yaml::{Data, Item, Node};

/// Values that opening the groups of one experiment may make, as [`Node::weight`] counts them.
const MAX_WEIGHT: usize = 20_000;

/// A stage as nodes.
pub(super) struct Written {
    pub item: Item,
    /// Where its settings are written: `stages.mget`, `stages.tokenizers.modalities.rgb`.
    pub path: String,
}

/// The stages of an experiment with the groups opened, in the order of the file.
#[derive(Default)]
pub(super) struct Opened {
    pub stages: Vec<Written>,
    pub groups: Vec<Group>,
}

/// Opens the groups among `items`; a group with mistakes has no stages.
pub(super) fn open(catalog: &Catalog, items: &[Item], diagnostics: &mut Vec<Diagnostic>) -> Opened {
    let mut opened = Opened::default();
    let mut room = MAX_WEIGHT;
    for item in items {
        let op = item.value.get("op").and_then(Node::text);
        let Some(entry) = op.and_then(|name| catalog.group(name)) else {
            opened.stages.push(Written {
                item: item.clone(),
                path: format!("stages.{}", item.key),
            });
            continue;
        };
        let members = members(entry, item, &mut room, diagnostics).unwrap_or_default();
        opened.groups.push(Group {
            name: item.key.clone(),
            key: entry.members,
            members: members.iter().map(|own| own.item.key.clone()).collect(),
        });
        opened.stages.extend(members);
    }
    for (at, own) in opened.stages.iter().enumerate() {
        let name = &own.item.key;
        if opened.stages[..at].iter().any(|it| it.item.key == *name) {
            let message = format!("two stages named `{name}`");
            diagnostics.push(Diagnostic::new(Code::E0205, own.item.key_span, message));
        }
    }
    opened
}

/// The stages of one group; `None` after a report.
fn members(
    entry: &GroupEntry,
    group: &Item,
    room: &mut usize,
    diagnostics: &mut Vec<Diagnostic>,
) -> Option<Vec<Written>> {
    let (map, op) = (entry.members, entry.op.name());
    let Some(all) = group.value.get(map) else {
        let message = format!(
            "stage `{}` needs `{map}`: a stage of `{op}` for each entry",
            group.key
        );
        diagnostics.push(
            Diagnostic::new(Code::E0204, group.key_span, message)
                .help(format!("add `{map}: {{NAME: {{...}}, ...}}`")),
        );
        return None;
    };
    if all.items().is_empty() {
        diagnostics.push(
            Diagnostic::new(
                Code::E0202,
                all.span,
                format!("`{map}` must be a map of at least one entry"),
            )
            .label(format!("this is {}", all.what())),
        );
        return None;
    }
    let shared = shared(entry, group, all, diagnostics);
    let weight = shared.weight() * all.items().len() + all.weight();
    let Some(left) = room.checked_sub(weight) else {
        diagnostics.push(
            Diagnostic::new(
                Code::E0501,
                all.span,
                format!("the groups make more than {MAX_WEIGHT} values"),
            )
            .help("move long lists into a file that an op reads"),
        );
        return None;
    };
    *room = left;
    let mut stages = Vec::new();
    for member in all.items() {
        let own = settings(entry, member, diagnostics)?;
        let merged = merge::merge(shared.clone(), own, diagnostics);
        let span = merged.span;
        let mut items: Vec<Item> = group.value.item("op").cloned().into_iter().collect();
        for item in &mut items {
            item.value.data = Data::Text(op.to_owned());
        }
        items.push(Item {
            key: entry.setting.to_owned(),
            key_span: member.key_span,
            value: Node::new(Data::Text(member.key.clone()), member.key_span),
        });
        if let Data::Map(settings) = merged.data {
            items.extend(settings);
        }
        stages.push(Written {
            item: Item {
                key: format!("{}.{}", group.key, member.key),
                key_span: member.key_span,
                value: Node::new(Data::Map(items), span),
            },
            path: format!("stages.{}.{map}.{}", group.key, member.key),
        });
    }
    Some(stages)
}

/// What holds for all stages of a group.
fn shared(entry: &GroupEntry, group: &Item, all: &Node, diagnostics: &mut Vec<Diagnostic>) -> Node {
    let map = entry.members;
    let mut items = Vec::new();
    for item in group.value.items() {
        if item.key == "op" || item.key == map {
            continue;
        }
        // `--set stages.tokenizers.rgb.steps=10` looks like this.
        if all.item(&item.key).is_some() {
            let message = format!("`{}` is an entry of `{map}`", item.key);
            diagnostics.push(
                Diagnostic::new(Code::E0201, item.key_span, message).help(format!(
                    "its settings are below `stages.{}.{map}.{}`",
                    group.key, item.key
                )),
            );
        } else if item.key == entry.setting {
            diagnostics.push(is_the_key(entry, item));
        } else {
            items.push(item.clone());
        }
    }
    Node::new(Data::Map(items), group.value.span)
}

/// What one entry says; `None` after a report.
fn settings(entry: &GroupEntry, member: &Item, diagnostics: &mut Vec<Diagnostic>) -> Option<Node> {
    let mut own = member.value.clone();
    match &mut own.data {
        Data::Null => own.data = Data::Map(Vec::new()),
        Data::Map(items) => items.retain(|item| {
            let taken = item.key == entry.setting || item.key == "op";
            if item.key == entry.setting {
                diagnostics.push(is_the_key(entry, item));
            } else if taken {
                let message = format!("every entry of `{}` is one op's", entry.members);
                diagnostics.push(
                    Diagnostic::new(Code::E0201, item.key_span, message)
                        .help("another op is a stage of its own"),
                );
            }
            !taken
        }),
        _ => {
            let message = format!("`{}` must be a map of settings", member.key);
            diagnostics.push(
                Diagnostic::new(Code::E0202, own.span, message)
                    .label(format!("this is {}", own.what()))
                    .help("`{}` takes what all of them have in common"),
            );
            return None;
        }
    }
    Some(own)
}

fn is_the_key(entry: &GroupEntry, item: &Item) -> Diagnostic {
    let (setting, map) = (entry.setting, entry.members);
    let message = format!("`{setting}` is the key of each entry of `{map}`");
    Diagnostic::new(Code::E0201, item.key_span, message)
        .help(format!("`{map}: {{{}: {{...}}}}`", item.value.inline()))
}
