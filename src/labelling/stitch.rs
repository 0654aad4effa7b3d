//! The depth of overlapping windows to the depth of one video: scale and shift of each window, then blending.

use std::collections::BTreeMap;

use super::DepthLabelKind;
use super::plan::{BLEND, KEY_SLOTS, OVERLAP, STEP};
use super::settings::WINDOW;
use crate::engine::ops::steps;

/// Frames from the first of a blend to the last.
const LAST: f64 = (BLEND - 1) as f64;

/// The depth of one frame as the network gives it.
#[derive(Debug, Clone, PartialEq)]
pub struct Map {
    /// Row-major, `height * width`.
    pub values: Vec<f32>,
    /// Height and width.
    pub size: [usize; 2],
}

impl Map {
    /// At another size, bilinearly with aligned corners.
    #[must_use]
    pub fn resized(&self, to: [usize; 2]) -> Vec<f32> {
        if self.size == to {
            return self.values.clone();
        }
        let [_, width] = self.size;
        let (lines, pixels) = (steps(self.size[0], to[0]), steps(width, to[1]));
        let mut out = Vec::with_capacity(to[0] * to[1]);
        let mut mixed = vec![0.0_f32; width];
        for line in &lines {
            let row = |at: usize| &self.values[at * width..][..width];
            let pair = row(line.lower).iter().zip(row(line.upper));
            for (mixed, (a, b)) in mixed.iter_mut().zip(pair) {
                *mixed = a * (1.0 - line.weight) + b * line.weight;
            }
            out.extend(
                pixels
                    .iter()
                    .map(|p| mixed[p.lower] * (1.0 - p.weight) + mixed[p.upper] * p.weight),
            );
        }
        out
    }
}

/// A map with what its window was scaled and shifted by: held at the network's size, so that memory does not grow with the
/// size of the video.
#[derive(Debug, Clone)]
struct Aligned {
    map: Map,
    fit: Fit,
}

impl Aligned {
    /// `[height * width]` at the size of the video.
    fn at(&self, size: [usize; 2]) -> Vec<f32> {
        let mut values = self.map.resized(size);
        if self.fit != Fit::IDENTITY {
            for value in &mut values {
                *value = self.fit.apply(*value);
            }
        }
        values
    }
}

/// `max(scale * value + shift, 0)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    /// Factor of a window's values.
    pub scale: f64,
    /// Added to the scaled values, in the unit of the depth that is fitted to.
    pub shift: f64,
}

impl Fit {
    /// Scale 1 and shift 0; maps are then taken as they are.
    pub const IDENTITY: Self = Self {
        scale: 1.0,
        shift: 0.0,
    };

    fn apply(self, value: f32) -> f32 {
        (self.scale * f64::from(value) + self.shift).max(0.0) as f32
    }

    /// The fit of least squares from `p` to `y`; the identity where `p` is constant.
    #[must_use]
    pub fn between(pairs: &[(&[f32], &[f32])]) -> Self {
        let [mut n, mut p, mut y, mut pp, mut py] = [0.0_f64; 5];
        for (from, to) in pairs {
            for (a, b) in from.iter().zip(*to) {
                let (a, b) = (f64::from(*a), f64::from(*b));
                n += 1.0;
                p += a;
                y += b;
                pp += a * a;
                py += a * b;
            }
        }
        let determinant = pp * n - p * p;
        if determinant == 0.0 || !determinant.is_finite() {
            return Self::IDENTITY;
        }
        Self {
            scale: (n * py - p * y) / determinant,
            shift: (pp * y - p * py) / determinant,
        }
    }
}

/// Takes the windows of a video in order and gives its frames in order, holding ten maps.
#[derive(Debug)]
pub struct Stitcher {
    kind: DepthLabelKind,
    /// Height and width of the video.
    size: [usize; 2],
    /// The video's first map, and the one that the next window's slot 1 shows.
    references: Option<[Aligned; 2]>,
    /// The last maps so far, to be blended with the next window.
    tail: Vec<Option<Aligned>>,
    windows: usize,
    /// Frames that were given out.
    given: usize,
}

impl Stitcher {
    /// The start of a video of `size` (height, width); only windows of relative depth are fitted to each other.
    #[must_use]
    pub fn new(kind: DepthLabelKind, size: [usize; 2]) -> Self {
        Self {
            kind,
            size,
            references: None,
            tail: Vec::new(),
            windows: 0,
            given: 0,
        }
    }

