//! The arrays and exports of a reconstruction folder.

use super::{FolderError, Manifest};
use crate::clip::clock::SIGNAL_RATE;
use crate::geometry::rigid::Rigid;
use crate::geometry::skeleton::{BODY, HAND, Joints};
use crate::reconstruction::export::files::Files;
use crate::reconstruction::export::gltf::{Camera, Wearer, write_glb};
use crate::reconstruction::export::manifest::ArrayFacts;
use crate::reconstruction::export::ply::write_ply;
use crate::reconstruction::predictions::ScaleStatus;
use crate::reconstruction::result::Reconstruction;
use crate::reconstruction::samples;
use nalgebra::Point3;
use ndarray::Array1;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

impl Reconstruction {
    pub(super) fn write_tracks(
        &self,
        path: &Path,
        manifest: &mut Manifest,
    ) -> Result<(), FolderError> {
        let frames = (self.video.len(), self.info.video_rate);
        let mut files = Files::new(path, self.info.intrinsics, frames);
        for (_, track) in self.tracks.iter() {
            track.write(&mut files)?;
        }
        for (name, values) in &self.certainty {
            let facts = files.facts(
                name,
                "0 (a guess) to 1 (certain)",
                "of the tokens, by their entropy; not an accuracy",
                ScaleStatus::None,
                None,
            );
            files.array("certainty.npz", Array1::from(values.clone()), facts);
        }
        let (arrays, names) = files.finish()?;
        manifest.arrays.extend(arrays);
        manifest.files.extend(names);
        Ok(())
    }

    /// Skeletons and camera in one scene; nothing where neither was reconstructed.
    pub(super) fn write_scene(
        &self,
        path: &Path,
        manifest: &mut Manifest,
    ) -> Result<(), FolderError> {
        let cameras = self.tracks.camera();
        // Hands are known in the camera; the scene has one world.
        let in_world = |poses: &[Joints]| -> Vec<Joints> {
            let place = |(pose, camera): (&Joints, &Rigid)| {
                pose.map(|p| {
                    let at = camera * Point3::from(p.map(f64::from));
                    [at.x as f32, at.y as f32, at.z as f32]
                })
            };
            poses.iter().zip(cameras).map(place).collect()
        };
        let left = in_world(self.tracks.left_hand());
        let right = in_world(self.tracks.right_hand());
        let parts = [
            ("body", &BODY, self.tracks.body(), [0.47, 0.86, 0.55]),
            ("left_hand", &HAND, left.as_slice(), [0.27, 0.67, 1.0]),
            ("right_hand", &HAND, right.as_slice(), [1.0, 0.43, 0.27]),
        ];
        let wearers = parts.map(|(name, skeleton, poses, colour)| Wearer {
            name,
            skeleton,
            poses,
            colour,
        });
        if cameras.is_empty() && wearers.iter().all(|wearer| wearer.poses.is_empty()) {
            return Ok(());
        }
        let camera = Camera {
            poses: cameras,
            intrinsics: &self.info.intrinsics,
        };
        write_file(path, "scene.glb", &mut manifest.files, |out| {
            write_glb(SIGNAL_RATE, &wearers, Some(&camera), out).map_err(FolderError::io(path))
        })
    }

    /// All samples and how far they spread, where there are several: `samples.npz`.
    pub(super) fn write_samples(
        &self,
        path: &Path,
        manifest: &mut Manifest,
    ) -> Result<(), FolderError> {
        if self.samples.is_empty() {
            return Ok(());
        }
        let (npz, arrays) = samples::arrays(&self.samples);
        npz.write(&path.join(samples::FILE))?;
        manifest.arrays.extend(arrays);
        manifest.files.push(samples::FILE.into());
        Ok(())
    }

    pub(super) fn write_points(
        &self,
        path: &Path,
        manifest: &mut Manifest,
    ) -> Result<(), FolderError> {
        if self.cloud.is_empty() {
            return Ok(());
        }
        let note = format!("reviv: world, z up, {}", manifest.scale.words());
        write_file(path, "points.ply", &mut manifest.files, |out| {
            write_ply(&self.cloud, &note, out).map_err(FolderError::io(path))
        })
    }

    pub(super) fn write_depth(
        &self,
        path: &Path,
        manifest: &mut Manifest,
    ) -> Result<(), FolderError> {
        let frames = &self.depth.frames;
        if frames.frames() == 0 {
            return Ok(());
        }
        let is_metric = matches!(self.depth.scale, ScaleStatus::Metric { .. });
        let name = if is_metric { "metres" } else { "relative" };
        let of = |depth| self.depth.value(depth);
        let shape = frames.write_npz(&path.join("depth.npz"), name, of)?;
        manifest.files.push("depth.npz".into());
        manifest.arrays.push(ArrayFacts {
            file: "depth.npz".into(),
            name: name.into(),
            shape: shape.to_vec(),
            unit: if is_metric {
                "m"
            } else {
                "unknown scale and shift"
            }
            .into(),
            frame: "along the optical axis of the frame's camera, over the square image".into(),
            rate: Some(self.info.video_rate),
            scale: manifest.scale.clone(),
            validity: None,
        });
        Ok(())
    }
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
