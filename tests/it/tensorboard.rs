//! The real TensorBoard reads what we write. Skips, and says so, where the package is not installed.

use reviv::run::metrics::Metrics;
use reviv::run::tensorboard::SessionStatus;
use serde_json::{Value, json};
use std::process::Command;

const READ: &str = r#"
import json, sys
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2
acc = EventAccumulator(sys.argv[1], size_guidance={"scalars": 0, "tensors": 0, "histograms": 0})
acc.Reload()
tags = acc.Tags()
def tensors(tag):
    return [(e.step, e.tensor_proto) for e in acc.Tensors(tag)]
def scalar(tag):
    if tag in tags["scalars"]:
        return [(e.step, e.value) for e in acc.Scalars(tag)]
    from tensorboard.util import tensor_util
    return [(s, float(tensor_util.make_ndarray(t))) for s, t in tensors(tag)]
def histogram(tag):
    if tag in tags["histograms"]:
        h = acc.Histograms(tag)[0].histogram_value
        return [h.num, h.min, h.max, h.sum]
    from tensorboard.util import tensor_util
    rows = tensor_util.make_ndarray(tensors(tag)[0][1])
    return [float(rows[:, 2].sum()), float(rows[0, 0]), float(rows[-1, 1]), None]
def plugin(tag):
    data = plugin_data_pb2.HParamsPluginData()
    data.ParseFromString(acc.SummaryMetadata(tag).plugin_data.content)
    return data
start = plugin("_hparams_/session_start_info").session_start_info
end = plugin("_hparams_/session_end_info").session_end_info
experiment = plugin("_hparams_/experiment").experiment
text = tensors("note")[0][1].string_val[0].decode()
print(json.dumps({
    "loss": scalar("loss"), "weights": histogram("weights"), "text": text,
    "text_plugin": acc.SummaryMetadata("note").plugin_data.plugin_name,
    "hparams": {k: getattr(v, v.WhichOneof("kind")) for k, v in start.hparams.items()},
    "names": sorted(i.name for i in experiment.hparam_infos), "status": end.status,
}))
"#;

/// The interpreter with the package: `$REVIV_PYTHON`, or the first `python3`.
fn python() -> Option<String> {
    let python = std::env::var("REVIV_PYTHON").unwrap_or_else(|_| "python3".into());
    let found = Command::new(&python)
        .args(["-c", "import tensorboard"])
        .output();
    if found.is_ok_and(|output| output.status.success()) {
        return Some(python);
    }
    crate::skipped::skipped(&format!(
        "`{python}` has no tensorboard (pip install tensorboard, or set REVIV_PYTHON)"
    ));
    None
}

#[test]
fn the_real_tensorboard_reads_scalars_text_histograms_hparams_and_the_rewind() {
    let Some(python) = python() else {
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let hparams = vec![
        ("steps".to_owned(), json!(8)),
        ("masking.use".to_owned(), json!("uniform")),
        ("mixed".to_owned(), json!(true)),
    ];
    let mut first = Metrics::open(dir.path(), hparams.clone()).unwrap();
    first.text(0, "note", "**bold** text, ünïcode").unwrap();
    first
        .histogram(0, "weights", &[1.0, 2.0, 2.0, 5.0, f32::NAN])
        .unwrap();
    for step in 1..=6 {
        first.scalars(step, &[("loss", step as f64)]).unwrap();
    }
    first.flush().unwrap();
    drop(first);
    // A kill; the checkpoint was at step 3.
    let mut second = Metrics::open(dir.path(), hparams).unwrap();
    for step in 4..=8 {
        second.scalars(step, &[("loss", -(step as f64))]).unwrap();
    }
    second.finish(SessionStatus::Success).unwrap();

    let output = Command::new(python)
        .args(["-c", READ])
        .arg(dir.path())
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let read: Value = serde_json::from_slice(&output.stdout).unwrap();
    let loss = json!([
        [1, 1.0],
        [2, 2.0],
        [3, 3.0],
        [4, -4.0],
        [5, -5.0],
        [6, -6.0],
        [7, -7.0],
        [8, -8.0]
    ]);
    assert_eq!(read["loss"], loss);
    assert_eq!(read["weights"][0], 4.0);
    assert_eq!(read["text"], "**bold** text, ünïcode");
    assert_eq!(read["text_plugin"], "text");
    assert_eq!(
        read["hparams"],
        json!({"steps": 8.0, "masking.use": "uniform", "mixed": true})
    );
    assert_eq!(read["names"], json!(["masking.use", "mixed", "steps"]));
    assert_eq!(read["status"], 1);
}
