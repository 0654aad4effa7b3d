//! `reviv reconstruct`: `experiments/reconstruct.yaml` with a video and a model.

use super::request::open;
use super::rerun;
use super::run::{RunsDir, interruptible, progress, tell};
use super::terminal::{Failure, Terminal};
use crate::engine::DeviceChoice;
use crate::experiment::catalog::Catalog;
use crate::experiment::load::Request;
use crate::model::shipped;
use crate::ops::ReconstructSettings;
use crate::reconstruction::dataset::write_nerfstudio;
use crate::reconstruction::folder::{FOLDER, MANIFEST, Manifest, PAGE};
use crate::reconstruction::overlay::{Overlay, OverlayError};
use crate::reconstruction::predictions::ScaleStatus;
use crate::run::execute::{Job, Outcome, execute};
use crate::run::schedule::Schedule;
use crate::run::{Cache, Interrupt, RunDirectory, RunError, Shard, State, WorkerPool, files};
use crate::video::{DecoderChoice, Video, VideoSettings};
use crate::view::movie;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// The experiment, where there is none beside the user.
const EXPERIMENT: &str = include_str!("../../experiments/reconstruct.yaml");
const FILE: &str = "experiments/reconstruct.yaml";
const STAGE: &str = "reconstruction";
/// The video with what was reconstructed drawn in: by `ffmpeg`, or without.
const OVERLAYS: [&str; 2] = ["overlay.mp4", "overlay.avi"];
/// The folder of a data set for NerfStudio.
const NERFSTUDIO: &str = "nerfstudio";
/// The kind of a model among artifacts.
const MODEL: &str = "mget";

/// Reconstruct the wearer and the world from one video
///
/// Makes a folder with the camera path, body, hands, gaze, depth, points and a page to look at (`view.html`), and prints what it
/// assumed. It runs `experiments/reconstruct.yaml`; every other setting is reached with `--set`.
#[derive(Debug, clap::Args)]
pub struct Reconstruct {
    /// A video, or a folder of pictures
    #[arg(value_name = "VIDEO")]
    video: PathBuf,
    /// The folder to make [default: the video's name with `_reconstruction`]
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// A run that trained a model, or a model folder [default: the model of the latest finished run, or
    /// else the one that comes with the program]
    #[arg(long, value_name = "MODEL")]
    model: Option<PathBuf>,
    /// How tokens are generated: `fast`, `paper`, `release`, or your own entry
    #[arg(long, value_name = "ENTRY")]
    decoding: Option<String>,
    /// Horizontal field of view of the centre square, degrees
    #[arg(long, value_name = "DEGREES")]
    fov: Option<f64>,
    /// Metric depth of another model to take the scale from: npz, or a folder of EXR or 16-bit PNG
    #[arg(long, value_name = "PATH")]
    anchor: Option<PathBuf>,
    /// A metric depth network to take the scale from, as `reviv import --depth metric` makes it
    #[arg(long, value_name = "DIR", conflicts_with = "anchor")]
    anchor_model: Option<PathBuf>,
    /// At most so many seconds of the video
    #[arg(long, value_name = "SECONDS")]
    seconds: Option<f64>,
    /// Also draw skeleton, hands and gaze into the video: `overlay.mp4`, or `overlay.avi` where there is no `ffmpeg`
    #[arg(long = "video")]
    overlay: bool,
    /// Also write for another program: `nerfstudio` makes a data set of pictures and cameras (`ns-train splatfacto --data DIR`),
    /// `rerun` a recording `scene.rrd`, by the Python package and its `rerun-sdk`
    #[arg(long, value_enum, value_name = "PROGRAM")]
    export: Vec<Export>,
    /// Who decodes the video
    #[arg(long, value_enum, value_name = "DECODER")]
    decoder: Option<DecoderChoice>,
    /// Where the models run: auto, cpu, cuda, vulkan, metal or wgpu, a GPU also with its number: `cuda:1`
    #[arg(long, value_name = "DEVICE")]
    device: Option<DeviceChoice>,
    /// The seed of the decoding
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Samples to write beside the reconstruction, with their spread
    #[arg(long, value_name = "N")]
    samples: Option<usize>,
    /// Change any other value: `--set stages.reconstruction.overlap=1.5`
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    #[command(flatten)]
    place: RunsDir,
}

/// Another program that what is found is written for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Export {
    Nerfstudio,
    Rerun,
}

