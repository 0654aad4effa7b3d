//! How fast the language is: loading, checking and planning the largest sweep, without starting a process.
//!
//! `cargo bench --bench language`. Budget: check and plan of the largest sweep under 100 ms each, `reviv --help` under 20 ms.

use reviv::experiment::catalog::Catalog;
use reviv::experiment::load::{Request, load};
use reviv::experiment::plan::plan;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The median of several runs.
fn median(mut work: impl FnMut()) -> Duration {
    let mut times: Vec<Duration> = (0..15)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed()
        })
        .collect();
    times.sort();
    times[times.len() / 2]
}

fn main() {
    println!("catalog: {:.1?}", median(|| drop(Catalog::linked())));
    let catalog = Catalog::linked();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut largest: Option<(usize, PathBuf)> = None;
    for (path, _) in catalog.experiments() {
        let request = Request {
            path: root.join(path),
            data_may_be_absent: true,
            ..Request::default()
        };
        if let (Some(experiment), _) = load(&catalog, &request) {
            let stages = experiment
                .cells
                .iter()
                .map(|cell| cell.graph.stages.len())
                .sum();
            if largest.as_ref().is_none_or(|(most, _)| stages > *most) {
                largest = Some((stages, request.path));
            }
        }
    }
    let Some((stages, path)) = largest else {
        println!("no experiment is shipped");
        return;
    };
    let request = Request {
        path: path.clone(),
        data_may_be_absent: true,
        ..Request::default()
    };
    println!("largest: {} ({stages} stages in all runs)", path.display());
    println!("check: {:.1?}", median(|| drop(load(&catalog, &request))));
    let (Some(experiment), _) = load(&catalog, &request) else {
        return;
    };
    let time = median(|| {
        let hash = &mut |path: &Path| std::fs::read(path).map(|bytes| blake3::hash(&bytes));
        drop(plan(&experiment, &|_| false, hash));
    });
    println!("plan: {time:.1?}");
    if let Some(binary) = option_env!("CARGO_BIN_EXE_reviv") {
        let time = median(|| {
            let output = std::process::Command::new(binary).arg("--help").output();
            drop(output);
        });
        println!("--help: {time:.1?}");
    }
}
