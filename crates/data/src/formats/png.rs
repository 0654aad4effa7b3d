//! PNG pictures: 8-bit grey and colour, 16-bit grey (depth).

use super::{FormatError, write_atomically};
use ndarray::{Array2, Array3};
use std::io::Cursor;
use std::path::Path;

/// A picture as `[height, width]` or `[height, width, 3]`.
#[derive(Debug, Clone, PartialEq)]
pub enum Picture {
    /// Grey of 8 bits, `[height, width]`.
    Grey8(Array2<u8>),
    /// Grey of 16 bits, `[height, width]`: depth maps.
    Grey16(Array2<u16>),
    /// Red, green and blue of 8 bits each, `[height, width, 3]`.
    Rgb8(Array3<u8>),
}

/// More pixels than any camera of the supported data sets has, and few enough to hold.
const MAX_PIXELS: u64 = 64 << 20;
/// More than a picture of that many pixels has, uncompressed.
const MAX_BYTES: u64 = 1 << 30;

/// Reads the picture at `path`. Palettes and fewer than 8 bits are expanded, transparency is dropped.
pub fn read(path: &Path) -> Result<Picture, FormatError> {
    super::read_whole(path, MAX_BYTES)
        .and_then(|bytes| parse(&bytes))
        .map_err(|e| e.in_file(path))
}

/// Writes a picture to `path` (to a temporary name first, then renamed).
pub fn write(path: &Path, picture: &Picture) -> Result<(), FormatError> {
    to_bytes(picture)
        .and_then(|bytes| write_atomically(path, &bytes))
        .map_err(|e| e.in_file(path))
}

/// Reads a picture from the bytes of a PNG file.
pub fn parse(bytes: &[u8]) -> Result<Picture, FormatError> {
    let mut decoder =
        png::Decoder::new_with_limits(Cursor::new(bytes), png::Limits { bytes: 64 << 20 });
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(|e| refused(bytes, &e))?;
    let (width, height) = (reader.info().width, reader.info().height);
    let pixels = u64::from(width) * u64::from(height);
    // A picture of n compressed bytes holds at most 1032 n bytes of pixels: a smaller file is a lie or a bomb.
    if pixels > MAX_PIXELS || pixels / 8 > (bytes.len() as u64).saturating_mul(1032) {
        let reason = format!("{width} x {height} pixels in {} bytes", bytes.len());
        return Err(malformed(16, reason));
    }
    let (color, depth) = reader.output_color_type();
    let size = reader
        .output_buffer_size()
        .ok_or_else(|| malformed(16, "the picture does not fit into memory"))?;
    let mut data = vec![0; size];
    reader
        .next_frame(&mut data)
        .map_err(|e| refused(bytes, &e))?;
    let (h, w) = (height as usize, width as usize);
    let shape_error = |e: ndarray::ShapeError| malformed(16, e.to_string());
    match (color, depth) {
        (png::ColorType::Grayscale, png::BitDepth::Eight) => Array2::from_shape_vec((h, w), data)
            .map(Picture::Grey8)
            .map_err(shape_error),
        (png::ColorType::GrayscaleAlpha, png::BitDepth::Eight) => {
            let grey = data.chunks_exact(2).map(|p| p[0]).collect();
            Array2::from_shape_vec((h, w), grey)
                .map(Picture::Grey8)
                .map_err(shape_error)
        }
        (png::ColorType::Grayscale, png::BitDepth::Sixteen) => {
            let grey = data
                .chunks_exact(2)
                .map(|p| u16::from_be_bytes([p[0], p[1]]))
                .collect();
            Array2::from_shape_vec((h, w), grey)
                .map(Picture::Grey16)
                .map_err(shape_error)
        }
        (png::ColorType::Rgb, png::BitDepth::Eight) => Array3::from_shape_vec((h, w, 3), data)
            .map(Picture::Rgb8)
            .map_err(shape_error),
        (png::ColorType::Rgba, png::BitDepth::Eight) => {
            let rgb = data
                .chunks_exact(4)
                .flat_map(|p| [p[0], p[1], p[2]])
                .collect();
            Array3::from_shape_vec((h, w, 3), rgb)
                .map(Picture::Rgb8)
                .map_err(shape_error)
        }
        (color, depth) => Err(malformed(
            24,
            format!(
                "{color:?} with {depth:?} bits is not read: 8-bit grey or colour, or 16-bit grey"
            ),
        )),
    }
}

