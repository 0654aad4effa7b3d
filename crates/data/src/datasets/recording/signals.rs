//! Camera, gaze and joints of a clip, sampled on its clock.

use super::pictures::pinhole;
use super::{CutSettings, GAZE_RANGE, GazeSample, Recording};
use crate::clip::clock::SIGNAL_RATE;
use crate::clip::frames::WorldJoints;
use crate::clip::{CameraTrack, GazeTrack, Intrinsics};
use crate::datasets::track::{Joints, Track};
use crate::geometry::camera::{Camera, Lens};
use crate::video::image::{SquareFit, Turn};
use nalgebra::{Isometry3, Point3, Vector2, Vector3};
use ndarray::{Array1, Array2};

impl Recording {
    /// Where the wearer looks at `time`: in units of the square picture, unbounded. `None` where it is not known or the point is
    /// behind the camera.
    #[must_use]
    pub fn gaze_at(&self, time: i64, settings: &CutSettings) -> Option<[f64; 2]> {
        let sample = self.gaze.as_ref()?.at(time)?;
        let mounted = self.mounted(time);
        let shown = |camera: &Camera| match settings.undistort {
            Some(angle) => pinhole(camera, angle, camera.width.min(camera.height)),
            None => camera.clone(),
        };
        // Where a direction in the camera falls in the upright picture, and that picture's size.
        let project = |camera: &Camera, direction: &Vector3<f64>| {
            let camera = shown(camera);
            let pixel = camera.project(direction)?;
            let (w, h) = (f64::from(camera.width), f64::from(camera.height));
            let (width, height) = self.turn.size(camera.width, camera.height);
            let pixel = self.turn.pixel(pixel.x, pixel.y, w, h);
            Some((pixel, f64::from(width), f64::from(height)))
        };
        let ((u, v), width, height) = match sample {
            GazeSample::Pixel {
                pixel: [u, v],
                size: [width, height],
            } => match mounted {
                Some(mounted) if settings.undistort.is_some() && mounted.has_lens() => {
                    let camera = &mounted.camera;
                    let (w, h) = self.turn.size(camera.width, camera.height);
                    let (w, h) = (f64::from(w), f64::from(h));
                    let back = self.turn.inverse();
                    let (u, v) = back.pixel(u * w / width, v * h / height, w, h);
                    project(camera, &camera.unproject(&Vector2::new(u, v))?)?
                }
                _ => ((u, v), width, height),
            },
            GazeSample::Aria(gaze, pupils) => {
                let mounted = mounted?;
                let distance = if settings.gaze_vergence && gaze.depth > 0.0 {
                    gaze.depth
                } else {
                    settings.gaze_distance
                };
                let point = mounted.T_device_camera.inverse() * gaze.point(&pupils, distance);
                project(&mounted.camera, &point.coords)?
            }
        };
        let side = width.min(height);
        Some([
            (u - (width - side) / 2.0) / side,
            (v - (height - side) / 2.0) / side,
        ])
    }

    pub(super) fn camera_track(
        &self,
        ticks: &[i64],
        settings: &CutSettings,
    ) -> Option<CameraTrack> {
        self.device.as_ref()?;
        let poses: Vec<Option<Isometry3<f64>>> =
            ticks.iter().map(|tick| self.pose(*tick)).collect();
        let valid = poses.iter().map(Option::is_some).collect();
        // A missing pose repeats the last known one: readers that ignore validity get no jump to the origin.
        let mut last = poses
            .iter()
            .flatten()
            .next()
            .copied()
            .unwrap_or_else(Isometry3::identity);
        let T_world_camera = poses
            .into_iter()
            .map(|pose| {
                last = pose.unwrap_or(last);
                last
            })
            .collect();
        Some(CameraTrack {
            rate: SIGNAL_RATE,
            T_world_camera,
            valid,
            up_world: self.up_world,
            intrinsics: self.intrinsics(ticks[0], settings),
        })
    }

