//! What recording costs: one metrics step must stay below 50 us on average, files on disk included.

use reviv::run::metrics::Metrics;
use std::time::Instant;

const STEPS: u64 = 50_000;

fn main() {
    let scalars = [
        ("loss", 3.217_340_1),
        ("loss/body", 2.9),
        ("loss/camera", 3.4),
        ("loss/gaze", 2.2),
        ("learning_rate", 1e-4),
        ("gradient_norm", 0.731),
        ("tokens_per_second", 18_231.0),
        ("codebook_perplexity", 201.3),
    ];
    let directory = tempfile::tempdir().expect("a temporary directory");
    let mut metrics = Metrics::open(directory.path(), Vec::new()).expect("an empty directory");
    let begun = Instant::now();
    for step in 1..=STEPS {
        metrics.scalars(step, &scalars).expect("space on the disk");
    }
    metrics.flush().expect("space on the disk");
    let each = begun.elapsed().as_secs_f64() / STEPS as f64 * 1e6;
    println!(
        "recording one step of {} scalars: {each:.2} us (the limit is 50)",
        scalars.len()
    );
}
