//! The square frames of a video on several threads: groups of pictures are decoded side by side, and colours are converted and
//! pictures resized behind them, so that even one long group keeps more than one core busy. Order and pixels do not depend on the
//! number of threads, and what is ahead of the reader is bounded.

use super::embedded::{Index, Part, Wanted};
use super::image::Image;
use super::{Frames, Video, colour};
use crate::formats::ReadError;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

/// Square frames of one part that wait to be taken.
const AHEAD: usize = 16;
/// More threads than this only wait for the reader.
const MOST_THREADS: usize = 8;
/// Pixels of one picture, times threads: one thread at 4K, five at full HD.
const PIXELS_AHEAD: u64 = 12_000_000;

/// A frame's number and its square, or why there is none.
type Square = Result<(usize, Image), ReadError>;
/// A square that is still being made.
type Promise = Receiver<Square>;
type Job = Box<dyn FnOnce() + Send>;

/// Iterator over square frames, ascending.
#[derive(Debug)]
pub struct Squares {
    inner: Source,
    side: u32,
}

#[derive(Debug)]
enum Source {
    /// One after the other, on the thread of the reader.
    Plain(Box<Frames>),
    /// Part after part, promise after promise. Threads stop when nobody receives any more.
    Parts {
        path: PathBuf,
        parts: Receiver<Receiver<Promise>>,
        current: Option<Receiver<Promise>>,
        left: usize,
    },
}

impl Video {
    /// The named frames, ascending and without repetition, each resized to a square of `side` pixels as in
    /// [`Video::load_clip`], decoded ahead on so many threads.
    ///
    /// # Errors
    /// When the file cannot be opened; later errors come out of the iterator, which then ends.
    pub fn squares(
        &self,
        mut frames: Vec<usize>,
        side: u32,
        threads: usize,
    ) -> Result<Squares, ReadError> {
        // A decoder keeps up to sixteen pictures: the larger they are, the fewer are decoded side by side.
        let pixels = (u64::from(self.info.width) * u64::from(self.info.height)).max(1);
        let threads = threads
            .min(MOST_THREADS)
            .min((PIXELS_AHEAD / pixels).max(1) as usize);
        let inner = match &self.pictures {
            super::Backing::Embedded(index) if threads > 1 => {
                frames.retain(|frame| *frame < self.info.frames);
                frames.sort_unstable();
                frames.dedup();
                let parts = index.parts(&frames)?;
                Source::Parts {
                    path: self.path.clone(),
                    parts: start(self, index, parts, side, threads),
                    current: None,
                    left: frames.len(),
                }
            }
            _ => Source::Plain(Box::new(self.chosen(frames)?)),
        };
        Ok(Squares { inner, side })
    }
}

fn start(
    video: &Video,
    index: &Arc<Index>,
    mut parts: Vec<Part>,
    side: u32,
    threads: usize,
) -> Receiver<Receiver<Promise>> {
    parts.reverse();
    let workers = threads.min(parts.len());
    let (announce, announced) = sync_channel(threads);
    let (hand_over, jobs) = sync_channel::<Job>(threads);
    let jobs = Arc::new(Mutex::new(jobs));
    for _ in 0..threads {
        let jobs = Arc::clone(&jobs);
        std::thread::spawn(move || {
            loop {
                let job = jobs.lock().unwrap_or_else(PoisonError::into_inner).recv();
                match job {
                    Ok(job) => job(),
                    Err(_) => return,
                }
            }
        });
    }
    // The lock is held while a part is announced: parts are announced in their order.
    let queue = Arc::new(Mutex::new((parts, announce)));
    let shape = Shape {
        index: Arc::clone(index),
        pixel_aspect: video.info.pixel_aspect,
        side,
    };
    for _ in 0..workers {
        let (queue, hand_over, shape) = (Arc::clone(&queue), hand_over.clone(), shape.clone());
        std::thread::spawn(move || {
            loop {
                let mut held = queue.lock().unwrap_or_else(PoisonError::into_inner);
                let Some(part) = held.0.pop() else { return };
                let (promise, promised) = sync_channel(AHEAD);
                if held.1.send(promised).is_err() {
                    return;
                }
                drop(held);
                if !decode(part, &shape, &promise, &hand_over) {
                    return;
                }
            }
        });
    }
    announced
}

/// What becomes of every picture.
#[derive(Clone)]
struct Shape {
    index: Arc<Index>,
    pixel_aspect: f64,
    side: u32,
}

/// Decodes one part; false when nobody wants it any more.
fn decode(
    part: Part,
    shape: &Shape,
    promise: &SyncSender<Promise>,
    hand_over: &SyncSender<Job>,
) -> bool {
    let pictures = match Wanted::of_parts(Arc::clone(&shape.index), vec![part]) {
        Ok(pictures) => pictures,
        Err(error) => return promise.send(broken(error)).is_ok(),
    };
    for picture in pictures {
        let (frame, picture, colours) = match picture {
            Ok(picture) => picture,
            Err(error) => return promise.send(broken(error)).is_ok(),
        };
        let (keep, square) = sync_channel(1);
        let shape = shape.clone();
        let job = Box::new(move || {
            let image = colour::to_rgb(&picture, colours).upright(shape.index.orientation);
            let image = image.with_square_pixels(shape.pixel_aspect);
            let _ = keep.send(Ok((frame, image.square(shape.side))));
        });
        if promise.send(square).is_err() || hand_over.send(job).is_err() {
            return false;
        }
    }
    true
}

fn broken(error: ReadError) -> Promise {
    let (keep, square) = sync_channel(1);
    let _ = keep.send(Err(error));
    square
}

impl Iterator for Squares {
    type Item = Square;

    fn next(&mut self) -> Option<Square> {
        match &mut self.inner {
            Source::Plain(frames) => {
                let frame = frames.next()?;
                Some(frame.map(|frame| (frame.index, frame.image.square(self.side))))
            }
            Source::Parts {
                path,
                parts,
                current,
                left,
            } => {
                if *left == 0 {
                    return None;
                }
                loop {
                    if let Some(promise) = current.as_ref().and_then(|part| part.recv().ok()) {
                        // Without an answer the thread that owed one is gone.
                        let square = promise.recv().unwrap_or_else(|_| {
                            Err(ReadError::unsupported(path, "its decoder stopped"))
                        });
                        *left = if square.is_ok() { *left - 1 } else { 0 };
                        return Some(square);
                    }
                    let Ok(part) = parts.recv() else {
                        *left = 0;
                        return Some(Err(ReadError::unsupported(path, "its decoder stopped")));
                    };
                    *current = Some(part);
                }
            }
        }
    }
}
