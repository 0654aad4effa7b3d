//! Clips to the lengths and sizes that the network takes, and back: edge frames in time, zeros in space.

/// Frames come in groups of this many after the first, whatever the tokenizer (as the reference pads).
const FRAMES: usize = 8;
/// Height and width are multiples of this.
const PIXELS: usize = 16;

/// How a clip lies in its padded form.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Padding {
    /// Frames, height, width of the clip.
    pub clip: [usize; 3],
    /// The same after padding.
    pub padded: [usize; 3],
    /// Where the clip starts in the padded form.
    pub start: [usize; 3],
}

impl Padding {
    /// The padding of a clip of `[frames, height, width]`, none of them 0, for a tokenizer of these compressions.
    #[must_use]
    pub fn of(clip: [usize; 3], temporal: usize, spatial: usize) -> Self {
        let frames = FRAMES.max(temporal);
        let pixels = PIXELS.max(spatial);
        let time = (frames - (clip[0] + frames - 1) % frames) % frames;
        let mut padded = [clip[0] + time, clip[1], clip[2]];
        let mut start = [time / 2, 0, 0];
        for axis in 1..3 {
            let space = clip[axis].next_multiple_of(pixels) - clip[axis];
            padded[axis] += space;
            start[axis] = space / 2;
        }
        Self {
            clip,
            padded,
            start,
        }
    }

    /// The frame of the clip that stands at `frame` of the padded form.
    #[must_use]
    pub fn source_frame(&self, frame: usize) -> usize {
        frame.saturating_sub(self.start[0]).min(self.clip[0] - 1)
    }

    /// Pads `[frames, height, width, colours]`.
    #[must_use]
    pub fn pad(&self, clip: &[f32], colours: usize) -> Vec<f32> {
        let [frames, height, width] = self.padded;
        let mut out = vec![0.0; frames * height * width * colours];
        let run = self.clip[2] * colours;
        for t in 0..frames {
            let source = self.source_frame(t);
            for y in 0..self.clip[1] {
                let from = (source * self.clip[1] + y) * run;
                let to = ((t * height + self.start[1] + y) * width + self.start[2]) * colours;
                out[to..to + run].copy_from_slice(&clip[from..from + run]);
            }
        }
        out
    }

    /// Cuts the clip out of its padded form.
    #[must_use]
    pub fn crop(&self, padded: &[f32], colours: usize) -> Vec<f32> {
        let [_, height, width] = self.padded;
        let run = self.clip[2] * colours;
        let mut out = Vec::with_capacity(self.clip.iter().product::<usize>() * colours);
        for t in 0..self.clip[0] {
            for y in 0..self.clip[1] {
                let row = (t + self.start[0]) * height + self.start[1] + y;
                let from = (row * width + self.start[2]) * colours;
                out.extend_from_slice(&padded[from..from + run]);
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn cropping_undoes_padding(t in 1usize..20, h in 1usize..35, w in 1usize..35) {
            let padding = Padding::of([t, h, w], 4, 8);
            prop_assert_eq!(padding.padded[0] % 8, 1);
            prop_assert!(padding.padded[1..].iter().all(|n| n.is_multiple_of(16)));
            let clip: Vec<f32> = (0..t * h * w * 2).map(|i| i as f32).collect();
            prop_assert_eq!(padding.crop(&padding.pad(&clip, 2), 2), clip);
        }
    }
}
