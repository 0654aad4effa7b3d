//! Depth frames until their scale is known: in memory, or on disk so that memory does not grow with the video.

use crate::formats::FormatError;
use crate::formats::zip::ZipWriter;
use ndarray::Array2;
use std::fs::File;
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;

/// Frames of one size, in order.
#[derive(Debug)]
pub struct DepthFrames {
    store: Store,
    frames: usize,
    size: Option<[usize; 2]>,
}

#[derive(Debug)]
enum Store {
    Memory(Vec<f32>),
    /// An unnamed temporary file.
    Disk(BufWriter<File>),
}

impl DepthFrames {
    /// No frames yet, to be held in memory.
    #[must_use]
    pub fn in_memory() -> Self {
        Self::of(Store::Memory(Vec::new()))
    }

    /// No frames yet, to be held on the disk that `folder` lies on.
    ///
    /// # Errors
    /// When the folder cannot be written to.
    pub fn on_disk(folder: &Path) -> std::io::Result<Self> {
        let file = BufWriter::new(tempfile::tempfile_in(folder)?);
        Ok(Self::of(Store::Disk(file)))
    }

    fn of(store: Store) -> Self {
        Self {
            store,
            frames: 0,
            size: None,
        }
    }

    /// Frames so far.
    #[must_use]
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// `[height, width]` of a frame; `None` before the first.
    #[must_use]
    pub fn size(&self) -> Option<[usize; 2]> {
        self.size
    }

    /// Adds a frame `[h, w]`.
    ///
    /// # Errors
    /// When it has another size than the frames before it (as `InvalidData`), or the disk is full.
    pub fn push(&mut self, frame: &Array2<f32>) -> std::io::Result<()> {
        let size = [frame.nrows(), frame.ncols()];
        if *self.size.get_or_insert(size) != size {
            let reason = format!("depth of {size:?} after {:?}", self.size);
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidData, reason));
        }
        match &mut self.store {
            Store::Memory(values) => values.extend(frame),
            Store::Disk(file) => {
                for value in frame {
                    file.write_all(&value.to_le_bytes())?;
                }
            }
        }
        self.frames += 1;
        Ok(())
    }

    /// Brings every frame to where [`DepthFrames::frame`] finds it.
    pub(super) fn flush(&mut self) -> std::io::Result<()> {
        match &mut self.store {
            Store::Memory(_) => Ok(()),
            Store::Disk(file) => file.flush(),
        }
    }

    /// Frame `index` as it was pushed, `[h, w]`.
    ///
    /// # Errors
    /// When the disk cannot be read, or there is no such frame.
    pub fn frame(&self, index: usize) -> std::io::Result<Array2<f32>> {
        let [height, width] = self.size.unwrap_or([0, 0]);
        let count = height * width;
        if index >= self.frames {
            let reason = format!("frame {index} of {}", self.frames);
            return Err(std::io::Error::new(
                std::io::ErrorKind::InvalidInput,
                reason,
            ));
        }
        let values = match &self.store {
            Store::Memory(values) => values[index * count..][..count].to_vec(),
            Store::Disk(file) => {
                let mut source = file.get_ref();
                let mut bytes = vec![0; 4 * count];
                source.seek(SeekFrom::Start((4 * index * count) as u64))?;
                source.read_exact(&mut bytes)?;
                let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
                bytes.chunks_exact(4).map(number).collect()
            }
        };
        Array2::from_shape_vec((height, width), values).map_err(std::io::Error::other)
    }

    /// Writes the frames, every value as `of` makes it, into the npz file `path` under `name`.
    ///
    /// # Errors
    /// When reading or writing fails, or the file would exceed 4 GB.
    pub fn write_npz(
        &self,
        path: &Path,
        name: &str,
        of: impl Fn(f32) -> f32,
    ) -> Result<[usize; 3], FormatError> {
        let [height, width] = self.size.unwrap_or([0, 0]);
        let shape = [self.frames, height, width];
        let folder = path
            .parent()
            .filter(|p| !p.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        let mut member = BufWriter::new(tempfile::tempfile_in(folder)?);
        member.write_all(&header(shape))?;
        for index in 0..self.frames {
            for value in self.frame(index)? {
                member.write_all(&of(value).to_le_bytes())?;
            }
        }
        let mut member = member
            .into_inner()
            .map_err(std::io::IntoInnerError::into_error)?;
        let mut out = crate::formats::temporary_in(folder)?;
        let mut zip = ZipWriter::new(BufWriter::new(out.as_file_mut()));
        zip.add_file(&format!("{name}.npy"), &mut member)?;
        zip.finish()?;
        out.as_file().sync_all()?;
        out.persist(path).map_err(|e| e.error)?;
        Ok(shape)
    }
}

/// The header of an npy file of f32 in C order.
fn header(shape: [usize; 3]) -> Vec<u8> {
    let [frames, height, width] = shape;
    let mut text = format!(
        "{{'descr': '<f4', 'fortran_order': False, 'shape': ({frames}, {height}, {width}), }}"
    );
    // 10 bytes of magic, version and length, then text that ends at a multiple of 64 with a newline.
    while !(text.len() + 11).is_multiple_of(64) {
        text.push(' ');
    }
    text.push('\n');
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((text.len() as u16).to_le_bytes());
    out.extend(text.as_bytes());
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::npz::Npz;

    #[test]
    fn frames_come_back_and_are_written_scaled_from_memory_and_from_disk() {
        let folder = tempfile::tempdir().unwrap();
        let on_disk = DepthFrames::on_disk(folder.path()).unwrap();
        let mut written = Vec::new();
        for mut frames in [on_disk, DepthFrames::in_memory()] {
            let made =
                |k: usize| Array2::from_shape_fn((2, 5), |(y, x)| (k * 10 + y * 5 + x) as f32);
            for k in 0..3 {
                frames.push(&made(k)).unwrap();
            }
            assert!(frames.push(&Array2::zeros((3, 3))).is_err());
            frames.flush().unwrap();
            assert_eq!(frames.frame(1).unwrap(), made(1));
            assert!(frames.frame(3).is_err());
            let path = folder.path().join("depth.npz");
            let shape = frames
                .write_npz(&path, "metres", |value| (2.0 * value - 5.0).max(0.001))
                .unwrap();
            assert_eq!(shape, [3, 2, 5]);
            let read = Npz::read(&path).unwrap();
            let metres = read
                .get("metres")
                .unwrap()
                .to_dim::<f32, ndarray::Ix3>()
                .unwrap();
            assert_eq!(metres[[2, 1, 4]], 53.0);
            assert_eq!(metres[[0, 0, 0]], 0.001);
            written.push(std::fs::read(&path).unwrap());
        }
        assert!(written[0] == written[1]);
    }
}
