//! The numbers of the reference implementation, as far as the vectors are at hand.

#[path = "../../examples/check_parity/mod.rs"]
pub mod check_parity;

use reviv::engine::{Compute, DeviceChoice, Precision};

#[test]
fn every_tensor_of_the_parity_vectors_matches() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let report = check_parity::check(&shared.join("vectors/parity"), &Compute::cpu()).unwrap();
    assert!(report.passed(), "{report}");
}

#[test]
fn every_tensor_of_the_parity_vectors_matches_on_a_gpu() {
    let (Some(shared), Some(compute)) = (crate::shared::folder(), crate::software_device::device())
    else {
        return;
    };
    let report = check_parity::check(&shared.join("vectors/parity"), &compute).unwrap();
    assert!(report.passed(), "{report}");
}

#[test]
fn the_transformer_s_vectors_match_within_bfloat16() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let compute = Compute::new(DeviceChoice::CPU, Precision::Bf16).unwrap();
    let report = check_parity::check(&shared.join("vectors/parity/mget"), &compute).unwrap();
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
