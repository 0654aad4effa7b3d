//! The points of the whole recording, quantised for the page.

/// A point in the world, metres, and its sRGB colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Metres, in the world.
    pub position: [f32; 3],
    /// Red, green, blue.
    pub color: [u8; 3],
}

/// 6 bytes of position, 3 of colour and 1 of padding a point.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloud {
    /// The corner of the box, metres.
    pub low: [f32; 3],
    /// The edge of the box, metres; positions are `low + u16 / 65535 * span`.
    pub span: f32,
    /// 10 bytes a point.
    pub bytes: Vec<u8>,
}

/// At most this many points end up in the page.
const LIMIT: usize = 160_000;

/// An even choice of the finite points; `None` without any extent.
pub fn quantise(points: &[Point]) -> Option<Cloud> {
    let finite: Vec<&Point> = points
        .iter()
        .filter(|p| p.position.iter().all(|v| v.is_finite()))
        .collect();
    let chosen: Vec<&Point> = finite
        .iter()
        .step_by(finite.len().div_ceil(LIMIT).max(1))
        .copied()
        .collect();
    let edge = |fold: fn(f32, f32) -> f32, from: f32| {
        [0, 1, 2].map(|axis| chosen.iter().map(|p| p.position[axis]).fold(from, fold))
    };
    let (low, high) = (
        edge(f32::min, f32::INFINITY),
        edge(f32::max, f32::NEG_INFINITY),
    );
    let span = (0..3)
        .map(|axis| high[axis] - low[axis])
        .fold(0.0_f32, f32::max);
    if chosen.is_empty() || !span.is_finite() || span <= 0.0 {
        return None;
    }
    let mut bytes = Vec::with_capacity(chosen.len() * 10);
    for point in chosen {
        for (value, low) in point.position.iter().zip(low) {
            let step = ((value - low) / span * 65535.0).round() as u16;
            bytes.extend_from_slice(&step.to_le_bytes());
        }
        bytes.extend_from_slice(&point.color);
        bytes.push(255);
    }
    Some(Cloud { low, span, bytes })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_survive_to_a_fraction_of_a_millimetre() {
        let points: Vec<Point> = (0..50)
            .map(|i| Point {
                position: [i as f32 * 0.1, -2.0, (i % 7) as f32],
                color: [i as u8; 3],
            })
            .collect();
        let cloud = quantise(&points).unwrap();
        for (point, bytes) in points.iter().zip(cloud.bytes.chunks(10)) {
            for axis in 0..3 {
                let step = u16::from_le_bytes([bytes[axis * 2], bytes[axis * 2 + 1]]);
                let back = cloud.low[axis] + f32::from(step) / 65535.0 * cloud.span;
                assert!((back - point.position[axis]).abs() < 1e-4);
            }
            assert_eq!(bytes[6..9], point.color);
        }
    }

    #[test]
    fn nothing_to_show_is_nothing() {
        assert_eq!(quantise(&[]), None);
        assert_eq!(
            quantise(&[Point {
                position: [f32::NAN; 3],
                color: [0; 3]
            }]),
            None
        );
    }
}
