//! Clips beside their golden answers: camera, gaze, joints, and what the pixels say.
//!
//! The pictures are 16 x 16 cells: row 4, columns 2 to 13, is the number of the picture in twelve bits, row 5 the same inverted; the
//! other cells have known colours, so that a wrong turn, mirror, crop, channel order or picture shows.

use std::path::Path;
use std::sync::Arc;

use ndarray::{Array1, Array2, Array3, Ix1, Ix2, Ix4, Ix5, s};
use reviv::clip::{Clip, JointTrack, Key, Rgb};
use reviv::datasets::recording::CutSettings;
use reviv::datasets::{ClipSource, Outcome as Cut, ReadError};

use super::Outcome;
use super::golden::{Golden, golden_files};
use super::report::Report;

/// Cells along a side of the square.
const CELLS: usize = 16;
/// Decoded colours differ by at most so many grey values.
const COLOUR: f64 = 12.0;

/// One answer that counts as right: some golden sets have several.
#[derive(Debug, Clone, Copy)]
pub struct Answer {
    /// The array of values.
    pub values: &'static str,
    /// The array that says which of them are valid; where `None`, all are.
    pub valid: Option<&'static str>,
    /// Samples that a reader may call valid beyond those, with whatever value.
    pub may_be_valid: Option<&'static str>,
    /// Which of the array's joints are ours, where it has more.
    pub joints: Option<&'static [usize]>,
    pub tolerance: f64,
}

impl Answer {
    pub const fn new(values: &'static str, valid: &'static str, tolerance: f64) -> Self {
        Self {
            values,
            valid: Some(valid),
            may_be_valid: None,
            joints: None,
            tolerance,
        }
    }
}

/// What is compared in a set and how closely. Signals without an answer are not compared; where the golden file lacks the arrays
/// of an answer, the clip must lack the signal.
#[derive(Debug, Clone, Copy, Default)]
pub struct Expected {
    /// Largest difference of an entry of a pose; metres.
    pub camera: f64,
    pub gaze: &'static [Answer],
    pub left_hand: &'static [Answer],
    pub right_hand: &'static [Answer],
    pub body: &'static [Answer],
    /// Metres.
    pub depth: f64,
    /// Frames whose times the recording does not know: either neighbour is right.
    pub times_missing: Option<&'static str>,
    /// The camera has no colour: cells are compared by luma.
    pub mono: bool,
}

/// Opens the recordings of a folder as clips.
pub type Open<'a> = dyn Fn(&Path, &CutSettings) -> Result<Arc<dyn ClipSource>, ReadError> + 'a;

/// Compares every golden file in `folder` with the clips of its recording.
pub fn check(folder: &Path, open: &Open<'_>, expected: &Expected, report: &mut Report) -> Outcome {
    for path in golden_files(folder)? {
        check_one(&path, folder, open, expected, report)?;
    }
    Ok(())
}

/// Compares one golden file with the clips of its recording in `folder`.
pub fn check_one(
    path: &Path,
    folder: &Path,
    open: &Open<'_>,
    expected: &Expected,
    report: &mut Report,
) -> Outcome {
    let golden = Golden::read(path)?;
    if let Err(error) = one(folder, open, expected, &golden, report) {
        report.problem(&golden.name, &error.to_string());
    }
    Ok(())
}

fn one(
    folder: &Path,
    open: &Open<'_>,
    expected: &Expected,
    golden: &Golden,
    report: &mut Report,
) -> Outcome {
    let settings = CutSettings::default();
    let clips = clips_of(open(folder, &settings)?.as_ref(), golden)?;
    pictures(golden, &clips, "8", expected, report)?;
    if golden.has("rgb_code16") {
        let settings = CutSettings {
            fps: 16.0,
            ..settings
        };
        let clips = clips_of(open(folder, &settings)?.as_ref(), golden)?;
        pictures(golden, &clips, "16", expected, report)?;
    }
    cells(golden, &clips, expected, report)?;
    depth(golden, &clips, expected, report)?;
    camera(golden, &clips, expected, report)?;
    let signals = [
        ("gaze", expected.gaze),
        ("left_hand", expected.left_hand),
        ("right_hand", expected.right_hand),
        ("body", expected.body),
    ];
    for (name, answers) in signals {
        signal(golden, &clips, name, answers, report)?;
    }
    Ok(())
}

