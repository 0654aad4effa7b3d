//! Depth frames on disk until their scale is known, so that memory does not grow with the video.

use crate::formats::FormatError;
use crate::formats::zip::ZipWriter;
use ndarray::Array2;
use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;

/// Frames of one size, in order, in an unnamed temporary file.
#[derive(Debug)]
pub struct DepthSpool {
    file: BufWriter<File>,
    frames: usize,
    size: Option<[usize; 2]>,
}

impl DepthSpool {
    /// An empty spool on the disk that `folder` lies on.
    ///
    /// # Errors
    /// When the folder cannot be written to.
    pub fn new(folder: &Path) -> std::io::Result<Self> {
        let file = BufWriter::new(tempfile::tempfile_in(folder)?);
        Ok(Self {
            file,
            frames: 0,
            size: None,
        })
    }

    /// Frames so far.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// `[height, width]` of a frame; `None` before the first.
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
        for value in frame {
            self.file.write_all(&value.to_le_bytes())?;
        }
        self.frames += 1;
        Ok(())
    }

    /// Writes the frames as `scale * depth + shift`, never below `lowest`, into the npz file `path` under `name`.
    ///
    /// # Errors
    /// When reading or writing fails, or the file would exceed 4 GB.
    pub fn write_npz(
        self,
        path: &Path,
        name: &str,
        [scale, shift]: [f32; 2],
        lowest: f32,
    ) -> Result<[usize; 3], FormatError> {
        let [height, width] = self.size.unwrap_or([0, 0]);
        let shape = [self.frames, height, width];
        let mut source = self
            .file
            .into_inner()
            .map_err(std::io::IntoInnerError::into_error)?;
        source.seek(SeekFrom::Start(0))?;
        let mut source = BufReader::new(source);

        let folder = path
            .parent()
            .filter(|p| !p.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        let mut member = BufWriter::new(tempfile::tempfile_in(folder)?);
        member.write_all(&header(shape))?;
        let mut row = vec![0; width * 4];
        for _ in 0..self.frames * height {
            source.read_exact(&mut row)?;
            for bytes in row.chunks_exact_mut(4) {
                let value = f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                bytes.copy_from_slice(&(scale * value + shift).max(lowest).to_le_bytes());
            }
            member.write_all(&row)?;
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
    fn what_is_spooled_is_read_back_scaled() {
        let folder = tempfile::tempdir().unwrap();
        let mut spool = DepthSpool::new(folder.path()).unwrap();
        for k in 0..3 {
            spool
                .push(&Array2::from_shape_fn((2, 5), |(y, x)| {
                    (k * 10 + y * 5 + x) as f32
                }))
                .unwrap();
        }
        assert!(spool.push(&Array2::zeros((3, 3))).is_err());
        let path = folder.path().join("depth.npz");
        let shape = spool
            .write_npz(&path, "metres", [2.0, -5.0], 0.001)
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
    }
}
