//! The language: layers, references, substitutions, sweeps.

use crate::language_ops::{Folder, TINY};
use serde_json::json;

#[test]
fn an_experiment_becomes_a_graph_with_every_default_filled_in() {
    let folder = Folder::new(&[("tiny.yaml", TINY)]);
    let experiment = folder.sound("tiny.yaml", &[]);
    let graph = &experiment.cells[0].graph;
    let names: Vec<&str> = graph.stages.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["clips", "tok_body", "tok_camera", "mget", "scores"]);
    assert_eq!(
        graph.find("clips").unwrap().settings,
        json!({
            "source": {"use": "world_small", "rooms": 2, "data": null},
            "train": 20, "only": null, "keep_invalid": false,
        })
    );
    assert_eq!(
        graph.find("mget").unwrap().settings["masking"],
        json!({"use": "dirichlet", "policy": "dirichlet", "alpha": 0.5})
    );
    assert_eq!(graph.find("mget").unwrap().edges[0].from, [1, 2]);
    let plan = graph.plan(graph.find("mget").unwrap());
    assert_eq!(plan.parameters, Some((512 + 256) * 16));
}
