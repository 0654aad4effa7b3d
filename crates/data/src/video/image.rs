//! Pictures in memory: decoding png and jpeg, quarter turns, and the resize and crop of every clip.

use crate::formats::png::Picture;
use ndarray::Array2;
use zune_core::bytestream::ZCursor;
use zune_core::colorspace::ColorSpace;
use zune_core::options::DecoderOptions;

/// Nothing that a recording holds is larger; a hostile header is refused before its pixels are allocated.
const LARGEST_SIDE: u32 = 16_384;
const MOST_PIXELS: u64 = 64_000_000;

/// Side of the blocks in which pictures are turned.
const BLOCK: usize = 32;

/// Eight-bit RGB, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// `height * width * 3` bytes.
    pub data: Vec<u8>,
}

/// Quarter turns clockwise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Turn {
    /// As it is.
    #[default]
    None,
    /// By 90 degrees to the right.
    Clockwise,
    /// By 180 degrees.
    Half,
    /// By 90 degrees to the left.
    CounterClockwise,
}

impl Turn {
    /// From degrees clockwise, a multiple of 90.
    #[must_use]
    pub fn from_degrees(degrees: u32) -> Self {
        match degrees % 360 / 90 {
            1 => Turn::Clockwise,
            2 => Turn::Half,
            3 => Turn::CounterClockwise,
            _ => Turn::None,
        }
    }

    /// Degrees clockwise.
    #[must_use]
    pub fn degrees(self) -> u32 {
        match self {
            Turn::None => 0,
            Turn::Clockwise => 90,
            Turn::Half => 180,
            Turn::CounterClockwise => 270,
        }
    }

    /// Where the pixel (u, v) of a `width` x `height` picture goes.
    #[must_use]
    pub fn pixel(self, u: f64, v: f64, width: f64, height: f64) -> (f64, f64) {
        match self {
            Turn::None => (u, v),
            Turn::Clockwise => (height - 1.0 - v, u),
            Turn::Half => (width - 1.0 - u, height - 1.0 - v),
            Turn::CounterClockwise => (v, width - 1.0 - u),
        }
    }

    /// The turn that undoes this one.
    #[must_use]
    pub fn inverse(self) -> Self {
        match self {
            Turn::Clockwise => Turn::CounterClockwise,
            Turn::CounterClockwise => Turn::Clockwise,
            same => same,
        }
    }

    /// The size of the turned picture.
    #[must_use]
    pub fn size(self, width: u32, height: u32) -> (u32, u32) {
        match self {
            Turn::None | Turn::Half => (width, height),
            Turn::Clockwise | Turn::CounterClockwise => (height, width),
        }
    }
}

/// How a stored picture comes upright: mirrored left to right first, then turned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Orientation {
    /// Whether left and right are exchanged, before the turn.
    pub mirrored: bool,
    /// How it is turned after that.
    pub turn: Turn,
}

impl Orientation {
    /// Of the eight that Exif numbers; as stored for any other number.
    #[must_use]
    pub fn from_exif(code: u32) -> Self {
        let (mirrored, turn) = match code {
            2 => (true, Turn::None),
            3 => (false, Turn::Half),
            4 => (true, Turn::Half),
            5 => (true, Turn::CounterClockwise),
            6 => (false, Turn::Clockwise),
            7 => (true, Turn::Clockwise),
            8 => (false, Turn::CounterClockwise),
            _ => (false, Turn::None),
        };
        Orientation { mirrored, turn }
    }

    /// From a display matrix, x' = a x + c y and y' = b x + d y; none where it turns by more than a degree beside a quarter.
    /// A matrix of rank one or zero says nothing.
    #[must_use]
    pub fn from_matrix([a, b, c, d]: [i32; 4]) -> Option<Self> {
        let [a, b, c, d] = [a, b, c, d].map(f64::from);
        let (x, y) = (a.hypot(c), b.hypot(d));
        if x == 0.0 || y == 0.0 {
            return Some(Self::default());
        }
        let (a, b, c, d) = (a / x, b / y, c / x, d / y);
        let mirrored = a * d - b * c < 0.0;
        // Undo the mirror: what is left is a turn.
        let a = if mirrored { -a } else { a };
        let b = if mirrored { -b } else { b };
        let degrees = b.atan2(a).to_degrees();
        let quarters = (degrees / 90.0).round();
        if (degrees - 90.0 * quarters).abs() > 1.0 {
            return None;
        }
        Some(Orientation {
            mirrored,
            turn: Turn::from_degrees((quarters as i32).rem_euclid(4) as u32 * 90),
        })
    }
}

