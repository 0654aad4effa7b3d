//! Movie fragments: samples that are described beside the media, a few seconds at a time.

use super::boxes::{Boxes, Defaults, be32, be64, entry_index};
use super::{SMALLEST_SAMPLE, Sample, Track};
use crate::formats::ReadError;

impl Boxes<'_> {
    pub(super) fn fragment(
        &self,
        moof: &[u8],
        moof_at: u64,
        track: &mut Track,
        defaults: &mut Defaults,
    ) -> Result<(), ReadError> {
        for traf in self.children(moof, 0, 0)? {
            if &traf.kind != b"traf" {
                continue;
            }
            let inside = self.children(traf.data, traf.at, 1)?;
            let Some(header) = inside.iter().find(|inner| &inner.kind == b"tfhd") else {
                continue;
            };
            if be32(header.data, 4) != Some(track.id) {
                continue;
            }
            let flags = self.need(be32(header.data, 0), header.at, "tfhd")? & 0x00ff_ffff;
            let mut at = 8;
            let mut base = moof_at;
            if flags & 1 != 0 {
                base = be64(header.data, at)
                    .ok_or_else(|| self.damaged(header.at, "`tfhd` is cut off"))?;
                at += 8;
            }
            let mut entry = defaults.entry;
            if flags & 2 != 0 {
                entry = entry_index(self.need(be32(header.data, at), header.at, "tfhd")?);
                at += 4;
            }
            let mut field = |bit: u32, default: u32| {
                if flags & bit == 0 {
                    return Ok(default);
                }
                at += 4;
                self.need(be32(header.data, at - 4), header.at, "tfhd")
            };
            let duration = field(8, defaults.duration)?;
            let size = field(16, defaults.size)?;
            let sample_flags = field(32, defaults.flags)?;
            if let Some(tfdt) = inside.iter().find(|inner| &inner.kind == b"tfdt") {
                let time = if tfdt.data.first() == Some(&1) {
                    be64(tfdt.data, 4)
                } else {
                    be32(tfdt.data, 4).map(u64::from)
                };
                defaults.next_time = time
                    .and_then(|time| i64::try_from(time).ok())
                    .filter(|time| *time < i64::MAX / 4)
                    .ok_or_else(|| self.damaged(tfdt.at, "`tfdt` holds no time"))?;
            }
            let mut offset = base;
            for trun in inside.iter().filter(|inner| &inner.kind == b"trun") {
                let flags = self.need(be32(trun.data, 0), trun.at, "trun")?;
                let signed = flags >> 24 != 0;
                let count = self.need(be32(trun.data, 4), trun.at, "trun")? as usize;
                let mut at = 8;
                if flags & 1 != 0 {
                    let shift = self.need(be32(trun.data, at), trun.at, "trun")? as i32;
                    offset = base.saturating_add_signed(i64::from(shift));
                    at += 4;
                }
                let mut first_flags = None;
                if flags & 4 != 0 {
                    first_flags = Some(self.need(be32(trun.data, at), trun.at, "trun")?);
                    at += 4;
                }
                let most = (self.file_len / SMALLEST_SAMPLE) as usize;
                if track.samples.len().saturating_add(count) > most {
                    return Err(self.damaged(
                        trun.at,
                        format!(
                            "{count} more video samples cannot fit into a file of {} bytes",
                            self.file_len
                        ),
                    ));
                }
                for index in 0..count {
                    let mut field = |bit: u32, default: u32| {
                        if flags & bit == 0 {
                            return Ok(default);
                        }
                        at += 4;
                        self.need(be32(trun.data, at - 4), trun.at, "trun")
                    };
                    let duration = field(0x100, duration)?;
                    let size = field(0x200, size)?;
                    let mut sample_flags = field(0x400, sample_flags)?;
                    let shift = field(0x800, 0)?;
                    if let (0, Some(first)) = (index, first_flags) {
                        sample_flags = first;
                    }
                    let shift = if signed {
                        i64::from(shift as i32)
                    } else {
                        i64::from(shift)
                    };
                    track.samples.push(Sample {
                        offset,
                        size,
                        entry,
                        time: defaults.next_time + shift,
                        // bit 16: not a sync sample
                        sync: sample_flags & 0x1_0000 == 0,
                    });
                    offset = offset.saturating_add(u64::from(size));
                    defaults.next_time += i64::from(duration);
                }
            }
        }
        Ok(())
    }
}
