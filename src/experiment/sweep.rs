//! A sweep opened into its cells: arms times grid points times seeds, each a patched base.

use super::compose::Composer;
use super::diagnostic::{Diagnostic, Span};
use super::merge;
use super::names;
use super::problem::Code;
use super::source::Origin;
use super::yaml::{Data, Item, Node, scalar};

/// More runs than anybody waits for.
const MAX_CELLS: usize = 4096;
/// Values of all cells together (see [`Node::weight`]): some hundred megabytes.
const MAX_WEIGHT: usize = 2_000_000;
/// The keys of a sweep.
pub const KEYS: [&str; 9] = [
    "sweep", "base", "about", "seeds", "arms", "grid", "compare", "stages", "params",
];

/// The cells of a document before they are resolved.
pub struct Plan {
    pub name: String,
    pub name_span: Span,
    pub about: String,
    pub cells: Vec<Draft>,
    pub compare: Option<Node>,
    /// What the cells are called, seeds apart: the rows of a comparison.
    pub rows: Vec<String>,
}

/// One cell: a whole experiment as nodes.
pub struct Draft {
    pub arm: String,
    pub seed: u64,
    pub root: Node,
}

/// A plain experiment: one cell.
pub fn single(composer: &mut Composer<'_>, root: Node, patches: Vec<Node>) -> Plan {
    let mut root = root;
    for patch in patches {
        let patch = merge::expand(&patch, composer.diagnostics);
        root = merge::merge(root, patch, composer.diagnostics);
    }
    let seed = seed_of(root.get("seed"), composer.diagnostics).unwrap_or(0);
    let name = root.get("experiment");
    if name.is_none() {
        let mut diagnostic = Diagnostic::new(
            Code::E0204,
            Span::point(root.span.layer, root.span.start as usize),
            "this is neither an experiment nor a sweep",
        )
        .help("start with `experiment: NAME`, or with `sweep: NAME` and `base: FILE`");
        if let Some(item) = root.items().first() {
            if composer.catalog.kind(&item.key).is_some() {
                diagnostic = diagnostic.help(format!(
                    "it looks like a registry entry: an experiment names it as `{}: {}`",
                    item.key,
                    item.value.inline()
                ));
            } else if let Some(near) =
                names::nearest(&item.key, ["experiment", "sweep"].into_iter())
            {
                diagnostic = diagnostic.help(format!("did you mean `{near}`?"));
            }
        }
        composer.diagnostics.push(diagnostic);
    }
    Plan {
        name: name.and_then(scalar).unwrap_or_default(),
        name_span: name.map_or(root.span, |node| node.span),
        about: about_of(&root),
        cells: vec![Draft {
            arm: String::new(),
            seed,
            root,
        }],
        compare: None,
        rows: Vec::new(),
    }
}

