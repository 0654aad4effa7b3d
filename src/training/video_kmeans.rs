//! k-means on blocks of pixels, one per token: what a video tokenizer with as many tokens and codes has to be better than.

use rand::seq::index;

use super::kmeans::{Centres, PATCHES, ROUNDS};
use crate::clip::Signal;
use crate::random::stream;
use crate::tokenizer::Tokenizer;
use crate::tokenizer::video::padding::Padding;
use crate::tokenizer::video::{VideoSettings, VideoTokenizer, haar};

/// Multiply-accumulates to spend on fitting; codebooks of tens of thousands have no such baseline.
const WORK: usize = 200_000_000_000;

/// Blocks per centre that a fit needs.
const BLOCKS_PER_CENTRE: usize = 4;

const COLOURS: usize = 3;

/// How clips fall into blocks: one frame, then groups of frames, as the tokenizer sees them.
#[derive(Debug, Clone)]
struct Blocks {
    padding: Padding,
    spatial: usize,
    temporal: usize,
}

impl Blocks {
    /// Values of a block.
    fn width(&self) -> usize {
        self.temporal * self.spatial * self.spatial * COLOURS
    }

    /// The padded clip.
    fn size(&self) -> [usize; 4] {
        let [frames, height, width] = self.padding.padded;
        [frames, height, width, COLOURS]
    }

    /// `[blocks, width]`.
    fn cut(&self, clip: &[f32]) -> Vec<f32> {
        let padded = self.padding.pad(clip, COLOURS);
        haar::cut(&padded, self.size(), [self.temporal, self.spatial])
    }

    fn paste(&self, rows: &[f32]) -> Vec<f32> {
        let padded = haar::paste(rows, self.size(), [self.temporal, self.spatial]);
        self.padding.crop(&padded, COLOURS)
    }
}

/// Of how many clips how many blocks each are looked at, where `count` clips have `each` blocks of `width` values; `None` where there
/// is no clip, or the codebook is too large for the fit.
fn sampled(width: usize, codes: usize, each: usize, count: usize) -> Option<[usize; 2]> {
    let most = (WORK / (width * codes * ROUNDS)).min(PATCHES);
    if count == 0 || most < BLOCKS_PER_CENTRE * codes {
        return None;
    }
    // A few blocks of every clip, or all blocks of some.
    let share = most.div_ceil(count).clamp(1, each);
    Some([count.min(most.div_ceil(share)), share])
}

/// Numbers that the fit holds at once, and its multiply-accumulates, for a tokenizer with these settings of `tokens` tokens and `codes`
/// codes, and `count` clips.
#[must_use]
pub fn cost(settings: &VideoSettings, codes: usize, tokens: usize, count: usize) -> [f64; 2] {
    let width = settings.temporal * settings.spatial * settings.spatial * COLOURS;
    sampled(width, codes, tokens, count).map_or([0.0; 2], |[clips, share]| {
        let values = (clips * share * width) as f64;
        // The blocks, and once more with the constant that the nearest centre is found by.
        [2.0 * values, values * (codes * ROUNDS) as f64]
    })
}

/// Centres of blocks.
#[derive(Debug, Clone)]
pub struct VideoKMeans {
    blocks: Blocks,
    centres: Centres,
}

impl VideoKMeans {
    /// As many centres as `tokenizer` has codes, of the blocks its tokens stand for. `read(i)` is clip `i` of `count`; clips
    /// that it does not give are left out. `Ok(None)` without clips, or where the codebook is too large for the fit.
    ///
    /// # Errors
    /// Those of `read`.
    pub fn fit<E>(
        tokenizer: &VideoTokenizer,
        count: usize,
        seed: u64,
        mut read: impl FnMut(usize) -> Result<Option<Signal>, E>,
    ) -> Result<Option<Self>, E> {
        let settings = tokenizer.settings();
        let blocks = Blocks {
            padding: Padding::of(tokenizer.clip(), settings.temporal, settings.spatial),
            spatial: settings.spatial,
            temporal: settings.temporal,
        };
        let (width, codes) = (blocks.width(), tokenizer.vocabulary());
        let each: usize = tokenizer.grid().iter().product();
        let Some([clips, share]) = sampled(width, codes, each, count) else {
            return Ok(None);
        };
        let mut rows = Vec::with_capacity(clips * share * width);
        for clip in 0..clips {
            let Some(signal) = read(clip)? else {
                continue;
            };
            let values: Vec<f32> = signal.values.iter().copied().collect();
            let cut = blocks.cut(&values);
            let mut random = stream(seed, "kmeans.blocks", clip as u64, 0);
            for block in index::sample(&mut random, each, share) {
                rows.extend_from_slice(&cut[block * width..(block + 1) * width]);
            }
        }
        let centres = Centres::fit(&rows, width, codes, seed);
        Ok(centres.map(|centres| Self { blocks, centres }))
    }

    /// The clip `[frames, height, width, 3]` with every block replaced by its nearest centre.
    #[must_use]
    pub fn reconstruct(&self, clip: &[f32]) -> Vec<f32> {
        self.blocks
            .paste(&self.centres.project(&self.blocks.cut(clip)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tokenizer::video::testing::small;
    use ndarray::{ArrayD, IxDyn};
    use std::convert::Infallible;

    fn tokenizer(levels: &[usize]) -> VideoTokenizer {
        small([5, 16, 24], [4, 4], levels, 2)
    }

    fn clip(seed: usize) -> Signal {
        let values = ArrayD::from_shape_fn(IxDyn(&[5, 16, 24, 3]), |at| {
            ((at[0] * 31 + at[1] * 7 + at[2] * 3 + at[3] + seed) as f32).sin()
        });
        Signal {
            values,
            valid: None,
        }
    }

    #[test]
    fn blocks_come_back_where_they_were_cut() {
        let tokenizer = tokenizer(&[3, 2]);
        let blocks = Blocks {
            padding: Padding::of(tokenizer.clip(), 4, 8),
            spatial: 8,
            temporal: 4,
        };
        let values: Vec<f32> = clip(0).values.iter().copied().collect();
        let rows = blocks.cut(&values);
        let tokens: usize = tokenizer.grid().iter().product();
        assert_eq!(rows.len(), tokens * blocks.width());
        assert_eq!(blocks.paste(&rows), values);
    }

    #[test]
    fn as_many_centres_as_blocks_reconstruct_a_clip_and_huge_codebooks_have_no_baseline() {
        let read = |i: usize| Ok::<_, Infallible>(Some(clip(i % 2)));
        let near = |levels: &[usize]| {
            let kmeans = VideoKMeans::fit(&tokenizer(levels), 12, 3, read).unwrap();
            kmeans.map(|kmeans| {
                let values: Vec<f32> = clip(1).values.iter().copied().collect();
                let found = kmeans.reconstruct(&values);
                let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
                found.iter().zip(&values).map(square).sum::<f64>() / values.len() as f64
            })
        };
        let (few, many) = (near(&[2, 2]).unwrap(), near(&[4, 4, 3]).unwrap());
        assert!(many < 0.5 * few, "{few} {many}");
        assert!(near(&[64, 64, 16]).is_none());
    }
}