impl Image {
    /// A picture of one colour.
    #[must_use]
    pub fn filled(width: u32, height: u32, colour: [u8; 3]) -> Self {
        Image {
            width,
            height,
            data: colour.repeat(width as usize * height as usize),
        }
    }

    /// Decodes a jpeg; grey ones become RGB.
    ///
    /// # Errors
    /// A sentence that says what is wrong with the data.
    pub fn from_jpeg(bytes: &[u8]) -> Result<Self, String> {
        let options = DecoderOptions::default()
            .jpeg_set_out_colorspace(ColorSpace::RGB)
            .set_max_width(LARGEST_SIDE as usize)
            .set_max_height(LARGEST_SIDE as usize)
            .set_strict_mode(true);
        let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(bytes), options);
        decoder
            .decode_headers()
            .map_err(|error| format!("jpeg: {error}"))?;
        let info = decoder.info().ok_or("jpeg: no header")?;
        let (width, height) = (u32::from(info.width), u32::from(info.height));
        check_size(width, height)?;
        let data = decoder.decode().map_err(|error| format!("jpeg: {error}"))?;
        if data.len() != width as usize * height as usize * 3 {
            return Err("jpeg: incomplete picture".to_owned());
        }
        Ok(Image {
            width,
            height,
            data,
        })
    }

    /// Decodes a png; grey, palette, 16-bit and transparent ones become 8-bit RGB.
    ///
    /// # Errors
    /// A sentence that says what is wrong with the data.
    pub fn from_png(bytes: &[u8]) -> Result<Self, String> {
        let (info, data) = read_png(bytes)?;
        let data = match info.color_type {
            png::ColorType::Rgb => data,
            png::ColorType::Rgba => data
                .chunks_exact(4)
                .flat_map(|p| [p[0], p[1], p[2]])
                .collect(),
            png::ColorType::Grayscale => data.iter().flat_map(|v| [*v; 3]).collect(),
            png::ColorType::GrayscaleAlpha => {
                data.chunks_exact(2).flat_map(|p| [p[0]; 3]).collect()
            }
            png::ColorType::Indexed => return Err("png: palette was not expanded".to_owned()),
        };
        Ok(Image {
            width: info.width,
            height: info.height,
            data,
        })
    }

    /// Decodes a png or jpeg by its first bytes.
    ///
    /// # Errors
    /// A sentence that says what is wrong with the data.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, String> {
        match bytes {
            [0x89, b'P', b'N', b'G', ..] => Self::from_png(bytes),
            [0xff, 0xd8, ..] => Self::from_jpeg(bytes),
            _ => Err("neither a png nor a jpeg".to_owned()),
        }
    }

    /// The picture turned by quarter turns.
    #[must_use]
    pub fn turned(self, turn: Turn) -> Self {
        if turn == Turn::None {
            return self;
        }
        let (width, height) = turn.size(self.width, self.height);
        let (w, h) = (self.width as usize, self.height as usize);
        let mut data = vec![0; self.data.len()];
        // Block by block, so that both pictures stay in cache.
        for top in (0..h).step_by(BLOCK) {
            for left in (0..w).step_by(BLOCK) {
                for y in top..(top + BLOCK).min(h) {
                    for x in left..(left + BLOCK).min(w) {
                        let (u, v) = match turn {
                            Turn::None => (x, y),
                            Turn::Clockwise => (h - 1 - y, x),
                            Turn::Half => (w - 1 - x, h - 1 - y),
                            Turn::CounterClockwise => (y, w - 1 - x),
                        };
                        let to = (v * width as usize + u) * 3;
                        let from = (y * w + x) * 3;
                        data[to..to + 3].copy_from_slice(&self.data[from..from + 3]);
                    }
                }
            }
        }
        Image {
            width,
            height,
            data,
        }
    }

    /// The upright picture.
    #[must_use]
    pub fn upright(mut self, orientation: Orientation) -> Self {
        if orientation.mirrored {
            for row in self.data.chunks_exact_mut(3 * self.width.max(1) as usize) {
                let (pixels, _) = row.as_chunks_mut::<3>();
                pixels.reverse();
            }
        }
        self.turned(orientation.turn)
    }
}

