//! The built-in world obeys physics and shows what it claims: bones, feet, joints, projections, depth, determinism.

use nalgebra::{Isometry3, Point3};
use reviv::clip::{Clip, Intrinsics, JointTrack, clock};
use reviv::geometry::skeleton::{BODY, HAND, JOINTS, Skeleton};
use reviv::world::render::Part;
use reviv::world::{HandValidity, World, WorldSettings};

fn world(size: u32) -> World {
    let settings = WorldSettings {
        size,
        hands: HandValidity::Always,
        ..WorldSettings::default()
    };
    World::new(settings, 11)
}

fn joint(track: &JointTrack, t: usize, j: usize) -> Point3<f64> {
    Point3::from(std::array::from_fn::<f64, 3, _>(|k| {
        f64::from(track.joints[[t, j, k]])
    }))
}

fn bones(skeleton: &Skeleton, track: &JointTrack, t: usize) -> Vec<f64> {
    let pose: [[f64; 3]; JOINTS] = std::array::from_fn(|j| joint(track, t, j).into());
    skeleton.bone_lengths(&pose)
}

/// How many clips the physical checks look at: `ordinary`, or what `REVIV_WORLD_CLIPS` says for a longer look.
fn looked_at(ordinary: u64) -> u64 {
    std::env::var("REVIV_WORLD_CLIPS").map_or(ordinary, |count| count.parse().unwrap())
}

#[test]
fn bones_keep_their_length_through_every_clip() {
    let world = world(16);
    for clip in (0..looked_at(40)).map(|index| world.clip(index)) {
        let tracks = [
            (&BODY, clip.body()),
            (&HAND, clip.left_hand()),
            (&HAND, clip.right_hand()),
        ];
        for (skeleton, track) in tracks {
            let track = track.unwrap();
            assert!(track.valid.iter().all(|v| *v), "{}", clip.id);
            let first = bones(skeleton, track, 0);
            for t in 1..60 {
                for (bone, (a, b)) in first.iter().zip(bones(skeleton, track, t)).enumerate() {
                    // The pelvis to spine2 spans the joint that the list leaves out, which bends.
                    let (parent, child) = skeleton.bones().nth(bone).unwrap();
                    let spans_two = skeleton.name == "body" && (parent, child) == (0, 5);
                    let tolerance = if spans_two { 0.02 } else { 2e-5 };
                    assert!(
                        (a - b).abs() < tolerance,
                        "{} {} {t} {parent}-{child}: {a} {b}",
                        clip.id,
                        skeleton.name
                    );
                }
            }
        }
    }
}

#[test]
fn a_foot_on_the_floor_slides_less_than_two_centimetres() {
    let world = world(16);
    let mut standing = 0;
    for index in 0..looked_at(40) {
        let episode = world.episode(index, 6.0);
        let toe = |t: f64, side: usize| episode.at(t).posture.body.toes[side];
        for side in 0..2 {
            let mut contact: Option<Point3<f64>> = None;
            for i in 0..(6 * 30) {
                let p = toe(f64::from(i) / 30.0, side);
                if p.z > 0.03 {
                    contact = None;
                    continue;
                }
                let start = *contact.get_or_insert(p);
                // Of a swing's first and last moments the foot is still within millimetres of the floor.
                assert!((p - start).xy().norm() < 0.02, "{index} {i}");
                standing += 1;
            }
        }
    }
    assert!(standing > 8000, "{standing}");
}

/// The angle between two bones at a joint, degrees; 180 is straight.
fn angle(a: &Point3<f64>, middle: &Point3<f64>, b: &Point3<f64>) -> f64 {
    (a - middle).angle(&(b - middle)).to_degrees()
}

