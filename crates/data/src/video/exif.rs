//! The orientation that a camera wrote beside a picture (Exif 2.32, tag 0x0112), in jpeg (`APP1`) and png (`eXIf`).

use super::image::Orientation;

/// How the stored picture comes upright; as it is where nothing is said.
#[must_use]
pub fn orientation(bytes: &[u8]) -> Orientation {
    let block = match bytes {
        [0xff, 0xd8, rest @ ..] => in_jpeg(rest),
        [0x89, b'P', b'N', b'G', _, _, _, _, rest @ ..] => in_png(rest),
        _ => None,
    };
    let code = block.and_then(tag).unwrap_or(1);
    Orientation::from_exif(code)
}

/// The TIFF block of a jpeg, from behind its first marker on.
fn in_jpeg(mut rest: &[u8]) -> Option<&[u8]> {
    loop {
        let at = rest.iter().position(|byte| *byte != 0xff)?;
        let marker = rest[at];
        rest = &rest[at + 1..];
        match marker {
            // Pictures without parameters, and the start of the data.
            0x01 | 0xd0..=0xd7 => continue,
            0xd9 | 0xda => return None,
            _ => {}
        }
        let size = usize::from(u16::from_be_bytes([*rest.first()?, *rest.get(1)?]));
        let body = rest.get(2..size)?;
        if let (0xe1, Some(block)) = (marker, body.strip_prefix(b"Exif\0\0")) {
            return Some(block);
        }
        rest = rest.get(size..)?;
        if rest.first() != Some(&0xff) {
            return None;
        }
    }
}

/// The TIFF block of a png, from behind its signature on.
fn in_png(mut rest: &[u8]) -> Option<&[u8]> {
    loop {
        let size = u32::from_be_bytes(rest.get(..4)?.try_into().ok()?) as usize;
        let kind = rest.get(4..8)?;
        let body = rest.get(8..size.checked_add(8)?)?;
        match kind {
            b"eXIf" => return Some(body),
            b"IEND" => return None,
            _ => rest = rest.get(size.checked_add(12)?..)?,
        }
    }
}

/// The orientation of the first directory.
fn tag(block: &[u8]) -> Option<u32> {
    let little = match block.get(..4)? {
        [b'I', b'I', 42, 0] => true,
        [b'M', b'M', 0, 42] => false,
        _ => return None,
    };
    let number = |at: usize, size: usize| {
        let bytes = block.get(at..at.checked_add(size)?)?;
        let add = |value: u32, byte: &u8| value << 8 | u32::from(*byte);
        Some(if little {
            bytes.iter().rev().fold(0, add)
        } else {
            bytes.iter().fold(0, add)
        })
    };
    let directory = number(4, 4)? as usize;
    let entries = number(directory, 2)? as usize;
    (0..entries)
        .map(|entry| directory + 2 + 12 * entry)
        .find(|at| number(*at, 2) == Some(0x0112))
        .and_then(|at| match number(at + 2, 2)? {
            1 => number(at + 8, 1),
            3 => number(at + 8, 2),
            4 => number(at + 8, 4),
            _ => None,
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::video::image::Turn;
    use proptest::prelude::*;

    fn block(little: bool, code: u16) -> Vec<u8> {
        let short = |value: u16| {
            if little {
                value.to_le_bytes()
            } else {
                value.to_be_bytes()
            }
        };
        let long = |value: u32| {
            if little {
                value.to_le_bytes()
            } else {
                value.to_be_bytes()
            }
        };
        let mut block = if little { b"II" } else { b"MM" }.to_vec();
        block.extend(short(42));
        block.extend(long(8));
        block.extend(short(2));
        // The make of the camera, then the orientation.
        for (tag, kind, count, value) in [(0x010f, 2, 4, 0), (0x0112, 3, 1, code)] {
            block.extend(short(tag));
            block.extend(short(kind));
            block.extend(long(count));
            block.extend(short(value));
            block.extend(short(0));
        }
        block.extend(long(0));
        block
    }

    fn jpeg(block: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0xff, 0xd8, 0xff, 0xe0, 0, 4, 1, 2, 0xff, 0xff, 0xe1];
        bytes.extend((block.len() as u16 + 8).to_be_bytes());
        bytes.extend(b"Exif\0\0");
        bytes.extend(block);
        bytes.extend([0xff, 0xda, 0, 2]);
        bytes
    }

    fn png(block: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x89PNG\r\n\x1a\n".to_vec();
        for (kind, body) in [(b"IHDR", &[0; 13][..]), (b"eXIf", block)] {
            bytes.extend((body.len() as u32).to_be_bytes());
            bytes.extend(kind);
            bytes.extend(body);
            bytes.extend([0; 4]);
        }
        bytes
    }

    #[test]
    fn both_byte_orders_are_read_in_jpeg_and_png() {
        for code in 1..=8 {
            let expected = Orientation::from_exif(code.into());
            for little in [false, true] {
                let block = block(little, code);
                assert_eq!(orientation(&jpeg(&block)), expected);
                assert_eq!(orientation(&png(&block)), expected);
            }
        }
        assert_eq!(Orientation::from_exif(6).turn, Turn::Clockwise);
        assert_eq!(orientation(&jpeg(&block(true, 9))), Orientation::default());
    }

    proptest! {
        #[test]
        fn damaged_blocks_never_panic(at in 0usize..80, value: u8, keep in 0usize..80, which: bool) {
            let block = block(which, 6);
            let mut bytes = if which { jpeg(&block) } else { png(&block) };
            let at = at % bytes.len();
            bytes[at] ^= value;
            bytes.truncate(keep);
            let _ = orientation(&bytes);
        }
    }
}
