//! What a file is by its first bytes: a checkpoint of a known container, or something that people have in place of one, by its name.

use super::Container;

/// Bytes that are looked at.
pub(super) const HEAD: usize = 1024;

/// The container that `head` begins, of a file of `length` bytes.
///
/// # Errors
/// A sentence that says what the file is instead.
pub(super) fn container(head: &[u8], length: u64) -> Result<Container, String> {
    if length == 0 {
        return Err("an empty file".to_owned());
    }
    if head.iter().all(|&byte| byte == 0) {
        return Err(
            "it begins with zeros: a download that was given its size, but not its content"
                .to_owned(),
        );
    }
    if head.starts_with(b"PK\x03\x04") || head.starts_with(b"PK\x05\x06") {
        return Ok(Container::Archive);
    }
    // Legacy files of torch begin with a pickled number, by which they know themselves.
    if matches!(head, [0x80, 0..=5, ..]) || head.starts_with(b"L11954703714603880133") {
        return Ok(Container::Legacy);
    }
    if let Some(what) = instead(head) {
        return Err(what);
    }
    if let [_, _, _, _, _, _, _, _, b'{', ..] = head {
        return Ok(Container::Safetensors);
    }
    // The length of a header that is not there any more.
    if (1..=9).contains(&length)
        && head
            .get(4..)
            .is_none_or(|rest| rest.iter().all(|&b| b == 0 || b == b'{'))
    {
        return Err(format!("cut off after {length} bytes"));
    }
    Err("neither a torch file (`.pth`, `.pt`, `.jit`) nor a safetensors file".to_owned())
}

/// What else a file can be that somebody calls weights.
fn instead(head: &[u8]) -> Option<String> {
    let text = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head);
    let text = text.trim_ascii_start();
    let begins = |with: &str| {
        text.get(..with.len())
            .is_some_and(|start| start.eq_ignore_ascii_case(with.as_bytes()))
    };
    let pointer = |tool: &str, command: &str| {
        format!("a {tool} pointer, not the weights it stands for: fetch them with `{command}`")
    };
    let packed = |tool: &str| format!("compressed with {tool}: unpack it first");
    if begins("version https://git-lfs.github.com/spec")
        || begins("version https://hawser.github.com/spec")
    {
        return Some(pointer("Git LFS", "git lfs pull"));
    }
    if begins("# xet version") || begins("version https://xet.huggingface.co") {
        return Some(pointer("Xet", "git xet checkout"));
    }
    if begins("/annex/objects/")
        || begins("../.git/annex/objects/")
        || begins(".git/annex/objects/")
    {
        return Some(pointer("git-annex", "git annex get"));
    }
    if begins("<!doctype html") || begins("<html") || begins("<head") || begins("<script") {
        return Some(
            "a web page (HTML), not weights: the download was answered with a page, perhaps one that asks to log in"
                .to_owned(),
        );
    }
    if begins("<?xml") || begins("<error") {
        return Some(
            "XML text, not weights: perhaps the answer of a server that refused".to_owned(),
        );
    }
    if begins("{") || begins("[") {
        return Some(
            "JSON text, not weights: perhaps the answer of a server, or an index of other files"
                .to_owned(),
        );
    }
    if head.get(257..262) == Some(b"ustar") {
        // Torch before 0.1.10 wrote these.
        let members: [&[u8]; 4] = [b"sys_info\0", b"pickle\0", b"storages\0", b"tensors\0"];
        return Some(if members.iter().any(|name| head.starts_with(name)) {
            "a torch file in the tar format of versions before 0.1.10, which `torch.load(weights_only=True)` refuses too: load it with an old torch and save it again".to_owned()
        } else {
            "a tar archive: unpack it first".to_owned()
        });
    }
    let magics: [(&[u8], String); 13] = [
        (b"\x1f\x8b", packed("gzip")),
        (b"BZh", packed("bzip2")),
        (b"\xfd7zXZ\0", packed("xz")),
        (b"\x28\xb5\x2f\xfd", packed("zstd")),
        (b"7z\xbc\xaf\x27\x1c", packed("7-Zip")),
        (b"Rar!", packed("RAR")),
        (b"\x89HDF", "an HDF5 file, as Keras writes them".to_owned()),
        (b"\x93NUMPY", "a NumPy array".to_owned()),
        (b"GGUF", "a GGUF file".to_owned()),
        (b"\x89PNG", "a picture".to_owned()),
        (b"%PDF", "a PDF document".to_owned()),
        (b"\xff\xfe", "text in UTF-16".to_owned()),
        (
            b"\0\x05\x16\x07",
            "what macOS stores beside a file that it copies (`._`), not the file".to_owned(),
        ),
    ];
    magics
        .into_iter()
        .find(|(magic, _)| head.starts_with(magic))
        .map(|(_, what)| what)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_people_have_in_place_of_weights_is_named() {
        let tar = {
            let mut head = vec![0; 512];
            head[257..262].copy_from_slice(b"ustar");
            head[0] = b'x';
            head
        };
        let mut legacy = tar.clone();
        legacy[..9].copy_from_slice(b"sys_info\0");
        let cases: [(&[u8], &str); 13] = [
            (b"", "empty"),
            (
                b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n",
                "Git LFS",
            ),
            (b"\xef\xbb\xbf\n <!DOCTYPE html><html>", "web page"),
            (b"<HTML><body>404</body>", "web page"),
            (b"<?xml version='1.0'?><Error>", "XML"),
            (b"{\"error\": \"not found\"}", "JSON"),
            (b"\x1f\x8b\x08\0", "gzip"),
            (b"\x89HDF\r\n", "HDF5"),
            (b"\0\0\0\0\0\0\0\0\0\0", "zeros"),
            (b"\x50\x01\0\0\0\0\0\0", "cut off after 8 bytes"),
            (b"hello, world", "neither a torch file"),
            (&tar, "a tar archive"),
            (&legacy, "tar format"),
        ];
        for (head, part) in cases {
            let error = container(head, head.len() as u64).unwrap_err();
            assert!(error.contains(part), "{part}: {error}");
        }
        for (head, is) in [
            (&b"PK\x03\x04"[..], Container::Archive),
            (b"\x80\x02\x8a\x0al\xfc", Container::Legacy),
            (b"L119547037146038801333356L\n.", Container::Legacy),
            (b"\x50\x01\0\0\0\0\0\0{\"a\"", Container::Safetensors),
        ] {
            assert_eq!(container(head, head.len() as u64), Ok(is));
        }
    }
}