    /// Pinhole intrinsics of the clip's frames, where the frames are pinhole pictures.
    pub(super) fn intrinsics(&self, time: i64, settings: &CutSettings) -> Option<Intrinsics> {
        let camera = &self.mounted(time)?.camera;
        let camera = match (settings.undistort, &camera.lens) {
            (Some(angle), _) => pinhole(camera, angle, settings.side),
            (None, Lens::Pinhole(_)) => {
                let fit = SquareFit::new(camera.width, camera.height, settings.side);
                let scale = f64::from(settings.side) / f64::from(camera.width.min(camera.height));
                camera.resized(scale).cropped(
                    f64::from(fit.left),
                    f64::from(fit.top),
                    fit.side,
                    fit.side,
                )
            }
            _ => return None,
        };
        let Lens::Pinhole(lens) = camera.lens else {
            return None;
        };
        let size = f64::from(settings.side);
        let (cx, cy) = self.turn.pixel(lens.cx, lens.cy, size, size);
        let (fx, fy) = match self.turn {
            Turn::None | Turn::Half => (lens.fx, lens.fy),
            Turn::Clockwise | Turn::CounterClockwise => (lens.fy, lens.fx),
        };
        Some(Intrinsics {
            fx,
            fy,
            cx,
            cy,
            width: settings.side,
            height: settings.side,
        })
    }

    pub(super) fn gaze_track(&self, ticks: &[i64], settings: &CutSettings) -> GazeTrack {
        let mut points = Array2::zeros((ticks.len(), 2));
        let mut valid = Array1::from_elem(ticks.len(), false);
        for (k, tick) in ticks.iter().enumerate() {
            if let Some([u, v]) = self.gaze_at(*tick, settings)
                && GAZE_RANGE.contains(&u)
                && GAZE_RANGE.contains(&v)
            {
                points[[k, 0]] = u as f32;
                points[[k, 1]] = v as f32;
                valid[k] = true;
            }
        }
        GazeTrack {
            rate: SIGNAL_RATE,
            points,
            valid,
        }
    }
}

pub(super) fn world_joints(track: &Track<Joints>, ticks: &[i64]) -> WorldJoints {
    ticks
        .iter()
        .map(|tick| match track.at(*tick) {
            Some(joints) => joints.to_vec(),
            None => vec![None::<Point3<f64>>; 21],
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::datasets::recording::MountedCamera;
    use crate::geometry::camera::Pinhole;

    #[test]
    fn a_gaze_pixel_goes_where_the_undistorted_picture_shows_it() {
        let mut recording = Recording::new("mine", "one");
        recording.turn = Turn::Clockwise;
        let lens = Lens::Pinhole(Pinhole {
            fx: 25.0,
            fy: 25.0,
            cx: 49.5,
            cy: 49.5,
        });
        let camera = Camera {
            lens,
            width: 100,
            height: 100,
            valid_radius: None,
        };
        let T_device_camera = Isometry3::identity();
        let mounted = MountedCamera {
            camera,
            T_device_camera,
        };
        recording.cameras = vec![(0, mounted)];
        // Half as far right of the centre as in front of it, given in a picture of twice the camera's size.
        let sample = GazeSample::Pixel {
            pixel: [2.0 * (49.5 + 12.5), 2.0 * 49.5],
            size: [200.0; 2],
        };
        recording.gaze = Some(Track::new(vec![(0, sample)], 1, 1));
        let gaze = |undistort| {
            let settings = CutSettings {
                undistort,
                ..CutSettings::default()
            };
            recording.gaze_at(0, &settings).unwrap()
        };
        assert_eq!(gaze(None), [0.62, 0.495]);
        let [u, v] = gaze(Some(90.0));
        assert!(
            (u - 0.745).abs() < 1e-9 && (v - 0.495).abs() < 1e-9,
            "{u} {v}"
        );
    }
}
