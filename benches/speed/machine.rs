//! What the numbers were measured on and with: the paragraph above the table.

use crate::Arguments;
use crate::peer::Engine;
use crate::table::Results;
use reviv::run::environment::{Environment, now_text};
use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

/// The header of the report.
pub fn header(arguments: &Arguments, threads: usize, all: &[Results]) -> String {
    let compared = arguments.python.is_some();
    let environment = Environment::look(Path::new(env!("CARGO_MANIFEST_DIR")));
    let memory = environment
        .memory_bytes
        .map(|bytes| format!(", {:.0} GiB of memory", bytes as f64 / f64::from(1 << 30)))
        .unwrap_or_default();
    let system = system().unwrap_or_else(|| environment.system.clone());
    let revision = environment.git.map(|git| {
        let short: String = git.revision.chars().take(7).collect();
        let changed = if git.dirty { " with changes" } else { "" };
        format!(" ({short}{changed})")
    });
    let mut with = format!(
        "reviv {}{}",
        environment.reviv,
        revision.unwrap_or_default()
    );
    if let Some(compiler) = compiler() {
        let _ = write!(with, ", {compiler}");
    }
    if let Some(Engine { version, threads }) = all
        .iter()
        .find_map(|results| results.theirs.as_ref()?.engine.clone())
    {
        let how = if arguments.compile {
            "MGET compiled"
        } else {
            "eager"
        };
        let _ = write!(with, "; PyTorch {version}, {how}, {threads} threads");
    }
    let ratio = if compared {
        " The ratio is that of the medians: above 1, reviv is faster."
    } else {
        ""
    };
    let precision = if arguments.bf16 {
        "f32 with MGET's products in bfloat16"
    } else {
        "f32"
    };
    let rounds = match arguments.rounds.get() {
        1 => "one round".to_owned(),
        rounds => format!("{rounds} rounds"),
    };
    format!(
        "# Speed\n\n\
         {}, {threads} of {} cores used{memory}; {system}. {with}. {}.\n\n\
         Seconds are the median and (least..most) of {rounds}, in {precision} on {}, each in a fresh process after one \
         call to warm up.{ratio} Memory is the peak of the process; page faults are the most of any call after the second.\n",
        environment.cpu,
        environment.cores,
        now_text(),
        crate::compute().name(),
    )
}

/// The name of the operating system and the kind of processor.
fn system() -> Option<String> {
    let text = std::fs::read_to_string("/etc/os-release").ok()?;
    let name = text
        .lines()
        .find_map(|line| line.strip_prefix("PRETTY_NAME="))?;
    Some(format!(
        "{}, {}",
        name.trim_matches('"'),
        std::env::consts::ARCH
    ))
}

/// The compiler that Cargo just built this with, where it can be found.
fn compiler() -> Option<String> {
    let name = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(name).arg("--version").output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    let mut words = text.split_whitespace();
    Some(format!("{} {}", words.next()?, words.next()?))
}