/// The size that a picture whose pixels are `aspect` times as wide as high has with square ones. A picture that would become
/// absurdly long is left as it is.
#[must_use]
pub fn squared(width: u32, height: u32, aspect: f64) -> (u32, u32) {
    if !(aspect.is_finite() && (1.0 / 16.0..=16.0).contains(&aspect)) {
        return (width, height);
    }
    let (wide, high) = if aspect > 1.0 {
        ((f64::from(width) * aspect).round() as u32, height)
    } else {
        (width, (f64::from(height) / aspect).round() as u32)
    };
    if check_size(wide, high).is_err() {
        return (width, height);
    }
    (wide, high)
}

/// How a picture becomes a square of `side` pixels: what happens to pixels, for intrinsics and gaze.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SquareFit {
    /// Width and height of the whole picture once its short side is `side`, pixels.
    pub resized: (u32, u32),
    /// Columns of the resized picture to the left of the square.
    pub left: u32,
    /// Rows of the resized picture above the square.
    pub top: u32,
    /// Width and height of the square, pixels.
    pub side: u32,
}

impl SquareFit {
    /// Short side to `side`, long side rounded half to even, offsets rounded down.
    #[must_use]
    pub fn new(width: u32, height: u32, side: u32) -> Self {
        let short = f64::from(width.min(height).max(1));
        let long = |size: u32| {
            (f64::from(size) * f64::from(side) / short)
                .round_ties_even()
                .max(f64::from(side)) as u32
        };
        let resized = (long(width), long(height));
        SquareFit {
            resized,
            left: (resized.0 - side) / 2,
            top: (resized.1 - side) / 2,
            side,
        }
    }
}

/// Decodes a 16-bit grey png, a depth map.
///
/// # Errors
/// A sentence that says what is wrong with the data.
pub fn grey16_from_png(bytes: &[u8]) -> Result<Array2<u16>, String> {
    match crate::formats::png::parse(bytes) {
        Ok(Picture::Grey16(values)) => Ok(values),
        Ok(_) => Err("png: not 16-bit grey".to_owned()),
        Err(error) => Err(error.to_string()),
    }
}

fn read_png(bytes: &[u8]) -> Result<(png::OutputInfo, Vec<u8>), String> {
    let fail = |error: png::DecodingError| format!("png: {error}");
    let mut decoder = png::Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let header = decoder.read_header_info().map_err(fail)?;
    check_size(header.width, header.height)?;
    let mut reader = decoder.read_info().map_err(fail)?;
    let size = reader.output_buffer_size().ok_or("png: too large")?;
    let mut data = vec![0; size];
    let info = reader.next_frame(&mut data).map_err(fail)?;
    data.truncate(info.buffer_size());
    Ok((info, data))
}

