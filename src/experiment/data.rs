//! Where data sets lie: `data.yaml` beside the experiment, and `REVIV_DATA_<NAME>` over it. Nowhere else.

use super::diagnostic::Diagnostic;
use super::files::{beside, read_bytes};
use super::problem::Code;
use super::source::{Origin, Source, Sources};
use super::yaml;
use crate::formats::place;
use figment::value::{Dict, Map, Value};
use figment::{Figment, Metadata, Profile, Provider};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The folder of a data set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DataRoot {
    /// The folder, or the `s3://` address of converted clips; a relative path in `data.yaml` is taken from that file's own folder.
    pub path: PathBuf,
    /// Who says so: `data.yaml` or `REVIV_DATA_ADT`.
    pub set_by: String,
}

/// One layer of data roots, for figment.
struct Roots {
    name: String,
    values: BTreeMap<String, String>,
}

impl Provider for Roots {
    fn metadata(&self) -> Metadata {
        Metadata::named(self.name.clone())
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        let dict: Dict = self
            .values
            .iter()
            .map(|(name, path)| (name.clone(), Value::from(path.clone())))
            .collect();
        Ok(Profile::Default.collect(dict))
    }
}

/// The data sets that `data.yaml` and the environment know, the environment over the file.
pub fn roots(
    experiment: &Path,
    environment: &BTreeMap<String, String>,
    sources: &mut Sources,
    diagnostics: &mut Vec<Diagnostic>,
) -> BTreeMap<String, DataRoot> {
    let mut figment = Figment::new();
    let mut from_file = BTreeMap::new();
    if let Some(path) = beside(experiment, "data.yaml")
        && let Ok(bytes) = read_bytes(&path)
    {
        let layer = sources.add(Source {
            name: path.display().to_string(),
            path: Some(path.clone()),
            text: String::new(),
            origin: Origin::Environment,
        });
        let folder = path.parent().map(Path::to_owned).unwrap_or_default();
        from_file = file(&bytes, layer, &folder, sources, diagnostics);
        figment = figment.merge(Roots {
            name: path.display().to_string(),
            values: from_file.clone(),
        });
    }
    for (variable, path) in environment {
        if let Some(name) = variable.strip_prefix("REVIV_DATA_")
            && !name.is_empty()
        {
            // Figment folds no case: a variable is upper case, a data set usually lower.
            let name = from_file
                .keys()
                .find(|known| known.eq_ignore_ascii_case(name))
                .cloned()
                .unwrap_or_else(|| name.to_ascii_lowercase());
            figment = figment.merge(Roots {
                name: variable.clone(),
                values: BTreeMap::from([(name, path.clone())]),
            });
        }
    }
    let paths: BTreeMap<String, String> = figment.extract().unwrap_or_default();
    paths
        .into_iter()
        .map(|(name, path)| {
            let set_by = figment
                .find_metadata(&name)
                .map(|metadata| metadata.name.to_string())
                .unwrap_or_default();
            (
                name,
                DataRoot {
                    path: PathBuf::from(path),
                    set_by,
                },
            )
        })
        .collect()
}

fn file(
    bytes: &[u8],
    layer: u32,
    folder: &Path,
    sources: &mut Sources,
    diagnostics: &mut Vec<Diagnostic>,
) -> BTreeMap<String, String> {
    let mut roots = BTreeMap::new();
    let text = match yaml::decode(bytes, layer) {
        Ok(text) => text.into_owned(),
        Err(diagnostic) => {
            diagnostics.push(*diagnostic);
            return roots;
        }
    };
    sources.set_text(layer, text.clone());
    if text.lines().all(|line| {
        let line = line.trim();
        line.is_empty() || line.starts_with('#')
    }) {
        return roots;
    }
    let Some(node) = yaml::parse(&text, layer, diagnostics) else {
        return roots;
    };
    if !matches!(node.data, yaml::Data::Map(_)) {
        diagnostics.push(
            Diagnostic::new(
                Code::E0202,
                node.span,
                "data.yaml is a map of names to folders",
            )
            .help("`adt: /data/adt`"),
        );
    }
    for item in node.items() {
        match item.value.text() {
            Some(path) => {
                let at = if place::is_remote(Path::new(path)) {
                    path.to_owned()
                } else {
                    folder.join(path).display().to_string()
                };
                roots.insert(item.key.clone(), at);
            }
            None => diagnostics.push(Diagnostic::new(
                Code::E0202,
                item.value.span,
                format!("`{}` must be a folder, not {}", item.key, item.value.what()),
            )),
        }
    }
    roots
}
