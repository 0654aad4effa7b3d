//! The reconstruction picture on the page of a run: held-out clips beside what comes back from their tokens.
//!
//! Video: rows of frames, one clip below the other (the clip, its reconstruction, k-means). Signals over time: a panel per
//! channel; joints over time: a panel per axis of a few joints.

use crate::modality::Shape;
use crate::training::tokenizer_scores::Example;
use std::fmt::Write;

/// Frames of each.
const FRAMES: usize = 6;

/// Pixels between frames.
const GAP: usize = 4;

/// Frames are enlarged to about this many pixels.
const SIDE: usize = 128;

/// The name of the file below `report/` and its bytes; `None` where there is nothing to show.
pub(super) fn draw(shape: &Shape, examples: &[Example]) -> Option<(&'static str, Vec<u8>)> {
    match shape {
        Shape::Video {
            frames,
            height,
            width,
        } => {
            let png = strips(examples, [*frames, *height, *width])?;
            Some(("tokenizer_reconstruction.png", png))
        }
        Shape::Temporal { samples, channels } => {
            let panels = (0..*channels).map(|c| (format!("channel {c}"), c, c));
            let svg = curves(examples.first()?, *samples, *channels, panels.collect(), 1)?;
            Some(("tokenizer_reconstruction.svg", svg.into_bytes()))
        }
        Shape::Kinematic { samples, joints } => {
            let mut panels = Vec::new();
            for joint in [0, joints / 2, joints.saturating_sub(1)] {
                for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
                    panels.push((
                        format!("joint {joint}, {name} (m)"),
                        joint * 3 + axis,
                        joint,
                    ));
                }
            }
            let svg = curves(examples.first()?, *samples, joints * 3, panels, *joints)?;
            Some(("tokenizer_reconstruction.svg", svg.into_bytes()))
        }
    }
}

/// Rows of frames as PNG.
fn strips(examples: &[Example], [frames, height, width]: [usize; 3]) -> Option<Vec<u8>> {
    if examples.is_empty() || frames == 0 || height == 0 || width == 0 {
        return None;
    }
    let zoom = (SIDE / height.max(width)).clamp(1, 8);
    let (tall, wide) = (height * zoom, width * zoom);
    let columns = FRAMES.min(frames);
    let rows: Vec<&[f32]> = examples
        .iter()
        .flat_map(|example| {
            [
                Some(&example.truth),
                Some(&example.found),
                example.kmeans.as_ref(),
            ]
        })
        .flatten()
        .map(Vec::as_slice)
        .collect();
    let row_count = rows.len();
    let size = [row_count * (tall + GAP) + GAP, columns * (wide + GAP) + GAP];
    let mut image = vec![255_u8; size[0] * size[1] * 3];
    for (row, values) in rows.into_iter().enumerate() {
        for column in 0..columns {
            let frame = column * (frames - 1) / (columns - 1).max(1);
            for y in 0..tall {
                for x in 0..wide {
                    let from = ((frame * height + y / zoom) * width + x / zoom) * 3;
                    let to = ((GAP + row * (tall + GAP) + y) * size[1]
                        + GAP
                        + column * (wide + GAP)
                        + x)
                        * 3;
                    for colour in 0..3 {
                        let value = values.get(from + colour).copied().unwrap_or(0.0);
                        image[to + colour] = ((value.clamp(-1.0, 1.0) + 1.0) * 127.5).round() as u8;
                    }
                }
            }
        }
    }
    let mut bytes = Vec::new();
    let (high, across) = (u32::try_from(size[0]).ok()?, u32::try_from(size[1]).ok()?);
    let mut encoder = png::Encoder::new(&mut bytes, across, high);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().ok()?;
    writer.write_image_data(&image).ok()?;
    writer.finish().ok()?;
    Some(bytes)
}

