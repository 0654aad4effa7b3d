//! Predictions of other systems, as the arrays they write, through a whole evaluation.

use ndarray::{Array2, Axis, Ix2};
use reviv::evaluation::evaluate::evaluate;
use reviv::evaluation::folders::Folders;
use reviv::evaluation::statistics::summarise;
use reviv::evaluation::suite::Suite;
use reviv::formats::npy;
use reviv::formats::npz::Npz;
use reviv::reconstruction::predictions::Predictions;

/// EgoM2P's example clip: true poses and gaze (pixels of 896x504, centre crop 480), and its tokenizers' reconstructions.
#[test]
fn the_arrays_of_egom2p_are_scored_against_their_truth() {
    let Some(shared) = crate::shared::folder() else {
        return;
    };
    let examples = shared.join("data/egom2p_examples");
    let folder = tempfile::tempdir().unwrap();
    let (truth, guess) = (folder.path().join("truth"), folder.path().join("egom2p"));
    std::fs::create_dir_all(&truth).unwrap();
    std::fs::create_dir_all(&guess).unwrap();
    let pixels: Array2<f64> = npy::read(&examples.join("gaze.npy"))
        .unwrap()
        .to_dim::<f64, Ix2>()
        .unwrap();
    let mut gaze = pixels;
    for (axis, size) in [(0, 896.0), (1, 504.0)] {
        gaze.index_axis_mut(Axis(1), axis)
            .mapv_inplace(|p| (p - (size - 480.0) / 2.0) / 480.0);
    }
    Npz::default()
        .with("camera", npy::read(&examples.join("cam.npy")).unwrap())
        .with("gaze", gaze)
        .write(&truth.join("holoassist.npz"))
        .unwrap();
    Npz::default()
        .with(
            "cam",
            npy::read(&examples.join("token/cam-recon.npy")).unwrap(),
        )
        .with(
            "gaze",
            npy::read(&examples.join("token/gaze-recon.npy")).unwrap(),
        )
        .write(&guess.join("holoassist.npz"))
        .unwrap();

    let folders = Folders::new(
        Predictions::open(&truth).unwrap(),
        Predictions::open(&guess).unwrap(),
    )
    .unwrap();
    let suite = Suite {
        metrics: ["camera.ate", "camera.rte", "camera.rre", "gaze.mse"]
            .map(str::to_owned)
            .to_vec(),
        ..Suite::default()
    };
    let scores = evaluate(
        "egom2p",
        &suite,
        "EgoM2P tokenizers",
        &folders,
        None,
        &mut |_, _| true,
    )
    .unwrap();
    let mean = |set: &reviv::evaluation::scores::ScoreSet, name: &str| {
        summarise(&set.column(name).unwrap().values).mean.unwrap()
    };
    let own = &scores.own;
    assert!(
        mean(own, "camera.ate") < 0.05,
        "a reconstruction follows the true path"
    );
    assert!(mean(own, "gaze.mse") < mean(&scores.baselines["image centre"], "gaze.mse"));
    assert!(
        mean(own, "camera.rre") > 0.0
            && mean(&scores.baselines["still camera"], "camera.rre") > 0.0
    );
}
