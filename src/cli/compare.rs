//! `reviv compare`: runs, arms and seeds in one table, paired on common clips; or two trajectory files, as `evo` does it.

use super::terminal::{Failure, Terminal};
use crate::evaluation::compare::{CompareSettings, Method, compare};
use crate::evaluation::intervals;
use crate::evaluation::published::Published;
use crate::evaluation::render::{Format, render};
use crate::evaluation::scores::{FILE, Scores};
use crate::evaluation::trajectory::TrajectoryErrors;
use crate::evaluation::tum::{self, TimedPoses};
use crate::experiment::catalog::Catalog;
use crate::experiment::load;
use crate::geometry::alignment::Freedom;
use crate::run::Cache;
use crate::run::RunDirectory;
use crate::run::cache::Key;
use crate::run::schedule::Schedule;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Put the scores of runs side by side, with intervals and paired differences
///
/// Arms of a sweep are rows, their seeds are repetitions. A scores file (or a folder with one) is a row, too. With
/// `--trajectory`, compares two TUM trajectory files instead and prints the numbers that `evo_ape` and `evo_rpe` print.
#[derive(Debug, clap::Args)]
pub struct Compare {
    /// Run names, run directories, or scores files
    #[arg(value_name = "RUN", required_unless_present = "trajectory")]
    runs: Vec<PathBuf>,
    /// The row that all others are tested against
    #[arg(long, value_name = "ROW")]
    baseline: Option<String>,
    /// Columns, in this order; `depth.abs_rel` stands for all its spaces
    #[arg(long, value_delimiter = ',', value_name = "COLUMN")]
    columns: Vec<String>,
    /// Confidence level of the intervals
    #[arg(long, default_value_t = 0.95, value_name = "SHARE", value_parser = level)]
    level: f64,
    /// Published rows below the table, as context; `reviv list published` shows the names
    #[arg(long, value_name = "NAME")]
    against: Option<String>,
    /// Also draw every row with its interval, into this file
    #[arg(long, value_name = "FILE.svg")]
    plot: Option<PathBuf>,
    /// How to write the table
    #[arg(long, default_value = "term", value_parser = ["term", "md", "latex", "csv"])]
    format: String,
    /// Two trajectory files, `timestamp tx ty tz qx qy qz qw` per line
    #[arg(long, num_args = 2, value_names = ["REFERENCE", "ESTIMATE"], conflicts_with = "runs")]
    trajectory: Option<Vec<PathBuf>>,
    /// Seconds within which two poses of trajectories count as simultaneous
    #[arg(long, default_value_t = tum::MAX_DIFFERENCE, value_name = "SECONDS", requires = "trajectory")]
    max_difference: f64,
    /// Where runs are
    #[arg(long = "runs-in", default_value = "runs", value_name = "DIR")]
    place: PathBuf,
    /// Write JSON to stdout
    #[arg(long)]
    json: bool,
}

impl super::Run for Compare {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        if let Some([reference, estimate]) = self.trajectory.as_deref() {
            return self.trajectories(terminal, reference, estimate);
        }
        let mut settings = CompareSettings {
            baseline: self.baseline,
            columns: self.columns,
            ..CompareSettings::default()
        };
        settings.interval.level = self.level;
        let mut entrants: Vec<Method> = Vec::new();
        for name in &self.runs {
            let mut found = entrants_of(name, &self.place, &settings.columns)?;
            for entrant in &mut found {
                if entrants.iter().any(|e| e.label == entrant.label) {
                    entrant.label = format!("{}/{}", name.display(), entrant.label);
                }
            }
            entrants.extend(found);
        }
        let against = self.against.as_deref().map(|name| {
            published(&Catalog::linked(), Path::new("./x"), name).ok_or_else(|| {
                Failure::input(
                    format!("no published rows `{name}`"),
                    "`reviv list published` shows all",
                )
            })
        });
        let published = against.transpose()?;
        let table = compare("", &entrants, &settings, published.as_ref()).map_err(|error| {
            Failure::input(error.to_string(), "`reviv list runs` shows all runs")
        })?;
        if let Some(path) = &self.plot {
            let plot = intervals::svg(&table)
                .ok_or_else(|| Failure::input("no number to draw", "see the table"))?;
            std::fs::write(path, plot)
                .map_err(|error| Failure::machine(format_args!("`{}`: {error}", path.display())))?;
        }
        if self.json {
            terminal.json(&table);
        } else {
            let format = Format::named(&self.format).unwrap_or(Format::Terminal);
            terminal.data(render(&table, format));
        }
        Ok(())
    }
}