impl super::Run for Reconstruct {
    fn run(self, terminal: &Terminal) -> Result<(), Failure> {
        super::ranks::only_one(terminal, "reconstruct")?;
        if !self.video.exists() {
            return Err(Failure::input(
                format!("no file `{}`", self.video.display()),
                "give the path of a video or of a folder of pictures",
            ));
        }
        let target = self.target()?;
        if self.export.contains(&Export::Rerun) {
            rerun::check()?;
        }
        let model = find_model(&self.place.runs, self.model.as_deref())
            .map_err(|error| tell(terminal, &error))?;
        let request = self.request(&model)?;
        terminal.note(format_args!(
            "experiment  {}\nmodel       {}\n",
            request.path.display(),
            model.display()
        ));
        let catalog = Catalog::linked();
        let (experiment, _) = open(&catalog, &request, terminal)?;
        let interrupt = interruptible(terminal)?;
        let progress = progress(terminal);
        let outcome = execute(&Job {
            experiment: &experiment,
            runs: &self.place.runs,
            only: None,
            shard: Shard::WHOLE,
            check: false,
            crew: WorkerPool::alone(),
            progress: &progress,
            interrupt: &interrupt,
        })
        .map_err(|error| tell(terminal, &error))?;
        finished(terminal, &outcome, &interrupt)?;
        let artifact = outcome.artifacts.get(STAGE).ok_or_else(|| {
            Failure::input(
                format!("the experiment has no stage `{STAGE}`"),
                format!("`{FILE}` names it so"),
            )
        })?;
        let made = artifact.join(FOLDER);
        let manifest = Manifest::read(&made).map_err(Failure::machine)?;
        publish(&made, &target).map_err(|error| tell(terminal, &error))?;
        self.write_more(terminal, &outcome, &target)?;
        Self::report(terminal, &outcome, &manifest, &target);
        Ok(())
    }
}

impl Reconstruct {
    /// Where the result goes: a new folder, or one that holds an earlier result.
    fn target(&self) -> Result<PathBuf, Failure> {
        let target = self.output.clone().unwrap_or_else(|| {
            let stem = self.video.file_stem().unwrap_or_default().to_string_lossy();
            PathBuf::from(format!("{stem}_reconstruction"))
        });
        match earlier(&target) {
            Some(_) => Ok(target),
            None => Err(Failure::input(occupied(&target), ANOTHER)),
        }
    }

    /// What is asked for beside the result: the overlay and pictures, which need the video once more, and files for other programs.
    fn write_more(
        &self,
        terminal: &Terminal,
        outcome: &Outcome,
        target: &Path,
    ) -> Result<(), Failure> {
        if self.export.contains(&Export::Rerun) {
            rerun::write(target)?;
        }
        let pictures = self.export.contains(&Export::Nerfstudio);
        if !self.overlay && !pictures {
            return Ok(());
        }
        let name = OVERLAYS[usize::from(!movie::ffmpeg())];
        if self.overlay && name != OVERLAYS[0] {
            terminal.note("no `ffmpeg`: the overlay is Motion JPEG, which browsers do not play\n");
        }
        let write = || -> Result<(), OverlayError> {
            let video = Video::open_with(&self.video, &reading(outcome))?;
            if self.overlay {
                Overlay::open(target)?.write(&video, &target.join(name))?;
            }
            if pictures {
                write_nerfstudio(target, &video, &target.join(NERFSTUDIO))?;
            }
            Ok(())
        };
        write().map_err(|error| match error {
            OverlayError::Folder { .. } => Failure::input(error.to_string(), "see `targets`"),
            error => Failure::machine(error),
        })
    }

