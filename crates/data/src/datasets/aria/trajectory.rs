//! Where the glasses were: `closed_loop_trajectory.csv` of Machine Perception Services, and ADT's `aria_trajectory.csv`.

use super::calibration::unit_quaternion;
use crate::datasets::csv::Table;
use crate::datasets::track::{SECOND, Track};
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use nalgebra::{Isometry3, Translation3, Unit, Vector3};
use std::path::Path;

/// Trajectories come at up to 1 kHz; 250 Hz is dense enough to interpolate a head, and a quarter of the memory.
const THINNEST: i64 = SECOND / 250;
/// At 30 Hz two rows may be lost; beyond that it is a gap.
const MAX_GAP: i64 = SECOND / 10;
const HOLD: i64 = SECOND / 50;

/// Poses of the device and the direction against gravity.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// `T_world_device` over device time.
    pub poses: Track<Isometry3<f64>>,
    /// Against gravity in the world of the poses, unit length; `None` where the file has no gravity.
    pub up_world: Option<Unit<Vector3<f64>>>,
    /// Time and position of the first rows as written, to match clocks with.
    pub first_rows: Vec<(i64, Vector3<f64>)>,
}

/// How gravity in the world is called, the newest name first.
const GRAVITY: [&str; 4] = [
    "gravity_{}_world",
    "gravity_{}",
    "gravity_world_{}",
    "g{}_world",
];
/// What to say of a trajectory without it.
pub const NO_GRAVITY: &str = "no body: the trajectory does not say where gravity points (columns `gravity_x_world`, `gravity_y_world`, `gravity_z_world`)";

/// Rows kept as written.
const FIRST_ROWS: usize = 4096;

/// Reads a trajectory with columns by name; their order and number vary.
///
/// # Errors
/// When the table is damaged; the line is named.
pub fn read(path: &Path) -> Result<Trajectory, ReadError> {
    let mut table = Table::open(path)?;
    let time = table.column("tracking_timestamp_us")?;
    let position = table.columns("t{}_world_device", ["x", "y", "z"])?;
    let rotation = table.columns("q{}_world_device", ["x", "y", "z", "w"])?;
    let gravity = table.columns_of_any(&GRAVITY, ["x", "y", "z"])?;
    let mut samples: Vec<(i64, Isometry3<f64>)> = Vec::new();
    let mut first_rows = Vec::new();
    let mut up_world = None;
    while let Some(row) = table.next_row() {
        let row = row?;
        let time = row
            .integer(time)?
            .checked_mul(1000)
            .ok_or_else(|| row.error("a time beyond all clocks".to_owned()))?;
        let [x, y, z] = row.numbers(position)?;
        let [qx, qy, qz, qw] = row.numbers(rotation)?;
        if up_world.is_none()
            && let Some(gravity) = gravity
        {
            let [gx, gy, gz] = row.numbers(gravity)?;
            up_world = Unit::try_new(-Vector3::new(gx, gy, gz), 1e-3);
        }
        // Rows that the tracker could not fill are NaN: a gap.
        let Some(quaternion) = unit_quaternion(qw, qx, qy, qz).filter(|_| (x + y + z).is_finite())
        else {
            continue;
        };
        if first_rows.len() < FIRST_ROWS {
            first_rows.push((time, Vector3::new(x, y, z)));
        }
        if samples
            .last()
            .is_some_and(|(last, _)| (0..THINNEST).contains(&(time - last)))
        {
            continue;
        }
        samples.push((
            time,
            Isometry3::from_parts(Translation3::new(x, y, z), quaternion),
        ));
    }
    if samples.is_empty() {
        return Err(ReadError::malformed(
            path,
            Position::File,
            "there is no pose in it",
        ));
    }
    Ok(Trajectory {
        poses: Track::new(samples, MAX_GAP, HOLD),
        up_world,
        first_rows,
    })
}