/// A confidence level, within the bounds that `compare:` of a sweep has.
fn level(text: &str) -> Result<f64, String> {
    let level: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if (0.5..=0.9999).contains(&level) {
        Ok(level)
    } else {
        Err("a level is a share from 0.5 to 0.9999, for instance `0.95`".to_owned())
    }
}

/// Published rows by the name of their entry, as a file in `path` sees it.
pub(super) fn published(catalog: &Catalog, path: &Path, name: &str) -> Option<Published> {
    load::entry(catalog, path, name)
}

impl Compare {
    fn trajectories(
        &self,
        terminal: &Terminal,
        reference: &Path,
        estimate: &Path,
    ) -> Result<(), Failure> {
        let read = |path: &Path| {
            tum::read_tum(path).map_err(|error| {
                Failure::input(
                    error.to_string(),
                    "a TUM trajectory has lines `timestamp tx ty tz qx qy qz qw`",
                )
            })
        };
        let (reference, estimate): (TimedPoses, TimedPoses) = (read(reference)?, read(estimate)?);
        let errors = |freedom| {
            tum::compare(&reference, &estimate, self.max_difference, freedom)
                .map_err(|error| Failure::input(error.to_string(), "see `--max-difference`"))
        };
        let (rigid, similar) = (errors(Freedom::Rigid)?, errors(Freedom::Similarity)?);
        if self.json {
            terminal.json(&serde_json::json!({
                "pairs": rigid.n_poses,
                "max_diff_s": self.max_difference,
                "se3": numbers(&rigid),
                "sim3": numbers(&similar),
                "degenerate": similar.degenerate,
            }));
            return Ok(());
        }
        let mut text = format!(
            "{} simultaneous poses (within {} s)\n\n",
            rigid.n_poses, self.max_difference
        );
        let _ = writeln!(
            text,
            "{:<34}{:>22}{:>22}",
            "", "rigid (SE3)", "similarity (Sim3)"
        );
        for (name, of) in ROWS {
            let show = |errors: &TrajectoryErrors| {
                of(errors).map_or_else(|| "-".to_owned(), |v| format!("{v:.15}"))
            };
            let _ = writeln!(text, "{name:<34}{:>22}{:>22}", show(&rigid), show(&similar));
        }
        if similar.degenerate {
            text += "\ndegenerate: the alignment is not unique; do not compare these numbers\n";
        }
        terminal.data(text);
        Ok(())
    }
}

type Of = fn(&TrajectoryErrors) -> Option<f64>;

/// What `evo_ape` and `evo_rpe` print as `rmse` and `mean`.
const ROWS: [(&str, Of); 7] = [
    ("ATE rmse (m)", |e| e.ate_rmse),
    ("ATE mean (m)", |e| e.ate_mean),
    ("RPE translation rmse (m)", |e| e.rte_rmse),
    ("RPE translation mean (m)", |e| e.rte_mean),
    ("RPE rotation rmse (deg)", |e| e.rre_rmse),
    ("RPE rotation mean (deg)", |e| e.rre_mean),
    ("scale of the alignment", |e| e.alignment.map(|a| a.scale)),
];

fn numbers(errors: &TrajectoryErrors) -> serde_json::Value {
    serde_json::json!({
        "ate_rmse_m": errors.ate_rmse,
        "ate_mean_m": errors.ate_mean,
        "rpe_trans_m_rmse": errors.rte_rmse,
        "rpe_trans_m_mean": errors.rte_mean,
        "rpe_rot_deg_rmse": errors.rre_rmse,
        "rpe_rot_deg_mean": errors.rre_mean,
        "scale": errors.alignment.map(|a| a.scale),
    })
}

