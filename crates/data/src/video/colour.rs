//! From the luma and chroma planes of a decoded picture to RGB, bit for bit as `ffmpeg` and through it `OpenCV` do on common
//! machines.
//!
//! The pixels that the released models were trained on went through that conversion: 16-bit fixed point, each product rounded
//! down, every chroma sample serving its 2 x 2 block. The matrix is the one that the stream names, else the container; where neither does it is
//! BT.601 with limited range at every resolution, as they do.

#[cfg(target_arch = "x86_64")]
mod x86;

use crate::video::image::Image;
use rusty_h264_common::YuvFrame;

/// How colours are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ColourSpace {
    /// How luma and chroma are made of red, green and blue.
    pub matrix: Matrix,
    /// Luma from 0 to 255 instead of 16 to 235.
    pub full_range: bool,
}

/// Matrix coefficients (ITU-T H.273, table 4).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Matrix {
    /// Not said, or said with a code that is not known: treated as BT.601.
    #[default]
    Unspecified,
    /// ITU-R BT.601, of standard definition.
    Bt601,
    /// ITU-R BT.709, of high definition.
    Bt709,
    /// Title 47 of the FCC's code.
    Fcc,
    /// SMPTE ST 240.
    Smpte240,
    /// ITU-R BT.2020, of ultra-high definition; constant luminance is not told apart.
    Bt2020,
}

impl Matrix {
    /// From the code in the stream.
    #[must_use]
    pub fn from_code(code: u8) -> Self {
        match code {
            1 => Matrix::Bt709,
            4 => Matrix::Fcc,
            5 | 6 => Matrix::Bt601,
            7 => Matrix::Smpte240,
            9 | 10 => Matrix::Bt2020,
            _ => Matrix::Unspecified,
        }
    }

    /// Contributions of V to red, U to blue, U to green and V to green for limited range, with 16 bits of fraction.
    fn coefficients(self) -> [i64; 4] {
        match self {
            Matrix::Unspecified | Matrix::Bt601 => [104_597, 132_201, -25_675, -53_279],
            Matrix::Fcc => [104_448, 132_798, -24_759, -53_109],
            Matrix::Smpte240 => [117_579, 136_230, -16_907, -35_559],
            Matrix::Bt709 => [117_489, 138_438, -13_975, -34_925],
            Matrix::Bt2020 => [110_013, 140_363, -12_277, -42_626],
        }
    }
}

/// From 16 to 13 bits of fraction, rounded.
fn thirteen(value: i64) -> i16 {
    (((value << 13) + (1 << 15)) >> 16) as i16
}

/// Factors with 13 bits of fraction; samples come with three, and 16 are dropped from each product.
#[derive(Clone, Copy)]
struct Factors {
    v_red: i16,
    u_blue: i16,
    u_green: i16,
    v_green: i16,
    luma: i16,
    luma_offset: i16,
}

impl Factors {
    fn of(space: ColourSpace) -> Self {
        let [v_red, u_blue, u_green, v_green] = space.matrix.coefficients().map(|value| {
            thirteen(if space.full_range {
                value * 224 / 255
            } else {
                value
            })
        });
        let (luma, luma_offset) = if space.full_range {
            (thirteen(1 << 16), 0)
        } else {
            (thirteen((255 << 16) / 219), 16)
        };
        Factors {
            v_red,
            u_blue,
            u_green,
            v_green,
            luma,
            luma_offset,
        }
    }

    /// What a chroma sample adds to red, green and blue.
    fn chroma(self, u: u8, v: u8) -> [i16; 3] {
        let (u, v) = (8 * (i16::from(u) - 128), 8 * (i16::from(v) - 128));
        [
            high(v, self.v_red),
            high(u, self.u_green) + high(v, self.v_green),
            high(u, self.u_blue),
        ]
    }

    fn luma(self, y: u8) -> i16 {
        high(8 * (i16::from(y) - self.luma_offset), self.luma)
    }
}

/// The upper half of the product.
fn high(a: i16, b: i16) -> i16 {
    ((i32::from(a) * i32::from(b)) >> 16) as i16
}

/// The planes of a 4:2:0 picture: of chroma half the columns and rows, rounded up.
#[derive(Debug, Clone, Copy)]
pub struct Planes<'a> {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Luma.
    pub y: &'a [u8],
    /// Blue chroma.
    pub u: &'a [u8],
    /// Red chroma.
    pub v: &'a [u8],
}

impl<'a> Planes<'a> {
    /// Bytes of all three.
    #[must_use]
    pub fn bytes(width: usize, height: usize) -> usize {
        width * height + 2 * width.div_ceil(2) * height.div_ceil(2)
    }