fn check_size(width: u32, height: u32) -> Result<(), String> {
    if width == 0 || height == 0 || u64::from(width) * u64::from(height) > MOST_PIXELS {
        return Err(format!("a picture of {width} x {height} pixels"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn numbered(width: u32, height: u32) -> Image {
        let data = (0..width * height)
            .flat_map(|i| [i as u8, (i / 7) as u8, 3])
            .collect();
        Image {
            width,
            height,
            data,
        }
    }

    #[test]
    fn turning_moves_pixels_where_the_formula_says() {
        let image = numbered(5, 3);
        for turn in [
            Turn::None,
            Turn::Clockwise,
            Turn::Half,
            Turn::CounterClockwise,
        ] {
            let turned = image.clone().turned(turn);
            assert_eq!((turned.width, turned.height), turn.size(5, 3));
            for y in 0..3 {
                for x in 0..5 {
                    let (u, v) = turn.pixel(x as f64, y as f64, 5.0, 3.0);
                    let at = (v as usize * turned.width as usize + u as usize) * 3;
                    assert_eq!(turned.data[at], image.data[(y * 5 + x) * 3]);
                }
            }
        }
    }

    /// Corner by corner, as the tables of Exif and of the display matrix draw them.
    #[test]
    fn the_eight_orientations_move_corners_as_exif_and_matrices_say() {
        let one = 1 << 16;
        // Top left, top right, bottom left, bottom right of the stored picture.
        let stored = [10, 20, 30, 40];
        for (code, matrix, upright) in [
            (1, [one, 0, 0, one], [10, 20, 30, 40]),
            (2, [-one, 0, 0, one], [20, 10, 40, 30]),
            (3, [-one, 0, 0, -one], [40, 30, 20, 10]),
            (4, [one, 0, 0, -one], [30, 40, 10, 20]),
            (5, [0, one, one, 0], [10, 30, 20, 40]),
            (6, [0, one, -one, 0], [30, 10, 40, 20]),
            (7, [0, -one, -one, 0], [40, 20, 30, 10]),
            (8, [0, -one, one, 0], [20, 40, 10, 30]),
        ] {
            let orientation = Orientation::from_exif(code);
            assert_eq!(
                Orientation::from_matrix(matrix),
                Some(orientation),
                "{code}"
            );
            let image = Image {
                width: 2,
                height: 2,
                data: stored.iter().flat_map(|v| [*v; 3]).collect(),
            };
            let found: Vec<u8> = image.upright(orientation).data;
            let found: Vec<u8> = found.chunks_exact(3).map(|pixel| pixel[0]).collect();
            assert_eq!(found, upright, "{code}");
        }
        assert_eq!(Orientation::from_matrix([one, one, -one, one]), None);
        assert_eq!(
            Orientation::from_matrix([0; 4]),
            Some(Orientation::default())
        );
    }

    #[test]
    fn pixels_become_square_by_lengthening_one_side() {
        assert_eq!(squared(72, 64, 4.0 / 3.0), (96, 64));
        assert_eq!(squared(64, 72, 0.75), (64, 96));
        assert_eq!(squared(1920, 1080, 1.0), (1920, 1080));
        assert_eq!(squared(1920, 1080, 1e-9), (1920, 1080));
        assert_eq!(squared(1920, 1080, f64::NAN), (1920, 1080));
    }

    #[test]
    fn the_square_fit_of_full_hd_is_the_releases() {
        let fit = SquareFit::new(1920, 1080, 256);
        assert_eq!((fit.resized, fit.left, fit.top), ((455, 256), 99, 0));
        let fit = SquareFit::new(896, 504, 256);
        assert_eq!((fit.resized, fit.left), ((455, 256), 99));
        let fit = SquareFit::new(1080, 1920, 512);
        assert_eq!((fit.resized, fit.left, fit.top), ((512, 910), 0, 199));
    }

    proptest! {
        #[test]
        fn damaged_pictures_are_errors(at in 0usize..400, value: u8, keep in 0usize..400) {
            let mut bytes = Vec::new();
            let mut encoder = png::Encoder::new(&mut bytes, 16, 12);
            encoder.set_color(png::ColorType::Rgb);
            let mut writer = encoder.write_header().unwrap();
            writer.write_image_data(&numbered(16, 12).data).unwrap();
            writer.finish().unwrap();
            let at = at % bytes.len();
            bytes[at] ^= value;
            bytes.truncate(keep.max(1));
            let _ = Image::from_bytes(&bytes);
            let _ = Image::from_jpeg(&bytes);
            let _ = grey16_from_png(&bytes);
        }
    }
}
