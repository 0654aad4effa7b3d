//! Camera trajectories: TUM (`timestamp tx ty tz qx qy qz qw`, camera to world) and COLMAP text (world to camera).

use crate::clip::Intrinsics;
use crate::geometry::rigid::Rigid;
use std::io::Write;
use std::path::Path;

/// One line per sample: `T_world_camera` with `OpenCV` axes, seconds, metres, unit quaternion.
///
/// # Errors
/// When writing fails.
pub fn write_tum(rate: f64, camera: &[Rigid], out: &mut impl Write) -> std::io::Result<()> {
    writeln!(
        out,
        "# timestamp tx ty tz qx qy qz qw (camera to world, OpenCV axes, metres)"
    )?;
    for (sample, pose) in camera.iter().enumerate() {
        let (t, q) = (pose.translation.vector, pose.rotation.coords);
        writeln!(
            out,
            "{:.6} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9}",
            sample as f64 / rate,
            t.x,
            t.y,
            t.z,
            q.x,
            q.y,
            q.z,
            q.w
        )?;
    }
    Ok(())
}

/// `cameras.txt`, `images.txt` and an empty `points3D.txt` below `folder`. Image names are `000000.jpg`, ... at `rate`.
///
/// COLMAP puts the centre of the top-left pixel at (0.5, 0.5); [`Intrinsics`] has it at (0, 0).
///
/// # Errors
/// When writing fails.
pub fn write_colmap(
    folder: &Path,
    camera: &[Rigid],
    intrinsics: &Intrinsics,
) -> std::io::Result<()> {
    std::fs::create_dir_all(folder)?;
    let mut cameras = std::fs::File::create(folder.join("cameras.txt"))?;
    writeln!(cameras, "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]")?;
    writeln!(
        cameras,
        "1 PINHOLE {} {} {} {} {} {}",
        intrinsics.width,
        intrinsics.height,
        intrinsics.fx,
        intrinsics.fy,
        intrinsics.cx + 0.5,
        intrinsics.cy + 0.5
    )?;
    let mut images = std::io::BufWriter::new(std::fs::File::create(folder.join("images.txt"))?);
    writeln!(
        images,
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    )?;
    writeln!(images, "# POINTS2D[] as (X, Y, POINT3D_ID)")?;
    for (index, T_world_camera) in camera.iter().enumerate() {
        let T_camera_world = T_world_camera.inverse();
        let (t, q) = (
            T_camera_world.translation.vector,
            T_camera_world.rotation.coords,
        );
        writeln!(
            images,
            "{} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} {:.9} 1 {index:06}.jpg\n",
            index + 1,
            q.w,
            q.x,
            q.y,
            q.z,
            t.x,
            t.y,
            t.z
        )?;
    }
    images.flush()?;
    let points = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n";
    std::fs::write(folder.join("points3D.txt"), points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{UnitQuaternion, Vector3};

    #[test]
    fn tum_lines_are_camera_to_world() {
        let pose = Rigid::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.0, 0.0, 0.5));
        let mut out = Vec::new();
        write_tum(30.0, &[pose, pose], &mut out).unwrap();
        let text = String::from_utf8(out).unwrap();
        let numbers: Vec<f64> = text
            .lines()
            .nth(2)
            .unwrap()
            .split(' ')
            .map(|n| n.parse().unwrap())
            .collect();
        assert!((numbers[0] - 1.0 / 30.0).abs() < 1e-6);
        assert_eq!(numbers[1..4], [1.0, 2.0, 3.0]);
        let q = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(
            numbers[7], numbers[4], numbers[5], numbers[6],
        ));
        assert!(q.angle_to(&pose.rotation) < 1e-8);
    }

    #[test]
    fn colmap_images_are_world_to_camera() {
        let folder = tempfile::tempdir().unwrap();
        let pose = Rigid::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, -0.2, 0.5));
        let intrinsics = Intrinsics {
            fx: 128.0,
            fy: 128.0,
            cx: 127.5,
            cy: 127.5,
            width: 256,
            height: 256,
        };
        write_colmap(folder.path(), &[pose], &intrinsics).unwrap();
        let text = std::fs::read_to_string(folder.path().join("images.txt")).unwrap();
        let fields: Vec<&str> = text.lines().nth(2).unwrap().split(' ').collect();
        let n: Vec<f64> = fields[1..8].iter().map(|v| v.parse().unwrap()).collect();
        let q = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(n[0], n[1], n[2], n[3]));
        // COLMAP: the camera centre is -R^T t.
        let centre = -(q.inverse() * Vector3::new(n[4], n[5], n[6]));
        assert!((centre - pose.translation.vector).norm() < 1e-7);
        let cameras = std::fs::read_to_string(folder.path().join("cameras.txt")).unwrap();
        assert!(cameras.contains("1 PINHOLE 256 256 128 128 128 128"));
    }
}
