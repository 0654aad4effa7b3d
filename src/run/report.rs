//! The page of a run, `report/index.html`: what came out, the curves of losses, and behind folds stages and times, other curves and
//! numbers, what the other ops have to show, settings, origin. One file, no network, no script.
//!
//! An op joins in by leaving `report/*.md`, `report/*.svg` or `report/*.png` in its artifact (or
//! `reconstruction/view.html`, which is linked): pieces are shown in the order of their names under the stage's heading.

use super::cache::{Cache, Key};
use super::curves::{self, Curve};
use super::environment;
use super::error::{AtPath, RunError};
use super::files;
use super::markdown::{escape, html};
use super::metrics;
use super::progress::duration;
use super::provenance::LockFile;
use super::record::{Run, RunDirectory, State};
use super::schedule::{Schedule, Task};
use super::stage::StageRecord;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::Path;

/// What the comparison of a sweep shows, in words, beside the page.
pub const CONCLUSION: &str = "conclusion.md";
/// The comparison of a sweep's arms, beside the page.
pub const TABLE: &str = "table.md";
/// The same as a plot, beside it.
pub const PLOT: &str = "table_intervals.svg";
/// Larger pieces are named, not shown.
const LARGEST_PIECE: u64 = 8 << 20;
/// More plots than anyone looks at make a page slow.
const MOST_PLOTS: usize = 60;

