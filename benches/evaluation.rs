//! Evaluating 1000 clips of body and camera, in memory and from disk: `cargo bench --bench evaluation`.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::disallowed_methods)]

use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use ndarray::{Array2, Array3};
use rand::RngExt;
use reviv::clip::{BODY, CAMERA, CameraTrack, Clip, JointTrack};
use reviv::evaluation::evaluate::{LoadError, Pairs, evaluate};
use reviv::evaluation::folders::Folders;
use reviv::evaluation::suite::Suite;
use reviv::reconstruction::predictions::{Predictions, PredictionsWriter};
use std::collections::BTreeMap;
use std::time::Instant;

const CLIPS: usize = 1000;

struct Memory {
    ids: Vec<String>,
    truth: Vec<Clip>,
    prediction: Vec<Clip>,
}

impl Pairs for Memory {
    fn ids(&self) -> &[String] {
        &self.ids
    }
    fn truth(&self, index: usize) -> Result<Clip, LoadError> {
        Ok(self.truth[index].clone())
    }
    fn prediction(&self, index: usize) -> Result<Option<Clip>, LoadError> {
        Ok(Some(self.prediction[index].clone()))
    }
}

fn clip(index: usize, noise: &str) -> Clip {
    let mut rng = reviv::random::stream(0, noise, index as u64, 0);
    let mut next = || rng.random::<f64>();
    let mut clip = Clip::empty(format!("bench/{index:06}"), "bench");
    let poses = (0..60)
        .map(|i| {
            let turn = UnitQuaternion::from_euler_angles(0.1 * next(), 0.1 * next(), 0.1 * next());
            Isometry3::from_parts(Translation3::new(0.05 * f64::from(i), next(), next()), turn)
        })
        .collect();
    clip.set(
        CAMERA,
        CameraTrack {
            rate: 30.0,
            T_world_camera: poses,
            valid: vec![true; 60],
            up_world: None,
            intrinsics: None,
        },
    );
    clip.set(
        BODY,
        JointTrack {
            rate: 30.0,
            joints: Array3::from_shape_fn((60, 21, 3), |_| next() as f32),
            valid: Array2::from_elem((60, 21), true),
        },
    );
    clip
}

fn main() {
    let truth: Vec<Clip> = (0..CLIPS).map(|i| clip(i, "truth")).collect();
    let prediction: Vec<Clip> = (0..CLIPS).map(|i| clip(i, "prediction")).collect();
    let suite = Suite {
        metrics: [
            "body.ga_mpjpe",
            "body.pa_mpjpe",
            "body.kin_fid",
            "body.kin_cos",
            "camera.ate",
            "camera.rte",
            "camera.rre",
        ]
        .map(str::to_owned)
        .to_vec(),
        ..Suite::default()
    };
    let time = |name: &str, pairs: &dyn Pairs| {
        let start = Instant::now();
        let scores = evaluate("bench", &suite, "bench", pairs, None, &mut |_, _| true).unwrap();
        println!(
            "{name}: {} clips in {:.2} s",
            scores.clips.len(),
            start.elapsed().as_secs_f64()
        );
    };

    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, clips: &[Clip]| {
        let path = folder.path().join(name);
        let mut writer = PredictionsWriter::create(&path, name, BTreeMap::new()).unwrap();
        for clip in clips {
            writer.add(clip, &BTreeMap::new()).unwrap();
        }
        writer.finish().unwrap();
        Predictions::open(&path).unwrap()
    };
    let folders =
        Folders::new(write("truth", &truth), write("prediction", &prediction)).expect("no floor");
    let ids = truth.iter().map(|c| c.id.clone()).collect();
    time(
        "in memory",
        &Memory {
            ids,
            truth,
            prediction,
        },
    );
    time("from disk", &folders);
}