#[test]
fn joints_stay_in_human_range() {
    let world = world(16);
    for index in 0..looked_at(40) {
        let episode = world.episode(index, 7.0);
        let wearer = &episode.motion().wearer;
        for i in 0..(7 * 15) {
            let t = f64::from(i) / 15.0;
            let moment = episode.at(t);
            let (body, trunk) = (&moment.posture.body, &moment.posture.body.trunk);
            for side in 0..2 {
                let knee = angle(&trunk.hips[side], &body.knees[side], &body.ankles[side]);
                assert!((30.0..180.0).contains(&knee), "{index} {t} knee {knee}");
                let elbow = angle(
                    &trunk.shoulders[side],
                    &body.elbows[side],
                    &body.wrists[side],
                );
                assert!((18.0..180.0).contains(&elbow), "{index} {t} elbow {elbow}");
                let forward = trunk.T_world_pelvis.rotation * nalgebra::Vector3::x();
                let line = body.ankles[side] - trunk.hips[side];
                let bend = body.knees[side] - trunk.hips[side];
                let out = bend - line * (bend.dot(&line) / line.norm_squared());
                assert!(
                    out.norm() < 0.03 || out.dot(&forward) > 0.0,
                    "{index} {t} knees bend forwards"
                );
                let forearm = body.wrists[side] - body.elbows[side];
                let fingers = moment.posture.T_world_hand[side].rotation * nalgebra::Vector3::x();
                let wrist = forearm.angle(&fingers).to_degrees();
                assert!(wrist < 75.0, "{index} {t} wrist {wrist}");
                let foot = body.toes[side] - body.ankles[side];
                assert!(
                    (foot.norm() - wearer.ankle.norm()).abs() < 1e-6,
                    "{index} {t} the leg reaches the foot"
                );
            }
            let up = |pose: &Isometry3<f64>| pose.rotation * nalgebra::Vector3::z();
            let neck = up(&trunk.T_world_head)
                .angle(&up(&trunk.T_world_chest))
                .to_degrees();
            assert!(neck < 75.0, "{index} {t} neck {neck}");
            assert!(body.toes.iter().all(|p| p.z > 0.01));
            let head = trunk.T_world_head.translation.vector;
            let size = episode.scene().size;
            assert!(head.x > 0.05 && head.x < f64::from(size.x) - 0.05);
            assert!(head.y > 0.05 && head.y < f64::from(size.y) - 0.05);
        }
    }
}

#[test]
fn hands_are_where_their_pixels_are() {
    let world = world(128);
    let (mut seen, mut hidden) = (0, 0);
    for index in 0..looked_at(12) {
        let episode = world.episode(index, 6.0);
        let renderer = episode.renderer();
        for step in 0..6 {
            let moment = episode.at(0.8 + 0.8 * f64::from(step));
            let frame = episode.frame(&renderer, &moment);
            for (side, hand) in moment.hands.iter().enumerate() {
                let part = [Part::LeftArm, Part::RightArm][side];
                for joint in hand {
                    let camera = &moment.posture.T_world_camera;
                    let Some([x, y, z]) = episode.project(camera, joint) else {
                        continue;
                    };
                    let (x, y) = (x.round(), y.round());
                    if !(0.0..128.0).contains(&x) || !(0.0..128.0).contains(&y) || z < 0.1 {
                        continue;
                    }
                    let pixel = y as usize * 128 + x as usize;
                    let surface = f64::from(frame.depth[pixel]);
                    assert!(
                        surface < z + 0.012,
                        "nothing shows behind a joint: {index} {step} {surface} {z}"
                    );
                    // Its own hand or arm, or something nearer.
                    if frame.parts[pixel] == part {
                        seen += 1;
                    } else {
                        hidden += 1;
                    }
                }
            }
        }
    }
    assert!(
        seen > 300 && seen > hidden,
        "{seen} joints seen, {hidden} behind something"
    );
}