/// A sweep: reads its base, applies `--set`, and makes a cell of every arm, grid point and seed.
pub fn open(composer: &mut Composer<'_>, root: Node, patches: Vec<Node>) -> Option<Plan> {
    let mut root = root;
    let mut last = Vec::new();
    for patch in patches {
        let key = patch.items().first().map(|item| item.key.clone());
        let first = key.as_deref().unwrap_or("").split('.').next().unwrap_or("");
        if first == "seed" {
            root = merge::merge(root, seeds_patch(&patch), composer.diagnostics);
        } else if KEYS.contains(&first) && first != "stages" && first != "params" {
            let patch = merge::expand(&patch, composer.diagnostics);
            root = merge::merge(root, patch, composer.diagnostics);
        } else {
            last.push(patch);
        }
    }
    keys(&root, &KEYS, composer.diagnostics);
    let name = root.get("sweep")?;
    check_name(name, "a sweep", composer.diagnostics);
    let base = match root.get("base") {
        None => {
            composer.diagnostics.push(
                Diagnostic::new(Code::E0204, name.span, "a sweep needs a `base`")
                    .help("`base: FILE` names the experiment that the arms change"),
            );
            return None;
        }
        Some(node) => {
            let Some(file) = node.text() else {
                composer.diagnostics.push(Diagnostic::new(
                    Code::E0202,
                    node.span,
                    format!("`base` names a file, not {}", node.what()),
                ));
                return None;
            };
            let sweep = composer.name_of(node.span);
            composer.named(file, node.span, Origin::Extended(sweep))?
        }
    };
    if let Some(inner) = base.item("sweep") {
        composer.diagnostics.push(
            Diagnostic::new(
                Code::E0206,
                root.get("base").map_or(root.span, |node| node.span),
                "the base of a sweep must be an experiment, not a sweep",
            )
            .also(inner.key_span, "a sweep")
            .help("`extends:` continues another sweep"),
        );
        return None;
    }
    // `stages:` and `params:` of the sweep are a layer over its base.
    let own: Vec<Item> = root
        .items()
        .iter()
        .filter(|item| item.key == "stages" || item.key == "params")
        .cloned()
        .collect();
    let base = if own.is_empty() {
        base
    } else {
        let own = Node::new(Data::Map(own), root.span);
        merge::merge(base, own, composer.diagnostics)
    };
    let arms = arms_of(&root, composer.diagnostics);
    let points = grid_of(&root, composer.diagnostics)?;
    let seeds = seeds_of(&root, &base, composer.diagnostics);
    if arms.len() * points.len() * seeds.len() > MAX_CELLS {
        composer.diagnostics.push(
            Diagnostic::new(
                Code::E0501,
                name.span,
                format!(
                    "{} arms, {} grid points and {} seeds make more than {MAX_CELLS} runs",
                    arms.len(),
                    points.len(),
                    seeds.len()
                ),
            )
            .help("make the grid smaller"),
        );
        return None;
    }
    let heaviest = |patches: &[(String, Option<Node>)]| {
        let weights = patches.iter().flat_map(|(_, patch)| patch);
        weights.map(Node::weight).max().unwrap_or(0)
    };
    let weight = base.weight()
        + heaviest(&arms)
        + heaviest(&points)
        + last.iter().map(Node::weight).sum::<usize>();
    let cells = arms.len() * points.len() * seeds.len();
    if cells.saturating_mul(weight) > MAX_WEIGHT {
        composer.diagnostics.push(too_heavy(name, cells, weight));
        return None;
    }
    let mut cells = Vec::new();
    let mut rows = Vec::new();
    for (arm, patch) in &arms {
        for (point, grid) in &points {
            let mut cell = base.clone();
            for layer in [patch.as_ref(), grid.as_ref()].into_iter().flatten() {
                let layer = merge::expand(layer, composer.diagnostics);
                cell = merge::merge(cell, layer, composer.diagnostics);
            }
            for patch in &last {
                let patch = merge::expand(patch, composer.diagnostics);
                cell = merge::merge(cell, patch, composer.diagnostics);
            }
            let arm = row(arm, point);
            rows.push(arm.clone());
            for &seed in &seeds {
                cells.push(Draft {
                    arm: arm.clone(),
                    seed,
                    root: cell.clone(),
                });
            }
        }
    }
    Some(Plan {
        name: scalar(name).unwrap_or_default(),
        name_span: name.span,
        about: about_of(&root),
        compare: root.get("compare").cloned(),
        rows,
        cells,
    })
}

/// What the cells of an arm and a grid point are called.
fn row(arm: &str, point: &str) -> String {
    match (arm.is_empty(), point.is_empty()) {
        (_, true) => arm.to_owned(),
        (true, false) => point.to_owned(),
        (false, false) => format!("{arm}-{point}"),
    }
}

fn too_heavy(place: &Node, cells: usize, weight: usize) -> Diagnostic {
    Diagnostic::new(
        Code::E0501,
        place.span,
        format!("{cells} runs of {weight} values each are more than {MAX_WEIGHT} values"),
    )
    .help("make the grid smaller, or move long lists into a file that an op reads")
}

