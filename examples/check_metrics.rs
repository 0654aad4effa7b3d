//! Checks the metrics against a folder of test vectors: `cargo run --example check_metrics DIR`.
//!
//! `DIR/expected.json` lists cases `{id, metric, file, params, expect | error, tol}`; every case is an npz beside it. Keys that
//! `expect` does not name are not compared; a case with `error` must be refused. The last line is `passed/total`; the exit
//! code is 1 when a case fails.
#![allow(clippy::print_stdout)]

use ndarray::{Array, Dimension, Ix1, Ix2, Ix3, Ix4};
use reviv::evaluation::Outcome;
use reviv::evaluation::depth::{Scored, Space, depth_errors};
use reviv::evaluation::gaze::gaze_errors;
use reviv::evaluation::joints::{
    HandMode, JointErrors, Valid, joint_errors, pair_of_hands, reconstruction_mm,
};
use reviv::evaluation::motion::{
    frechet_distance, kin_scores, kinematic_descriptor, mean_cosine, score01,
};
use reviv::evaluation::runtime::runtime;
use reviv::evaluation::tokens::codebook_use;
use reviv::evaluation::trajectory::{poses_from_matrices, trajectory_errors};
use reviv::formats::npy::Element;
use reviv::formats::npz::Npz;
use reviv::geometry::alignment::Freedom;
use serde_json::{Map, Value, json};
use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

fn main() -> ExitCode {
    let Some(directory) = std::env::args_os().nth(1).map(PathBuf::from) else {
        eprintln!("usage: check_metrics DIR    (a folder with expected.json and one npz per case)");
        return ExitCode::from(1);
    };
    match check_all(&directory) {
        Ok((passed, total)) => {
            println!("{passed}/{total}");
            ExitCode::from(u8::from(passed != total || total == 0))
        }
        Err(error) => {
            eprintln!("{}: {error}", directory.display());
            ExitCode::from(1)
        }
    }
}

pub fn check_all(directory: &Path) -> Result<(usize, usize), Box<dyn Error>> {
    let text = std::fs::read_to_string(directory.join("expected.json"))?;
    let expected: Value = serde_json::from_str(&text)?;
    let cases = expected["cases"]
        .as_array()
        .ok_or("expected.json has no list `cases`")?;
    let mut passed = 0;
    for case in cases {
        match check(directory, case) {
            Ok(()) => passed += 1,
            Err(reason) => println!("FAIL {}: {reason}", text_of(case, "id")),
        }
    }
    Ok((passed, cases.len()))
}

/// The reason of the failure, if there is one.
fn check(directory: &Path, case: &Value) -> Result<(), String> {
    let npz = Npz::read(&directory.join(text_of(case, "file")))
        .map_err(|e| format!("cannot be read: {e}"))?;
    let computed = compute(text_of(case, "metric"), &npz, &case["params"]);
    if let Some(error) = case.get("error") {
        return match computed {
            Ok(values) => Err(format!("must be refused ({error}), got {values:?}")),
            Err(failure) if failure.is::<reviv::evaluation::MetricError>() => Ok(()),
            Err(failure) => Err(format!("failed instead of refusing: {failure}")),
        };
    }
    let computed = computed.map_err(|e| format!("refused: {e}"))?;
    let expect = case["expect"]
        .as_object()
        .ok_or("has neither `expect` nor `error`")?;
    let tolerance = |key: &str| case["tol"][key].as_f64().unwrap_or(0.0);
    for (key, want) in expect {
        let got = computed
            .get(key)
            .ok_or_else(|| format!("`{key}` is not computed"))?;
        let equal = match (want.as_f64(), got.as_f64()) {
            (Some(want), Some(got)) => {
                (want - got).abs() <= tolerance("abs") + tolerance("rel") * want.abs()
            }
            _ => want == got,
        };
        if !equal {
            return Err(format!("`{key}` is {got}, expected {want}"));
        }
    }
    Ok(())
}

