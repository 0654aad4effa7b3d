//! Numbers and text out of little-endian bytes.

use super::Node;

pub(super) fn unsigned(bytes: &[u8]) -> Option<Node> {
    let mut wide = [0; 16];
    wide.get_mut(..bytes.len())?.copy_from_slice(bytes);
    Some(Node::Int(i128::from_le_bytes(wide)))
}

/// Text of four bytes a character.
pub(super) fn ucs4(bytes: &[u8]) -> Option<String> {
    let mut text = String::new();
    for chunk in bytes.chunks(4) {
        let code = u32::from_le_bytes(chunk.try_into().ok()?);
        if code != 0 {
            text.push(char::from_u32(code)?);
        }
    }
    Some(text)
}

/// A little-endian two's complement integer.
pub(super) fn long(bytes: &[u8]) -> Option<i128> {
    let sign = if bytes.last().is_some_and(|b| b & 0x80 != 0) {
        0xff
    } else {
        0
    };
    let mut wide = [sign; 16];
    wide.get_mut(..bytes.len())?.copy_from_slice(bytes);
    Some(i128::from_le_bytes(wide))
}