/// Reports keys that a document does not have.
pub fn keys(root: &Node, known: &[&str], diagnostics: &mut Vec<Diagnostic>) {
    for item in root.items() {
        if !known.contains(&item.key.as_str()) {
            let mut diagnostic = Diagnostic::new(
                Code::E0201,
                item.key_span,
                format!("unknown key `{}`", item.key),
            )
            .label("nothing reads this");
            if item.key == "seed" && known.contains(&"seeds") {
                diagnostic = diagnostic.help("a sweep has `seeds: [0, 1, 2]`");
            } else {
                diagnostic = diagnostic.help(names::suggest(&item.key, known).unwrap_or_default());
            }
            diagnostics.push(diagnostic);
        }
    }
}

/// Names become parts of file names.
pub fn is_name(name: &str) -> bool {
    !name.is_empty()
        && name.len() <= 100
        && name
            .chars()
            .all(|c| c.is_alphanumeric() || matches!(c, '_' | '-' | '.' | '@' | '='))
        && !name.starts_with('.')
}

/// Reports a name of an experiment or a sweep (`what`) that cannot be part of file names.
pub fn check_name(name: &Node, what: &str, diagnostics: &mut Vec<Diagnostic>) {
    if !scalar(name).is_some_and(|name| is_name(&name)) {
        diagnostics.push(
            Diagnostic::new(
                Code::E0202,
                name.span,
                format!("`{}` cannot name {what}", name.inline()),
            )
            .help("use letters, digits, `_` and `-`: it becomes part of folder names"),
        );
    }
}

fn about_of(root: &Node) -> String {
    root.get("about")
        .and_then(Node::text)
        .map(|text| text.trim().to_owned())
        .unwrap_or_default()
}

/// `--seed 3` of a sweep means `seeds: [3]`.
fn seeds_patch(patch: &Node) -> Node {
    let items = patch
        .items()
        .iter()
        .map(|item| Item {
            key: "seeds".to_owned(),
            key_span: item.key_span,
            value: Node::new(Data::List(vec![item.value.clone()]), item.value.span),
        })
        .collect();
    Node::new(Data::Map(items), patch.span)
}

/// A seed: a whole number from zero.
pub fn seed_of(node: Option<&Node>, diagnostics: &mut Vec<Diagnostic>) -> Option<u64> {
    let node = node?;
    if let Data::Int(value) = node.data
        && let Ok(seed) = u64::try_from(value)
    {
        return Some(seed);
    }
    diagnostics.push(
        Diagnostic::new(Code::E0202, node.span, "a seed is a whole number from 0")
            .label(format!("this is `{}`", node.inline())),
    );
    None
}

fn seeds_of(root: &Node, base: &Node, diagnostics: &mut Vec<Diagnostic>) -> Vec<u64> {
    let Some(node) = root.get("seeds") else {
        return vec![seed_of(base.get("seed"), diagnostics).unwrap_or(0)];
    };
    let mut seeds = Vec::new();
    if node.list().is_empty() {
        diagnostics.push(
            Diagnostic::new(
                Code::E0202,
                node.span,
                "`seeds` must be a list of at least one",
            )
            .help("`seeds: [0, 1, 2]`"),
        );
    }
    for node in node.list() {
        if let Some(seed) = seed_of(Some(node), diagnostics) {
            if seeds.contains(&seed) {
                diagnostics.push(Diagnostic::new(
                    Code::E0206,
                    node.span,
                    format!("seed {seed} twice"),
                ));
            } else {
                seeds.push(seed);
            }
        }
    }
    seeds
}

