//! Coloured points as binary little-endian PLY.

use std::io::Write;

pub use crate::view::cloud::Point;

/// Writes `points`.
///
/// # Errors
/// When writing fails.
pub fn write_ply(points: &[Point], comment: &str, out: &mut impl Write) -> std::io::Result<()> {
    writeln!(out, "ply\nformat binary_little_endian 1.0")?;
    for line in comment.lines() {
        writeln!(out, "comment {line}")?;
    }
    writeln!(out, "element vertex {}", points.len())?;
    for property in [
        "float x",
        "float y",
        "float z",
        "uchar red",
        "uchar green",
        "uchar blue",
    ] {
        writeln!(out, "property {property}")?;
    }
    writeln!(out, "end_header")?;
    for point in points {
        for value in point.position {
            out.write_all(&value.to_le_bytes())?;
        }
        out.write_all(&point.color)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_header_says_what_follows() {
        let points = [Point {
            position: [1.0, -2.0, 0.5],
            color: [9, 8, 7],
        }; 3];
        let mut out = Vec::new();
        write_ply(&points, "metres", &mut out).unwrap();
        let body = out.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        assert!(String::from_utf8_lossy(&out[..body]).contains("element vertex 3\n"));
        assert_eq!(out.len() - body, 3 * 15);
        assert_eq!(out[body..body + 4], 1.0_f32.to_le_bytes());
        assert_eq!(out[out.len() - 3..], [9, 8, 7]);
    }
}