/// Letters and digits, everything else as `_`: names in file names.
fn plain(name: &str) -> String {
    name.chars()
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
        .collect()
}

/// As many clips of the golden file's recording as it has answers for.
fn clips_of(source: &dyn ClipSource, golden: &Golden) -> Outcome<Vec<Clip>> {
    let wanted = plain(golden.recording());
    let count = golden.clips()?;
    let recordings = source.recordings();
    let fits = |exactly: bool| {
        recordings.iter().find(|(name, range)| {
            let name = plain(name);
            let named = name == wanted || (!exactly && name.contains(&wanted));
            named && range.len() >= count
        })
    };
    let (name, range) = fits(true).or_else(|| fits(false)).ok_or_else(|| {
        let known: Vec<String> = recordings
            .iter()
            .map(|(name, range)| format!("{name} ({} clips)", range.len()))
            .collect();
        format!(
            "no recording for it with {count} clips among: {}",
            known.join(", ")
        )
    })?;
    let mut clips = Vec::new();
    for index in range.clone().take(count) {
        match source.clip(index)? {
            Cut::Clip(clip) => clips.push(*clip),
            Cut::Dropped { reason, .. } => {
                return Err(format!("{name}: a clip is dropped: {}", reason.text()).into());
            }
        }
    }
    Ok(clips)
}

/// The mean of the middle of a cell.
fn cell(rgb: &Rgb, frame: usize, row: usize, column: usize) -> [f64; 3] {
    let side = rgb.frames.shape()[1] / CELLS;
    let (inset, size) = (side / 4, side / 2);
    let (top, left) = (row * side + inset, column * side + inset);
    std::array::from_fn(|channel| {
        let middle = rgb
            .frames
            .slice(s![frame, top..top + size, left..left + size, channel]);
        middle.iter().map(|v| f64::from(*v)).sum::<f64>() / middle.len() as f64
    })
}

fn luma([r, g, b]: [f64; 3]) -> f64 {
    0.299 * r + 0.587 * g + 0.114 * b
}

/// The number written into a picture; `None` where the two rows of bits contradict each other.
fn code(rgb: &Rgb, frame: usize) -> Option<i64> {
    let mut code = 0;
    for column in 2..14 {
        let bit = luma(cell(rgb, frame, 4, column)) > 127.5;
        let inverted = luma(cell(rgb, frame, 5, column)) > 127.5;
        if bit == inverted {
            return None;
        }
        code = code << 1 | i64::from(bit);
    }
    Some(code)
}

fn rgb(clip: &Clip) -> Outcome<&Rgb> {
    clip.rgb().ok_or_else(|| "a clip has no pictures".into())
}

/// Which pictures were chosen, by the numbers in their pixels.
fn pictures(
    golden: &Golden,
    clips: &[Clip],
    rate: &str,
    expected: &Expected,
    report: &mut Report,
) -> Outcome {
    let codes = golden.array::<i64, Ix2>(&format!("rgb_code{rate}"))?;
    // Where a frame has no time, its neighbours are as good.
    let excused: Vec<i64> = match expected.times_missing {
        Some(key) if golden.has(key) => {
            let missing = golden.array::<bool, Ix1>(key)?;
            let all = golden.array::<i64, Ix1>("frame_code")?;
            let missing = missing.iter().zip(&all).filter(|(missing, _)| **missing);
            missing.map(|(_, code)| *code).collect()
        }
        _ => Vec::new(),
    };
    let mut wrong = 0;
    for (clip, codes) in clips.iter().zip(codes.rows()) {
        let rgb = rgb(clip)?;
        if rgb.frames.shape()[0] != codes.len() {
            return Err(format!(
                "{} pictures instead of {}",
                rgb.frames.shape()[0],
                codes.len()
            )
            .into());
        }
        for (frame, expected) in codes.iter().enumerate() {
            let right = code(rgb, frame).is_some_and(|found| {
                let excused = excused.contains(&found) || excused.contains(expected);
                found == *expected || (excused && (found - expected).abs() <= 1)
            });
            wrong += usize::from(!right);
        }
    }
    let name = format!("{} pictures at {rate} Hz", golden.name);
    report.wrong(&name, wrong, codes.len());
    Ok(())
}

