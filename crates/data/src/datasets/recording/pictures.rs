//! Colour and depth of a clip: which frames, undistorted, upright, fitted to a square.

use super::{CutSettings, DEPTH_APART, Recording, TIE};
use crate::clip::{Depth, Rgb};
use crate::datasets::DropReason;
use crate::datasets::track::{SECOND, nearest};
use crate::formats::ReadError;
use crate::geometry::camera::{Camera, Lens, Pinhole};
use crate::geometry::undistortion::Remap;
use crate::video::image::{Image, SquareFit, Turn};
use nalgebra::Vector2;
use ndarray::{Array2, Array3, Array4};
use std::sync::Arc;

/// Colour and depth of a clip.
type ClipVideo = (Option<Rgb>, Option<Depth>);

impl Recording {
    /// Colour and depth from `start` on; the inner error is why the clip is dropped.
    pub(super) fn video(
        &self,
        start: i64,
        settings: &CutSettings,
    ) -> Result<Result<ClipVideo, DropReason>, ReadError> {
        let Some(colour) = &self.colour else {
            return Ok(Ok((None, None)));
        };
        let (times, missing) = match &self.depth {
            // Only frames whose depth was taken at the same moment take part.
            Some(depth) => (
                (0..colour.times().len())
                    .filter(|&frame| {
                        let time = colour.times()[frame];
                        nearest(depth.times(), time)
                            .is_some_and(|near| (depth.times()[near] - time).abs() <= DEPTH_APART)
                    })
                    .collect::<Vec<_>>(),
                DropReason::DepthApart,
            ),
            None => ((0..colour.times().len()).collect(), DropReason::VideoGap),
        };
        let kept: Vec<i64> = times.iter().map(|&frame| colour.times()[frame]).collect();
        let Some((_, end)) = self.extent() else {
            return Ok(Err(missing));
        };
        let period = (end - colour.times()[0]) / colour.times().len().max(1) as i64;
        let tolerance = match missing {
            // Frames without depth of their own moment are not replaced by others.
            DropReason::DepthApart => period * 3 / 4 + SECOND / 1000,
            // One lost picture is: its neighbour stands in for it.
            _ => period + SECOND / 500,
        };
        let mut chosen = Vec::with_capacity(settings.frames());
        for k in 0..settings.frames() {
            let tick = start + (k as f64 / settings.fps * SECOND as f64).round() as i64;
            let Some(mut near) = nearest(&kept, tick) else {
                return Ok(Err(missing));
            };
            // Half-way between two frames the release's rule rounds to even, counted from the clip's first frame.
            if let Some(next) = kept.get(near + 1) {
                let tie = ((next - tick) - (tick - kept[near])).abs() <= TIE;
                let from_first = times[near] - chosen.first().copied().unwrap_or(times[near]);
                near += usize::from(tie && from_first % 2 == 1);
            }
            let beyond = settings.pad_short && tick >= end - period;
            if (kept[near] - tick).abs() > tolerance && !beyond {
                return Ok(Err(missing));
            }
            chosen.push(times[near]);
        }
        let mut distinct = chosen.clone();
        distinct.dedup();
        let side = settings.side as usize;
        let mut squares = Vec::with_capacity(distinct.len());
        let mut depths: Vec<Vec<f32>> = Vec::new();
        // One picture at a time: full-size pictures are not held.
        colour.read(&distinct, &mut |_, picture| {
            squares.push(self.square(picture, settings).data);
        })?;
        if squares.len() != distinct.len() {
            return Err(ReadError::Settings(format!(
                "{} of {} pictures were read",
                squares.len(),
                distinct.len()
            )));
        }
        if let Some(depth) = &self.depth {
            let near: Vec<usize> = distinct
                .iter()
                .map(|&frame| nearest(depth.times(), colour.times()[frame]).unwrap_or(0))
                .collect();
            let mut each = near.clone();
            each.dedup();
            let mut maps = Vec::with_capacity(each.len());
            depth.read_several(&each, &mut |metres| {
                maps.push(self.square_depth(&metres, settings));
            })?;
            if maps.len() != each.len() {
                return Err(ReadError::Settings(format!(
                    "{} of {} depth maps were read",
                    maps.len(),
                    each.len()
                )));
            }
            depths = near
                .iter()
                .map(|index| maps[each.binary_search(index).unwrap_or(0)].clone())
                .collect();
        }
        let find = |frame: usize| distinct.binary_search(&frame).unwrap_or(0);
        let mut pixels = Vec::with_capacity(chosen.len() * side * side * 3);
        for &frame in &chosen {
            pixels.extend_from_slice(&squares[find(frame)]);
        }
        let shape = |error: ndarray::ShapeError| ReadError::Settings(error.to_string());
        let rgb = Rgb {
            rate: settings.fps,
            frames: Array4::from_shape_vec((chosen.len(), side, side, 3), pixels).map_err(shape)?,
        };
        let depth = if depths.is_empty() {
            None
        } else {
            let metres = chosen
                .iter()
                .flat_map(|&frame| depths[find(frame)].iter().copied())
                .collect();
            Some(Depth {
                rate: settings.fps,
                metres: Array3::from_shape_vec((chosen.len(), side, side), metres)
                    .map_err(shape)?,
            })
        };
        Ok(Ok((Some(rgb), depth)))
    }

