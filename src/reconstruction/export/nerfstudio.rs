//! A NerfStudio data set: `transforms.json` beside the pictures it names (`ns-train splatfacto --data FOLDER`).
//!
//! Poses are camera to world with OpenGL's camera (x right, y up, z back), the world is ours (metres, z up); pixel coordinates count
//! from the corner of the picture, so that its middle is half its size.

use crate::clip::Intrinsics;
use crate::geometry::rigid::{Rigid, to_row_major};
use nalgebra::{UnitQuaternion, Vector3};
use serde_json::{Value, json};

/// Below the data set's folder.
pub const TRANSFORMS: &str = "transforms.json";

/// The name of picture `index`.
#[must_use]
pub fn picture(index: usize) -> String {
    format!("images/{index:06}.jpg")
}

/// The data set of pictures of `side` pixels at these poses; `points` names a point cloud in the same world.
#[must_use]
pub fn transforms(
    cameras: &[Rigid],
    intrinsics: &Intrinsics,
    side: u32,
    points: Option<&str>,
) -> Value {
    let (x, y) = (
        f64::from(side) / f64::from(intrinsics.width),
        f64::from(side) / f64::from(intrinsics.height),
    );
    let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let frame = |(index, T_world_camera): (usize, &Rigid)| {
        let flat = to_row_major(&(T_world_camera * turn));
        let rows: Vec<&[f64]> = flat.chunks(4).collect();
        json!({"file_path": picture(index), "transform_matrix": rows})
    };
    let mut data = json!({
        "camera_model": "OPENCV",
        "w": side,
        "h": side,
        "fl_x": intrinsics.fx * x,
        "fl_y": intrinsics.fy * y,
        "cx": (intrinsics.cx + 0.5) * x,
        "cy": (intrinsics.cy + 0.5) * y,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        // The world is metric and level as it is.
        "orientation_override": "none",
        "frames": cameras.iter().enumerate().map(frame).collect::<Vec<Value>>(),
    });
    if let Some(points) = points {
        data["ply_file_path"] = json!(points);
    }
    data
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_camera_looks_along_minus_z_and_the_middle_is_half_the_size() {
        let intrinsics = Intrinsics {
            fx: 32.0,
            fy: 32.0,
            cx: 31.5,
            cy: 31.5,
            width: 64,
            height: 64,
        };
        let pose = Rigid::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.0, 0.0, 0.5));
        let data = transforms(&[pose], &intrinsics, 512, Some("points.ply"));
        assert_eq!(
            (data["cx"].as_f64(), data["fl_x"].as_f64()),
            (Some(256.0), Some(256.0))
        );
        let matrix = &data["frames"][0]["transform_matrix"];
        let column =
            |k: usize| -> Vec<f64> { (0..3).map(|row| matrix[row][k].as_f64().unwrap()).collect() };
        assert_eq!(column(3), [1.0, 2.0, 3.0]);
        let ahead = pose.rotation * Vector3::z();
        let back = Vector3::from_vec(column(2));
        assert!((ahead + back).norm() < 1e-12);
        assert_eq!(data["frames"][0]["file_path"], "images/000000.jpg");
    }
}