fn cells(golden: &Golden, clips: &[Clip], expected: &Expected, report: &mut Report) -> Outcome {
    let colours = golden.array::<f64, Ix5>("rgb_cells8")?;
    let mut worst = 0.0_f64;
    for (clip, colours) in clips.iter().zip(colours.outer_iter()) {
        let rgb = rgb(clip)?;
        for (frame, colours) in colours.outer_iter().enumerate() {
            for row in 0..CELLS {
                for column in 0..CELLS {
                    let found = cell(rgb, frame, row, column);
                    let wanted = std::array::from_fn(|k| colours[[row, column, k]]);
                    let off = if expected.mono {
                        let grey = luma(wanted);
                        found.map(|v| (v - grey).abs())
                    } else {
                        std::array::from_fn(|k| (found[k] - wanted[k]).abs())
                    };
                    worst = off.into_iter().fold(worst, f64::max);
                }
            }
        }
    }
    report.difference(&format!("{} cells", golden.name), worst, COLOUR, "of 255");
    Ok(())
}

fn depth(golden: &Golden, clips: &[Clip], expected: &Expected, report: &mut Report) -> Outcome {
    if !golden.has("depth_cells8") {
        if clips.iter().any(|clip| clip.depth().is_some()) {
            report.problem(
                &format!("{} depth", golden.name),
                "depth where there is none",
            );
        }
        return Ok(());
    }
    let metres = golden.array::<f64, Ix4>("depth_cells8")?;
    let (mut worst, mut wrong) = (0.0_f64, 0);
    for (clip, metres) in clips.iter().zip(metres.outer_iter()) {
        let found = &clip.depth().ok_or("a clip has no depth")?.metres;
        let side = found.shape()[1] / CELLS;
        for ((frame, row, column), wanted) in metres.indexed_iter() {
            let at = [frame, row * side + side / 2, column * side + side / 2];
            let found = f64::from(found[at]);
            wrong += usize::from(found.is_nan() != wanted.is_nan());
            worst = worst.max((found - wanted).abs());
        }
    }
    report.wrong(
        &format!("{} depth missing", golden.name),
        wrong,
        metres.len(),
    );
    report.difference(
        &format!("{} depth", golden.name),
        worst,
        expected.depth,
        "m",
    );
    Ok(())
}

fn camera(golden: &Golden, clips: &[Clip], expected: &Expected, report: &mut Report) -> Outcome {
    if !golden.has("camera") {
        if clips.iter().any(|clip| clip.camera().is_some()) {
            report.problem(
                &format!("{} camera", golden.name),
                "a camera where there is none",
            );
        }
        return Ok(());
    }
    let poses = golden.array::<f64, Ix4>("camera")?;
    let valid = golden.array::<bool, Ix2>("camera_valid")?;
    let up = golden
        .has("up_world")
        .then(|| golden.array::<f64, Ix1>("up_world"))
        .transpose()?;
    let (mut worst, mut wrong, mut up_off) = (0.0_f64, 0, 0.0_f64);
    for (index, clip) in clips.iter().enumerate() {
        let track = clip.camera().ok_or("a clip has no camera")?;
        for k in 0..valid.ncols() {
            wrong += usize::from(track.valid[k] != valid[[index, k]]);
            if !(track.valid[k] && valid[[index, k]]) {
                continue;
            }
            let found = track.T_world_camera[k].to_homogeneous();
            for row in 0..4 {
                for column in 0..4 {
                    let off = (found[(row, column)] - poses[[index, k, row, column]]).abs();
                    worst = worst.max(off);
                }
            }
        }
        match (&up, &track.up_world) {
            (None, None) => {}
            (Some(up), Some(found)) => {
                for k in 0..3 {
                    up_off = up_off.max((found[k] - up[k]).abs());
                }
            }
            // A reader may know less than the golden file, not more.
            (Some(_), None) => up_off = f64::NAN,
            (None, Some(_)) => return Err("a world with a direction up that is not known".into()),
        }
    }
    let name = format!("{} camera", golden.name);
    report.wrong(&format!("{name} validity"), wrong, valid.len());
    report.difference(&name, worst, expected.camera, "m");
    if up.is_some() {
        report.difference(&format!("{name} up"), up_off, 1e-6, "");
    }
    Ok(())
}

/// A signal of a clip as `[samples, parts, channels]` with validity `[samples, parts]`.
fn parts(clip: &Clip, name: &str) -> Option<(Array3<f64>, Array2<bool>)> {
    match name {
        "gaze" => {
            let track = clip.gaze()?;
            let samples = track.valid.len();
            let points = track.points.mapv(f64::from);
            Some((
                points.into_shape_with_order((samples, 1, 2)).ok()?,
                track
                    .valid
                    .clone()
                    .into_shape_with_order((samples, 1))
                    .ok()?,
            ))
        }
        name => {
            let track = clip.get(Key::<JointTrack>::new(name))?;
            Some((track.joints.mapv(f64::from), track.valid.clone()))
        }
    }
}

