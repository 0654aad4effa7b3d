//! How far the work is: bars on a terminal, plain lines elsewhere, with rate and remaining time. Where the bytes go is the
//! command's choice.

use super::environment::Stopwatch;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::Write;
use std::sync::Mutex;
use std::time::Duration;

/// Tells a person how a run goes.
pub struct Progress {
    show: Show,
}

enum Show {
    Terminal(MultiProgress),
    Lines(Mutex<Box<dyn Write + Send>>),
    Silent,
}

/// Nothing is drawn for work that ends sooner.
const PATIENCE: Duration = Duration::from_secs(2);
/// Between two plain lines of one task.
const LINE_EVERY: Duration = Duration::from_secs(15);

impl Progress {
    /// Bars on standard error.
    pub fn terminal() -> Self {
        let bars = MultiProgress::with_draw_target(ProgressDrawTarget::stderr_with_hz(10));
        Self {
            show: Show::Terminal(bars),
        }
    }

    /// Plain lines.
    pub fn lines(out: Box<dyn Write + Send>) -> Self {
        Self {
            show: Show::Lines(Mutex::new(out)),
        }
    }

    /// Shows nothing.
    pub fn silent() -> Self {
        Self { show: Show::Silent }
    }

    /// One line that stays.
    pub fn say(&self, line: &str) {
        match &self.show {
            // A line that cannot be shown (a closed pipe) is no reason to stop the work.
            Show::Terminal(bars) => drop(bars.println(line)),
            Show::Lines(out) => {
                if let Ok(mut out) = out.lock() {
                    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
                }
            }
            Show::Silent => {}
        }
    }

    /// Begins to follow one task.
    pub fn task(&self, name: &str) -> Task<'_> {
        Task {
            progress: self,
            name: name.to_owned(),
            started: Stopwatch::start(),
            first: None,
            said: None,
            bar: None,
        }
    }
}

impl std::fmt::Debug for Progress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self.show {
            Show::Terminal(_) => "Progress::terminal",
            Show::Lines(_) => "Progress::lines",
            Show::Silent => "Progress::silent",
        })
    }
}

/// Something with a beginning and an end.
#[derive(Debug)]
pub struct Task<'a> {
    progress: &'a Progress,
    name: String,
    started: Stopwatch,
    /// Where it was when first heard of: after a resume that is not zero, and does not count for the rate.
    first: Option<(u64, Stopwatch)>,
    said: Option<Stopwatch>,
    bar: Option<ProgressBar>,
}

impl Task<'_> {
    /// `done` of `total` `unit`s. Cheap: call it per step.
    pub fn update(&mut self, done: u64, total: u64, unit: &str) {
        let (first, since) = *self.first.get_or_insert_with(|| (done, Stopwatch::start()));
        if self.started.elapsed() < PATIENCE {
            return;
        }
        match &self.progress.show {
            Show::Silent => {}
            Show::Terminal(bars) => {
                let bar = self
                    .bar
                    .get_or_insert_with(|| bars.add(new_bar(&self.name)));
                bar.set_length(total);
                bar.set_position(done);
                let pace = Pace::of(
                    done.saturating_sub(first),
                    total.saturating_sub(done),
                    since.seconds(),
                );
                bar.set_message(pace.text(unit));
            }
            Show::Lines(_) => {
                if self.said.is_some_and(|said| said.elapsed() < LINE_EVERY) {
                    return;
                }
                self.said = Some(Stopwatch::start());
                let pace = Pace::of(
                    done.saturating_sub(first),
                    total.saturating_sub(done),
                    since.seconds(),
                );
                let name = &self.name;
                self.progress
                    .say(&format!("{name}: {done}/{total} {unit}{}", pace.text(unit)));
            }
        }
    }

    /// Since the task began.
    pub fn seconds(&self) -> f64 {
        self.started.seconds()
    }
}

impl Drop for Task<'_> {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn new_bar(name: &str) -> ProgressBar {
    let style = ProgressStyle::with_template("{prefix} [{bar:24}] {pos}/{len}{msg}");
    let bar = ProgressBar::no_length();
    if let Ok(style) = style {
        bar.set_style(style.progress_chars("=> "));
    }
    bar.with_prefix(name.to_owned())
}

/// How fast, and how long still.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pace {
    per_second: Option<f64>,
    remaining: Option<f64>,
}

impl Pace {
    fn of(done: u64, left: u64, seconds: f64) -> Self {
        let per_second = (done > 0 && seconds > 0.0).then(|| done as f64 / seconds);
        let remaining = per_second.map(|rate| left as f64 / rate);
        Self {
            per_second,
            remaining,
        }
    }

    fn text(self, unit: &str) -> String {
        match (self.per_second, self.remaining) {
            (Some(rate), Some(remaining)) => {
                format!(
                    ", {} {unit}/s, {} left",
                    significant(rate),
                    duration(remaining)
                )
            }
            _ => String::new(),
        }
    }
}

fn significant(value: f64) -> String {
    let digits = if value >= 100.0 {
        0
    } else if value >= 10.0 {
        1
    } else {
        2
    };
    format!("{value:.digits$}")
}

/// `1.4 s`, `42 s`, `3 min 05 s`, `2 h 10 min`, `3 d 4 h`.
pub fn duration(seconds: f64) -> String {
    let whole = seconds.round().clamp(0.0, 1e15) as u64;
    match whole {
        0..10 => format!("{seconds:.1} s"),
        10..60 => format!("{whole} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        3600..86_400 => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
        _ => format!("{} d {} h", whole / 86_400, whole / 3600 % 24),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_counts_from_where_the_process_began() {
        let pace = Pace::of(50, 100, 10.0);
        assert_eq!(pace.text("steps"), ", 5.00 steps/s, 20 s left");
        assert_eq!(Pace::of(0, 100, 10.0).text("steps"), "");
    }

    #[test]
    fn durations_read_like_a_person_says_them() {
        let said: Vec<String> = [0.04, 9.97, 42.2, 185.0, 7800.0, 273_600.0]
            .map(duration)
            .into();
        assert_eq!(
            said,
            [
                "0.0 s",
                "10 s",
                "42 s",
                "3 min 05 s",
                "2 h 10 min",
                "3 d 4 h"
            ]
        );
    }
}
