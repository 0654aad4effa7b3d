//! The answers of both sides as a Markdown table.

use crate::Case;
use crate::peer::{Answers, Measured};
use std::fmt::Write as _;

/// Everything said of one case.
#[derive(Debug)]
pub struct Results {
    pub case: Case,
    pub ours: Answers,
    /// `None` where PyTorch was not asked.
    pub theirs: Option<Answers>,
}

impl Results {
    /// The names of the measurements: as we said them, or the other side where we failed.
    fn names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for answers in std::iter::once(&self.ours).chain(&self.theirs) {
            for measured in &answers.measured {
                if !names.contains(&measured.name.as_str()) {
                    names.push(&measured.name);
                }
            }
        }
        if names.is_empty() {
            names.push("all");
        }
        names
    }
}

/// One side of one row.
enum Cell<'a> {
    Measured(&'a Measured),
    Failed(&'a str),
    NotAsked,
}

impl<'a> Cell<'a> {
    /// A measurement counts when it was taken in every round; what a side measured before it failed does.
    fn of(answers: Option<&'a Answers>, name: &str, repeats: usize) -> Self {
        let Some(answers) = answers else {
            return Self::NotAsked;
        };
        let expected = answers.rounds * repeats;
        let found = answers.measured.iter().find(|known| known.name == name);
        match (found, &answers.failure) {
            (Some(measured), _) if measured.seconds.len() >= expected => Self::Measured(measured),
            (_, Some(failure)) => Self::Failed(failure),
            _ => Self::Failed("this was not measured in every round"),
        }
    }

    fn median(&self) -> Option<f64> {
        match self {
            Self::Measured(measured) => Some(median(&measured.seconds)),
            _ => None,
        }
    }

    fn seconds(&self) -> String {
        match self {
            Self::Measured(Measured { seconds, .. }) => {
                let least = seconds.iter().copied().fold(f64::INFINITY, f64::min);
                let most = seconds.iter().copied().fold(0.0, f64::max);
                format!("{:.3} s ({least:.3}..{most:.3})", median(seconds))
            }
            // A bar would end the cell.
            Self::Failed(why) => format!("failed: {}", why.replace('|', "\\|")),
            Self::NotAsked => "-".to_owned(),
        }
    }

    fn memory(&self) -> String {
        match self {
            Self::Measured(measured) => measured
                .memory_mib
                .map_or_else(|| "-".to_owned(), |mib| format!("{mib:.0} MiB")),
            _ => "-".to_owned(),
        }
    }

    fn faults(&self) -> String {
        match self {
            Self::Measured(Measured {
                faults: Some(faults),
                ..
            }) => faults.to_string(),
            _ => "-".to_owned(),
        }
    }
}

/// A row per measurement.
pub fn table(all: &[Results], compared: bool) -> String {
    let mut text = String::new();
    text += if compared {
        "| case | reviv | PyTorch | ratio | memory, reviv | memory, PyTorch | page faults, reviv |\n|---|--:|--:|--:|--:|--:|--:|\n"
    } else {
        "| case | reviv | memory | page faults |\n|---|--:|--:|--:|\n"
    };
    for results in all {
        let case = results.case;
        for name in results.names() {
            let ours = Cell::of(Some(&results.ours), name, case.repeats());
            let _ = write!(text, "| {}: {name} | {} |", case.title(), ours.seconds());
            if !compared {
                let _ = writeln!(text, " {} | {} |", ours.memory(), ours.faults());
                continue;
            }
            let theirs = Cell::of(results.theirs.as_ref(), name, case.repeats());
            let ratio = match (ours.median(), theirs.median()) {
                (Some(ours), Some(theirs)) => format!("{:.2}", theirs / ours),
                _ => "-".to_owned(),
            };
            let _ = writeln!(
                text,
                " {} | {ratio} | {} | {} | {} |",
                theirs.seconds(),
                ours.memory(),
                theirs.memory(),
                ours.faults()
            );
        }
    }
    for sentence in shares(all) {
        let _ = writeln!(text, "\n{sentence}");
    }
    if let Some(sentence) = all.iter().find_map(packing) {
        let _ = writeln!(text, "\n{sentence}");
    }
    text
}

/// The rate of what has its operations counted, and its share of that of the large product, in a sentence each.
fn shares(all: &[Results]) -> Vec<String> {
    let rate = |measured: &Measured| Some(measured.flop? / median(&measured.seconds));
    let product = all.iter().find(|results| results.case == Case::Product);
    let peak = product.and_then(|results| rate(results.ours.measured.first()?));
    let counted = all.iter().flat_map(|results| {
        let measured = results.ours.measured.iter();
        measured.filter_map(move |measured| Some((results.case, measured, rate(measured)?)))
    });
    let sentence = |(case, measured, rate): (Case, &Measured, f64)| {
        let what = format!(
            "{}, {}: {:.3} TFLOP/s",
            case.title(),
            measured.name,
            rate / 1e12
        );
        match peak.filter(|_| case != Case::Product) {
            Some(peak) => format!("{what}, {:.0} % of the product.", 100.0 * rate / peak),
            None => format!("{what}."),
        }
    };
    counted.map(sentence).collect()
}

/// What packing saves, in a sentence.
fn packing(results: &Results) -> Option<String> {
    match (results.case, results.ours.measured.as_slice()) {
        (Case::Packing, [packed, padded]) => Some(format!(
            "Packing the samples of a batch instead of padding them makes a step {:.2} times as fast.",
            median(&padded.seconds) / median(&packed.seconds)
        )),
        _ => None,
    }
}

fn median(seconds: &[f64]) -> f64 {
    let mut sorted = seconds.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    match sorted.len() {
        0 => f64::NAN,
        count if count.is_multiple_of(2) => f64::midpoint(sorted[middle - 1], sorted[middle]),
        _ => sorted[middle],
    }
}