/// The bytes of a PNG file; equal pictures give equal bytes.
pub fn to_bytes(picture: &Picture) -> Result<Vec<u8>, FormatError> {
    let (height, width, color, depth, data): (_, _, _, _, Vec<u8>) = match picture {
        Picture::Grey8(a) => (
            a.nrows(),
            a.ncols(),
            png::ColorType::Grayscale,
            png::BitDepth::Eight,
            a.iter().copied().collect(),
        ),
        Picture::Grey16(a) => (
            a.nrows(),
            a.ncols(),
            png::ColorType::Grayscale,
            png::BitDepth::Sixteen,
            a.iter().flat_map(|v| v.to_be_bytes()).collect(),
        ),
        Picture::Rgb8(a) => {
            let (h, w, channels) = a.dim();
            if channels != 3 {
                let reason = format!("a colour picture of shape [{h}, {w}, {channels}]");
                return Err(FormatError::Conversion { reason });
            }
            (
                h,
                w,
                png::ColorType::Rgb,
                png::BitDepth::Eight,
                a.iter().copied().collect(),
            )
        }
    };
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, width as u32, height as u32);
    encoder.set_color(color);
    encoder.set_depth(depth);
    let unwritable = |e: png::EncodingError| FormatError::Conversion {
        reason: format!("the picture cannot be written as PNG: {e}"),
    };
    let mut writer = encoder.write_header().map_err(unwritable)?;
    writer.write_image_data(&data).map_err(unwritable)?;
    writer.finish().map_err(unwritable)?;
    Ok(out)
}

fn malformed(offset: u64, reason: impl Into<String>) -> FormatError {
    FormatError::malformed("png", offset, reason)
}

fn refused(bytes: &[u8], error: &png::DecodingError) -> FormatError {
    let offset = if bytes.starts_with(b"\x89PNG") { 8 } else { 0 };
    malformed(offset, error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn pictures() -> [Picture; 3] {
        [
            Picture::Grey8(Array2::from_shape_fn((5, 7), |(y, x)| (y * 31 + x) as u8)),
            Picture::Grey16(Array2::from_shape_fn((5, 7), |(y, x)| {
                (y * 9999 + x) as u16
            })),
            Picture::Rgb8(Array3::from_shape_fn((5, 7, 3), |(y, x, c)| {
                (y * 31 + x * 3 + c) as u8
            })),
        ]
    }

    #[test]
    fn pictures_survive_the_round_trip() {
        for picture in pictures() {
            let bytes = to_bytes(&picture).unwrap();
            assert_eq!(bytes, to_bytes(&picture).unwrap());
            assert_eq!(parse(&bytes).unwrap(), picture);
        }
    }

    #[test]
    fn a_huge_declared_size_is_refused_before_it_is_allocated() {
        let mut bytes = to_bytes(&pictures()[0]).unwrap();
        bytes[16..20].copy_from_slice(&60_000u32.to_be_bytes());
        bytes[20..24].copy_from_slice(&1000u32.to_be_bytes());
        let mut crc = flate2::Crc::new();
        crc.update(&bytes[12..29]);
        let sum = crc.sum().to_be_bytes();
        bytes[29..33].copy_from_slice(&sum);
        let error = parse(&bytes).unwrap_err().to_string();
        assert!(error.contains("60000 x 1000"), "{error}");
    }

    proptest! {
        #[test]
        fn no_damage_makes_the_reader_panic(which in 0usize..3, at in 0usize..300, value in any::<u8>(), cut in 0usize..400) {
            let mut bytes = to_bytes(&pictures()[which]).unwrap();
            let at = at % bytes.len();
            bytes[at] = value;
            bytes.truncate(cut);
            let _ = parse(&bytes);
        }
    }
}
