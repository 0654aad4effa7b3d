//! Furniture: desks, sideboards, shelves, sofas, low tables, plants, lamps, toys on the floor; doors, windows and pictures.
//!
//! Everything is built in wall coordinates: `u` along the wall, `v` into the room, `z` up.

mod floor;
mod shelves;
mod tables;
mod walls;

pub use walls::{door, hang};

use super::object;
use super::scene::{Rect, Scene, Spot};
use super::wall::{Style, Wall};
use crate::random::StreamRng;
use floor::{floor_lamp, plant, sofa, toys};
use nalgebra::Point2;
use rand::RngExt;
use shelves::{shelf, sideboard};
use tables::table;

/// Places something random at `u`; returns its width and the height above which the wall is free.
pub fn random(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    style: &Style,
    u: f32,
    room_left: f32,
) -> (f32, f32) {
    let needs_spot = scene.spots.is_empty();
    let width =
        |rng: &mut StreamRng, low: f32, high: f32| rng.random_range(low..high).min(room_left);
    let pick = rng.random_range(0..100);
    if room_left < 0.7 || (pick < 8 && !needs_spot) {
        return if rng.random_bool(0.5) {
            plant(scene, rng, wall, u)
        } else {
            floor_lamp(scene, wall, style, u)
        };
    }
    if pick < 34 || needs_spot {
        let w = width(rng, 1.0, 1.6);
        table(scene, rng, wall, style, u, w, false)
    } else if pick < 54 {
        let w = width(rng, 0.9, 1.5);
        sideboard(scene, rng, wall, style, u, w)
    } else if pick < 74 {
        let w = width(rng, 0.7, 1.1);
        shelf(scene, rng, wall, style, u, w)
    } else if pick < 83 && room_left > 1.7 {
        sofa(scene, rng, wall, style, u)
    } else if pick < 92 {
        let w = width(rng, 0.8, 1.1);
        table(scene, rng, wall, style, u, w, true)
    } else {
        let w = width(rng, 0.8, 1.1);
        toys(scene, rng, wall, u, w)
    }
}

fn obstacle(scene: &mut Scene, wall: &Wall, u0: f32, u1: f32, v1: f32) {
    let (a, b) = (wall.at(u0, 0.0, 0.0), wall.at(u1, v1, 0.0));
    let point = |x: f32, y: f32| Point2::new(f64::from(x), f64::from(y));
    scene.obstacles.push(Rect {
        low: point(a.x.min(b.x), a.y.min(b.y)),
        high: point(a.x.max(b.x), a.y.max(b.y)),
    });
}

/// Somewhere to stand in front of `u`, with the objects of `us` in reach.
fn spot(scene: &mut Scene, wall: &Wall, u: f32, v: f32, objects: Vec<usize>) {
    let p = wall.at(u, v, 0.0);
    let stand = Point2::new(f64::from(p.x), f64::from(p.y));
    let heading = f64::from((-wall.inward.y).atan2(-wall.inward.x));
    scene.spots.push(Spot {
        stand,
        heading,
        objects,
    });
}

/// Objects on a surface at `height`, near its front edge, and a spot before each pair of them.
fn stock(
    scene: &mut Scene,
    rng: &mut StreamRng,
    wall: &Wall,
    u: [f32; 2],
    front: f32,
    depth: f32,
    height: f32,
) {
    let count = ((u[1] - u[0]) / 0.3).floor().clamp(1.0, 4.0) as usize;
    let step = (u[1] - u[0]) / count as f32;
    let mut indices = Vec::new();
    for i in 0..count {
        let at = u[0] + step * (i as f32 + rng.random_range(0.3..0.7));
        let v = front - rng.random_range(0.08..depth.min(0.24));
        let foot = wall.at(at, v, height);
        indices.push((at, object::place(scene, rng, &foot.into())));
    }
    for pair in indices.chunks(2) {
        let middle = pair.iter().map(|p| p.0).sum::<f32>() / pair.len() as f32;
        let objects = pair.iter().map(|p| p.1).collect();
        let stand = middle + rng.random_range(-0.12..0.12);
        let lowest = wall.from.max(0.35);
        let stand = stand.clamp(lowest, (wall.to.min(wall.length - 0.35)).max(lowest));
        spot(
            scene,
            wall,
            stand,
            front + rng.random_range(0.22..0.34),
            objects,
        );
    }
}