    /// Adds the next window: maps by slot; those of [`super::plan::needed_slots`] suffice. `frames` is how many frames the video has,
    /// where its end was reached. Finished frames go to `sink`, `[height * width]` each. Gives what the window was fitted by.
    ///
    /// # Errors
    /// What `sink` refuses.
    pub fn push<E>(
        &mut self,
        mut window: BTreeMap<usize, Map>,
        frames: Option<usize>,
        sink: &mut dyn FnMut(usize, Vec<f32>) -> Result<(), E>,
    ) -> Result<Fit, E> {
        let fit = self.fit(&window);
        let end = frames.unwrap_or(usize::MAX);
        let last = end <= (self.windows + 1) * STEP;
        let own_from = if self.windows == 0 { 0 } else { OVERLAP };
        let mut aligned = |slot: usize| window.remove(&slot).map(|map| Aligned { map, fit });
        let mut finished = Vec::new();
        for (i, before) in std::mem::take(&mut self.tail).into_iter().enumerate() {
            let after = aligned(OVERLAP - BLEND + i);
            finished.push([(before, 1.0 - i as f64 / LAST), (after, i as f64 / LAST)]);
        }
        let mut own: Vec<Option<Aligned>> = (own_from..WINDOW).map(aligned).collect();
        if !last {
            let key = own[KEY_SLOTS[1] - own_from].clone();
            let start = match self.references.take() {
                Some([start, _]) => Some(start),
                None => own[0].clone(),
            };
            self.references = start.zip(key).map(|(start, key)| [start, key]);
            self.tail = own.split_off(own.len() - BLEND);
        }
        finished.extend(own.into_iter().map(|map| [(map, 1.0), (None, 0.0)]));
        for parts in finished {
            if self.given >= end {
                break;
            }
            if let Some(values) = mixed(parts, self.size) {
                sink(self.given, values)?;
            }
            self.given += 1;
        }
        self.windows += 1;
        Ok(fit)
    }

    fn fit(&self, window: &BTreeMap<usize, Map>) -> Fit {
        let (Some(references), DepthLabelKind::Relative) = (&self.references, self.kind) else {
            return Fit::IDENTITY;
        };
        let [Some(first), Some(second)] = [0, 1].map(|slot| window.get(&slot)) else {
            return Fit::IDENTITY;
        };
        let (a, b) = (first.resized(self.size), second.resized(self.size));
        let [x, y] = references.each_ref().map(|map| map.at(self.size));
        Fit::between(&[(&a, &x), (&b, &y)])
    }
}

/// The blend of maps by their shares; one without a share may be missing.
fn mixed(parts: [(Option<Aligned>, f64); 2], size: [usize; 2]) -> Option<Vec<f32>> {
    let shared: Vec<(Option<Aligned>, f64)> = parts
        .into_iter()
        .filter(|(_, share)| *share > 0.0)
        .collect();
    let mut maps = Vec::new();
    for (map, share) in shared {
        maps.push((map?.at(size), share));
    }
    let mut maps = maps.into_iter();
    let (mut values, share) = maps.next()?;
    for (other, other_share) in maps {
        for (value, other) in values.iter_mut().zip(other) {
            *value = (f64::from(*value) * share + f64::from(other) * other_share) as f32;
        }
    }
    Some(values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::labelling::plan;

    /// The depth that a perfect network would give frame `frame`.
    fn truth(frame: usize) -> Vec<f32> {
        (0..6)
            .map(|i| 1.0 + (frame * 7 + i * 3) as f32 % 11.0)
            .collect()
    }

    fn stitched(frames: usize, kind: DepthLabelKind) -> Vec<Vec<f32>> {
        let mut stitcher = Stitcher::new(kind, [2, 3]);
        let mut all = Vec::new();
        let plan = plan::plan(frames);
        for (index, slots) in plan.iter().enumerate() {
            let scale = 1.0 + index as f32 * 0.5;
            let relative = kind == DepthLabelKind::Relative;
            let window = plan::needed_slots(index, frames, relative)
                .into_iter()
                .map(|slot| {
                    let mut values = truth(slots[slot]);
                    if relative {
                        for v in &mut values {
                            *v = *v * scale + 0.25 * scale - 0.25;
                        }
                    }
                    (
                        slot,
                        Map {
                            values,
                            size: [2, 3],
                        },
                    )
                })
                .collect();
            // The end is known once a window reaches beyond it.
            let end = (index * STEP + WINDOW > frames).then_some(frames);
            stitcher
                .push(window, end, &mut |frame, values| {
                    assert_eq!(frame, all.len());
                    all.push(values);
                    Ok::<(), ()>(())
                })
                .unwrap();
        }
        all
    }

    #[test]
    fn windows_of_any_scale_become_one_video_of_every_length() {
        for kind in [DepthLabelKind::Relative, DepthLabelKind::Metric] {
            for frames in [1, 16, 22, 23, 24, 25, 31, 32, 33, 44, 45, 66, 70] {
                let all = stitched(frames, kind);
                assert_eq!(all.len(), frames);
                for (frame, values) in all.iter().enumerate() {
                    for (a, b) in values.iter().zip(truth(frame)) {
                        assert!((a - b).abs() < 1e-4, "{frames} {frame}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_constant_window_is_left_as_it_is() {
        let (black, grey) = ([0.0_f32; 4], [2.0_f32; 4]);
        assert_eq!(Fit::between(&[(&black, &grey)]), Fit::IDENTITY);
        assert_eq!(Fit::between(&[]), Fit::IDENTITY);
    }
}
