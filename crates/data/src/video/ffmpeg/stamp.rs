//! What `ffmpeg` says of every frame it decodes: when it is shown, its size, and how its pixels are coded.

use crate::video::colour::{ColourSpace, Matrix};

/// How the pixels of a picture come through the pipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Layout {
    /// RGB, of whatever was decoded.
    Rgb,
    /// The planes of eight-bit 4:2:0 as they were decoded: half as many bytes, and nothing to convert for those that nobody wants.
    Planes,
    /// The same from `ffmpeg`s that tell full range apart by the name of the format.
    FullRangePlanes,
}

impl Layout {
    /// As `ffmpeg` calls it.
    pub fn name(self) -> &'static str {
        match self {
            Layout::Rgb => "rgb24",
            Layout::Planes => "yuv420p",
            Layout::FullRangePlanes => "yuvj420p",
        }
    }
}

/// A decoded frame, without its picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Stamp {
    /// Microseconds; none where the stream says none.
    pub time: Option<i64>,
    pub width: u32,
    pub height: u32,
    /// Width to height of a pixel.
    pub pixel_aspect: f64,
    /// As decoded.
    planes: Option<Layout>,
    /// As [`Stamp::add_colours`] was told.
    colours: Option<ColourSpace>,
}

impl Stamp {
    /// From a line of the filter `showinfo`.
    pub fn parse(line: &str) -> Option<Self> {
        if !line.contains("showinfo") {
            return None;
        }
        let field = |name: &str| {
            let (_, rest) = line.split_once(name)?;
            rest.split_ascii_whitespace().next()
        };
        field(" n:")?;
        let (width, height) = field(" s:")?.split_once('x')?;
        let (wide, high) = field(" sar:")?.split_once('/')?;
        let (wide, high): (f64, f64) = (wide.parse().ok()?, high.parse().ok()?);
        let format = field(" fmt:").unwrap_or_default();
        Some(Stamp {
            time: field(" pts:")?.parse().ok(),
            width: width.parse().ok()?,
            height: height.parse().ok()?,
            pixel_aspect: if wide > 0.0 && high > 0.0 {
                wide / high
            } else {
                1.0
            },
            planes: [Layout::Planes, Layout::FullRangePlanes]
                .into_iter()
                .find(|planes| planes.name() == format),
            colours: None,
        })
    }

    /// Takes the line on colours that follows that of the frame; false where it is another one.
    pub fn add_colours(&mut self, line: &str) -> bool {
        let Some((_, said)) = line.split_once("] color_range:") else {
            return false;
        };
        let range = said.split_ascii_whitespace().next();
        let matrix = said.split_once(" color_space:").map_or("", |(_, rest)| {
            rest.split_ascii_whitespace().next().unwrap_or_default()
        });
        let full_range = match (self.planes, range) {
            (Some(Layout::FullRangePlanes), Some("pc" | "unknown"))
            | (Some(Layout::Planes), Some("pc")) => true,
            (Some(Layout::Planes), Some("tv" | "unknown")) => false,
            _ => return true,
        };
        let matrix = match matrix {
            "bt709" => Matrix::Bt709,
            "fcc" => Matrix::Fcc,
            "bt470bg" | "smpte170m" => Matrix::Bt601,
            "smpte240m" => Matrix::Smpte240,
            "bt2020nc" | "bt2020c" => Matrix::Bt2020,
            _ => Matrix::Unspecified,
        };
        self.colours = Some(ColourSpace { matrix, full_range });
        true
    }

    /// How it can come through the pipe without a loss. `ffmpeg` converts odd sizes in another way, and what it says of the colours
    /// has to be known.
    pub fn layout(&self) -> Layout {
        let even = self.width.is_multiple_of(2) && self.height.is_multiple_of(2);
        match (self.planes, self.colours) {
            (Some(planes), Some(_)) if even => planes,
            _ => Layout::Rgb,
        }
    }

    /// Of planes.
    pub fn colours(&self) -> ColourSpace {
        self.colours.unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: &str = "[Parsed_showinfo_1 @ 0x55] [info] n:   1 pts:  33333 pts_time:0.033333 pos:     1368 fmt:yuv420p \
                        sar:4/3 s:72x64 i:P iskey:0 type:B ";

    #[test]
    fn lines_of_showinfo_become_stamps() {
        let stamp = Stamp::parse(LINE).unwrap();
        assert_eq!(
            (stamp.time, stamp.width, stamp.height),
            (Some(33333), 72, 64)
        );
        assert!((stamp.pixel_aspect - 4.0 / 3.0).abs() < 1e-9);
        let none = LINE.replace("  33333", "NOPTS").replace("4/3", "0/1");
        let stamp = Stamp::parse(&none).unwrap();
        assert_eq!((stamp.time, stamp.pixel_aspect), (None, 1.0));
        assert_eq!(Stamp::parse("[info] Input #0, mov"), None);
        assert_eq!(
            Stamp::parse("[Parsed_showinfo_1 @ 0x55] [info] color_range:tv"),
            None
        );
    }

    #[test]
    fn planes_come_through_the_pipe_where_all_is_said_of_them() {
        let layout = |line: &str, range: &str, matrix: &str| {
            let mut stamp = Stamp::parse(line).unwrap();
            let colours = format!(
                "[Parsed_showinfo_1 @ 0x55] [info] color_range:{range} color_space:{matrix} color_primaries:unknown"
            );
            assert!(stamp.add_colours(&colours));
            (stamp.layout(), stamp.colours())
        };
        let space = |matrix, full_range| ColourSpace { matrix, full_range };
        assert_eq!(
            layout(LINE, "tv", "bt709"),
            (Layout::Planes, space(Matrix::Bt709, false))
        );
        assert_eq!(
            layout(LINE, "pc", "unknown"),
            (Layout::Planes, space(Matrix::Unspecified, true))
        );
        let full = LINE.replace("yuv420p", "yuvj420p");
        assert_eq!(
            layout(&full, "unknown", "smpte170m"),
            (Layout::FullRangePlanes, space(Matrix::Bt601, true))
        );
        for (line, range) in [
            (full.as_str(), "tv"),
            (LINE, "strange"),
            (&LINE.replace("72x64", "71x64"), "tv"),
            (&LINE.replace("72x64", "72x63"), "tv"),
            (&LINE.replace("yuv420p", "yuv420p10le"), "tv"),
            (&LINE.replace("yuv420p", "yuv422p"), "tv"),
        ] {
            assert_eq!(layout(line, range, "bt709").0, Layout::Rgb, "{line}");
        }
        let mut silent = Stamp::parse(LINE).unwrap();
        assert!(!silent.add_colours("[info] Input #0, mov"));
        assert_eq!(silent.layout(), Layout::Rgb);
    }
}
