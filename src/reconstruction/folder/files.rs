//! The arrays and exports of a reconstruction folder.

use super::{Folder, FolderError, Manifest, NEAREST};
use crate::clip::clock::SIGNAL_RATE;
use crate::geometry::rigid::{Rigid, to_row_major};
use crate::geometry::skeleton::{BODY, HAND, JOINTS};
use crate::reconstruction::export::bvh::{from_camera, from_z_up, write_bvh};
use crate::reconstruction::export::camera::{write_colmap, write_tum};
use crate::reconstruction::export::manifest::{ArrayFacts, ArrayFile};
use crate::reconstruction::export::ply::{Point, write_ply};
use crate::reconstruction::export::write_gaze;
use crate::reconstruction::predictions::ScaleStatus;
use crate::reconstruction::stitch::{Joints, Tracks};
use ndarray::{Array2, Array3};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

impl Folder {
    pub(super) fn write_tracks(
        &self,
        tracks: &Tracks,
        manifest: &mut Manifest,
    ) -> Result<(), FolderError> {
        let path = &self.path;
        let learned = ScaleStatus::Metric {
            by: "learning from metric data".into(),
        };
        let facts =
            |name: &str, unit: &str, frame: &str, scale: &ScaleStatus, validity: Option<&str>| {
                ArrayFacts {
                    file: String::new(),
                    name: name.into(),
                    shape: Vec::new(),
                    unit: unit.into(),
                    frame: frame.into(),
                    rate: Some(SIGNAL_RATE),
                    scale: scale.clone(),
                    validity: validity.map(Into::into),
                }
            };
        let world = "world: z up, origin and heading of the first camera";
        let io = |error| FolderError::Io {
            path: path.clone(),
            error,
        };
        if !tracks.camera.is_empty() {
            let matrices: Vec<f64> = tracks.camera.iter().flat_map(to_row_major).collect();
            let array = Array3::from_shape_vec((tracks.camera.len(), 4, 4), matrices)
                .expect("sixteen numbers a pose");
            let note = facts("T_world_camera", "m", world, &learned, None);
            manifest.files.push("camera.npz".into());
            manifest.arrays.extend(
                ArrayFile::default()
                    .with(&array, note)
                    .write(path, "camera.npz")?,
            );
            write_file(path, "camera.tum", &mut manifest.files, |out| {
                write_tum(SIGNAL_RATE, &tracks.camera, out).map_err(io)
            })?;
            let at_frames: Vec<Rigid> = (0..self.video.len())
                .map(|frame| tracks.camera[self.sample_of(frame, tracks.camera.len())])
                .collect();
            write_colmap(&path.join("colmap"), &at_frames, &self.setting.intrinsics).map_err(io)?;
            for name in ["cameras.txt", "images.txt", "points3D.txt"] {
                manifest.files.push(format!("colmap/{name}"));
            }
        }
        if !tracks.gaze.is_empty() {
            write_file(path, "gaze.csv", &mut manifest.files, |out| {
                write_gaze(SIGNAL_RATE, &tracks.gaze, out).map_err(io)
            })?;
        }
        let camera = "camera of the same sample, OpenCV axes";
        let mut hands = ArrayFile::default();
        for (name, joints) in [
            ("left_hand", &tracks.left_hand),
            ("right_hand", &tracks.right_hand),
        ] {
            if joints.is_empty() {
                continue;
            }
            let (values, valid) = joint_arrays(joints);
            let validity = format!("{name}_valid");
            hands = hands
                .with(&values, facts(name, "m", camera, &learned, Some(&validity)))
                .with(
                    &valid,
                    facts(&validity, "true or false", camera, &ScaleStatus::None, None),
                );
            // A hand that is never seen whole has no motion to write.
            if joints
                .iter()
                .any(|pose| pose.iter().flatten().all(|v| v.is_finite()))
            {
                write_file(path, &format!("{name}.bvh"), &mut manifest.files, |out| {
                    write_bvh(&HAND, joints, SIGNAL_RATE, &from_camera(), out).map_err(io)
                })?;
            }
        }
        let written = hands.write(path, "hands.npz")?;
        if !written.is_empty() {
            manifest.files.push("hands.npz".into());
            manifest.arrays.extend(written);
        }
        if !tracks.body.is_empty() {
            let (values, valid) = joint_arrays(&tracks.body);
            let body = ArrayFile::default()
                .with(
                    &values,
                    facts("body", "m", world, &learned, Some("body_valid")),
                )
                .with(
                    &valid,
                    facts(
                        "body_valid",
                        "true or false",
                        world,
                        &ScaleStatus::None,
                        None,
                    ),
                );
            manifest.files.push("body.npz".into());
            manifest.arrays.extend(body.write(path, "body.npz")?);
            write_file(path, "body.bvh", &mut manifest.files, |out| {
                write_bvh(&BODY, &tracks.body, SIGNAL_RATE, &from_z_up(), out).map_err(io)
            })?;
        }
        Ok(())
    }

    pub(super) fn write_points(
        &self,
        cloud: &[Point],
        manifest: &mut Manifest,
    ) -> Result<(), FolderError> {
        if cloud.is_empty() {
            return Ok(());
        }
        let note = format!("reviv: world, z up, {}", manifest.scale.words());
        write_file(&self.path, "points.ply", &mut manifest.files, |out| {
            write_ply(cloud, &note, out).map_err(|error| FolderError::Io {
                path: self.path.clone(),
                error,
            })
        })
    }

    pub(super) fn write_depth(self, manifest: &mut Manifest) -> Result<(), FolderError> {
        if self.spool.frames() == 0 {
            return Ok(());
        }
        let (scale, shift) = manifest
            .fit
            .map_or((1.0, 0.0), |f| (f.scale as f32, f.shift as f32));
        let name = if manifest.fit.is_some() {
            "metres"
        } else {
            "relative"
        };
        let shape =
            self.spool
                .write_npz(&self.path.join("depth.npz"), name, [scale, shift], NEAREST)?;
        manifest.files.push("depth.npz".into());
        manifest.arrays.push(ArrayFacts {
            file: "depth.npz".into(),
            name: name.into(),
            shape: shape.to_vec(),
            unit: if manifest.fit.is_some() {
                "m"
            } else {
                "unknown scale and shift"
            }
            .into(),
            frame: "along the optical axis of the frame's camera, over the square image".into(),
            rate: Some(self.setting.video_rate),
            scale: manifest.scale.clone(),
            validity: None,
        });
        Ok(())
    }
}

fn joint_arrays(joints: &[Joints]) -> (Array3<f32>, Array2<bool>) {
    let values = Array3::from_shape_fn((joints.len(), JOINTS, 3), |(t, j, k)| joints[t][j][k]);
    let valid = Array2::from_shape_fn((joints.len(), JOINTS), |(t, j)| {
        joints[t][j].iter().all(|v| v.is_finite())
    });
    (values, valid)
}
pub(super) fn write_file(
    folder: &Path,
    name: &str,
    files: &mut Vec<String>,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), FolderError>,
) -> Result<(), FolderError> {
    let path = folder.join(name);
    let io = |error| FolderError::Io {
        path: path.clone(),
        error,
    };
    let mut out = BufWriter::new(File::create(&path).map_err(io)?);
    write(&mut out)?;
    out.flush().map_err(io)?;
    files.push(name.into());
    Ok(())
}
