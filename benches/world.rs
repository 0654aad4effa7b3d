//! Seconds per world clip on one core, at the paper's size and at laptop size.

use reviv::world::{World, WorldSettings};
use std::time::Instant;

fn main() {
    for (size, clips, limit_ms) in [(256u32, 8u64, Some(500.0)), (64, 32, None)] {
        let settings = WorldSettings {
            size,
            ..WorldSettings::default()
        };
        let world = World::new(settings, 0);
        let start = Instant::now();
        let mut checksum = 0u64;
        for index in 0..clips {
            let clip = world.clip(index);
            let rgb = clip.rgb().expect("the world renders colour");
            checksum = rgb.frames.iter().fold(checksum, |a, b| {
                a.wrapping_mul(31).wrapping_add(u64::from(*b))
            });
        }
        let ms = start.elapsed().as_secs_f64() * 1e3 / clips as f64;
        let motion = Instant::now();
        for index in 0..clips {
            std::hint::black_box(world.episode(index, 6.0));
        }
        let plan_ms = motion.elapsed().as_secs_f64() * 1e3 / clips as f64;
        println!(
            "{size}x{size}x16: {ms:.1} ms per clip, of which planning 6 s of motion {plan_ms:.1} ms ({checksum:x})"
        );
        if let Some(limit) = limit_ms {
            println!(
                "  at most {limit} ms: {}",
                if ms <= limit { "ok" } else { "TOO SLOW" }
            );
        }
    }
}
