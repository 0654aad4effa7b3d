//! A contact sheet: some frames of some clips with gaze and hands drawn in, their depth, and which samples of which signal are
//! valid.

use super::canvas::{Canvas, Colour, LETTER, LINE, viridis};
use crate::clip::{Clip, Intrinsics, JointTrack};
use crate::geometry::skeleton::HAND;
use crate::modality::BUILT_IN;
use crate::video::image::Image;
use ndarray::{Array1, Axis};

/// Side of a frame, frames of a clip, and pixels between them.
const TILE: usize = 176;
const FRAMES: usize = 6;
const GAP: usize = 4;
const MARGIN: usize = 12;
/// Height of a strip of validity.
const STRIP: usize = 8;

const PAPER: Colour = [24, 24, 28];
const INK: Colour = [225, 225, 225];
const FAINT: Colour = [130, 130, 135];
const GAZE: Colour = [255, 230, 0];
pub(super) const LEFT: Colour = [70, 170, 255];
pub(super) const RIGHT: Colour = [255, 110, 70];
const VALID: Colour = [70, 190, 110];
const INVALID: Colour = [90, 40, 45];

/// The sheet of these clips, one below the other.
pub fn contact_sheet(clips: &[Clip]) -> Canvas {
    let width = 2 * MARGIN + FRAMES * TILE + (FRAMES - 1) * GAP;
    let heights: Vec<usize> = clips.iter().map(height).collect();
    let mut canvas = Canvas::new(
        width,
        MARGIN + heights.iter().sum::<usize>().max(LINE),
        PAPER,
    );
    let mut y = MARGIN;
    for (clip, height) in clips.iter().zip(heights) {
        draw(&mut canvas, clip, y);
        y += height;
    }
    canvas
}

/// Of every modality that says which of its values are valid, the share of valid ones per sample.
fn strips(clip: &Clip) -> Vec<(String, Vec<f64>)> {
    let mut names: Vec<&str> = clip.modalities().collect();
    names.sort_by_key(|name| {
        BUILT_IN
            .iter()
            .position(|known| known == name)
            .unwrap_or(BUILT_IN.len())
    });
    let strip = |name: &str| {
        let valid = clip.held(name)?.to_arrays().valid?.to::<bool>().ok()?;
        let rows = valid.axis_iter(Axis(0));
        let share =
            rows.map(|row| row.iter().filter(|v| **v).count() as f64 / row.len().max(1) as f64);
        Some((name.replace('_', " "), share.collect()))
    };
    names.into_iter().filter_map(strip).collect()
}

fn height(clip: &Clip) -> usize {
    let rows = usize::from(clip.rgb().is_some()) + usize::from(clip.depth().is_some());
    LINE + rows * (TILE + GAP) + strips(clip).len() * (STRIP + 4) + 2 * MARGIN
}

fn draw(canvas: &mut Canvas, clip: &Clip, mut y: usize) {
    let mut title = clip.id.clone();
    if clip.rgb().is_none() {
        title += "   no colour";
    }
    if clip.gaze().is_some() {
        title += "   gaze: ring";
    }
    let intrinsics = clip.camera().and_then(|camera| camera.intrinsics);
    let hands = clip.left_hand().is_some() || clip.right_hand().is_some();
    title += match (hands, intrinsics) {
        (true, Some(_)) => "   hands: left blue, right orange",
        (true, None) => "   hands not drawn: fisheye, no pinhole intrinsics",
        _ => "",
    };
    canvas.text(MARGIN, y, &title, INK);
    y += LINE;
    let column = |k: usize| MARGIN + k * (TILE + GAP);
    if let Some(rgb) = clip.rgb() {
        let (count, side) = (rgb.frames.shape()[0], rgb.frames.shape()[2]);
        for (k, frame) in chosen(count).into_iter().enumerate() {
            let picture = rgb.frames.index_axis(Axis(0), frame);
            paste(
                canvas,
                column(k),
                y,
                side,
                picture.iter().copied().collect(),
            );
            let seconds = frame as f64 / rgb.rate;
            let place = |u: f64, v: f64| {
                let inside = [u, v].iter().all(|x| (-0.01..1.01).contains(x));
                let at = |origin: usize, x: f64| origin as f64 + x * TILE as f64;
                inside.then(|| [at(column(k), u), at(y, v)])
            };
            if let Some(k) = &intrinsics {
                for (track, colour) in [(clip.left_hand(), LEFT), (clip.right_hand(), RIGHT)] {
                    if let Some(track) = track {
                        hand(canvas, track, seconds, k, colour, &place);
                    }
                }
            }
            if let Some(gaze) = clip.gaze() {
                let sample = (seconds * gaze.rate).round() as usize;
                if gaze.valid.get(sample) == Some(&true)
                    && let Some(at) = place(
                        f64::from(gaze.points[(sample, 0)]),
                        f64::from(gaze.points[(sample, 1)]),
                    )
                {
                    canvas.ring(at, 6.0, 3.5, [0; 3]);
                    canvas.ring(at, 6.0, 2.0, GAZE);
                }
            }
            label(canvas, column(k), y, &format!("{seconds:.2} s"));
        }
        y += TILE + GAP;
    }
    if let Some(depth) = clip.depth() {
        let side = depth.metres.shape()[2];
        let mut values: Vec<f32> = depth
            .metres
            .iter()
            .copied()
            .filter(|v| v.is_finite())
            .collect();
        values.sort_by(f32::total_cmp);
        let at = |share: f64| values.get((share * values.len() as f64) as usize).copied();
        let (near, far) = (at(0.01).unwrap_or(0.0), at(0.99).unwrap_or(1.0));
        for (k, frame) in chosen(depth.metres.shape()[0]).into_iter().enumerate() {
            let map = depth.metres.index_axis(Axis(0), frame);
            let colour = |z: &f32| {
                if z.is_finite() {
                    viridis(1.0 - f64::from((z - near) / (far - near).max(1e-3)))
                } else {
                    PAPER
                }
            };
            paste(
                canvas,
                column(k),
                y,
                side,
                map.iter().flat_map(colour).collect(),
            );
            if k == 0 {
                label(canvas, column(k), y, &format!("{near:.2}-{far:.2} m"));
            }
        }
        y += TILE + GAP;
    }
    let left = MARGIN + 12 * LETTER;
    let width = FRAMES * TILE + (FRAMES - 1) * GAP - 12 * LETTER;
    for (name, valid) in strips(clip) {
        canvas.text(MARGIN, y, &name, FAINT);
        let all = Array1::from(valid);
        for x in 0..width {
            // A signal of no samples has none that is valid.
            let share = all.get(x * all.len() / width).copied().unwrap_or(0.0);
            let mixed = std::array::from_fn(|c| {
                (f64::from(INVALID[c]) * (1.0 - share) + f64::from(VALID[c]) * share).round() as u8
            });
            canvas.fill(left + x, y, 1, STRIP, mixed);
        }
        y += STRIP + 4;
    }
}

