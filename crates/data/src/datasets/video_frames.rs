//! The pictures of a recording that are a video beside it.

use super::ReadError;
use super::recording::ColourFrames;
use crate::video::Video;
use crate::video::image::Image;

/// The frames of a video on their own clock.
pub(super) struct Frames {
    pub video: Video,
    pub times: Vec<i64>,
}

impl ColourFrames for Frames {
    fn times(&self) -> &[i64] {
        &self.times
    }

    fn read(&self, indices: &[usize], each: &mut dyn FnMut(usize, Image)) -> Result<(), ReadError> {
        for frame in self.video.chosen(indices.to_vec())? {
            let frame = frame?;
            each(frame.index, frame.image);
        }
        Ok(())
    }

    fn decoder(&self) -> Option<String> {
        Some(self.video.info().read_by())
    }
}
