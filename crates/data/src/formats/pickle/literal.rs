//! Texts as protocol 0 and Python 2 write them.

use super::Node;

/// A string of Python 2: text where it is UTF-8.
pub(super) fn text_or_bytes(bytes: Vec<u8>) -> Node {
    match String::from_utf8(bytes) {
        Ok(text) => Node::Text(text),
        Err(error) => Node::Bytes(error.into_bytes()),
    }
}

/// The bytes of a string literal as `repr` writes it.
pub(super) fn unquoted(line: &[u8]) -> Option<Vec<u8>> {
    let line = line.trim_ascii();
    let ([b'\'', inside @ .., b'\''] | [b'"', inside @ .., b'"']) = line else {
        return None;
    };
    let mut out = Vec::with_capacity(inside.len());
    let mut rest = inside.iter().copied();
    while let Some(byte) = rest.next() {
        if byte != b'\\' {
            out.push(byte);
            continue;
        }
        out.push(match rest.next()? {
            b'n' => b'\n',
            b'r' => b'\r',
            b't' => b'\t',
            b'a' => 7,
            b'b' => 8,
            b'v' => 11,
            b'f' => 12,
            b'x' => {
                let digits = [rest.next()?, rest.next()?];
                u8::from_str_radix(std::str::from_utf8(&digits).ok()?, 16).ok()?
            }
            same @ (b'\\' | b'\'' | b'"') => same,
            _ => return None,
        });
    }
    Some(out)
}

/// Text in `raw-unicode-escape`: Latin-1, with `\u` and `\U` for everything beyond.
pub(super) fn unescaped(line: &[u8]) -> Option<String> {
    let mut out = String::with_capacity(line.len());
    let mut at = 0;
    while let Some(&byte) = line.get(at) {
        at += 1;
        let digits = match (byte, line.get(at)) {
            (b'\\', Some(b'u')) => 4,
            (b'\\', Some(b'U')) => 8,
            _ => {
                out.push(char::from(byte));
                continue;
            }
        };
        let code = |at: usize| {
            let digits = std::str::from_utf8(line.get(at..at + digits)?).ok()?;
            u32::from_str_radix(digits, 16).ok()
        };
        let mut character = code(at + 1)?;
        at += 1 + digits;
        // Python on Windows wrote what lies beyond 16 bits as two halves.
        if (0xd800..0xdc00).contains(&character) && line.get(at..at + 2) == Some(b"\\u") {
            let low = code(at + 2).filter(|low| (0xdc00..0xe000).contains(low))?;
            character = 0x1_0000 + ((character - 0xd800) << 10) + (low - 0xdc00);
            at += 6;
        }
        out.push(char::from_u32(character)?);
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_of_old_protocols_are_those_of_python() {
        assert_eq!(unquoted(b"'a\\'b\\n\\x41'"), Some(b"a'b\nA".to_vec()));
        assert_eq!(unquoted(b"\"it's\""), Some(b"it's".to_vec()));
        assert_eq!(unquoted(b"'a"), None);
        assert_eq!(unquoted(b"'\\x4'"), None);
        assert_eq!(
            unescaped(b"h\xe9 \\u20ac \\U0001f600").as_deref(),
            Some("h\u{e9} \u{20ac} \u{1f600}")
        );
        assert_eq!(unescaped(b"\\ud83d\\ude00").as_deref(), Some("\u{1f600}"));
        assert_eq!(unescaped(b"\\ud83d"), None);
        assert_eq!(unescaped(b"\\u12"), None);
    }
}