/// Frames spread over a clip.
fn chosen(count: usize) -> Vec<usize> {
    let shown = FRAMES.min(count);
    (0..shown)
        .map(|k| k * (count - 1) / (shown - 1).max(1))
        .collect()
}

fn paste(canvas: &mut Canvas, x: usize, y: usize, side: usize, data: Vec<u8>) {
    let picture = Image {
        width: side as u32,
        height: (data.len() / 3 / side.max(1)) as u32,
        data,
    };
    let tile = picture.square(TILE as u32);
    canvas.paste(x, y, TILE, &tile.data);
}

fn label(canvas: &mut Canvas, x: usize, y: usize, text: &str) {
    canvas.fill(x, y, text.len() * LETTER + 4, LINE, [0; 3]);
    canvas.text(x + 3, y + 2, text, INK);
}

fn hand(
    canvas: &mut Canvas,
    track: &JointTrack,
    seconds: f64,
    k: &Intrinsics,
    colour: Colour,
    place: &impl Fn(f64, f64) -> Option<[f64; 2]>,
) {
    let sample = (seconds * track.rate).round() as usize;
    // Nothing beyond the end of the track, and no joint that it does not have.
    let pixel = |joint: usize| {
        let at = |c: usize| Some(f64::from(*track.joints.get((sample, joint, c))?));
        let (x, y, z) = (at(0)?, at(1)?, at(2)?);
        if track.valid.get((sample, joint)) != Some(&true) || z <= 0.02 {
            return None;
        }
        let (u, v) = (k.fx * x / z + k.cx, k.fy * y / z + k.cy);
        place(
            (u + 0.5) / f64::from(k.width),
            (v + 0.5) / f64::from(k.height),
        )
    };
    for (a, b) in HAND.bones() {
        if let (Some(a), Some(b)) = (pixel(a), pixel(b)) {
            canvas.line(a, b, 1.6, colour);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::{CAMERA, CameraTrack, LEFT_HAND, RGB, RIGHT_HAND, Rgb};
    use ndarray::{Array2, Array3, Array4};

    #[test]
    fn tracks_without_samples_and_hands_with_few_joints_are_drawn() {
        let mut clip = Clip::empty("short", "test");
        clip.set(
            RGB,
            Rgb {
                rate: 8.0,
                frames: Array4::zeros((1, 8, 8, 3)),
            },
        );
        clip.set(
            CAMERA,
            CameraTrack {
                rate: 30.0,
                T_world_camera: Vec::new(),
                valid: Vec::new(),
                up_world: None,
                intrinsics: Some(Intrinsics {
                    fx: 4.0,
                    fy: 4.0,
                    cx: 3.5,
                    cy: 3.5,
                    width: 8,
                    height: 8,
                }),
            },
        );
        let hand = |joints| JointTrack {
            rate: 30.0,
            joints: Array3::from_shape_fn((1, joints, 3), |(_, j, c)| match c {
                2 => 1.0,
                _ => 0.1 * j as f32,
            }),
            valid: Array2::from_elem((1, joints), true),
        };
        let without = contact_sheet(std::slice::from_ref(&clip));
        clip.set(LEFT_HAND, hand(0));
        clip.set(RIGHT_HAND, hand(5));
        let with = contact_sheet(&[clip]);
        assert_eq!(with.size().0, without.size().0);
        assert!(with.size().1 > without.size().1);
    }
}