    /// One behind the other; `data` has as many bytes as [`Planes::bytes`] says.
    #[must_use]
    pub fn packed(width: usize, height: usize, data: &'a [u8]) -> Self {
        let (y, chroma) = data.split_at(width * height);
        let (u, v) = chroma.split_at(width.div_ceil(2) * height.div_ceil(2));
        Planes {
            width,
            height,
            y,
            u,
            v,
        }
    }

    /// RGB.
    #[must_use]
    pub fn to_rgb(self, space: ColourSpace) -> Image {
        let factors = Factors::of(space);
        let (width, half) = (self.width, self.width.div_ceil(2));
        let mut data = Vec::with_capacity(width * self.height * 3);
        let mut line = vec![0; width * 3];
        for row in 0..self.height {
            let y = &self.y[row * width..][..width];
            let u = &self.u[row / 2 * half..][..half];
            let v = &self.v[row / 2 * half..][..half];
            line_to_rgb(&mut line, y, u, v, factors);
            data.extend_from_slice(&line);
        }
        Image {
            width: width as u32,
            height: self.height as u32,
            data,
        }
    }
}

/// RGB of one 4:2:0 picture.
#[must_use]
pub fn to_rgb(picture: &YuvFrame, space: ColourSpace) -> Image {
    let planes = Planes {
        width: picture.width,
        height: picture.height,
        y: &picture.y,
        u: &picture.u,
        v: &picture.v,
    };
    planes.to_rgb(space)
}

fn line_to_rgb(out: &mut [u8], y: &[u8], u: &[u8], v: &[u8], factors: Factors) {
    #[cfg(target_arch = "x86_64")]
    let done = x86::blocks_to_rgb(out, y, u, v, factors);
    #[cfg(not(target_arch = "x86_64"))]
    let done = 0;
    let pixels = out[3 * done..].chunks_mut(6).zip(y[done..].chunks(2));
    for (((out, y), u), v) in pixels.zip(&u[done / 2..]).zip(&v[done / 2..]) {
        let add = factors.chroma(*u, *v);
        for (pixel, y) in out.chunks_exact_mut(3).zip(y) {
            let y = factors.luma(*y);
            for (value, add) in pixel.iter_mut().zip(add) {
                *value = (y + add).clamp(0, 255) as u8;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one_colour(y: u8, u: u8, v: u8, space: ColourSpace) -> [u8; 3] {
        let picture = YuvFrame {
            width: 2,
            height: 2,
            y: vec![y; 4],
            u: vec![u],
            v: vec![v],
        };
        to_rgb(&picture, space).data[..3].try_into().unwrap()
    }

    /// The same in the widest integers, pixel by pixel.
    fn plainly(planes: Planes<'_>, space: ColourSpace) -> Vec<u8> {
        let wide = Factors::of(space);
        let product = |a: i32, b: i16| (8 * a * i32::from(b)) >> 16;
        let mut data = Vec::new();
        for row in 0..planes.height {
            for column in 0..planes.width {
                let at = row / 2 * planes.width.div_ceil(2) + column / 2;
                let y = i32::from(planes.y[row * planes.width + column]);
                let y = product(y - i32::from(wide.luma_offset), wide.luma);
                let (u, v) = (i32::from(planes.u[at]) - 128, i32::from(planes.v[at]) - 128);
                let green = product(u, wide.u_green) + product(v, wide.v_green);
                let colours = [product(v, wide.v_red), green, product(u, wide.u_blue)];
                data.extend(colours.map(|add| (y + add).clamp(0, 255) as u8));
            }
        }
        data
    }

    proptest::proptest! {
        #[test]
        fn blocks_and_what_is_left_beside_them_are_converted_alike(
            width in 1_usize..200, height in 1_usize..5, seed: u32, code in 0_u8..10, full_range: bool,
        ) {
            let mut state = seed | 1;
            let data: Vec<u8> = std::iter::repeat_with(|| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 24) as u8
            }).take(Planes::bytes(width, height)).collect();
            let space = ColourSpace { matrix: Matrix::from_code(code), full_range };
            let planes = Planes::packed(width, height, &data);
            proptest::prop_assert_eq!(planes.to_rgb(space).data, plainly(planes, space));
        }
    }

    #[test]
    fn black_white_and_red_are_what_the_standard_says() {
        let limited = ColourSpace::default();
        assert_eq!(one_colour(16, 128, 128, limited), [0, 0, 0]);
        // Products are rounded down: white may lose a level.
        assert!(one_colour(235, 128, 128, limited).iter().all(|v| *v >= 254));
        // BT.601 red: Y 81, Cb 90, Cr 240.
        let [r, g, b] = one_colour(81, 90, 240, limited);
        assert!(r >= 252 && g <= 1 && b <= 1, "{r} {g} {b}");
        let full = ColourSpace {
            matrix: Matrix::Bt709,
            full_range: true,
        };
        assert_eq!(one_colour(255, 128, 128, full), [255; 3]);
        assert_eq!(one_colour(7, 128, 128, full), [7, 7, 7]);
    }
}