/// Writes the page as the run stands now.
pub fn write(directory: &RunDirectory) -> Result<(), RunError> {
    let run = directory.read()?;
    let schedule = Schedule::read(directory)?;
    let cache = Cache::of(directory.runs());
    let mut page = String::new();
    head(&mut page, &run, &schedule, directory);
    comparison(&mut page, directory);
    let (results, parts) = results(&schedule);
    for work in results {
        sections(&mut page, work, &schedule, &cache)?;
    }
    for work in &schedule.works {
        linked(&mut page, work, &schedule, directory, &cache)?;
    }
    let measured = Measured::read(&schedule, directory, &cache)?;
    measured.losses(&mut page);
    // Who looks at a run that has not ended wants to see where it stands.
    let open = if run.state == State::Done {
        ""
    } else {
        " open"
    };
    let _ = writeln!(page, "<details{open}><summary>Stages and times</summary>");
    stages(&mut page, &schedule, directory);
    page.push_str("</details>\n");
    measured.others(&mut page);
    let mut rest = String::new();
    for work in parts {
        sections(&mut rest, work, &schedule, &cache)?;
    }
    fold(&mut page, "What the stages before have to show", &rest);
    let mut rest = String::new();
    origin(&mut rest, &run, directory);
    fold(&mut page, "Settings and origin", &rest);
    page += "</main></body></html>\n";
    let path = directory.report();
    files::create_directory(path.parent().unwrap_or(directory.path()))?;
    files::write(&path, page.as_bytes())
}

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:0;color:#1a1a1a;background:#fff}\
main{max-width:64rem;margin:0 auto;padding:1.5rem}h1{margin:.2rem 0}h2{margin-top:2rem;border-bottom:1px solid #ccc}\
table{border-collapse:collapse;margin:.8rem 0}th,td{padding:.2rem .7rem;text-align:left;vertical-align:top;\
border-bottom:1px solid #e3e3e3;overflow-wrap:anywhere;font-variant-numeric:tabular-nums}.n{text-align:right}\
details{border-top:1px solid #ccc;padding:.6rem 0}summary{font-weight:600}.said{font-size:1.15em}\
code,pre{font:13px/1.45 ui-monospace,monospace}pre{background:#f5f5f5;padding:.8rem;overflow-x:auto}\
.plots{display:flex;flex-wrap:wrap;gap:.5rem}.plots img{max-width:min(100%,30rem)}img{max-width:100%}summary{cursor:pointer}\
@media(prefers-color-scheme:dark){body{background:#161616;color:#e8e8e8}pre{background:#222}th,td{border-color:#333}\
img{background:#fff}a{color:#8ab4f8}}";

fn head(page: &mut String, run: &Run, schedule: &Schedule, directory: &RunDirectory) {
    let name = escape(&schedule.name);
    let _ = write!(
        page,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>{name}: {}</title>\
         <style>{STYLE}</style></head>\n<body><main>\n<h1>{name}</h1>\n",
        run.state
    );
    page.push_str(&html(&schedule.about));
    let _ = writeln!(
        page,
        "<p>{}: <code>{}</code>, {}</p>",
        run.state,
        escape(&directory.name()),
        escape(&run.created)
    );
    for part in run.parts.values() {
        if let Some(error) = &part.error {
            let _ = writeln!(
                page,
                "<p><strong>{}</strong>: {}</p>",
                escape(&error.code),
                escape(&error.message)
            );
        }
    }
}

/// Who made the run when.
fn history(run: &Run) -> Vec<(&'static str, String)> {
    let mut rows = vec![
        ("experiment", run.experiment.clone()),
        ("created", run.created.clone()),
    ];
    for (shard, part) in &run.parts {
        let label = if run.parts.len() > 1 {
            format!("{shard} {}", part.state)
        } else {
            part.state.to_string()
        };
        let ended = part.ended.clone().unwrap_or_else(|| "still running".into());
        rows.push((
            "last work",
            format!("{label}: {} to {ended} on {}", part.started, part.host),
        ));
    }
    rows
}

/// Something that few look for.
fn fold(page: &mut String, summary: &str, inside: &str) {
    if !inside.is_empty() {
        let _ = writeln!(
            page,
            "<details><summary>{summary}</summary>\n{inside}</details>"
        );
    }
}

/// What an experiment is for, and the rest: the stages that no other reads. A sweep's result is its comparison.
fn results(schedule: &Schedule) -> (Vec<&Task>, Vec<&Task>) {
    let ports = schedule.works.iter().flat_map(|work| &work.inputs);
    let read: BTreeSet<&Key> = ports.flat_map(|p| &p.from).map(|(_, key)| key).collect();
    schedule
        .works
        .iter()
        .partition(|work| !schedule.sweep && !read.contains(&work.key))
}

/// The table of a sweep's `compare:` block, if it was written: it needs every arm.
fn comparison(page: &mut String, directory: &RunDirectory) {
    let said = std::fs::read_to_string(directory.path().join("report").join(CONCLUSION));
    if let Ok(said) = said
        && !said.is_empty()
    {
        let _ = writeln!(page, "<div class=\"said\">{}</div>", html(&said));
    }
    let path = directory.path().join("report").join(TABLE);
    let small = std::fs::metadata(&path).is_ok_and(|meta| meta.len() <= LARGEST_PIECE);
    if let (true, Ok(text)) = (small, std::fs::read_to_string(&path)) {
        page.push_str("<h2>Comparison</h2>\n");
        page.push_str(&html(&text));
    }
    let path = directory.path().join("report").join(PLOT);
    let small = std::fs::metadata(&path).is_ok_and(|meta| meta.len() <= LARGEST_PIECE);
    if let (true, Ok(plot)) = (small, std::fs::read(&path)) {
        image(
            page,
            "svg+xml",
            &plot,
            "Every row of the comparison with its interval",
        );
    }
}

fn stage_directory(directory: &RunDirectory, work: &Task) -> std::path::PathBuf {
    directory.path().join("stages").join(&work.directory)
}

fn stages(page: &mut String, schedule: &Schedule, directory: &RunDirectory) {
    page.push_str("<table>\n<tr><th>stage</th><th>op</th><th>state</th><th class=\"n\">time</th><th>artifact</th></tr>\n");
    for work in &schedule.works {
        let record = StageRecord::read(&stage_directory(directory, work));
        let state = record
            .as_ref()
            .map_or("queued".to_owned(), |record| match &record.found {
                Some(_) => "done (found in the cache)".to_owned(),
                None => record.state.to_string(),
            });
        let seconds = record.as_ref().map(|record| {
            record
                .found
                .as_ref()
                .map_or(record.seconds, |made| made.seconds)
        });
        let time = seconds
            .filter(|seconds| *seconds > 0.0)
            .map_or_else(String::new, duration);
        let key = work.key.to_string();
        let _ = writeln!(
            page,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td class=\"n\">{time}</td><td><code>cache/{}/{}...</code></td></tr>",
            escape(&work.label(schedule.sweep)),
            escape(&work.op),
            escape(&state),
            &key[..2],
            &key[..12],
        );
    }
    page.push_str("</table>\n");
}

/// What was measured on the way: a plot per stage name and metric, with a line per cell.
#[derive(Debug)]
struct Measured<'a> {
    /// Names of the stages.
    stages: Vec<&'a str>,
    /// By stage and metric, more than one step.
    plots: Vec<((usize, String), Vec<Curve>)>,
    /// By stage and metric, measured once.
    once: Vec<((usize, String), Vec<Curve>)>,
}

/// Whether a metric is what training makes small: `loss` of a step, `validation/loss` of held-out clips.
fn is_loss(metric: &str) -> bool {
    metric == "loss" || metric.ends_with("/loss")
}

impl<'a> Measured<'a> {
    fn read(
        schedule: &'a Schedule,
        directory: &RunDirectory,
        cache: &Cache,
    ) -> Result<Self, RunError> {
        let mut found: BTreeMap<(usize, String), Vec<Curve>> = BTreeMap::new();
        let mut stages: Vec<&str> = Vec::new();
        for work in &schedule.works {
            let known = stages.iter().position(|name| *name == work.stage);
            let position = known.unwrap_or_else(|| {
                stages.push(&work.stage);
                stages.len() - 1
            });
            let mut at = stage_directory(directory, work);
            if !at.join(metrics::METRICS).exists() {
                // Found in the cache: its curves are where it was made, if that run is still there.
                if let Some(made) = cache.made(&work.key) {
                    at = directory.runs().join(made.stage);
                }
            }
            let mut curves: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
            for row in metrics::read(&at)? {
                for (name, value) in row.scalars {
                    let points = curves.entry(name).or_default();
                    points.push((row.step as f64, value));
                }
            }
            for (metric, points) in curves {
                let name = if schedule.sweep {
                    work.cells.join(", ")
                } else {
                    String::new()
                };
                let held = found.entry((position, metric)).or_default();
                held.push(Curve { name, points });
            }
        }
        let (plots, once) = found
            .into_iter()
            .partition(|(_, curves)| curves.iter().any(|curve| curve.points.len() > 1));
        Ok(Self {
            stages,
            plots,
            once,
        })
    }

    /// The curves that say whether training went well.
    fn losses(&self, page: &mut String) {
        let losses: Vec<_> = self.plots.iter().filter(|((_, m), _)| is_loss(m)).collect();
        if !losses.is_empty() {
            page.push_str("<h2>Losses</h2>\n");
            self.draw(page, &losses);
        }
    }

    /// The other curves, and a table of what was measured once.
    fn others(&self, page: &mut String) {
        let mut inside = String::new();
        let others: Vec<_> = self
            .plots
            .iter()
            .filter(|((_, m), _)| !is_loss(m))
            .collect();
        if !others.is_empty() {
            self.draw(&mut inside, &others);
        }
        if !self.once.is_empty() {
            inside.push_str(
                "<table>\n<tr><th>stage</th><th>metric</th><th class=\"n\">value</th></tr>\n",
            );
            for ((stage, metric), curves) in &self.once {
                let values = curves.iter().flat_map(|curve| &curve.points);
                let value = spread(values.map(|(_, value)| *value));
                let _ = writeln!(
                    inside,
                    "<tr><td>{}</td><td>{}</td><td class=\"n\">{value}</td></tr>",
                    escape(self.stages[*stage]),
                    escape(metric),
                );
            }
            inside.push_str("</table>\n");
        }
        fold(page, "Other curves and numbers", &inside);
    }

    fn draw(&self, page: &mut String, plots: &[&((usize, String), Vec<Curve>)]) {
        page.push_str("<div class=\"plots\">\n");
        for ((stage, metric), curves) in plots.iter().take(MOST_PLOTS) {
            let title = format!("{}: {metric}", self.stages[*stage]);
            if let Some(svg) = curves::svg(&title, curves) {
                image(page, "svg+xml", svg.as_bytes(), metric);
            }
        }
        page.push_str("</div>\n");
        if plots.len() > MOST_PLOTS {
            let _ = writeln!(
                page,
                "<p>{} more are in the stages' <code>metrics.jsonl</code>.</p>",
                plots.len() - MOST_PLOTS
            );
        }
    }
}

/// One number, or the least and the most; `NaN` where there is no other.
fn spread(values: impl Iterator<Item = f64>) -> String {
    let (least, most) = values.fold((f64::NAN, f64::NAN), |(least, most), value| {
        (least.min(value), most.max(value))
    });
    if least < most {
        format!("{} to {}", number(least), number(most))
    } else {
        number(most)
    }
}

fn number(value: f64) -> String {
    if value == 0.0 || (1e-3..1e6).contains(&value.abs()) {
        format!("{value:.4}")
    } else {
        format!("{value:.3e}")
    }
}

/// What an op left to be shown.
fn sections(
    page: &mut String,
    work: &Task,
    schedule: &Schedule,
    cache: &Cache,
) -> Result<(), RunError> {
    let directory = cache.path(&work.key).join("report");
    let Ok(entries) = std::fs::read_dir(&directory) else {
        return Ok(());
    };
    let mut names: Vec<_> = entries.flatten().map(|entry| entry.file_name()).collect();
    names.sort();
    if !names.is_empty() {
        let _ = writeln!(page, "<h2>{}</h2>", escape(&work.label(schedule.sweep)));
    }
    for name in names {
        let path = directory.join(&name);
        let size = std::fs::metadata(&path).at("reading", &path)?.len();
        let name = name.to_string_lossy();
        let extension = Path::new(name.as_ref())
            .extension()
            .and_then(|e| e.to_str())
            .unwrap_or("");
        if size > LARGEST_PIECE {
            let _ = writeln!(
                page,
                "<p><code>{}</code> is too large to show.</p>",
                escape(&path.display().to_string())
            );
            continue;
        }
        let bytes = std::fs::read(&path).at("reading", &path)?;
        match extension {
            "md" => page.push_str(&html(&String::from_utf8_lossy(&bytes))),
            "svg" => image(page, "svg+xml", &bytes, &name),
            "png" => image(page, "png", &bytes, &name),
            _ => {}
        }
    }
    Ok(())
}

/// The page of a reconstruction, copied beside this one and linked.
fn linked(
    page: &mut String,
    work: &Task,
    schedule: &Schedule,
    directory: &RunDirectory,
    cache: &Cache,
) -> Result<(), RunError> {
    let own = cache.path(&work.key).join("reconstruction/view.html");
    if !own.is_file() {
        return Ok(());
    }
    let name = format!("{}.html", work.directory.replace('/', "-"));
    let report = directory.report();
    let folder = report.parent().unwrap_or(directory.path());
    files::create_directory(folder)?;
    let copy = folder.join(&name);
    std::fs::copy(&own, &copy).at("writing", &copy)?;
    let _ = writeln!(
        page,
        "<p><a href=\"{name}\">See the reconstruction</a> of <code>{}</code> (one page, works offline)</p>",
        escape(&work.label(schedule.sweep)),
        name = escape(&name),
    );
    Ok(())
}

fn origin(page: &mut String, run: &Run, directory: &RunDirectory) {
    page.push_str("<table>\n");
    for (name, value) in history(run) {
        let _ = writeln!(page, "<tr><th>{name}</th><td>{}</td></tr>", escape(&value));
    }
    page.push_str("</table>\n");
    if let Ok(resolved) = std::fs::read_to_string(directory.path().join("resolved.yaml")) {
        let resolved = escape(&resolved);
        let _ = writeln!(
            page,
            "<details><summary>Every value and where it was written</summary><pre>{resolved}</pre></details>"
        );
    }
    let lock: Result<LockFile, _> = files::read_json(&directory.path().join("lock.json"));
    let Ok(lock) = lock else {
        return;
    };
    let environment: &environment::Environment = &lock.environment;
    let git = environment.git.as_ref().map_or_else(
        || "not in a git work tree".into(),
        |git| {
            format!(
                "{}{}",
                git.revision,
                if git.dirty {
                    ", with changes (source/dirty.patch)"
                } else {
                    ""
                }
            )
        },
    );
    page.push_str("<table>\n");
    for (name, value) in [
        ("reviv", environment.reviv.clone()),
        ("git", git),
        (
            "machine",
            format!(
                "{}, {} cores, {}",
                environment.cpu, environment.cores, environment.system
            ),
        ),
        ("command", environment.argv.join(" ")),
    ] {
        let _ = writeln!(page, "<tr><th>{name}</th><td>{}</td></tr>", escape(&value));
    }
    for file in &lock.files {
        let path = escape(&file.path.display().to_string());
        let _ = writeln!(
            page,
            "<tr><th>input</th><td>{path}, {} bytes, <code>{}</code></td></tr>",
            file.bytes,
            escape(&file.blake3)
        );
    }
    page.push_str("</table>\n");
}

/// A picture inside the page; as an `img`, so that nothing in it can act.
fn image(page: &mut String, kind: &str, bytes: &[u8], name: &str) {
    let _ = writeln!(
        page,
        "<img alt=\"{}\" src=\"data:image/{kind};base64,{}\">",
        escape(name),
        STANDARD.encode(bytes)
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_metric_that_is_no_number_is_not_shown_as_one() {
        assert_eq!(spread([f64::NAN].into_iter()), "NaN");
        assert_eq!(spread([2.0, f64::NAN, 1.0].into_iter()), "1.0000 to 2.0000");
        assert_eq!(spread([0.0, 0.0].into_iter()), "0.0000");
    }
}
