//! Depth lifted into the world, coloured by the video.

use super::export::ply::Point;
use crate::clip::Intrinsics;
use crate::geometry::rigid::Rigid;
use nalgebra::Point3;
use ndarray::{ArrayView2, ArrayView3};

/// Points of one frame on every `stride`-th cell of its depth, in rows from the top left. `depth` `[h, w]` and `rgb`
/// `[H, W, 3]` cover the same square image, whose intrinsics are `intrinsics`.
pub fn lift(
    depth: ArrayView2<f32>,
    rgb: ArrayView3<u8>,
    intrinsics: &Intrinsics,
    T_world_camera: &Rigid,
    stride: usize,
) -> Vec<Point> {
    let (rows, columns) = depth.dim();
    let (height, width, _) = rgb.dim();
    let mut points = Vec::new();
    for row in (0..rows).step_by(stride.max(1)) {
        for column in (0..columns).step_by(stride.max(1)) {
            let z = f64::from(depth[[row, column]]);
            if !z.is_finite() || z <= 0.0 {
                continue;
            }
            let [x, y] = ray(intrinsics, [rows, columns], row, column);
            let p = T_world_camera * Point3::new(x * z, y * z, z);
            let at = |cell: usize, cells: usize, pixels: usize| {
                ((cell as f64 + 0.5) / cells as f64 * pixels as f64) as usize
            };
            let (v, u) = (at(row, rows, height), at(column, columns, width));
            points.push(Point {
                position: [p.x as f32, p.y as f32, p.z as f32],
                color: [rgb[[v, u, 0]], rgb[[v, u, 1]], rgb[[v, u, 2]]],
            });
        }
    }
    points
}

/// The ray through the centre of a cell of a `[rows, columns]` grid over the image, at unit depth.
pub fn ray(intrinsics: &Intrinsics, grid: [usize; 2], row: usize, column: usize) -> [f64; 2] {
    let u = (column as f64 + 0.5) / grid[1] as f64 * f64::from(intrinsics.width) - 0.5;
    let v = (row as f64 + 0.5) / grid[0] as f64 * f64::from(intrinsics.height) - 0.5;
    [
        (u - intrinsics.cx) / intrinsics.fx,
        (v - intrinsics.cy) / intrinsics.fy,
    ]
}