    /// The undistortion map for pictures `side` pixels wide; made from the first calibration and kept.
    pub(super) fn remap(&self, angle: f64, side: u32) -> Option<Arc<Remap>> {
        // Not that of the picture's own time: which picture asks first depends on the threads.
        let (_, mounted) = self.cameras.first()?;
        Some(Arc::clone(self.remap.get_or_init(|| {
            Arc::new(Remap::new(
                &mounted.camera,
                &pinhole(&mounted.camera, angle, side),
            ))
        })))
    }

    /// Sampled three times finer than the clip, then averaged: undistortion must not alias.
    pub(super) fn fine_side(settings: &CutSettings) -> u32 {
        settings.side * 3
    }

    pub(super) fn square(&self, picture: Image, settings: &CutSettings) -> Image {
        let picture = match settings
            .undistort
            .and_then(|angle| self.remap(angle, Self::fine_side(settings)))
        {
            Some(remap) => Image {
                width: remap.size().0 as u32,
                height: remap.size().1 as u32,
                data: remap.colour(&picture.data),
            },
            None => picture,
        };
        picture.turned(self.turn).square(settings.side)
    }

    pub(super) fn square_depth(&self, metres: &Array2<f32>, settings: &CutSettings) -> Vec<f32> {
        let remapped;
        let metres = match settings
            .undistort
            .and_then(|angle| self.remap(angle, Self::fine_side(settings)))
        {
            Some(remap) => {
                let (width, height) = remap.size();
                let values = metres.as_standard_layout();
                let values = values.as_slice().unwrap_or(&[]);
                let flat = remap
                    .nearest(values)
                    .map(|d| d.unwrap_or(f32::NAN))
                    .collect();
                remapped = Array2::from_shape_vec((height, width), flat)
                    .unwrap_or_else(|_| metres.clone());
                &remapped
            }
            None => metres,
        };
        depth_square(metres, self.turn, settings.side)
    }
}

/// A pinhole camera with the axes of `camera` and the given horizontal field of view, `side` pixels a side.
pub(super) fn pinhole(camera: &Camera, degrees: f64, side: u32) -> Camera {
    debug_assert!(camera.width > 0, "a camera has pixels");
    let size = f64::from(side);
    let focal = size / 2.0 / (degrees.to_radians() / 2.0).tan();
    Camera {
        lens: Lens::Pinhole(Pinhole {
            fx: focal,
            fy: focal,
            cx: (size - 1.0) / 2.0,
            cy: (size - 1.0) / 2.0,
        }),
        width: side,
        height: side,
        valid_radius: None,
    }
}

/// The centre square of a depth map, turned upright, by nearest neighbour: depth must not be averaged over edges.
#[must_use]
pub fn depth_square(metres: &Array2<f32>, turn: Turn, side: u32) -> Vec<f32> {
    let (height, width) = metres.dim();
    let (turned_width, turned_height) = turn.size(width as u32, height as u32);
    let fit = SquareFit::new(turned_width, turned_height, side);
    let mut out = Vec::with_capacity(side as usize * side as usize);
    let back = turn.inverse();
    let scale = Vector2::new(
        f64::from(turned_width) / f64::from(fit.resized.0),
        f64::from(turned_height) / f64::from(fit.resized.1),
    );
    for row in 0..side {
        for column in 0..side {
            let u = ((f64::from(column + fit.left) + 0.5) * scale.x - 0.5).round();
            let v = ((f64::from(row + fit.top) + 0.5) * scale.y - 0.5).round();
            let (x, y) = back.pixel(u, v, f64::from(turned_width), f64::from(turned_height));
            let x = (x.max(0.0) as usize).min(width - 1);
            let y = (y.max(0.0) as usize).min(height - 1);
            out.push(metres[[y, x]]);
        }
    }
    out
}
