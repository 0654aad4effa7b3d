//! `reviv new`: the skeleton of a registry entry.

use super::terminal::{Failure, Terminal};
use crate::experiment::catalog::Catalog;
use crate::experiment::registry::Registry;
use crate::modality::BUILT_IN;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Write the skeleton of a new registry entry
#[derive(Debug, clap::Args)]
pub struct New {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    /// A modality: a sensor of a few channels, declared in YAML
    Modality {
        /// Its name: small letters, digits and `_`; also the name of columns, files and folders
        name: String,
        /// The folder of entries
        #[arg(long, default_value = "registry", value_name = "DIR")]
        registry: PathBuf,
    },
}

const MODALITY: &str = include_str!("new/modality.yaml");

impl super::Run for New {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        let What::Modality { name, registry } = self.what;
        let sound = name.starts_with(|c: char| c.is_ascii_lowercase())
            && name.len() <= 64
            && name
                .chars()
                .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
        if !sound {
            return Err(Failure::input(
                format!("`{name}` cannot name a modality"),
                "small letters, digits and `_`, a letter first",
            ));
        }
        let catalog = Catalog::linked();
        let shipped = Registry::new(&catalog, None);
        if BUILT_IN.contains(&name.as_str()) || shipped.text("modality", &name).is_some() {
            return Err(Failure::input(
                format!("there is a modality `{name}` already"),
                format!(
                    "give it another name; to change some keys in place, `{{use: {name}, ...}}`"
                ),
            ));
        }
        let path = registry.join("modality").join(format!("{name}.yaml"));
        write_new(&path, &MODALITY.replace("NAME", &name))?;
        terminal.data(format_args!("{}\n", path.display()));
        terminal.note(format_args!(
            "hint: say what it measures, then `reviv check {}`\n",
            path.display()
        ));
        Ok(())
    }
}

/// Writes a file that is not there yet.
fn write_new(path: &Path, text: &str) -> Result<(), Failure> {
    let failed = |error: std::io::Error| {
        if error.kind() == std::io::ErrorKind::AlreadyExists {
            return Failure::input(
                format!("`{}` is there already", path.display()),
                "nothing was written; remove it first, or give another name",
            );
        }
        Failure::machine(format_args!("`{}`: {error}", path.display()))
    };
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(failed)?;
    }
    let mut file = std::fs::File::create_new(path).map_err(failed)?;
    file.write_all(text.as_bytes()).map_err(failed)
}