fn compute(metric: &str, npz: &Npz, params: &Value) -> Result<Map<String, Value>, Box<dyn Error>> {
    let index = |key: &str, default: u64| params[key].as_u64().unwrap_or(default) as usize;
    let flag = |key: &str| params[key].as_bool().unwrap_or(false);
    let values = match metric {
        "mpjpe_family" => {
            let e = joints(npz, "pred", "gt", "valid", index("root", 0))?;
            json!({
                "n_frames": e.n_frames, "n_points": e.n_points, "degenerate": e.ga_degenerate,
                "mpjpe": e.mpjpe, "ra": e.ra, "ga": e.ga, "ga_scale": e.ga_scale,
                "pa": e.pa, "pa_degenerate_frames": e.pa_degenerate_frames,
            })
        }
        "hand_pair" => {
            let left = joints(npz, "pred_l", "gt_l", "valid_l", index("root", 0))?;
            let right = joints(npz, "pred_r", "gt_r", "valid_r", index("root", 0))?;
            let mode = match params["mode"].as_str() {
                Some("compat") => HandMode::Compat,
                _ => HandMode::Strict,
            };
            let pair = |of: fn(&JointErrors) -> Outcome| {
                pair_of_hands([of(&left), of(&right)], mode).number()
            };
            json!({
                "mpjpe": pair(JointErrors::mpjpe_outcome), "ga": pair(JointErrors::ga_outcome),
                "ra": pair(JointErrors::ra_outcome), "pa": pair(JointErrors::pa_outcome),
            })
        }
        "trajectory" => {
            let estimate = poses_from_matrices(array::<f64, Ix3>(npz, "est")?.view(), "est")?;
            let reference = poses_from_matrices(array::<f64, Ix3>(npz, "ref")?.view(), "ref")?;
            let e = trajectory_errors(
                &estimate,
                &reference,
                index("delta", 1),
                Freedom::Similarity,
            )?;
            json!({
                "ate_rmse": e.ate_rmse, "ate_mean": e.ate_mean, "rte_rmse": e.rte_rmse, "rte_mean": e.rte_mean,
                "rte_tum_rmse": e.rte_tum_rmse, "rre_rmse": e.rre_rmse, "rre_mean": e.rre_mean,
                "still_rte_rmse": e.still_rte_rmse, "still_rte_mean": e.still_rte_mean,
                "still_rre_rmse": e.still_rre_rmse, "still_rre_mean": e.still_rre_mean,
                "sim3_scale": e.alignment.map(|a| a.scale), "degenerate": e.degenerate, "n_pairs": e.n_pairs,
            })
        }
        "gaze" => {
            let valid = optional::<bool, Ix1>(npz, "valid")?;
            let (pred, gt) = (
                array::<f64, Ix2>(npz, "pred")?,
                array::<f64, Ix2>(npz, "gt")?,
            );
            let e = gaze_errors(pred.view(), gt.view(), valid.as_ref().map(|v| v.view()))?;
            json!({"mse": e.mse, "l2": e.l2, "center_mse": e.center_mse, "n_valid": e.n_valid})
        }
        "depth" => {
            let (pred, gt) = (
                array::<f64, Ix3>(npz, "pred")?,
                array::<f64, Ix3>(npz, "gt")?,
            );
            let mask = optional::<bool, Ix3>(npz, "mask")?;
            let space = match params["space"].as_str() {
                None | Some("depth") => Space::Depth,
                Some("disparity") => Space::Disparity,
                Some("median") => Space::Median,
                Some("none") => Space::None,
                Some(other) => return Err(format!("unknown space `{other}`").into()),
            };
            let mask = mask.as_ref().map(|m| m.view());
            let range = Scored::between(params["dmin"].as_f64(), params["dmax"].as_f64());
            let e = depth_errors(pred.view(), gt.view(), mask, space, range)?;
            json!({
                "abs_rel": e.abs_rel, "delta_1_25": e.delta_1_25, "scale": e.scale, "shift": e.shift,
                "n_valid": e.n_valid, "degenerate": e.degenerate,
            })
        }
        "frechet" => {
            let (a, b) = (array::<f64, Ix2>(npz, "a")?, array::<f64, Ix2>(npz, "b")?);
            json!({"fid": frechet_distance(a.view(), b.view(), flag("normalize"))?})
        }
        "similarity" => {
            let (a, b) = (array::<f64, Ix2>(npz, "a")?, array::<f64, Ix2>(npz, "b")?);
            let cosine = mean_cosine(a.view(), b.view())?;
            json!({"cos": cosine, "score01": cosine.map(score01)})
        }
        "kin_scores" => {
            let rate = params["fps"].as_f64().unwrap_or(30.0);
            let descriptors = |name| -> Result<_, Box<dyn Error>> {
                let motions = array::<f64, Ix4>(npz, name)?;
                let rows: Vec<_> = motions
                    .outer_iter()
                    .map(|motion| {
                        kinematic_descriptor(motion, rate, index("root", 0), index("up", 2))
                    })
                    .collect();
                let views: Vec<_> = rows.iter().map(|r| r.view()).collect();
                Ok(ndarray::stack(ndarray::Axis(0), &views)?)
            };
            let scores = kin_scores(descriptors("pred")?.view(), descriptors("gt")?.view())?;
            json!({"kin_fid": scores.kin_fid, "kin_cos": scores.kin_cos, "n": scores.n, "dim": scores.dim})
        }
        "codebook" => {
            let ids = npz.get("ids")?.to::<i64>()?;
            let e = codebook_use(ids.iter().copied(), index("k", 0))?;
            json!({"usage": e.usage, "perplexity": e.perplexity, "distinct": e.distinct, "n_tokens": e.n_tokens})
        }
        "recon_mm" => {
            let (x, y) = (array::<f64, Ix3>(npz, "x")?, array::<f64, Ix3>(npz, "y")?);
            json!({"recon_mm": reconstruction_mm(x.view(), y.view())?})
        }
        "runtime" => {
            let samples = array::<f64, Ix1>(npz, "samples")?;
            let e = runtime(&samples.to_vec(), index("warmup", 3));
            json!({"median": e.median, "mean": e.mean, "p90": e.p90, "n": e.n})
        }
        other => return Err(format!("unknown metric `{other}`").into()),
    };
    match values {
        Value::Object(map) => Ok(map),
        _ => Err("no values".into()),
    }
}

