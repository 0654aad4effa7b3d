//! From the luma and chroma planes of a decoded picture to RGB.
//!
//! The matrix is the one the stream names; a stream that names none is taken as BT.601 with limited range, as `ffmpeg` and
//! through it `OpenCV` do at every resolution. Every chroma sample serves its 2 x 2 block of pixels, as in their fast path.

use crate::source::image::Image;
use rusty_h264::YuvFrame;

/// How colours are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ColourSpace {
    pub matrix: Matrix,
    /// Luma from 0 to 255 instead of 16 to 235.
    pub full_range: bool,
}

/// Matrix coefficients (ITU-T H.273, table 4).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Matrix {
    #[default]
    Unspecified,
    Bt601,
    Bt709,
    Bt2020,
}

impl Matrix {
    /// From the code in the stream.
    #[must_use]
    pub fn from_code(code: u32) -> Self {
        match code {
            1 => Matrix::Bt709,
            5 | 6 => Matrix::Bt601,
            9 | 10 => Matrix::Bt2020,
            _ => Matrix::Unspecified,
        }
    }

    /// The weights of red and blue in luma.
    fn luma_weights(self) -> (f64, f64) {
        match self {
            Matrix::Unspecified | Matrix::Bt601 => (0.299, 0.114),
            Matrix::Bt709 => (0.2126, 0.0722),
            Matrix::Bt2020 => (0.2627, 0.0593),
        }
    }
}

/// Fixed point with 16 bits of fraction.
const ONE: f64 = 65536.0;

/// RGB of one 4:2:0 picture.
#[must_use]
pub fn to_rgb(picture: &YuvFrame, space: ColourSpace) -> Image {
    let (red, blue) = space.matrix.luma_weights();
    let green = 1.0 - red - blue;
    let (luma_scale, luma_offset, chroma_scale) = if space.full_range {
        (1.0, 0, 1.0)
    } else {
        (255.0 / 219.0, 16, 255.0 / 224.0)
    };
    let fixed = |value: f64| (value * ONE).round() as i32;
    let luma = fixed(luma_scale);
    let v_to_red = fixed(chroma_scale * 2.0 * (1.0 - red));
    let u_to_blue = fixed(chroma_scale * 2.0 * (1.0 - blue));
    let u_to_green = fixed(chroma_scale * 2.0 * (1.0 - blue) * blue / green);
    let v_to_green = fixed(chroma_scale * 2.0 * (1.0 - red) * red / green);

    let (width, height) = (picture.width, picture.height);
    let chroma_width = width.div_ceil(2);
    let mut data = vec![0_u8; width * height * 3];
    for (row, out) in data.chunks_exact_mut(width * 3).enumerate() {
        let y_row = &picture.y[row * width..][..width];
        let u_row = &picture.u[row / 2 * chroma_width..][..chroma_width];
        let v_row = &picture.v[row / 2 * chroma_width..][..chroma_width];
        for (((out, y), u), v) in out.chunks_mut(6).zip(y_row.chunks(2)).zip(u_row).zip(v_row) {
            let (u, v) = (i32::from(*u) - 128, i32::from(*v) - 128);
            let half = 1 << 15;
            let add_red = v_to_red * v + half;
            let add_green = half - u_to_green * u - v_to_green * v;
            let add_blue = u_to_blue * u + half;
            for (pixel, y) in out.chunks_exact_mut(3).zip(y) {
                let y = luma * (i32::from(*y) - luma_offset);
                pixel[0] = ((y + add_red) >> 16).clamp(0, 255) as u8;
                pixel[1] = ((y + add_green) >> 16).clamp(0, 255) as u8;
                pixel[2] = ((y + add_blue) >> 16).clamp(0, 255) as u8;
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
        assert_eq!(one_colour(235, 128, 128, limited), [255, 255, 255]);
        // BT.601 red: Y 81, Cb 90, Cr 240.
        let [r, g, b] = one_colour(81, 90, 240, limited);
        assert!(r >= 253 && g <= 1 && b <= 1, "{r} {g} {b}");
        let full = ColourSpace {
            matrix: Matrix::Bt709,
            full_range: true,
        };
        assert_eq!(one_colour(255, 128, 128, full), [255, 255, 255]);
        assert_eq!(one_colour(7, 128, 128, full), [7, 7, 7]);
    }
}
