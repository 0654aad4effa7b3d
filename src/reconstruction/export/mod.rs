//! Files for other programs: TUM, COLMAP and NerfStudio cameras, gaze csv, BVH, glTF, PLY, and npz with a manifest.
//!
//! Every writer takes plain data and an `impl Write`, so that it can be tested without a disk. The conventions each format needs
//! are in its module.

pub mod bvh;
pub mod camera;
pub mod files;
pub mod gltf;
pub mod manifest;
pub mod nerfstudio;
pub mod ply;

use std::io::Write;

/// Gaze as csv: seconds, x and y in the upright square image (`[0, 1]`, x right, y down), validity.
///
/// # Errors
/// When writing fails.
pub fn write_gaze(rate: f64, gaze: &[[f32; 2]], out: &mut impl Write) -> std::io::Result<()> {
    writeln!(out, "seconds,x,y,valid")?;
    for (sample, [x, y]) in gaze.iter().enumerate() {
        let seconds = sample as f64 / rate;
        if x.is_finite() && y.is_finite() {
            writeln!(out, "{seconds:.6},{x:.6},{y:.6},1")?;
        } else {
            writeln!(out, "{seconds:.6},,,0")?;
        }
    }
    Ok(())
}
