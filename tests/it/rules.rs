//! The rules of the house, read from the sources themselves.

use std::path::{Path, PathBuf};

/// From the door down: a room uses rooms of its own floor and of the floors below, never of a floor above.
const FLOORS: &[&[&str]] = &[
    &["cli"],
    &["ops"],
    &["experiment", "run"],
    &[
        "training",
        "decoding",
        "reconstruction",
        "evaluation",
        "view",
        "import",
        "model",
    ],
    &["tokenizer", "mget", "masking", "labelling"],
    &["datasets", "world"],
    &["modality", "clip", "video"],
    &["nn", "engine", "geometry", "formats", "random", "flow"],
];

/// Where the rooms are: those of the program, and the two floors that are crates of their own.
const SOURCES: [&str; 3] = ["src", "crates/data/src", "crates/engine/src"];

/// The framework knows no model: beside itself it may use nothing but these.
const FRAMEWORK_USES: &[&str] = &["experiment", "run", "formats", "random"];

/// A file holds one idea. Tests below it do not count.
const MOST_LINES: usize = 500;

/// Longer already, to be split. A number may only fall.
const LONGER: &[(&str, usize)] = &[];

struct File {
    /// Relative to the package, with `/`.
    name: String,
    text: String,
}

impl File {
    /// The lines above the tests, without comments, numbered from 1.
    fn code(&self) -> impl Iterator<Item = (usize, &str)> {
        let lines = self
            .text
            .lines()
            .enumerate()
            .map(|(at, line)| (at + 1, line));
        let code = lines.take_while(|(_, line)| *line != "#[cfg(test)]");
        code.map(|(at, line)| (at, line.split("//").next().unwrap_or("")))
    }

    /// `run` for `src/run/cache.rs`, `clip` for `crates/data/src/clip/mod.rs`.
    fn room(&self) -> Option<&str> {
        let inside = SOURCES
            .iter()
            .find_map(|folder| self.name.strip_prefix(folder)?.strip_prefix('/'))?;
        let room = inside.split('/').next()?;
        Some(room.strip_suffix(".rs").unwrap_or(room))
    }
}

fn files(folder: &str) -> Vec<File> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut found = Vec::new();
    let mut open = vec![root.join(folder)];
    while let Some(path) = open.pop() {
        let Ok(listing) = std::fs::read_dir(&path) else {
            continue;
        };
        let mut entries: Vec<PathBuf> = listing.map(|entry| entry.unwrap().path()).collect();
        entries.sort();
        for path in entries {
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let name = path
                    .strip_prefix(root)
                    .unwrap()
                    .to_string_lossy()
                    .replace('\\', "/");
                let text = std::fs::read_to_string(&path).unwrap();
                found.push(File { name, text });
            }
        }
    }
    found
}

/// Every source file of the rooms.
fn sources() -> Vec<File> {
    SOURCES.iter().flat_map(|folder| files(folder)).collect()
}

/// Every line of the rooms outside tests that breaks a rule.
fn broken(breaks: impl Fn(&File, &str) -> Option<String>) -> Vec<String> {
    let mut lines = Vec::new();
    let sources = sources();
    assert!(sources.len() > 20, "the sources were not found");
    for file in &sources {
        for (at, line) in file.code() {
            if let Some(why) = breaks(file, line) {
                lines.push(format!("{}:{at}: {why}: {}", file.name, line.trim()));
            }
        }
    }
    lines
}

fn floor(room: &str) -> Option<usize> {
    FLOORS.iter().position(|rooms| rooms.contains(&room))
}

