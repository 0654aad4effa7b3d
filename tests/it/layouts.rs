//! The readers of the data sets on samples in the exact layouts, as far as they are at hand.

#[path = "../../examples/check_layouts/mod.rs"]
pub mod check_layouts;

#[test]
fn every_golden_answer_of_the_layouts_is_met() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let report = check_layouts::check(&shared.join("layouts")).unwrap();
    assert!(report.passed(), "{report}");
}
