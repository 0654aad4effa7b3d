//! Changes to the boxes of an mp4 whose movie header lies behind its media, so that nothing moves but the header itself.

/// Duration in ticks of the movie, first tick of the media, rate as 16.16 fixed point.
pub type Edit = (u32, i64, i32);

fn boxes(data: &[u8]) -> Vec<([u8; 4], &[u8])> {
    let mut found = Vec::new();
    let mut here = 0;
    while here + 8 <= data.len() {
        let size = u32::from_be_bytes(data[here..here + 4].try_into().unwrap()) as usize;
        let kind = data[here + 4..here + 8].try_into().unwrap();
        found.push((kind, &data[here + 8..here + size]));
        here += size;
    }
    found
}

fn container(kind: [u8; 4], body: &[u8]) -> Vec<u8> {
    let mut bytes = (body.len() as u32 + 8).to_be_bytes().to_vec();
    bytes.extend(kind);
    bytes.extend(body);
    bytes
}

/// The new payload of a box by its number, or `None` to leave it out.
type Change<'a> = dyn FnMut(usize, &[u8]) -> Option<Vec<u8>> + 'a;

/// Replaces the payload of every box at `path`; the number of the box counts those of the same path before it.
fn map(data: &[u8], path: &[&[u8; 4]], change: &mut Change<'_>) -> Vec<u8> {
    fn inner(
        data: &[u8],
        path: &[&[u8; 4]],
        count: &mut usize,
        change: &mut Change<'_>,
    ) -> Vec<u8> {
        let mut bytes = Vec::new();
        for (kind, body) in boxes(data) {
            if &kind != path[0] {
                bytes.extend(container(kind, body));
            } else if path.len() > 1 {
                bytes.extend(container(kind, &inner(body, &path[1..], count, change)));
            } else {
                if let Some(body) = change(*count, body) {
                    bytes.extend(container(kind, &body));
                }
                *count += 1;
            }
        }
        bytes
    }
    inner(data, path, &mut 0, change)
}

pub fn media_timescale(file: &[u8]) -> u32 {
    let mut scale = 0;
    map(
        file,
        &[b"moov", b"trak", b"mdia", b"mdhd"],
        &mut |_, body| {
            scale = u32::from_be_bytes(body[12..16].try_into().unwrap());
            Some(body.to_vec())
        },
    );
    scale
}

pub fn with_edits(file: Vec<u8>, edits: &[Edit]) -> Vec<u8> {
    map(&file, &[b"moov", b"trak", b"edts"], &mut |_, _| {
        let mut body = vec![0; 4];
        body.extend((edits.len() as u32).to_be_bytes());
        for (duration, time, rate) in edits {
            body.extend(duration.to_be_bytes());
            body.extend((*time as i32).to_be_bytes());
            body.extend(rate.to_be_bytes());
        }
        Some(container(*b"elst", &body))
    })
}

/// `a b c d` of the first track's matrix, or of the movie's.
pub fn with_matrix(file: Vec<u8>, whose: [u8; 4], [a, b, c, d]: [i32; 4]) -> Vec<u8> {
    let put = |body: &[u8], at: usize| {
        let mut body = body.to_vec();
        for (cell, value) in [(0, a), (1, b), (3, c), (4, d)] {
            body[at + 4 * cell..][..4].copy_from_slice(&value.to_be_bytes());
        }
        Some(body)
    };
    if &whose == b"mvhd" {
        map(&file, &[b"moov", b"mvhd"], &mut |_, body| put(body, 36))
    } else {
        map(&file, &[b"moov", b"trak", b"tkhd"], &mut |_, body| {
            put(body, 40)
        })
    }
}

pub fn with_track_flags(file: Vec<u8>, flags: &[u8]) -> Vec<u8> {
    map(&file, &[b"moov", b"trak", b"tkhd"], &mut |track, body| {
        let mut body = body.to_vec();
        body[3] = flags[track.min(flags.len() - 1)];
        Some(body)
    })
}

/// Changes the boxes of the sample description.
fn with_entry(file: &[u8], change: impl Fn(Vec<u8>) -> Vec<u8>) -> Vec<u8> {
    let path: [&[u8; 4]; 6] = [b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd"];
    map(file, &path, &mut |_, body| {
        let entries = boxes(&body[8..]);
        let (kind, entry) = entries[0];
        let mut inside = entry[..78].to_vec();
        inside.extend(change(entry[78..].to_vec()));
        let mut new = body[..8].to_vec();
        new.extend(container(kind, &inside));
        Some(new)
    })
}

pub fn with_entry_box(file: Vec<u8>, extra: &[u8]) -> Vec<u8> {
    with_entry(&file, |mut inside| {
        inside.extend(extra);
        inside
    })
}

/// Without the shape of pixels in the container: neither `pasp` nor a size of the track that differs.
pub fn without_shapes(file: Vec<u8>) -> Vec<u8> {
    let file = with_entry(&file, |inside| {
        boxes(&inside)
            .into_iter()
            .filter(|(kind, _)| kind != b"pasp")
            .flat_map(|(kind, body)| container(kind, body))
            .collect()
    });
    map(&file, &[b"moov", b"trak", b"tkhd"], &mut |_, body| {
        let mut body = body.to_vec();
        body[76..84].fill(0);
        Some(body)
    })
}

pub fn nclx(matrix: u16, full_range: bool) -> Vec<u8> {
    let mut body = b"nclx\0\x02\0\x02".to_vec();
    body.extend(matrix.to_be_bytes());
    body.push(u8::from(full_range) << 7);
    container(*b"colr", &body)
}

pub fn nclc(matrix: u16) -> Vec<u8> {
    let mut body = b"nclc\0\x02\0\x02".to_vec();
    body.extend(matrix.to_be_bytes());
    container(*b"colr", &body)
}

pub fn pasp(wide: u32, high: u32) -> Vec<u8> {
    container(*b"pasp", &[wide.to_be_bytes(), high.to_be_bytes()].concat())
}