/// Compares gaze, a hand or the body with each answer; the nearest one counts.
fn signal(
    golden: &Golden,
    clips: &[Clip],
    name: &str,
    answers: &[Answer],
    report: &mut Report,
) -> Outcome {
    let row = format!("{} {name}", golden.name);
    let mut best: Option<(usize, f64, Answer, usize)> = None;
    for answer in answers.iter().filter(|answer| golden.has(answer.values)) {
        let (wrong, off, samples) = beside(golden, clips, name, answer)?;
        let nearer = best.is_none_or(|(least, distance, other, _)| {
            (wrong, off / answer.tolerance) < (least, distance / other.tolerance)
        });
        if nearer {
            best = Some((wrong, off, *answer, samples));
        }
    }
    match best {
        Some((wrong, off, answer, samples)) => {
            report.wrong(&format!("{row} validity"), wrong, samples);
            let unit = if name == "gaze" {
                "of the picture"
            } else {
                "m"
            };
            report.difference(&row, off, answer.tolerance, unit);
        }
        None if clips.iter().any(|clip| parts(clip, name).is_some()) => {
            report.problem(&row, "a signal where there is none");
        }
        None => {}
    }
    Ok(())
}

/// How many samples have the wrong validity, the largest difference where both are valid, and the number of samples.
fn beside(
    golden: &Golden,
    clips: &[Clip],
    name: &str,
    answer: &Answer,
) -> Outcome<(usize, f64, usize)> {
    let count = clips.len();
    let (mut wrong, mut worst, mut samples) = (0, 0.0_f64, 0);
    for (index, clip) in clips.iter().enumerate() {
        let golden_shape = golden.array::<f64, ndarray::IxDyn>(answer.values)?;
        let golden_shape = golden_shape.shape();
        // A clip without the signal is one in which none of its samples is valid.
        let (found, found_valid) = parts(clip, name).unwrap_or_else(|| {
            let (joints, channels) = match golden_shape {
                [_, _, joints, channels] => {
                    (answer.joints.map_or(*joints, <[usize]>::len), *channels)
                }
                _ => (1, 2),
            };
            let samples = golden_shape.get(1).copied().unwrap_or(0);
            (
                Array3::zeros((samples, joints, channels)),
                Array2::from_elem((samples, joints), false),
            )
        });
        let shape = found.dim();
        let flags = |key: &str| -> Outcome<Array1<bool>> {
            let all = golden.array::<bool, ndarray::IxDyn>(key)?;
            if all.len() != count.max(golden.clips()?) * shape.0 * shape.1 {
                return Err(format!("`{key}` has shape {:?}", all.shape()).into());
            }
            let clip = all.index_axis(ndarray::Axis(0), index);
            Ok(clip.iter().copied().collect())
        };
        let values = golden.array::<f64, ndarray::IxDyn>(answer.values)?;
        let values = values.index_axis(ndarray::Axis(0), index);
        let values: Vec<f64> = match answer.joints {
            Some(joints) => values
                .select(ndarray::Axis(1), joints)
                .iter()
                .copied()
                .collect(),
            None => values.iter().copied().collect(),
        };
        let values = Array3::from_shape_vec(shape, values)?;
        let valid = match answer.valid {
            Some(key) => flags(key)?,
            None => Array1::from_elem(shape.0 * shape.1, true),
        };
        let may_be = match answer.may_be_valid {
            Some(key) => flags(key)?,
            None => Array1::from_elem(valid.len(), false),
        };
        for (at, (sample, part)) in ndarray::indices((shape.0, shape.1)).into_iter().enumerate() {
            let found_valid = found_valid[[sample, part]];
            samples += 1;
            wrong += usize::from(found_valid != valid[at] && !(found_valid && may_be[at]));
            if found_valid && valid[at] {
                let distance = (0..shape.2)
                    .map(|k| (found[[sample, part, k]] - values[[sample, part, k]]).powi(2))
                    .sum::<f64>()
                    .sqrt();
                worst = worst.max(distance);
            }
        }
    }
    Ok((wrong, worst, samples))
}