    /// The experiment with the video, the model and the other flags.
    fn request(&self, model: &Path) -> Result<Request, Failure> {
        let path = if Path::new(FILE).is_file() {
            PathBuf::from(FILE)
        } else {
            let path = self.place.runs.join("reconstruct.yaml");
            std::fs::create_dir_all(&self.place.runs)
                .and_then(|()| std::fs::write(&path, EXPERIMENT))
                .map_err(|error| Failure::machine(format_args!("{}: {error}", path.display())))?;
            path
        };
        let runs = &self.place.runs;
        let mut set = vec![
            change("clips", "!unset"),
            change("model", "!unset"),
            change("video", &text(&self.video, runs)?),
            change("model_folder", &text(model, runs)?),
        ];
        if let Some(name) = &self.decoding {
            set.push(change("decoding", name));
        }
        if let Some(degrees) = self.fov {
            set.push(change("camera.field_of_view", &degrees.to_string()));
        }
        if let Some(path) = &self.anchor {
            set.push(change("anchor", &text(path, runs)?));
        }
        if let Some(path) = &self.anchor_model {
            set.push(change("anchor_model", &text(path, runs)?));
        }
        if let Some(seconds) = self.seconds {
            set.push(change("seconds", &seconds.to_string()));
        }
        if let Some(samples) = self.samples {
            set.push(change("samples", &samples.to_string()));
        }
        if let Some(decoder) = self.decoder {
            set.push(change("reading.decoder", decoder.name()));
        }
        if let Some(device) = self.device {
            set.push(change("device", &device.to_string()));
        }
        set.extend(self.set.iter().cloned());
        Ok(Request {
            path,
            set,
            seed: self.seed,
            data_may_be_absent: false,
        })
    }

    /// What was made, what was assumed, and where the time went.
    fn report(terminal: &Terminal, outcome: &Outcome, manifest: &Manifest, target: &Path) {
        let mut text = String::from("\n");
        for [label, value] in &manifest.assumptions {
            let _ = writeln!(text, "{label:<12}{value}");
        }
        if manifest.scale != ScaleStatus::None {
            let _ = writeln!(text, "{:<12}{}", "Depth", manifest.scale.words());
        }
        if let Some(reason) = &manifest.refused {
            let _ = writeln!(text, "{:<12}no metric scale: {reason}", "");
        }
        if let Ok(rows) = outcome.metrics(STAGE)
            && let Some(row) = rows.last()
        {
            text.push('\n');
            for (name, seconds) in &row.scalars {
                let part = name.trim_start_matches("seconds/");
                let each = seconds / row.step.max(1) as f64;
                let _ = writeln!(text, "{part:<16}{seconds:>8.2} s {each:>8.3} s per window");
            }
        }
        if let Some(name) = OVERLAYS.iter().find(|name| target.join(name).is_file()) {
            let _ = writeln!(text, "\n{:<12}{}", "Overlay", target.join(name).display());
        }
        for (program, made) in [("NerfStudio", NERFSTUDIO), ("Rerun", rerun::FILE)] {
            let made = target.join(made);
            if made.exists() {
                let _ = writeln!(text, "{program:<12}{}", made.display());
            }
        }
        terminal.note(text);
        terminal.data(format_args!("{}\n", target.join(PAGE).display()));
    }
}

fn change(key: &str, value: &str) -> String {
    format!("stages.{STAGE}.{key}={value}")
}

/// A path as a YAML string that does not depend on where the experiment lies. An experiment is text: a file whose name is none
/// gets a link among the runs.
fn text(path: &Path, runs: &Path) -> Result<String, Failure> {
    let mut absolute = std::path::absolute(path).map_err(Failure::machine)?;
    if absolute.to_str().is_none() {
        absolute = linked(&absolute, runs)?;
    }
    let Some(text) = absolute.to_str() else {
        let message = format!(
            "`{}`: a name that is not UTF-8 cannot stand in an experiment",
            absolute.display()
        );
        return Err(Failure::input(message, "rename it, or give a link to it"));
    };
    Ok(serde_json::Value::from(text).to_string())
}

/// A link below `runs` with a name that is text, the same for the same file.
#[cfg(unix)]
fn linked(file: &Path, runs: &Path) -> Result<PathBuf, Failure> {
    use std::os::unix::ffi::OsStrExt as _;
    let wrong =
        |error: std::io::Error| Failure::machine(format_args!("{}: {error}", runs.display()));
    let plain = |part: Option<&std::ffi::OsStr>| {
        let part = part.unwrap_or_default().to_string_lossy();
        part.replace(
            |c: char| !c.is_ascii_alphanumeric() && !"-_".contains(c),
            "_",
        )
    };
    let hash = blake3::hash(file.as_os_str().as_bytes()).to_hex();
    let mut name = format!("{}-{}", plain(file.file_stem()), &hash[..8]);
    if file.extension().is_some() {
        name = format!("{name}.{}", plain(file.extension()));
    }
    let folder = std::path::absolute(runs.join("links")).map_err(wrong)?;
    std::fs::create_dir_all(&folder).map_err(wrong)?;
    let link = folder.join(name);
    match std::os::unix::fs::symlink(file, &link) {
        Err(error) if error.kind() != std::io::ErrorKind::AlreadyExists => Err(wrong(error)),
        _ => Ok(link),
    }
}

