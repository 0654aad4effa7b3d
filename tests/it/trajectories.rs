//! The metric numbers of `evo` on real trajectories (TUM RGB-D, freiburg1_xyz).

use reviv::evaluation::tum::{MAX_DIFFERENCE, compare, read_tum};
use reviv::geometry::alignment::Freedom;

/// `evo` 1.38 wrote the reference; equal to nine digits.
#[test]
fn trajectory_errors_equal_those_of_evo() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let data = shared.join("data");
    let text = std::fs::read_to_string(data.join("refs/freiburg1_xyz-rgbdslam.evo.json")).unwrap();
    let evo: serde_json::Value = serde_json::from_str(&text).unwrap();
    let reference = read_tum(&data.join("trajectories/freiburg1_xyz-groundtruth.txt")).unwrap();
    let estimate = read_tum(&data.join("trajectories/freiburg1_xyz-rgbdslam.txt")).unwrap();
    for (freedom, suffix) in [(Freedom::Rigid, "se3"), (Freedom::Similarity, "sim3")] {
        let errors = compare(&reference, &estimate, MAX_DIFFERENCE, freedom).unwrap();
        assert_eq!(errors.n_poses as u64, evo["pairs"].as_u64().unwrap());
        for (name, ours) in [
            ("ate_rmse_m", errors.ate_rmse),
            ("rpe_trans_m_rmse", errors.rte_rmse),
            ("rpe_rot_deg_rmse", errors.rre_rmse),
        ] {
            let theirs = evo[format!("{name}_{suffix}")].as_f64().unwrap();
            let ours = ours.unwrap();
            assert!(
                (ours - theirs).abs() < 1e-9 * theirs,
                "{name}_{suffix}: {ours} against {theirs}"
            );
        }
        if freedom == Freedom::Similarity {
            let theirs = evo["sim3_scale"].as_f64().unwrap();
            assert!((errors.alignment.unwrap().scale - theirs).abs() < 1e-9);
        }
    }
}

/// The command of the guide: `reviv compare --trajectory REFERENCE ESTIMATE`.
#[test]
fn one_command_prints_the_numbers_of_evo() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let data = shared.join("data");
    let text = std::fs::read_to_string(data.join("refs/freiburg1_xyz-rgbdslam.evo.json")).unwrap();
    let evo: serde_json::Value = serde_json::from_str(&text).unwrap();
    let compare = |extra: &[&str]| {
        let output = std::process::Command::new(env!("CARGO_BIN_EXE_reviv"))
            .args(["compare", "--trajectory"])
            .arg(data.join("trajectories/freiburg1_xyz-groundtruth.txt"))
            .arg(data.join("trajectories/freiburg1_xyz-rgbdslam.txt"))
            .args(extra)
            .output()
            .unwrap();
        assert!(output.status.success());
        String::from_utf8(output.stdout).unwrap()
    };
    let ours: serde_json::Value = serde_json::from_str(&compare(&["--json"])).unwrap();
    assert_eq!(ours["pairs"], evo["pairs"]);
    let number = |value: &serde_json::Value| value.as_f64().unwrap();
    for freedom in ["se3", "sim3"] {
        for name in ["ate_rmse_m", "rpe_trans_m_rmse", "rpe_rot_deg_rmse"] {
            let theirs = number(&evo[format!("{name}_{freedom}")]);
            let ours = number(&ours[freedom][name]);
            assert!(
                (ours - theirs).abs() < 1e-9 * theirs,
                "{name}_{freedom}: {ours} against {theirs}"
            );
        }
    }
    assert!((number(&ours["sim3"]["scale"]) - number(&evo["sim3_scale"])).abs() < 1e-9);
    // The printed table has the same digits.
    assert!(compare(&[]).contains("0.013470088849"), "ATE, rigid");
}
