//! The wearer drawn into a frame of their own camera: the skeleton, both hands, and where they look.

use super::canvas::{Canvas, Colour};
use super::contact::{LEFT, RIGHT};
use crate::clip::Intrinsics;
use crate::geometry::rigid::Rigid;
use crate::geometry::skeleton::{BODY, HAND, Joints, Skeleton};
use nalgebra::Point3;

/// As on the page of a reconstruction.
const BODY_COLOUR: Colour = [120, 220, 140];
const GAZE: Colour = [255, 230, 0];
const SHADE: Colour = [10, 10, 14];
/// What is nearer to the camera than this is not seen, metres.
const NEAREST: f64 = 0.05;

/// The wearer at one moment; what is unknown is not drawn.
#[derive(Debug, Clone, Copy, Default)]
pub struct Moment<'a> {
    /// Needed for the body, which stands in the world.
    pub T_world_camera: Option<&'a Rigid>,
    /// In the world, metres.
    pub body: Option<&'a Joints>,
    /// Left and right, in the camera, metres.
    pub hands: [Option<&'a Joints>; 2],
    /// In the square image, `[0, 1]^2`.
    pub gaze: Option<[f32; 2]>,
}

/// Draws a moment into a square frame, whose camera has these intrinsics at whatever size.
pub fn draw(canvas: &mut Canvas, intrinsics: &Intrinsics, moment: &Moment<'_>) {
    let side = canvas.size().0 as f64;
    let weight = side / 480.0;
    if let (Some(body), Some(pose)) = (moment.body, moment.T_world_camera) {
        let inverse = pose.inverse();
        let joints = body.map(|p| inverse * Point3::from(p.map(f64::from)));
        skeleton(
            canvas,
            intrinsics,
            &BODY,
            &joints,
            4.0 * weight,
            BODY_COLOUR,
        );
    }
    for (hand, colour) in moment.hands.into_iter().zip([LEFT, RIGHT]) {
        if let Some(hand) = hand {
            let joints = hand.map(|p| Point3::from(p.map(f64::from)));
            skeleton(canvas, intrinsics, &HAND, &joints, 2.5 * weight, colour);
        }
    }
    if let Some(gaze) = moment
        .gaze
        .filter(|point| point.iter().all(|v| v.is_finite()))
    {
        let at = gaze.map(|share| f64::from(share) * side - 0.5);
        canvas.ring(at, 11.0 * weight, 5.0 * weight, SHADE);
        canvas.ring(at, 11.0 * weight, 2.5 * weight, GAZE);
        canvas.disc(at, 2.0 * weight, GAZE);
    }
}

/// Bones, dark below, so that they stand out on any picture; each is cut where it passes the camera.
fn skeleton(
    canvas: &mut Canvas,
    intrinsics: &Intrinsics,
    skeleton: &Skeleton,
    joints: &[Point3<f64>],
    thickness: f64,
    colour: Colour,
) {
    let side = canvas.size().0 as f64;
    let seen: Vec<[[f64; 2]; 2]> = skeleton
        .bones()
        .filter_map(|(a, b)| before(joints[a], joints[b]))
        .map(|ends| ends.map(|p| project(intrinsics, side, p)))
        .collect();
    for [from, to] in &seen {
        canvas.line(*from, *to, thickness + 0.5 * thickness, SHADE);
    }
    for [from, to] in &seen {
        canvas.line(*from, *to, thickness, colour);
    }
}

/// The part of a bone before the camera.
fn before(a: Point3<f64>, b: Point3<f64>) -> Option<[Point3<f64>; 2]> {
    let known = |p: Point3<f64>| p.iter().all(|v| v.is_finite());
    if !known(a) || !known(b) || (a.z < NEAREST && b.z < NEAREST) {
        return None;
    }
    let cut = |from: Point3<f64>, to: Point3<f64>| {
        if from.z >= NEAREST {
            return from;
        }
        from + (to - from) * ((NEAREST - from.z) / (to.z - from.z))
    };
    Some([cut(a, b), cut(b, a)])
}

/// Where a point before the camera is seen, in pixels of a square of this side.
fn project(intrinsics: &Intrinsics, side: f64, p: Point3<f64>) -> [f64; 2] {
    let u = (intrinsics.fx * p.x / p.z + intrinsics.cx + 0.5) / f64::from(intrinsics.width) * side
        - 0.5;
    let v = (intrinsics.fy * p.y / p.z + intrinsics.cy + 0.5) / f64::from(intrinsics.height) * side
        - 0.5;
    [u, v]
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENS: Intrinsics = Intrinsics {
        fx: 32.0,
        fy: 32.0,
        cx: 31.5,
        cy: 31.5,
        width: 64,
        height: 64,
    };

    #[test]
    fn a_point_on_the_axis_is_in_the_middle_at_any_size() {
        let p = Point3::new(0.0, 0.0, 2.0);
        assert_eq!(project(&LENS, 64.0, p), [31.5, 31.5]);
        assert_eq!(project(&LENS, 256.0, p), [127.5, 127.5]);
        // 45 degrees to the right is the edge of a view of 90 degrees.
        assert_eq!(project(&LENS, 64.0, Point3::new(2.0, 0.0, 2.0))[0], 63.5);
    }

    #[test]
    fn a_bone_that_passes_the_camera_is_cut_and_one_behind_it_is_not_drawn() {
        let behind = Point3::new(1.0, 0.0, -1.0);
        let ahead = Point3::new(1.0, 0.0, 1.0);
        assert!(before(behind, behind).is_none());
        assert!(before(ahead, Point3::new(f64::NAN, 0.0, 1.0)).is_none());
        let [cut, kept] = before(behind, ahead).unwrap();
        assert!((cut.z - NEAREST).abs() < 1e-12 && (cut.x - 1.0).abs() < 1e-12);
        assert_eq!(kept, ahead);
    }

    #[test]
    fn hands_gaze_and_body_leave_their_colours_and_the_unknown_leaves_none() {
        let black = || Canvas::new(256, 256, [0; 3]);
        let spread = |z: f32| -> Joints {
            std::array::from_fn(|j| [(j as f32 - 10.0) * 0.02, (j % 5) as f32 * 0.05, z])
        };
        let (near, world) = (spread(0.5), spread(1.0));
        let pose = Rigid::identity();
        let mut canvas = black();
        let moment = Moment {
            T_world_camera: Some(&pose),
            body: Some(&world),
            hands: [Some(&near), None],
            gaze: Some([0.1, 0.9]),
        };
        draw(&mut canvas, &LENS, &moment);
        let has = |canvas: &Canvas, like: Colour| {
            let close = |pixel: &[u8]| pixel.iter().zip(like).all(|(a, b)| a.abs_diff(b) < 60);
            canvas.rgb().chunks_exact(3).any(close)
        };
        assert!(has(&canvas, GAZE) && has(&canvas, LEFT) && !has(&canvas, RIGHT));
        let mut nothing = black();
        let unknown = [[f32::NAN; 3]; 21];
        let moment = Moment {
            body: Some(&world),
            hands: [Some(&unknown), None],
            gaze: Some([f32::NAN; 2]),
            ..Moment::default()
        };
        draw(&mut nothing, &LENS, &moment);
        assert_eq!(nothing, black());
    }
}