/// Names of files are text here.
#[cfg(not(unix))]
fn linked(file: &Path, _runs: &Path) -> Result<PathBuf, Failure> {
    Ok(file.to_owned())
}

/// The folder of a model: `given` is one, or a run that trained one; without it, the latest run that did, or else the model that
/// comes with the program.
///
/// # Errors
/// When `given` is none, or the folder of runs cannot be read or written.
pub fn find_model(runs: &Path, given: Option<&Path>) -> Result<PathBuf, RunError> {
    if let Some(given) = given {
        if given.join("run.json").is_file() || !given.exists() {
            let run = RunDirectory::named(runs, given)?;
            return artifact_of(&run, MODEL).ok_or_else(|| RunError::Request {
                message: format!("run `{}` has no finished model of its own", run.name()),
                help: "name a run with a `train_mget` stage, or a model folder".into(),
            });
        }
        return Ok(given.to_owned());
    }
    let mut finished: Vec<(String, RunDirectory)> = RunDirectory::all(runs)?
        .into_iter()
        .filter_map(|run| Some((run.read().ok()?.created, run)))
        .collect();
    finished.sort_by(|a, b| b.0.cmp(&a.0));
    let models = finished.iter();
    let mut models = models.filter_map(|(_, run)| artifact_of(run, MODEL));
    if let Some(found) = models.next() {
        return Ok(found);
    }
    shipped::unpack(&runs.join("models")).map_err(|error| RunError::Request {
        message: error.to_string(),
        help: "the model that comes with the program is written there once; `--runs` names another folder".into(),
    })
}

/// What a run made, or used, of this kind (`mget`, `clips`, `tokens`): the last one of its plan that is in the cache.
pub fn artifact_of(run: &RunDirectory, kind: &str) -> Option<PathBuf> {
    let schedule = Schedule::read(run).ok()?;
    let cache = Cache::of(run.runs());
    let made = schedule.works.iter().rev().filter(|work| work.kind == kind);
    made.filter(|work| cache.contains(&work.key))
        .map(|work| cache.path(&work.key))
        .next()
}

/// How the stage read the video.
fn reading(outcome: &Outcome) -> VideoSettings {
    let settings = outcome.settings(STAGE);
    let reading = settings.and_then(|own| {
        own.with(|own: &ReconstructSettings| own.reading.clone())
            .ok()
    });
    reading.unwrap_or_default()
}

fn finished(terminal: &Terminal, outcome: &Outcome, interrupt: &Interrupt) -> Result<(), Failure> {
    for error in &outcome.failures {
        tell(terminal, error);
    }
    match outcome.state {
        State::Done => Ok(()),
        State::Interrupted if interrupt.requested() => Err(Failure::Ended(130)),
        _ => {
            let worst = outcome.failures.iter().map(RunError::exit_code).max();
            Err(Failure::Ended(worst.unwrap_or(2)))
        }
    }
}

/// The files of the earlier result in `target`, which may go; `None` where it holds anything else.
fn earlier(target: &Path) -> Option<Vec<PathBuf>> {
    if !target.exists() {
        return Some(Vec::new());
    }
    if std::fs::read_dir(target).ok()?.next().is_none() {
        return Some(Vec::new());
    }
    let manifest = Manifest::read(target).ok()?;
    let own = |file: &PathBuf| {
        file == Path::new(MANIFEST)
            || file.starts_with(NERFSTUDIO)
            || file == Path::new(rerun::FILE)
            || OVERLAYS.iter().any(|name| file == Path::new(name))
            || manifest.files.iter().any(|name| file == Path::new(name))
    };
    let found = files::files_below(target).ok()?;
    found.iter().all(own).then_some(found)
}

const ANOTHER: &str = "name another folder with `-o`";

fn occupied(target: &Path) -> String {
    format!("`{}` holds something else", target.display())
}

/// Copies the result to where it was asked for; the files of an earlier result there go.
fn publish(artifact: &Path, target: &Path) -> Result<(), RunError> {
    // Asked again: a reconstruction takes long enough for somebody to have put something there.
    let old = earlier(target).ok_or_else(|| RunError::Request {
        message: occupied(target),
        help: ANOTHER.into(),
    })?;
    for file in old {
        files::remove(&target.join(file))?;
    }
    files::copy_tree(artifact, target)
}
