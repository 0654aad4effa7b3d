//! The metrics against vectors from an independent oracle.

#[path = "../../examples/check_metrics.rs"]
#[allow(dead_code, reason = "the example has its own `main`")]
mod check_metrics;

#[test]
fn every_metric_vector_passes_and_every_bad_input_is_refused() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let (passed, total) = check_metrics::check_all(&shared.join("vectors/metrics")).unwrap();
    assert_eq!((passed, total), (total, 97));
}
