//! The sample tables of a track: where each picture's bytes are, and when it is shown.

use super::boxes::entry_index;
use super::boxes::{Boxes, Inner, be32, be64};
use super::{SMALLEST_SAMPLE, Sample, Track};
use crate::formats::ReadError;

#[derive(Default)]
struct Tables<'b> {
    durations: &'b [u8],
    shifts: &'b [u8],
    syncs: Option<&'b [u8]>,
    chunks: &'b [u8],
    sizes: &'b [u8],
    /// Bits of a size in `stz2`; 0 where sizes are those of `stsz`.
    size_bits: usize,
    offsets: Option<(&'b [u8], usize)>,
}

/// Run-length coded values: (count, value) pairs after a 4-byte version and a 4-byte number of pairs.
struct Runs<'b> {
    data: &'b [u8],
    at: usize,
    left: u32,
    value: u32,
}

impl<'b> Runs<'b> {
    fn new(data: &'b [u8]) -> Self {
        Runs {
            data,
            at: 8,
            left: 0,
            value: 0,
        }
    }
}

impl Iterator for Runs<'_> {
    type Item = u32;

    fn next(&mut self) -> Option<u32> {
        while self.left == 0 {
            self.left = be32(self.data, self.at)?;
            self.value = be32(self.data, self.at + 4)?;
            self.at += 8;
        }
        self.left -= 1;
        Some(self.value)
    }
}

impl Boxes<'_> {
    pub(super) fn sample_table(&self, stbl: Inner<'_>, track: &mut Track) -> Result<(), ReadError> {
        let mut tables = Tables::default();
        for inner in self.children(stbl.data, stbl.at, 4)? {
            match &inner.kind {
                b"stsd" => self.descriptions(inner, track)?,
                b"stts" => tables.durations = inner.data,
                b"ctts" => tables.shifts = inner.data,
                b"stss" => tables.syncs = Some(inner.data),
                b"stsc" => tables.chunks = inner.data,
                b"stsz" => tables.sizes = inner.data,
                b"stz2" => {
                    tables.sizes = inner.data;
                    tables.size_bits = usize::from(inner.data.get(7).copied().unwrap_or(0));
                }
                b"stco" => tables.offsets = Some((inner.data, 4)),
                b"co64" => tables.offsets = Some((inner.data, 8)),
                _ => {}
            }
        }
        self.samples(stbl.at, &tables, track)
    }

    fn samples(&self, at: usize, tables: &Tables<'_>, track: &mut Track) -> Result<(), ReadError> {
        let count = u64::from(be32(tables.sizes, 8).unwrap_or(0));
        if count == 0 {
            return Ok(()); // a fragmented file
        }
        let smallest = if tables.size_bits == 0 {
            SMALLEST_SAMPLE
        } else {
            1
        };
        if count > self.file_len / smallest {
            return Err(self.damaged(
                at,
                format!(
                    "{count} video samples cannot fit into a file of {} bytes",
                    self.file_len
                ),
            ));
        }
        let constant = if tables.size_bits == 0 {
            be32(tables.sizes, 4).unwrap_or(0)
        } else {
            0
        };
        let size_of = |index: usize| match tables.size_bits {
            0 => be32(tables.sizes, 12 + 4 * index),
            4 => {
                let pair = tables.sizes.get(12 + index / 2)?;
                Some(u32::from(if index.is_multiple_of(2) {
                    pair >> 4
                } else {
                    pair & 15
                }))
            }
            8 => tables.sizes.get(12 + index).copied().map(u32::from),
            16 => {
                let pair = tables.sizes.get(12 + 2 * index..14 + 2 * index)?;
                Some(u32::from(u16::from_be_bytes([pair[0], pair[1]])))
            }
            _ => None,
        };
        let Some((offsets, width)) = tables.offsets else {
            return Err(self.damaged(at, "no chunk offsets (`stco` or `co64`)"));
        };
        let chunk_offset = |chunk: u64| {
            let at = usize::try_from(chunk)
                .ok()?
                .checked_mul(width)?
                .checked_add(8)?;
            if width == 4 {
                be32(offsets, at).map(u64::from)
            } else {
                be64(offsets, at)
            }
        };
        let mut durations = Runs::new(tables.durations);
        let mut shifts = Runs::new(tables.shifts);
        let mut next_sync = 0;
        let mut samples = Vec::with_capacity(count as usize);
        let (mut chunk, mut chunk_run, mut left_in_chunk, mut offset) =
            (0_u64, 0_usize, 0_u32, 0_u64);
        let mut decode_time = 0_i64;
        let mut entry = 0;
        for index in 0..count {
            if left_in_chunk == 0 {
                if index > 0 {
                    chunk += 1;
                }
                // Entries: first chunk (from 1), samples per chunk, description.
                while be32(tables.chunks, 8 + 12 * (chunk_run + 1))
                    .is_some_and(|first| u64::from(first) <= chunk + 1)
                {
                    chunk_run += 1;
                }
                left_in_chunk = be32(tables.chunks, 12 + 12 * chunk_run).unwrap_or(0);
                if left_in_chunk == 0 {
                    return Err(
                        self.damaged(at, format!("chunk {chunk} holds no samples (`stsc`)"))
                    );
                }
                entry = entry_index(be32(tables.chunks, 16 + 12 * chunk_run).unwrap_or(1));
                offset = chunk_offset(chunk).ok_or_else(|| {
                    self.damaged(at, format!("no offset for chunk {chunk}, sample {index}"))
                })?;
            }
            let size = if constant != 0 {
                constant
            } else {
                size_of(index as usize).ok_or_else(|| {
                    self.damaged(at, format!("no size for sample {index} (`stsz`)"))
                })?
            };
            let duration = durations.next().ok_or_else(|| {
                self.damaged(at, format!("no duration for sample {index} (`stts`)"))
            })?;
            let shift = shifts.next().unwrap_or(0) as i32;
            let sync = match tables.syncs {
                None => true,
                Some(syncs) => {
                    let hit = be32(syncs, 8 + 4 * next_sync) == Some(index as u32 + 1);
                    next_sync += usize::from(hit);
                    hit
                }
            };
            samples.push(Sample {
                offset,
                size,
                entry,
                time: decode_time + i64::from(shift),
                sync,
            });
            offset = offset.saturating_add(u64::from(size));
            decode_time += i64::from(duration);
            left_in_chunk -= 1;
        }
        track.samples = samples;
        Ok(())
    }
}