/// Panels `(title, channel, item of the validity)` of one clip as SVG.
fn curves(
    example: &Example,
    samples: usize,
    channels: usize,
    panels: Vec<(String, usize, usize)>,
    items: usize,
) -> Option<String> {
    const COLUMNS: usize = 3;
    const PANEL: [f64; 2] = [260.0, 150.0];
    if samples == 0 || panels.is_empty() {
        return None;
    }
    let rows = panels.len().div_ceil(COLUMNS);
    let size = [PANEL[0] * COLUMNS as f64, PANEL[1] * rows as f64 + 24.0];
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" width=\"{}\" \
         font-family=\"sans-serif\" font-size=\"11\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        size[0], size[1], size[0]
    );
    let mut legend = 10.0;
    let kinds = [
        ("held-out clip", "#222222", "1.8", ""),
        ("k-means", "#56b4e9", "1.2", "2 3"),
        ("tokenizer", "#d55e00", "1.6", "6 3"),
    ];
    for (name, colour, thick, dashes) in &kinds {
        let _ = writeln!(
            svg,
            "<line x1=\"{legend}\" x2=\"{}\" y1=\"12\" y2=\"12\" stroke=\"{colour}\" stroke-width=\"{thick}\" \
             stroke-dasharray=\"{dashes}\"/><text x=\"{}\" y=\"16\">{name}</text>",
            legend + 30.0,
            legend + 36.0
        );
        legend += 140.0;
    }
    for (index, (title, channel, item)) in panels.iter().enumerate() {
        let corner = [
            (index % COLUMNS) as f64 * PANEL[0] + 44.0,
            (index / COLUMNS) as f64 * PANEL[1] + 44.0,
        ];
        let inner = [PANEL[0] - 58.0, PANEL[1] - 40.0];
        let series = |values: &[f32]| -> Vec<Option<f64>> {
            (0..samples)
                .map(|t| values.get(t * channels + channel).map(|v| f64::from(*v)))
                .collect()
        };
        let mut truth = series(&example.truth);
        if let Some(valid) = &example.valid {
            let per = valid.len() / samples;
            for (t, value) in truth.iter_mut().enumerate() {
                let place = if per == items {
                    t * per + item % per.max(1)
                } else {
                    t * per
                };
                if !valid.get(place).copied().unwrap_or(true) {
                    *value = None;
                }
            }
        }
        let lines = [
            truth,
            example.kmeans.as_deref().map(series).unwrap_or_default(),
            series(&example.found),
        ];
        let finite = || lines.iter().flatten().flatten().filter(|v| v.is_finite());
        let low = finite().copied().fold(f64::INFINITY, f64::min);
        let high = finite().copied().fold(f64::NEG_INFINITY, f64::max);
        if low > high {
            continue;
        }
        let span = (high - low).max(1e-6);
        let _ = writeln!(
            svg,
            "<rect x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" fill=\"none\" stroke=\"#bbbbbb\"/>\
             <text x=\"{}\" y=\"{}\">{title}</text>\
             <text x=\"{}\" y=\"{}\" text-anchor=\"end\" fill=\"#555555\">{high:.2}</text>\
             <text x=\"{}\" y=\"{}\" text-anchor=\"end\" fill=\"#555555\">{low:.2}</text>",
            corner[0],
            corner[1],
            inner[0],
            inner[1],
            corner[0],
            corner[1] - 5.0,
            corner[0] - 4.0,
            corner[1] + 10.0,
            corner[0] - 4.0,
            corner[1] + inner[1],
        );
        for (line, (_, colour, thick, dashes)) in lines.iter().zip(&kinds) {
            let mut path = String::new();
            let mut pen_down = false;
            for (t, value) in line.iter().enumerate() {
                let Some(value) = value.filter(|value| value.is_finite()) else {
                    pen_down = false;
                    continue;
                };
                let x = corner[0] + inner[0] * t as f64 / (samples - 1).max(1) as f64;
                let y = corner[1] + inner[1] * (high - value) / span;
                let _ = write!(path, "{}{x:.1} {y:.1}", if pen_down { 'L' } else { 'M' });
                pen_down = true;
            }
            let _ = writeln!(
                svg,
                "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{thick}\" stroke-dasharray=\"{dashes}\"/>"
            );
        }
    }
    svg.push_str("</svg>\n");
    Some(svg)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn example(values: usize) -> Example {
        Example {
            truth: (0..values).map(|i| (i as f32 * 0.1).sin()).collect(),
            valid: None,
            found: vec![0.5; values],
            kmeans: None,
        }
    }

    #[test]
    fn a_video_shows_every_clip_and_its_reconstruction_side_by_side() {
        let shape = Shape::Video {
            frames: 4,
            height: 16,
            width: 16,
        };
        let examples = [example(4 * 16 * 16 * 3), example(4 * 16 * 16 * 3)];
        let (name, bytes) = draw(&shape, &examples).unwrap();
        assert_eq!(name, "tokenizer_reconstruction.png");
        let decoder = png::Decoder::new(std::io::Cursor::new(bytes));
        let info = decoder.read_info().unwrap().info().clone();
        assert_eq!(info.height as usize, 4 * (128 + GAP) + GAP);
        assert_eq!(info.width as usize, 4 * (128 + GAP) + GAP);
        assert!(draw(&shape, &[]).is_none());
    }

    #[test]
    fn a_curve_is_broken_where_the_clip_is_not_valid() {
        let shape = Shape::Kinematic {
            samples: 6,
            joints: 4,
        };
        let mut one = example(6 * 12);
        let whole = String::from_utf8(draw(&shape, &[one.clone()]).unwrap().1).unwrap();
        let mut valid = vec![true; 24];
        valid[3 * 4] = false;
        one.valid = Some(valid);
        let broken = String::from_utf8(draw(&shape, &[one]).unwrap().1).unwrap();
        // The three axes of joint 0 start anew after the gap.
        assert_eq!(broken.matches('M').count(), whole.matches('M').count() + 3);
    }
}
