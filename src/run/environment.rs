//! The only place that looks at the machine, at git and at the clock.

use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// What a run was made with, as `lock.json` keeps it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Environment {
    /// Version of this program.
    pub reviv: String,
    /// blake3 of the running binary.
    pub binary: Option<String>,
    /// The machine's name.
    pub host: String,
    /// Operating system and processor family: `linux x86_64`.
    pub system: String,
    /// Model name of the processor; `unknown` where the machine does not say.
    pub cpu: String,
    /// Threads that this process can run at once.
    pub cores: usize,
    /// Main memory of the machine; `None` where it does not say.
    pub memory_bytes: Option<u64>,
    /// The repository that holds the experiment, if there is one.
    pub git: Option<Git>,
    /// How random numbers are made; another scheme gives other numbers from the same seed.
    pub random: String,
    /// The command line, the program itself first.
    pub argv: Vec<String>,
}

/// The state of a git work tree.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Git {
    /// Hash of the commit that is checked out.
    pub revision: String,
    /// Whether tracked files differ from that commit; untracked files do not count.
    pub dirty: bool,
    /// `git diff HEAD`; the run directory keeps it as `source/dirty.patch`.
    #[serde(skip)]
    pub patch: Vec<u8>,
}

/// The file that this program is, where the process belongs to another: a module of Python.
static PROGRAM: OnceLock<PathBuf> = OnceLock::new();

/// Says which file the program is, where it is not the process's own; the first word stands.
pub fn program_is(path: PathBuf) {
    PROGRAM.get_or_init(|| path);
}

impl Environment {
    /// Looks at the machine, and at the git work tree around `project`.
    pub fn look(project: &Path) -> Self {
        let own = PROGRAM.get().cloned();
        let binary = own
            .or_else(|| std::env::current_exe().ok())
            .and_then(|path| super::files::hash(&path).ok())
            .map(|(hash, _)| hash.to_hex().to_string());
        Self {
            reviv: env!("CARGO_PKG_VERSION").into(),
            binary,
            host: host(),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            cpu: field_of("/proc/cpuinfo", "model name").unwrap_or_else(|| "unknown".into()),
            cores: std::thread::available_parallelism().map_or(1, usize::from),
            memory_bytes: memory(),
            git: git(project),
            random: "chacha8 keyed by blake3(seed, step, sample, stream name), scheme 1".into(),
            argv: std::env::args_os()
                .map(|argument| argument.to_string_lossy().into_owned())
                .collect(),
        }
    }
}

/// The machine's name.
pub fn host() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname")
        .ok()
        .or_else(|| std::env::var("HOSTNAME").ok())
        .or_else(|| std::env::var("COMPUTERNAME").ok())
        .or_else(|| output(Command::new("hostname")));
    let name = name.map(|name| name.trim().to_owned());
    name.filter(|name| !name.is_empty())
        .unwrap_or_else(|| "unknown".into())
}

/// This process.
pub fn pid() -> u32 {
    std::process::id()
}

fn field_of(file: &str, name: &str) -> Option<String> {
    let text = std::fs::read_to_string(file).ok()?;
    let line = text.lines().find(|line| line.starts_with(name))?;
    Some(line.split_once(':')?.1.trim().to_owned())
}

/// Bytes of memory of this machine, where it says so.
pub fn memory() -> Option<u64> {
    let text = field_of("/proc/meminfo", "MemTotal")?;
    let kib: u64 = text.strip_suffix("kB")?.trim().parse().ok()?;
    kib.checked_mul(1024)
}

fn git(project: &Path) -> Option<Git> {
    let run = |arguments: &[&str]| {
        let mut command = Command::new("git");
        command.arg("-C").arg(project).args(arguments);
        command.stdin(std::process::Stdio::null());
        let output = command.output().ok()?;
        output.status.success().then_some(output.stdout)
    };
    let revision = run(&["rev-parse", "HEAD"])?;
    let patch = run(&["diff", "--binary", "HEAD"])?;
    Some(Git {
        revision: String::from_utf8_lossy(&revision).trim().to_owned(),
        dirty: !patch.is_empty(),
        patch,
    })
}

fn output(mut command: Command) -> Option<String> {
    let output = command.output().ok()?;
    String::from_utf8(output.stdout).ok()
}

/// Seconds since 1970 in UTC.
pub fn now() -> f64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0.0, |duration| duration.as_secs_f64())
}

/// The moment as `2026-11-22T02:30:00Z`.
pub fn now_text() -> String {
    Utc::from_unix(now() as i64).text()
}

/// A moment in UTC, taken apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Utc {
    /// Of the proleptic Gregorian calendar.
    pub year: i64,
    /// 1 to 12.
    pub month: u32,
    /// 1 to 31.
    pub day: u32,
    /// 0 to 23.
    pub hour: u32,
    /// 0 to 59.
    pub minute: u32,
    /// 0 to 59: there are no leap seconds.
    pub second: u32,
}

impl Utc {
    /// The proleptic Gregorian date of `seconds` since 1970 (Howard Hinnant's `civil_from_days`).
    pub fn from_unix(seconds: i64) -> Self {
        let days = seconds.div_euclid(86_400) + 719_468;
        let of_day = seconds.rem_euclid(86_400) as u32;
        let era = days.div_euclid(146_097);
        let of_era = days.rem_euclid(146_097);
        let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
        let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
        let shifted = (5 * of_year + 2) / 153;
        let month = if shifted < 10 {
            shifted + 3
        } else {
            shifted - 9
        } as u32;
        Self {
            year: year_of_era + era * 400 + i64::from(month <= 2),
            month,
            day: (of_year - (153 * shifted + 2) / 5 + 1) as u32,
            hour: of_day / 3600,
            minute: of_day / 60 % 60,
            second: of_day % 60,
        }
    }

    /// `2026-11-22T02:30:00Z`.
    pub fn text(self) -> String {
        let Self {
            year,
            month,
            day,
            hour,
            minute,
            second,
        } = self;
        format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
    }

    /// `1122`, the first part of a run directory's name.
    pub fn month_day(self) -> String {
        format!("{:02}{:02}", self.month, self.day)
    }
}

/// Measures elapsed time.
#[derive(Debug, Clone, Copy)]
pub struct Stopwatch(Instant);

impl Stopwatch {
    /// Begins to measure.
    pub fn start() -> Self {
        Self(Instant::now())
    }

    /// Time since the start; setting the machine's clock does not change it.
    pub fn elapsed(self) -> Duration {
        self.0.elapsed()
    }

    /// Seconds since the start.
    pub fn seconds(self) -> f64 {
        self.elapsed().as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_follow_the_gregorian_calendar() {
        // Reference values from `date -u -d @N +%FT%TZ`.
        for (seconds, text) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_795_314_176, "2026-11-22T02:22:56Z"),
            (4_107_542_399, "2100-02-28T23:59:59Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
            (-1, "1969-12-31T23:59:59Z"),
        ] {
            assert_eq!(Utc::from_unix(seconds).text(), text);
        }
    }

    #[test]
    fn looking_never_fails_even_outside_a_repository() {
        let dir = tempfile::tempdir().unwrap();
        let seen = Environment::look(dir.path());
        assert!(seen.cores >= 1 && !seen.host.is_empty());
    }
}