fn joints(
    npz: &Npz,
    pred: &str,
    gt: &str,
    valid: &str,
    root: usize,
) -> Result<JointErrors, Box<dyn Error>> {
    let (pred, gt) = (array::<f64, Ix3>(npz, pred)?, array::<f64, Ix3>(npz, gt)?);
    let errors = match npz.arrays.get(valid) {
        None => joint_errors(pred.view(), gt.view(), Valid::All, root),
        Some(mask) if mask.shape.len() == 1 => {
            let mask = mask.to_dim::<bool, Ix1>()?;
            joint_errors(pred.view(), gt.view(), Valid::Frames(mask.view()), root)
        }
        Some(mask) => {
            let mask = mask.to_dim::<bool, Ix2>()?;
            joint_errors(pred.view(), gt.view(), Valid::Joints(mask.view()), root)
        }
    };
    Ok(errors?)
}

fn array<T: Element, D: Dimension>(npz: &Npz, name: &str) -> Result<Array<T, D>, Box<dyn Error>> {
    Ok(npz.get(name)?.to_dim::<T, D>()?)
}

fn optional<T: Element, D: Dimension>(
    npz: &Npz,
    name: &str,
) -> Result<Option<Array<T, D>>, Box<dyn Error>> {
    npz.arrays
        .contains_key(name)
        .then(|| array(npz, name))
        .transpose()
}

fn text_of<'a>(case: &'a Value, key: &str) -> &'a str {
    case[key].as_str().unwrap_or("?")
}
