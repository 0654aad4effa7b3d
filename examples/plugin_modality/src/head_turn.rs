//! `head_turn`: how fast the head turns, about the three axes of the camera, computed from the camera's path.
//!
//! Two things are submitted at link time: the registry entry that says what the signal is, and the code that computes it. There is
//! nothing else to register; both are found because they are linked into the binary that runs.

use ndarray::{Array1, Array2};
use reviv::clip::{Clip, Signal};
use reviv::experiment::LinkedEntry;
use reviv::modality::code::SignalCode;
use reviv::modality::{DeclaredSettings, ModalityError};

inventory::submit! {
    LinkedEntry {
        origin: "plugin_modality 0.1",
        text: include_str!("head_turn.yaml"),
    }
}

inventory::submit! {
    SignalCode {
        name: "head_turn",
        about: "Angular velocity of the camera from consecutive orientations.",
        derive,
    }
}

/// `[T, 3]` rad/s in the axes of the camera of the same sample. The last sample has no next one and takes the one before.
fn derive(clip: &Clip, settings: &DeclaredSettings) -> Result<Option<Signal>, ModalityError> {
    let Some(camera) = clip.camera() else {
        return Ok(None);
    };
    let poses = &camera.T_world_camera;
    if poses.len() < 2 || camera.rate != settings.signal.rate {
        return Err(ModalityError::Degenerate {
            clip: clip.id.clone(),
            modality: settings.name.clone(),
            reason: format!(
                "{} poses at {} Hz, declared at {} Hz",
                poses.len(),
                camera.rate,
                settings.signal.rate
            ),
        });
    }
    let mut values = Array2::zeros((poses.len(), 3));
    let mut valid = Array1::from_elem(poses.len(), true);
    for t in 0..poses.len() {
        let from = t.min(poses.len() - 2);
        let turn = poses[from].rotation.inverse() * poses[from + 1].rotation;
        let velocity = turn.scaled_axis() * camera.rate;
        for axis in 0..3 {
            values[[t, axis]] = velocity[axis] as f32;
        }
        valid[t] = camera.valid[from] && camera.valid[from + 1];
    }
    Ok(Some(Signal {
        values: values.into_dyn(),
        valid: Some(valid.into_dyn()),
    }))
}
