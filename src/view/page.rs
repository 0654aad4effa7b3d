//! One HTML file from a [`Scene`].

use super::cloud::quantise;
use super::scene::{Drawing, Part, SAMPLE, Scene, Tone, ViewError};
use base64::engine::general_purpose::STANDARD;
use base64::write::EncoderWriter;
use ndarray::Array3;
use serde_json::{Value, json};
use std::io::Write;

const TEMPLATE: &str = include_str!("page/page.html");
const STYLE: &str = include_str!("page/page.css");
const SCRIPT: [&str; 3] = [
    include_str!("page/data.js"),
    include_str!("page/draw.js"),
    include_str!("page/main.js"),
];
/// Metres per step of the embedded depth: 65.535 m at most.
const DEPTH_UNIT: f32 = 0.001;

/// Writes the page of `scene` to `out`.
///
/// # Errors
/// When lengths in the scene disagree, a frame cannot be stored, or writing fails.
pub fn write_page(scene: &Scene, out: &mut impl Write) -> Result<(), ViewError> {
    scene.check()?;
    let cloud = quantise(&scene.cloud);
    let intrinsics = &scene.intrinsics;
    let (width, height) = (f64::from(intrinsics.width), f64::from(intrinsics.height));
    let manifest = json!({
        "title": scene.title,
        "badges": scene.badges.iter().map(|b| json!({"text": b.text, "kind": match b.tone {
            Tone::Plain => "plain", Tone::Good => "good", Tone::Warn => "warn" }})).collect::<Vec<_>>(),
        "facts": scene.facts.iter().map(|f| json!({"label": f.label, "value": f.value})).collect::<Vec<_>>(),
        "rate": scene.rate,
        "samples": scene.samples,
        "floor": scene.floor,
        // Focal length and centre as shares of the image, whose corners are (0, 0) and (1, 1).
        "lens": [intrinsics.fx / width, intrinsics.fy / height, (intrinsics.cx + 0.5) / width, (intrinsics.cy + 0.5) / height],
        "video": scene.video.as_ref().map(|v| json!({
            "rate": v.rate, "count": v.len(), "offsets": v.offsets() })),
        "depth": scene.depth.as_ref().map(|d| json!({
            "size": [d.metres.shape()[2], d.metres.shape()[1]], "unit": DEPTH_UNIT })),
        "cloud": cloud.as_ref().map(|c| json!({"low": c.low, "span": c.span})),
        "tracks": scene.tracks.iter().map(|t| json!({"name": t.name, "truth": t.truth,
            "ghost": t.name.starts_with(SAMPLE),
            "parts": t.parts.iter().map(part).collect::<Vec<Value>>()})).collect::<Vec<Value>>(),
        "certainty": scene.certainty.iter().map(|c| json!({"name": c.name})).collect::<Vec<Value>>(),
    });

    let mut rest = TEMPLATE;
    while let Some((before, after)) = rest.split_once("{{") {
        let (slot, after) = after
            .split_once("}}")
            .expect("the template closes every slot");
        out.write_all(before.as_bytes())?;
        match slot {
            "title" => out.write_all(escape(&scene.title).as_bytes())?,
            "style" => out.write_all(STYLE.as_bytes())?,
            // `<` may not end the script element the manifest stands in.
            "manifest" => out.write_all(manifest.to_string().replace('<', "\\u003c").as_bytes())?,
            "script" => {
                for part in SCRIPT {
                    out.write_all(part.as_bytes())?;
                }
            }
            "blobs" => {
                if let Some(video) = &scene.video {
                    blob(out, "video", video.bytes())?;
                }
                if let Some(depth) = &scene.depth {
                    blob(out, "depth", &depth_bytes(&depth.metres))?;
                }
                if let Some(cloud) = &cloud {
                    blob(out, "cloud", &cloud.bytes)?;
                }
                for (track, part) in scene
                    .tracks
                    .iter()
                    .flat_map(|t| t.parts.iter().map(move |p| (t, p)))
                {
                    let name = format!("{}-{}", track.name, part.modality);
                    blob(out, &name, &float_bytes(part.values.iter().copied()))?;
                }
                for strip in &scene.certainty {
                    blob(
                        out,
                        &format!("certainty-{}", strip.name),
                        &float_bytes(strip.values.iter().copied()),
                    )?;
                }
            }
            other => unreachable!("the template has no slot `{other}`"),
        }
        rest = after;
    }
    out.write_all(rest.as_bytes())?;
    Ok(())
}

fn part(part: &Part) -> Value {
    let mut about = match &part.drawing {
        Drawing::Camera => json!({"kind": "camera"}),
        Drawing::Pose => json!({"kind": "pose"}),
        Drawing::ImagePoint => json!({"kind": "point"}),
        Drawing::Joints { bones, in_image } => {
            json!({"kind": "joints", "bones": bones, "in_image": in_image})
        }
        Drawing::Plot { channels, units } => {
            json!({"kind": "plot", "channels": channels, "units": units})
        }
    };
    about["name"] = json!(part.modality);
    about["layer"] = json!(part.layer);
    about["width"] = json!(part.values.ncols());
    about
}

/// `u16` steps of [`DEPTH_UNIT`], little-endian; 0 where unknown.
fn depth_bytes(metres: &Array3<f32>) -> Vec<u8> {
    metres
        .iter()
        .flat_map(|m| {
            if m.is_finite() {
                (m / DEPTH_UNIT).round() as u16
            } else {
                0
            }
            .to_le_bytes()
        })
        .collect()
}

fn float_bytes(values: impl Iterator<Item = f32>) -> Vec<u8> {
    values.flat_map(f32::to_le_bytes).collect()
}

fn blob(out: &mut impl Write, name: &str, bytes: &[u8]) -> Result<(), ViewError> {
    // Names of modalities come from the folder of a model.
    let name = escape(name);
    write!(out, "<script type=\"text/plain\" id=\"blob-{name}\">")?;
    let mut encoder = EncoderWriter::new(&mut *out, &STANDARD);
    encoder.write_all(bytes)?;
    encoder.finish()?;
    drop(encoder);
    out.write_all(b"</script>\n")?;
    Ok(())
}

/// For text and for attributes in double quotes.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
