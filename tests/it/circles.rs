//! Files of a room use each other one way: whoever reads one never has to have read the other first.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// A module by its path below the crate's root: `["run", "cache"]`.
type Module = Vec<String>;

/// Every module of a crate and its text above the tests, without comments.
fn modules(root: &Path) -> BTreeMap<Module, String> {
    let mut found = BTreeMap::new();
    let mut open: Vec<PathBuf> = vec![root.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
                continue;
            }
            let name = path.strip_prefix(root).unwrap().to_string_lossy();
            let Some(name) = name.strip_suffix(".rs") else {
                continue;
            };
            let mut module: Module = name.split(['/', '\\']).map(str::to_owned).collect();
            if module.last().is_some_and(|last| last == "mod") {
                module.pop();
            }
            if module != ["lib"] && module != ["main"] {
                let text = std::fs::read_to_string(&path).unwrap();
                let code = text
                    .lines()
                    .take_while(|line| *line != "#[cfg(test)]")
                    .map(|line| line.split("//").next().unwrap_or(""));
                found.insert(module, code.collect::<Vec<_>>().join("\n"));
            }
        }
    }
    found
}

/// Every path of a `use` tree: `a::{b, c::d}` is `a::b` and `a::c::d`.
fn paths(prefix: &[String], tree: &str, found: &mut Vec<Vec<String>>) {
    let segments = |text: &str| -> Vec<String> {
        let text = text.split(" as ").next().unwrap_or("");
        let parts = text
            .split("::")
            .map(|part| part.trim().trim_start_matches("r#"));
        parts
            .filter(|part| !part.is_empty())
            .map(str::to_owned)
            .collect()
    };
    let (mut depth, mut from) = (0, 0);
    let mut parts = Vec::new();
    for (at, c) in tree.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(&tree[from..at]);
                from = at + 1;
            }
            _ => {}
        }
    }
    parts.push(&tree[from..]);
    for part in parts.into_iter().filter(|part| !part.trim().is_empty()) {
        match (part.find('{'), part.rfind('}')) {
            (Some(open), Some(close)) => {
                let inner: Vec<String> = [prefix, &segments(&part[..open])].concat();
                paths(&inner, &part[open + 1..close], found);
            }
            _ => found.push([prefix, &segments(part)].concat()),
        }
    }
}

/// The paths that a text's `use` lines and expressions name.
fn named(code: &str) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    for (at, keyword) in code.match_indices("use ") {
        // `refuse =` and words in messages are no declarations.
        let before = code[..at].rsplit('\n').next().unwrap_or("").trim();
        if !["", "pub", "pub(crate)", "pub(super)"].contains(&before) {
            continue;
        }
        if let Some((tree, _)) = code[at + keyword.len()..].split_once(';') {
            paths(&[], tree, &mut found);
        }
    }
    for start in ["crate::", "super::", "self::"] {
        for (at, _) in code.match_indices(start) {
            let path: String = code[at..]
                .chars()
                .take_while(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | ':'))
                .collect();
            paths(&[], path.trim_end_matches(':'), &mut found);
        }
    }
    found
}

/// The module of the crate that a path in `here` leads into.
fn target(modules: &BTreeMap<Module, String>, here: &Module, path: &[String]) -> Option<Module> {
    let first = path.first()?;
    let mut absolute: Vec<String> = match first.as_str() {
        "crate" => path[1..].to_vec(),
        "self" => [here.as_slice(), &path[1..]].concat(),
        "super" => {
            let ups = path.iter().take_while(|part| *part == "super").count();
            let above = here.len().checked_sub(ups)?;
            [&here[..above], &path[ups..]].concat()
        }
        _ => [here.as_slice(), path].concat(),
    };
    while !absolute.is_empty() && !modules.contains_key(&absolute) {
        absolute.pop();
    }
    (!absolute.is_empty() && absolute != *here).then_some(absolute)
}

/// The files from which `from` can be reached and which it reaches: its circle, if it is in one.
fn reached(edges: &BTreeMap<Module, BTreeSet<Module>>, from: &Module) -> BTreeSet<Module> {
    let mut seen = BTreeSet::new();
    let mut open: Vec<&Module> = edges.get(from).into_iter().flatten().collect();
    while let Some(next) = open.pop() {
        if seen.insert(next.clone()) {
            open.extend(edges.get(next).into_iter().flatten());
        }
    }
    seen
}

#[test]
fn files_of_a_room_form_no_circles() {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut circles = BTreeSet::new();
    for root in ["src", "crates/data/src", "crates/engine/src"] {
        let modules = modules(&package.join(root));
        assert!(modules.len() > 10, "the sources of {root} were not found");
        let mut edges: BTreeMap<Module, BTreeSet<Module>> = BTreeMap::new();
        for (here, code) in &modules {
            for path in named(code) {
                let Some(there) = target(&modules, here, &path) else {
                    continue;
                };
                // A file and the files below it are one thing in two layers: it names its parts, they use its types.
                let nested = there.starts_with(here) || here.starts_with(&there);
                if !nested && there[0] == here[0] {
                    edges.entry(here.clone()).or_default().insert(there);
                }
            }
        }
        for here in modules.keys() {
            let circle: Vec<String> = reached(&edges, here)
                .iter()
                .filter(|there| reached(&edges, there).contains(here))
                .map(|module| module.join("/"))
                .collect();
            if circle.len() > 1 {
                circles.insert(circle.join(", "));
            }
        }
    }
    let circles: Vec<String> = circles.into_iter().collect();
    assert!(
        circles.is_empty(),
        "files that use each other in a circle:\n{}",
        circles.join("\n")
    );
}

#[test]
fn a_circle_would_be_found() {
    let code = "use super::{cache::{Cache, Key}, lock};\nlet x = crate::run::gc::sweep();";
    let modules: BTreeMap<Module, String> = ["cache", "lock", "gc", "report"]
        .map(|file| (vec!["run".to_owned(), file.to_owned()], String::new()))
        .into();
    let here = vec!["run".to_owned(), "report".to_owned()];
    let found: BTreeSet<String> = named(code)
        .iter()
        .filter_map(|path| target(&modules, &here, path))
        .map(|module| module.join("/"))
        .collect();
    assert_eq!(
        found.into_iter().collect::<Vec<_>>(),
        ["run/cache", "run/gc", "run/lock"]
    );
}