#[test]
fn arrows_between_rooms_point_down_only() {
    let found = broken(|file, line| {
        let room = file.room()?;
        let here = floor(room)?;
        for part in line.split("crate::").skip(1) {
            let used: String = part
                .chars()
                .take_while(|c| c.is_ascii_alphanumeric() || *c == '_')
                .collect();
            let Some(there) = floor(&used) else {
                continue;
            };
            if there < here {
                return Some(format!("`{room}` uses `{used}` from a floor above"));
            }
            if ["experiment", "run"].contains(&room) && !FRAMEWORK_USES.contains(&used.as_str()) {
                return Some(format!(
                    "the framework's `{room}` knows the science's `{used}`"
                ));
            }
        }
        None
    });
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn every_room_has_its_floor() {
    for file in sources() {
        let room = file.room().unwrap().to_owned();
        assert!(
            ["lib", "main"].contains(&room.as_str()) || floor(&room).is_some(),
            "{}: no floor for `{room}`",
            file.name
        );
    }
}

#[test]
fn a_file_holds_one_idea() {
    let mut long = Vec::new();
    for file in ["src", "crates", "tests", "examples", "benches"]
        .iter()
        .flat_map(|folder| files(folder))
    {
        let lines = file
            .text
            .lines()
            .take_while(|line| *line != "#[cfg(test)]")
            .count();
        // Tables of tests are long by nature; a file of tests may be as long as it has cases.
        let known = LONGER.iter().find(|(name, _)| *name == file.name);
        if lines > known.map_or(MOST_LINES, |(_, most)| *most) && !file.name.starts_with("tests/") {
            long.push(format!(
                "{}: {lines} lines, at most {MOST_LINES}",
                file.name
            ));
        }
    }
    assert!(long.is_empty(), "{}", long.join("\n"));
}

#[test]
fn every_module_says_what_it_is() {
    let silent: Vec<String> = sources()
        .into_iter()
        .filter(|file| file.name != "src/main.rs" && !file.text.starts_with("//!"))
        .map(|file| file.name)
        .collect();
    assert!(silent.is_empty(), "no module documentation: {silent:?}");
}

#[test]
fn nothing_unwraps_outside_tests() {
    let found = broken(|_, line| line.contains(".unwrap()").then(|| "unwraps".to_owned()));
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn only_the_command_line_prints() {
    let prints = [
        "println!",
        "print!(",
        "eprintln!",
        "eprint!(",
        "dbg!(",
        "stdout()",
    ];
    let found = broken(|file, line| {
        let outside = file.room() != Some("cli");
        (outside && prints.iter().any(|print| line.contains(print))).then(|| "prints".to_owned())
    });
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn only_the_environment_looks_at_the_clock() {
    let found = broken(|file, line| {
        let looks = line.contains("Instant::now") || line.contains("SystemTime::now");
        (looks && file.name != "src/run/environment.rs").then(|| "looks at the clock".to_owned())
    });
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn no_generator_keeps_a_state_of_its_own() {
    let stateful = [
        "thread_rng",
        "rand::rng()",
        "StdRng",
        "SmallRng",
        "from_os_rng",
        "from_entropy",
    ];
    let found = broken(|_, line| {
        let has = stateful.iter().any(|name| line.contains(name));
        has.then(|| "randomness not from `random::stream`".to_owned())
    });
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn hash_maps_are_not_used_for_their_order() {
    // Their order changes from run to run; nothing here needs them where a BTreeMap does not do.
    let found = broken(|_, line| {
        let has = line.contains("HashMap<") || line.contains("HashSet<");
        has.then(|| "a map without an order".to_owned())
    });
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn only_the_engine_is_unsafe() {
    let found = broken(|file, line| {
        let outside = file.room() != Some("engine");
        let has = ["unsafe {", "unsafe fn", "unsafe impl", "allow(unsafe_code)"]
            .iter()
            .any(|u| line.contains(u));
        (outside && has).then(|| "unsafe".to_owned())
    });
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn every_shipped_experiment_checks_and_plans() {
    use reviv::experiment::catalog::Catalog;
    use reviv::experiment::load::{Request, load};
    let catalog = Catalog::linked();
    for (path, _) in catalog.experiments() {
        let request = Request {
            path: Path::new(env!("CARGO_MANIFEST_DIR")).join(path),
            data_may_be_absent: true,
            ..Request::default()
        };
        let (experiment, report) = load(&catalog, &request);
        let experiment = experiment.unwrap_or_else(|| panic!("{path}\n{}", report.render(false)));
        for cell in &experiment.cells {
            for stage in &cell.graph.stages {
                let plan = cell.graph.plan(stage);
                assert!(
                    plan.flop.is_none_or(f64::is_finite),
                    "{path}: {}",
                    stage.name
                );
            }
        }
    }
}

/// Files and folders of the package that a page names between backticks; `file::name` names a test in it.
fn named(page: &str) -> impl Iterator<Item = (&str, Option<&str>)> {
    const FOLDERS: [&str; 8] = [
        "src/",
        "crates/",
        "registry/",
        "experiments/",
        "tests/",
        "examples/",
        "benches/",
        "docs/",
    ];
    page.split('`')
        .skip(1)
        .step_by(2)
        .filter(|code| FOLDERS.iter().any(|folder| code.starts_with(folder)))
        .map(|code| match code.split_once("::") {
            Some((path, test)) => (path, Some(test)),
            None => (code, None),
        })
}

/// `Sec. 4.2`, `Supp. A`, `Alg. 1`, `Eq. 3`, `Table 1`: the parts of the paper that a text quotes.
fn quoted(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for mark in ["Sec. ", "Supp. ", "Alg. ", "Eq. ", "Table "] {
        for rest in text.split(mark).skip(1) {
            let number = |c: char| c.is_ascii_alphanumeric() || c == '.';
            let part = rest.split(|c| !number(c)).next().unwrap_or_default();
            let part = part.trim_end_matches('.');
            let whole = part.starts_with(|c: char| c.is_ascii_digit()) || part.len() == 1;
            if whole && !part.is_empty() {
                found.push(format!("{mark}{part}"));
            }
        }
    }
    found
}

#[test]
fn pages_name_files_and_tests_that_exist() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut missing = Vec::new();
    for name in [
        "docs/paper.md",
        "docs/compare.md",
        "README.md",
        "ARCHITECTURE.md",
        "DESIGN.md",
    ] {
        let page = std::fs::read_to_string(root.join(name)).unwrap();
        for (path, test) in named(&page) {
            let there = match test {
                None => root.join(path).exists(),
                Some(test) => std::fs::read_to_string(root.join(path))
                    .is_ok_and(|text| text.contains(&format!("fn {test}("))),
            };
            if !there {
                missing.push(format!("{name}: {path} {}", test.unwrap_or_default()));
            }
        }
    }
    assert!(missing.is_empty(), "{}", missing.join("\n"));
}

#[test]
fn the_map_of_the_paper_has_every_room_of_science_and_every_quoted_section() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let page = std::fs::read_to_string(root.join("docs/paper.md")).unwrap();
    let mut missing: Vec<String> = Vec::new();
    for room in FLOORS[3..].iter().copied().flatten() {
        let here = |path: &str| {
            SOURCES.iter().any(|folder| {
                path.starts_with(&format!("{folder}/{room}/"))
                    || path == format!("{folder}/{room}.rs")
            })
        };
        if !named(&page).any(|(path, _)| here(path)) {
            missing.push(format!("the room `{room}`"));
        }
    }
    for file in sources() {
        for part in quoted(&file.text) {
            if !page.contains(&part) {
                missing.push(format!("{part}, quoted in {}", file.name));
            }
        }
    }
    assert!(missing.is_empty(), "{}", missing.join("\n"));
}

/// What the paper has: sections, equations, its algorithm, the tables whose numbers are known, and the supplement.
const PAPER: [&str; 19] = [
    "Sec. 3", "Sec. 3.1", "Sec. 3.2", "Sec. 4.1", "Sec. 4.2", "Sec. 4.3", "Sec. 5", "Eq. 1",
    "Eq. 2", "Eq. 3", "Alg. 1", "Table 1", "Table 2", "Supp. A", "Supp. B", "Supp. C", "Supp. D",
    "Supp. E", "Supp. F",
];

#[test]
fn the_map_of_the_paper_has_a_row_or_a_heading_for_each_of_its_items() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let page = std::fs::read_to_string(root.join("docs/paper.md")).unwrap();
    // A heading, the line above a table, or the first cell of a row.
    let mut places: Vec<String> = Vec::new();
    for line in page.lines() {
        let place = match line.strip_prefix("| ") {
            Some(row) => row.split(" |").next().unwrap_or_default(),
            None if line.starts_with('#') || line.ends_with(':') => line,
            None => continue,
        };
        places.extend(quoted(place));
    }
    let missing = |items: &[String], from: &[String]| -> Vec<String> {
        let absent = items.iter().filter(|item| !from.contains(item));
        absent.cloned().collect()
    };
    let paper: Vec<String> = PAPER.map(str::to_owned).to_vec();
    assert_eq!(missing(&paper, &places), [""; 0], "no row");
    assert_eq!(missing(&places, &paper), [""; 0], "not of the paper");
}