fn scores(path: &Path) -> Result<Scores, Failure> {
    Scores::read(path)
        .map_err(|error| Failure::input(error.to_string(), "was it written by `op: evaluate`?"))
}

/// The rows that `name` stands for: a scores file, a folder with one, or a run.
pub fn entrants_of(path: &Path, runs: &Path, columns: &[String]) -> Result<Vec<Method>, Failure> {
    if path.is_file() || path.join(FILE).is_file() {
        let scores = scores(path)?;
        return Ok(vec![Method {
            label: scores.system.clone(),
            seeds: vec![scores],
        }]);
    }
    let run =
        RunDirectory::named(runs, path).map_err(|error| Failure::input(error.to_string(), ""))?;
    let schedule = Schedule::read(&run).map_err(|error| Failure::input(error.to_string(), ""))?;
    rows_of(&run, &schedule, columns)
}

/// The rows of a run, by what it was planned to do.
///
/// Stages of a run that score nothing of `columns` are left out, if another of its stages does: a table of depth has no row
/// for scores of hands, which may be of other clips.
pub fn rows_of(
    run: &RunDirectory,
    schedule: &Schedule,
    columns: &[String],
) -> Result<Vec<Method>, Failure> {
    let cache = Cache::of(run.runs());
    let is_scores = |key| {
        schedule
            .works
            .iter()
            .any(|work| work.key == key && work.kind == "scores")
    };
    let mut found: BTreeMap<Key, Scores> = BTreeMap::new();
    let mut missing = 0;
    let all = schedule.cells.iter().flat_map(|cell| &cell.stages);
    for (_, key) in all.filter(|(_, key)| is_scores(*key)) {
        if found.contains_key(key) {
            continue;
        }
        let folder = cache.path(key);
        if folder.join(FILE).is_file() {
            found.insert(*key, scores(&folder)?);
        } else {
            missing += 1;
        }
    }
    let any = found.values().any(|scores| scores.has(columns));
    let is_row = |key: &Key| {
        let asked = |scores: &Scores| !any || scores.has(columns);
        is_scores(*key) && found.get(key).is_none_or(asked)
    };
    let mut entrants: Vec<Method> = Vec::new();
    for cell in &schedule.cells {
        let scored: Vec<_> = cell.stages.iter().filter(|(_, key)| is_row(key)).collect();
        for (stage, key) in &scored {
            let arm = if schedule.sweep {
                cell.arm.clone()
            } else {
                schedule.name.clone()
            };
            let label = if scored.len() > 1 {
                format!("{arm}/{stage}")
            } else {
                arm
            };
            let Some(scores) = found.get(key).cloned() else {
                continue;
            };
            match entrants.iter_mut().find(|e| e.label == label) {
                Some(entrant) => entrant.seeds.push(scores),
                None => entrants.push(Method {
                    label,
                    seeds: vec![scores],
                }),
            }
        }
    }
    if entrants.is_empty() {
        let (message, help) = if missing > 0 {
            (
                format!("run `{}` has not finished its scores", run.name()),
                run.read().map_or_else(
                    |_| "continue it with `reviv run FILE`".to_owned(),
                    |run| format!("continue it with `reviv run {}`", run.experiment),
                ),
            )
        } else {
            (
                format!("run `{}` has no scores", run.name()),
                "add a stage with `op: evaluate`".to_owned(),
            )
        };
        return Err(Failure::input(message, help));
    }
    Ok(entrants)
}

#[cfg(test)]
mod tests {
    use super::level;

    #[test]
    fn a_level_is_a_share_and_not_a_percentage() {
        assert_eq!(level("0.95"), Ok(0.95));
        for text in ["95", "0", "1", "nan", "-0.5", "much"] {
            assert!(level(text).is_err(), "{text}");
        }
    }
}
