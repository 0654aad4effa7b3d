//! From the luma and chroma planes of a decoded picture to RGB, bit for bit as `ffmpeg` and through it `OpenCV` do on common
//! machines.
//!
//! The pixels that the released models were trained on went through that conversion: 16-bit fixed point, each product rounded
//! down, every chroma sample serving its 2 x 2 block. The matrix is the one that the stream names, else the container; where neither does it is
//! BT.601 with limited range at every resolution, as they do.

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
fn thirteen(value: i64) -> i32 {
    (((value << 13) + (1 << 15)) >> 16) as i32
}

/// RGB of one 4:2:0 picture.
#[must_use]
pub fn to_rgb(picture: &YuvFrame, space: ColourSpace) -> Image {
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
    let (width, height) = (picture.width, picture.height);
    let chroma_width = width.div_ceil(2);
    let mut data = vec![0_u8; width * height * 3];
    for (row, out) in data.chunks_exact_mut(width * 3).enumerate() {
        let y_row = &picture.y[row * width..][..width];
        let u_row = &picture.u[row / 2 * chroma_width..][..chroma_width];
        let v_row = &picture.v[row / 2 * chroma_width..][..chroma_width];
        for (((out, y), u), v) in out.chunks_mut(6).zip(y_row.chunks(2)).zip(u_row).zip(v_row) {
            let (u, v) = (8 * (i32::from(*u) - 128), 8 * (i32::from(*v) - 128));
            let add_red = (v * v_red) >> 16;
            let add_green = ((u * u_green) >> 16) + ((v * v_green) >> 16);
            let add_blue = (u * u_blue) >> 16;
            for (pixel, y) in out.chunks_exact_mut(3).zip(y) {
                let y = (8 * (i32::from(*y) - luma_offset) * luma) >> 16;
                pixel[0] = (y + add_red).clamp(0, 255) as u8;
                pixel[1] = (y + add_green).clamp(0, 255) as u8;
                pixel[2] = (y + add_blue).clamp(0, 255) as u8;
            }
        }
    }
    Image {
        width: width as u32,
        height: height as u32,
        data,
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
