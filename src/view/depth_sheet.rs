//! Some frames of a video above their depth.

use super::canvas::{Canvas, Colour, LINE, viridis};
use crate::video::image::Image;

const PAPER: Colour = [24, 24, 28];
const INK: Colour = [225, 225, 225];
/// Width of a tile, tiles of a row, and pixels between them.
const TILE: usize = 240;
const COLUMNS: usize = 4;
const GAP: usize = 4;
const MARGIN: usize = 12;

/// A frame and its depth, both small.
#[derive(Debug, Clone)]
pub struct DepthTile {
    /// Number of the frame, printed above the tile.
    pub frame: usize,
    width: usize,
    rgb: Vec<u8>,
    depth: Vec<f32>,
}

impl DepthTile {
    /// A tile of a frame and its depth `[height * width]`.
    #[must_use]
    pub fn new(frame: usize, image: &Image, depth: &[f32]) -> Self {
        let (width, height) = (image.width as usize, image.height as usize);
        let tall = (TILE * height).div_ceil(width).clamp(1, 4 * TILE);
        let places = (0..tall)
            .flat_map(|y| (0..TILE).map(move |x| y * height / tall * width + x * width / TILE));
        let places: Vec<usize> = places.collect();
        Self {
            frame,
            width: TILE,
            rgb: places
                .iter()
                .flat_map(|at| image.data[3 * at..3 * at + 3].iter().copied())
                .collect(),
            depth: places.iter().map(|at| depth[*at]).collect(),
        }
    }

    fn height(&self) -> usize {
        self.depth.len() / self.width
    }
}

/// The sheet, with one scale of colours for all tiles: bright is near if `near_is_large`, else far.
#[must_use]
pub fn depth_sheet(title: &str, tiles: &[DepthTile]) -> Canvas {
    let height = tiles.iter().map(DepthTile::height).max().unwrap_or(0);
    let rows = tiles.len().div_ceil(COLUMNS);
    let mut canvas = Canvas::new(
        2 * MARGIN + COLUMNS * TILE + (COLUMNS - 1) * GAP,
        2 * MARGIN + LINE + rows * (LINE + 2 * height + 2 * GAP),
        PAPER,
    );
    canvas.text(MARGIN, MARGIN, title, INK);
    let values = tiles.iter().flat_map(|tile| &tile.depth);
    let finite = values.filter(|value| value.is_finite());
    let (low, high) = finite.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| {
        (low.min(*v), high.max(*v))
    });
    for (index, tile) in tiles.iter().enumerate() {
        let x = MARGIN + index % COLUMNS * (TILE + GAP);
        let y = MARGIN + LINE + index / COLUMNS * (LINE + 2 * height + 2 * GAP);
        canvas.text(x, y, &format!("frame {}", tile.frame), INK);
        canvas.paste(x, y + LINE, tile.width, &tile.rgb);
        let colours: Vec<u8> = tile
            .depth
            .iter()
            .flat_map(|value| {
                let share = (value - low) / (high - low);
                viridis(if share.is_finite() {
                    f64::from(share)
                } else {
                    0.0
                })
            })
            .collect();
        canvas.paste(x, y + LINE + tile.height() + GAP, tile.width, &colours);
    }
    canvas
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_of_any_shape_are_drawn_and_constant_depth_is_no_error() {
        for (width, height) in [(1, 1), (640, 480), (3, 4000)] {
            let image = Image {
                width,
                height,
                data: vec![7; (width * height * 3) as usize],
            };
            let depth = vec![2.0; (width * height) as usize];
            let tiles: Vec<DepthTile> = (0..5)
                .map(|frame| DepthTile::new(frame, &image, &depth))
                .collect();
            let (across, down) = depth_sheet("title", &tiles).size();
            assert!(across > 4 * TILE && down > LINE);
        }
    }
}
