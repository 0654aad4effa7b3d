//! Which frames of a long video the windows see.
//!
//! Windows of 32 frames start every 22. The first ten slots of a later window are frames that earlier windows have seen: its
//! own slots 2 to 9 overlap the end of the window before, and slots 0 and 1 are key frames that tie its scale to theirs.

use super::settings::WINDOW;

/// Frames from one window to the next.
pub const STEP: usize = 22;
/// Slots of a window that are taken over from the window before.
pub const OVERLAP: usize = WINDOW - STEP;
/// Frames over which two windows are blended.
pub const BLEND: usize = 8;
/// The slots of a window that become the first of the next.
pub const KEY_SLOTS: [usize; OVERLAP] = [0, 12, 24, 25, 26, 27, 28, 29, 30, 31];

/// How many windows a video of `frames` frames has.
#[must_use]
pub fn windows(frames: usize) -> usize {
    frames.div_ceil(STEP)
}

/// The frame in every slot of every window. Beyond its end a video repeats its last frame.
#[must_use]
pub fn plan(frames: usize) -> Vec<[usize; WINDOW]> {
    let mut all: Vec<[usize; WINDOW]> = Vec::with_capacity(windows(frames));
    for window in 0..windows(frames) {
        let slots = std::array::from_fn(|slot| match all.last() {
            Some(before) if slot < OVERLAP => before[KEY_SLOTS[slot]],
            _ => (window * STEP + slot).min(frames - 1),
        });
        all.push(slots);
    }
    all
}

/// The slots of window `window` whose depth the result of a video of `frames` frames depends on. Slots 0 and 1 serve the fit of
/// relative depth; blending starts with slot 3 (slot 2 has no weight) and leaves nothing of the last slot.
#[must_use]
pub fn needed_slots(window: usize, frames: usize, fitted: bool) -> Vec<usize> {
    let last = window + 1 == windows(frames);
    (0..WINDOW)
        .filter(|slot| {
            let inside = window * STEP + slot < frames;
            let of_own = match (window, *slot) {
                (0, _) | (_, 10..) => inside,
                (_, 0 | 1) => fitted,
                (_, 2) => false,
                _ => inside,
            };
            of_own && (last || *slot + 1 < WINDOW)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_sees_the_first_frame_a_key_frame_and_the_overlap() {
        let plan = plan(60);
        assert_eq!(plan.len(), 3);
        assert_eq!(plan[1][..4], [0, 12, 24, 25]);
        assert_eq!(plan[1][10..12], [32, 33]);
        assert_eq!(plan[2][..4], [0, 34, 46, 47]);
        assert_eq!(plan[2][31], 59);
        assert_eq!(windows(0), 0);
        assert_eq!((windows(22), windows(23)), (1, 2));
    }

    #[test]
    fn only_slots_that_change_the_result_are_wanted() {
        assert_eq!(needed_slots(0, 1, true), [0]);
        assert_eq!(needed_slots(0, 22, true).len(), 22);
        assert_eq!(needed_slots(0, 40, true), (0..31).collect::<Vec<_>>());
        let second = needed_slots(1, 40, true);
        assert_eq!(second[..3], [0, 1, 3]);
        assert_eq!(second.last(), Some(&17));
        assert_eq!(needed_slots(1, 40, false)[0], 3);
    }
}
