//! What lies outside an experiment and is read by it: files that settings name, and data sets that `data.yaml` names.

use super::data::DataRoot;
use super::diagnostic::{Diagnostic, Span};
use super::problem::Code;
use super::stage::{DataInput, FileInput};
use crate::formats::place;
use std::collections::BTreeMap;

/// The data sets of a stage with the folders they lie in; none where nothing says so, or where no folder is. Optional ones that are
/// not there are not inputs.
pub fn data(
    asked: Vec<(String, String)>,
    optional: Vec<(String, String)>,
    roots: &BTreeMap<String, DataRoot>,
) -> Vec<DataInput> {
    let found = |(name, key): (String, String)| {
        let root = roots
            .get(&name)
            .filter(|root| place::may_be_folder(&root.path));
        DataInput {
            path: root.map(|root| root.path.clone()),
            name,
            key,
        }
    };
    let optional = optional.into_iter().map(found);
    let there = optional.filter(|data| data.path.is_some());
    asked.into_iter().map(found).chain(there).collect()
}

/// Says that a file is not there.
pub fn missing_file(file: &FileInput, span: Span) -> Option<Diagnostic> {
    if file.path.exists() {
        return None;
    }
    let message = format!("there is no file `{}`", file.path.display());
    Some(
        Diagnostic::new(Code::E0601, span, message)
            .label("not found")
            .help("relative paths start at the file they are written in, those of `--set` and of registry entries at the current folder"),
    )
}

/// Says that a data set is not here: an error for who wants to run, a note for who only checks and plans.
pub fn missing_data(
    data: &DataInput,
    root: Option<&DataRoot>,
    may_be_absent: bool,
    span: Span,
) -> Option<Diagnostic> {
    if data.path.is_some() {
        return None;
    }
    let name = &data.name;
    let code = if may_be_absent {
        Code::W0702
    } else {
        Code::E0601
    };
    let diagnostic = match root {
        Some(root) if place::is_remote(&root.path) => Diagnostic::new(
            code,
            span,
            format!(
                "data set `{name}`: `{}` is read by builds with the feature `s3`, and this is none",
                root.path.display()
            ),
        )
        .help("`cargo build --release --features s3`, or copy it to a disk"),
        Some(root) => Diagnostic::new(
            code,
            span,
            format!(
                "data set `{name}`: there is no folder `{}`",
                root.path.display()
            ),
        )
        .note(format!("{} says it lies there", root.set_by)),
        None => Diagnostic::new(
            code,
            span,
            format!("data set `{name}`: nothing says where it lies"),
        )
        .help(format!(
            "set `REVIV_DATA_{}=FOLDER`, or write `{name}: FOLDER` into data.yaml",
            name.to_ascii_uppercase()
        )),
    };
    Some(if may_be_absent {
        diagnostic
            .note("the experiment can be checked and planned here, and runs where the data is")
    } else {
        diagnostic
    })
}
