//! The numbers of the reference implementation, as far as the vectors are at hand.

#[path = "../../examples/check_parity/mod.rs"]
pub mod check_parity;

use reviv::engine::Compute;

#[test]
fn every_tensor_of_the_parity_vectors_matches() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let report = check_parity::check(&shared.join("vectors/parity"), &Compute::cpu()).unwrap();
    assert!(report.passed(), "{report}");
}

#[test]
fn every_tensor_of_the_depth_and_motion_vectors_matches() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    for folder in ["vda", "tmr"] {
        let report =
            check_parity::check(&shared.join("vectors").join(folder), &Compute::cpu()).unwrap();
        assert!(report.passed(), "{report}");
    }
}