fn arms_of(root: &Node, diagnostics: &mut Vec<Diagnostic>) -> Vec<(String, Option<Node>)> {
    let Some(node) = root.get("arms") else {
        return vec![(String::new(), None)];
    };
    if node.items().is_empty() {
        diagnostics.push(
            Diagnostic::new(Code::E0202, node.span, "`arms` must be a map of patches")
                .label(format!("this is {}", node.what()))
                .help("`arms: {full: {}, small: {stages.mget.size: laptop}}`"),
        );
    }
    let mut arms = Vec::new();
    for item in node.items() {
        if !is_name(&item.key) {
            diagnostics.push(
                Diagnostic::new(
                    Code::E0202,
                    item.key_span,
                    format!("`{}` cannot name an arm", item.key),
                )
                .help("use letters, digits, `_` and `-`: it becomes part of file names"),
            );
        }
        match item.value.data {
            Data::Map(_) => arms.push((item.key.clone(), Some(item.value.clone()))),
            Data::Null => arms.push((item.key.clone(), None)),
            _ => diagnostics.push(
                Diagnostic::new(
                    Code::E0202,
                    item.value.span,
                    format!("arm `{}` must be a map of changes", item.key),
                )
                .label(format!("this is {}", item.value.what()))
                .help("`{stages.mget.masking: uniform}`; `{}` changes nothing"),
            ),
        }
    }
    arms
}

/// Every point of the grid as a name and a patch; one empty point where there is no grid, `None` where it is too much.
fn grid_of(root: &Node, diagnostics: &mut Vec<Diagnostic>) -> Option<Vec<(String, Option<Node>)>> {
    let mut points: Vec<(String, Option<Node>)> = vec![(String::new(), None)];
    let Some(grid) = root.get("grid") else {
        return Some(points);
    };
    if !matches!(grid.data, Data::Map(_)) {
        diagnostics.push(
            Diagnostic::new(
                Code::E0202,
                grid.span,
                "`grid` must be a map of key paths to lists",
            )
            .help("`grid: {stages.mget.steps: [100, 200]}`"),
        );
        return Some(points);
    }
    for (number, item) in grid.items().iter().enumerate() {
        if item.value.list().is_empty() {
            diagnostics.push(
                Diagnostic::new(
                    Code::E0202,
                    item.value.span,
                    format!("`{}` must be a list of at least one", item.key),
                )
                .label(format!("this is {}", item.value.what())),
            );
            continue;
        }
        let short = item.key.rsplit('.').next().unwrap_or(&item.key);
        let short = if is_name(short) {
            short.to_owned()
        } else {
            format!("key{}", number + 1)
        };
        let mut next = Vec::new();
        let many = (points.len() * item.value.list().len()).min(MAX_CELLS + 1);
        let patches = points.iter().flat_map(|(_, patch)| patch);
        let values = item.value.list().iter();
        let weight = patches.map(Node::weight).max().unwrap_or(1)
            + values.map(Node::weight).max().unwrap_or(0);
        if many.saturating_mul(weight) > MAX_WEIGHT {
            diagnostics.push(too_heavy(&item.value, many, weight));
            return None;
        }
        for (name, patch) in &points {
            for (index, value) in item.value.list().iter().enumerate() {
                if next.len() > MAX_CELLS {
                    break;
                }
                let shown = value
                    .get("use")
                    .unwrap_or(value)
                    .inline()
                    .replace(['/', ' '], "_");
                let shown = if is_name(&shown) && shown.len() <= 24 {
                    shown
                } else {
                    index.to_string()
                };
                let name = if name.is_empty() {
                    format!("{short}={shown}")
                } else {
                    format!("{name}-{short}={shown}")
                };
                // Two changes of one entry differ in their settings only.
                let name = if next.iter().any(|(other, _)| *other == name) {
                    format!("{name}.{index}")
                } else {
                    name
                };
                let mut items = patch
                    .as_ref()
                    .map(|patch| patch.items().to_vec())
                    .unwrap_or_default();
                items.push(Item {
                    key: item.key.clone(),
                    key_span: item.key_span,
                    value: value.clone(),
                });
                next.push((name, Some(Node::new(Data::Map(items), grid.span))));
            }
        }
        points = next;
    }
    Some(points)
}
