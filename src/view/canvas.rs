//! A small picture to draw on: rectangles, smooth lines and discs, other pictures, and words in capitals.

use crate::formats::png::Picture;
use crate::video::image::Image;
use ndarray::Array3;

/// Red, green, blue.
pub type Colour = [u8; 3];

/// A colour picture, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Canvas {
    width: usize,
    height: usize,
    data: Vec<u8>,
}

/// Pixels between the starts of two letters, and from a line of words to the next.
pub const LETTER: usize = 8;
/// Pixels from the top of one line of words to the top of the next.
pub const LINE: usize = 14;

/// Five rows of three bits per character, from the top, one octal digit each.
const GLYPHS: [(char, u16); 54] = [
    ('A', 0o25755),
    ('B', 0o65656),
    ('C', 0o34443),
    ('D', 0o65556),
    ('E', 0o74647),
    ('F', 0o74644),
    ('G', 0o34553),
    ('H', 0o55755),
    ('I', 0o72227),
    ('J', 0o11152),
    ('K', 0o55655),
    ('L', 0o44447),
    ('M', 0o57755),
    ('N', 0o65555),
    ('O', 0o25552),
    ('P', 0o65644),
    ('Q', 0o25563),
    ('R', 0o65655),
    ('S', 0o34216),
    ('T', 0o72222),
    ('U', 0o55557),
    ('V', 0o55552),
    ('W', 0o55775),
    ('X', 0o55255),
    ('Y', 0o55222),
    ('Z', 0o71247),
    ('0', 0o75557),
    ('1', 0o26227),
    ('2', 0o61247),
    ('3', 0o61216),
    ('4', 0o55711),
    ('5', 0o74616),
    ('6', 0o34757),
    ('7', 0o71122),
    ('8', 0o75757),
    ('9', 0o75716),
    ('.', 0o00002),
    (',', 0o00024),
    (':', 0o02020),
    ('-', 0o00700),
    ('+', 0o02720),
    ('/', 0o11244),
    ('_', 0o00007),
    ('(', 0o24442),
    (')', 0o21112),
    ('%', 0o51245),
    ('=', 0o07070),
    ('[', 0o64446),
    (']', 0o31113),
    ('<', 0o12421),
    ('>', 0o42124),
    ('*', 0o05250),
    ('\'', 0o22000),
    ('#', 0o57575),
];

impl Canvas {
    /// A picture of one colour.
    pub fn new(width: usize, height: usize, colour: Colour) -> Self {
        Canvas {
            width,
            height,
            data: colour.repeat(width * height),
        }
    }

    /// A picture to draw into.
    pub fn of(image: Image) -> Self {
        Canvas {
            width: image.width as usize,
            height: image.height as usize,
            data: image.data,
        }
    }

    /// Its pixels, row by row.
    pub fn rgb(&self) -> &[u8] {
        &self.data
    }

    /// Width and height in pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// For the disk.
    pub fn into_picture(self) -> Picture {
        let shape = (self.height, self.width, 3);
        Picture::Rgb8(Array3::from_shape_vec(shape, self.data).expect("three bytes per pixel"))
    }

    /// Mixes `colour` into a pixel; pixels outside are ignored.
    fn mix(&mut self, x: isize, y: isize, colour: Colour, weight: f64) {
        if x < 0 || y < 0 || x >= self.width as isize || y >= self.height as isize {
            return;
        }
        let at = (y as usize * self.width + x as usize) * 3;
        for (old, new) in self.data[at..at + 3].iter_mut().zip(colour) {
            let mixed =
                f64::from(*old) + (f64::from(new) - f64::from(*old)) * weight.clamp(0.0, 1.0);
            *old = mixed.round() as u8;
        }
    }

    /// A filled rectangle.
    pub fn fill(&mut self, x: usize, y: usize, width: usize, height: usize, colour: Colour) {
        for row in y..(y + height).min(self.height) {
            for column in x..(x + width).min(self.width) {
                self.mix(column as isize, row as isize, colour, 1.0);
            }
        }
    }

    /// Copies RGB rows of `width` pixels to (x, y); what does not fit is cut off.
    pub fn paste(&mut self, x: usize, y: usize, width: usize, rgb: &[u8]) {
        let fits = width.min(self.width.saturating_sub(x)) * 3;
        for (row, line) in rgb.chunks_exact(width.max(1) * 3).enumerate() {
            if y + row >= self.height {
                return;
            }
            let at = ((y + row) * self.width + x) * 3;
            self.data[at..at + fits].copy_from_slice(&line[..fits]);
        }
    }