fn unproject(k: &Intrinsics, x: f64, y: f64, z: f64) -> Point3<f64> {
    Point3::new((x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z)
}

#[test]
fn depth_and_pose_of_one_frame_predict_the_depth_of_another() {
    let world = world(96);
    let k = world.settings().intrinsics();
    let (mut agree, mut disagree) = (0, 0);
    for index in 0..looked_at(6) {
        let episode = world.episode(index, 5.0);
        let renderer = episode.renderer();
        for step in 0..4 {
            let t = 1.0 + 0.7 * f64::from(step);
            let (a, b) = (episode.at(t), episode.at(t + 0.2));
            let (frame_a, frame_b) = (episode.frame(&renderer, &a), episode.frame(&renderer, &b));
            for pixel in (0..96 * 96).step_by(7) {
                if frame_a.parts[pixel] != Part::Room {
                    continue;
                }
                let (x, y) = ((pixel % 96) as f64, (pixel / 96) as f64);
                let z = f64::from(frame_a.depth[pixel]);
                let point = a.posture.T_world_camera * unproject(&k, x, y, z);
                let size = episode.scene().size;
                for (v, limit) in [(point.x, size.x), (point.y, size.y), (point.z, size.z)] {
                    assert!(v > -2e-3 && v < f64::from(limit) + 2e-3, "inside the room");
                }
                let Some([x, y, z]) = episode.project(&b.posture.T_world_camera, &point) else {
                    continue;
                };
                let (x, y) = (x.round(), y.round());
                if (0.0..96.0).contains(&x) && (0.0..96.0).contains(&y) {
                    let other = y as usize * 96 + x as usize;
                    let found = f64::from(frame_b.depth[other]);
                    if (found - z).abs() < 0.03 * z + 0.02 {
                        agree += 1;
                    } else {
                        disagree += 1;
                    }
                }
            }
        }
    }
    assert!(
        agree > 5000 && agree > 9 * disagree,
        "{agree} agree, {disagree} do not"
    );
}

#[test]
fn clips_are_a_function_of_seed_and_index_on_any_number_of_threads() {
    use rayon::prelude::*;
    let world = world(24);
    let one: Vec<Clip> = (0..6).map(|i| world.clip(i)).collect();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(4)
        .build()
        .unwrap();
    let many: Vec<Clip> = pool.install(|| {
        (0..6usize)
            .into_par_iter()
            .rev()
            .map(|i| world.clip(i as u64))
            .collect()
    });
    for (a, b) in one.iter().zip(many.iter().rev()) {
        assert!(a == b, "{}", a.id);
    }
    assert!(one[0] != one[1]);
    assert!(World::new(world.settings().clone(), 12).clip(0) != one[0]);
}

#[test]
fn a_longer_episode_begins_like_a_shorter_one() {
    let world = world(16);
    for index in 0..5 {
        let (short, long) = (world.episode(index, 4.0), world.episode(index, 9.0));
        for i in 0..30 {
            let t = f64::from(i) * 0.1;
            let (a, b) = (short.at(t), long.at(t));
            assert!((a.hands[0][5] - b.hands[0][5]).norm() < 1e-9, "{index} {t}");
            assert_eq!(a.gaze.is_some(), b.gaze.is_some());
        }
    }
}

#[test]
fn what_is_to_be_learned_varies_and_is_often_in_view() {
    let settings = WorldSettings {
        size: 16,
        ..WorldSettings::default()
    };
    let world = World::new(settings, 3);
    let (mut gaze, mut heights, mut travel) = (Vec::new(), Vec::new(), Vec::new());
    let (mut with_hands, mut blinks) = (0, 0);
    for index in 0..60 {
        let clip = world.clip(index);
        let track = clip.gaze().unwrap();
        for t in 0..60 {
            if track.valid[t] {
                gaze.push([
                    f64::from(track.points[[t, 0]]),
                    f64::from(track.points[[t, 1]]),
                ]);
            } else {
                blinks += 1;
            }
        }
        let body = clip.body().unwrap();
        heights.push(joint(body, 0, 9).z);
        travel.push((joint(body, 59, 0) - joint(body, 0, 0)).norm());
        let seen = |hand: Option<&JointTrack>| hand.unwrap().valid.iter().any(|v| *v);
        with_hands += usize::from(seen(clip.left_hand()) || seen(clip.right_hand()));
        let imu = &clip.signal("head_imu").unwrap();
        assert_eq!(imu.values.shape(), [60, 6]);
        let mean_force = (0..60)
            .map(|t| {
                (0..3)
                    .map(|k| imu.values[[t, k]].powi(2))
                    .sum::<f32>()
                    .sqrt()
            })
            .sum::<f32>()
            / 60.0;
        assert!(
            (8.5..12.5).contains(&mean_force),
            "{} {mean_force}",
            clip.id
        );
        assert_eq!(
            clip.camera().unwrap().T_world_camera.len(),
            clock::SIGNAL_SAMPLES
        );
    }
    let spread = |values: Vec<f64>| {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
    };
    let (x, y) = (
        spread(gaze.iter().map(|g| g[0]).collect()),
        spread(gaze.iter().map(|g| g[1]).collect()),
    );
    assert!(x > 0.06 && y > 0.06, "gaze {x} {y}");
    assert!(spread(heights) > 0.08);
    assert!(spread(travel.clone()) > 0.3, "{}", spread(travel));
    assert!(
        (25..60).contains(&with_hands),
        "{with_hands} of 60 clips show a hand"
    );
    assert!((40..800).contains(&blinks), "{blinks}");
}
