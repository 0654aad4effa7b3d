//! Embeds `registry/`, `experiments/` and `models/world/`: their files become part of the binary, without a list to keep.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

fn main() {
    let root = PathBuf::from(std::env::var("CARGO_MANIFEST_DIR").expect("cargo sets it"));
    let is_yaml = |file: &Path| {
        file.extension()
            .is_some_and(|extension| extension == "yaml")
    };
    let mut texts = String::new();
    for (folder, name) in [("registry", "REGISTRY"), ("experiments", "EXPERIMENTS")] {
        texts += &table(
            &root,
            &root.join(folder),
            name,
            ("str", "include_str"),
            is_yaml,
        );
    }
    let world = root.join("models/world");
    let is_of_the_model =
        |file: &Path| !file.starts_with(world.join("record")) && !file.ends_with("README.md");
    let model = table(
        &world,
        &world,
        "WORLD",
        ("[u8]", "include_bytes"),
        is_of_the_model,
    );
    let out = PathBuf::from(std::env::var("OUT_DIR").expect("cargo sets it"));
    for (file, code) in [("embedded.rs", texts), ("model.rs", model)] {
        std::fs::write(out.join(file), code).expect("the build directory can be written");
    }
}

/// A static slice of the paths below `root`, and the contents, of the files in `folder`.
fn table(
    root: &Path,
    folder: &Path,
    name: &str,
    (contents, include): (&str, &str),
    takes: impl Fn(&Path) -> bool,
) -> String {
    let mut files = Vec::new();
    collect(folder, &mut files);
    files.retain(|file| takes(file));
    files.sort();
    let mut code = format!("pub static {name}: &[(&str, &{contents})] = &[\n");
    for file in files {
        let path = file.strip_prefix(root).expect("it is below the root");
        let path = path.to_string_lossy().replace('\\', "/");
        let full = file.to_string_lossy().into_owned();
        writeln!(code, "    ({path:?}, {include}!({full:?})),").expect("writing to a string");
    }
    code + "];\n"
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    println!("cargo::rerun-if-changed={}", folder.display());
    let Ok(listing) = std::fs::read_dir(folder) else {
        return;
    };
    for item in listing.flatten() {
        let path = item.path();
        if path.is_dir() {
            collect(&path, files);
        } else {
            files.push(path);
        }
    }
}