    /// A smooth line of this thickness with round ends. Ends that are not finite draw nothing.
    pub fn line(&mut self, from: [f64; 2], to: [f64; 2], thickness: f64, colour: Colour) {
        let far = 4.0 * (self.width + self.height) as f64;
        if [from, to]
            .iter()
            .flatten()
            .any(|v| !v.is_finite() || v.abs() > far)
        {
            return;
        }
        let along = [to[0] - from[0], to[1] - from[1]];
        let length2 = along[0] * along[0] + along[1] * along[1];
        let reach = thickness / 2.0 + 1.0;
        let range = |k: usize, most: usize| {
            let low = (from[k].min(to[k]) - reach).floor().max(0.0) as isize;
            let high = (from[k].max(to[k]) + reach).ceil().min(most as f64 - 1.0) as isize;
            low..=high
        };
        for y in range(1, self.height) {
            for x in range(0, self.width) {
                let p = [x as f64 - from[0], y as f64 - from[1]];
                let t = if length2 > 0.0 {
                    ((p[0] * along[0] + p[1] * along[1]) / length2).clamp(0.0, 1.0)
                } else {
                    0.0
                };
                let distance = (p[0] - t * along[0]).hypot(p[1] - t * along[1]);
                self.mix(x, y, colour, thickness / 2.0 + 0.5 - distance);
            }
        }
    }

    /// A smooth disc.
    pub fn disc(&mut self, centre: [f64; 2], radius: f64, colour: Colour) {
        self.line(centre, centre, 2.0 * radius, colour);
    }

    /// A smooth circle.
    pub fn ring(&mut self, centre: [f64; 2], radius: f64, thickness: f64, colour: Colour) {
        let point = |k: i32| {
            let angle = f64::from(k) * std::f64::consts::TAU / 24.0;
            [
                centre[0] + radius * angle.cos(),
                centre[1] + radius * angle.sin(),
            ]
        };
        for k in 0..24 {
            self.line(point(k), point(k + 1), thickness, colour);
        }
    }

    /// Words from (x, y) on, in capitals.
    pub fn text(&mut self, x: usize, y: usize, text: &str, colour: Colour) {
        for (place, letter) in text.chars().enumerate() {
            let letter = letter.to_ascii_uppercase();
            let found = GLYPHS.iter().find(|(known, _)| *known == letter);
            let Some((_, bits)) = found else { continue };
            for row in 0..5 {
                for column in 0..3 {
                    if bits >> ((4 - row) * 3 + (2 - column)) & 1 == 1 {
                        self.fill(x + place * LETTER + column * 2, y + row * 2, 2, 2, colour);
                    }
                }
            }
        }
    }
}

/// A colour between dark violet (0) and yellow (1), even in brightness.
pub fn viridis(value: f64) -> Colour {
    const ANCHORS: [[f64; 3]; 6] = [
        [68.0, 1.0, 84.0],
        [65.0, 68.0, 135.0],
        [42.0, 120.0, 142.0],
        [34.0, 168.0, 132.0],
        [122.0, 209.0, 81.0],
        [253.0, 231.0, 37.0],
    ];
    let place = value.clamp(0.0, 1.0) * 5.0;
    let low = (place as usize).min(4);
    let t = place - low as f64;
    std::array::from_fn(|k| (ANCHORS[low][k] * (1.0 - t) + ANCHORS[low + 1][k] * t).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drawing_beyond_the_edge_is_cut_off() {
        let mut canvas = Canvas::new(20, 10, [0; 3]);
        canvas.line([-50.0, 5.0], [60.0, 5.0], 3.0, [255, 0, 0]);
        canvas.line([f64::NAN, 5.0], [6.0, 5.0], 3.0, [0, 255, 0]);
        canvas.line([1e300, 5.0], [6.0, 5.0], 3.0, [0, 255, 0]);
        canvas.disc([19.0, 9.0], 30.0, [0, 0, 255]);
        canvas.text(15, 5, "beyond", [255; 3]);
        canvas.paste(18, 8, 5, &[9; 5 * 5 * 3]);
        canvas.fill(19, 9, 100, 100, [1; 3]);
        assert_eq!(canvas.size(), (20, 10));
        assert!(!canvas.data.chunks(3).any(|p| p == [0, 255, 0]));
    }

    #[test]
    fn letters_differ() {
        for (i, (a, bits)) in GLYPHS.iter().enumerate() {
            for (b, other) in &GLYPHS[..i] {
                assert!(bits != other, "{a} and {b}");
            }
        }
    }
}
