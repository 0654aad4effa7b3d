//! Drawing a benchmark's clips ("3,000 random clips") so that anyone draws the same: by SHA-256 of `seed/clip_id`.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// How many clips, and which.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Sample {
    /// At most this many clips.
    pub clips: usize,
    /// Part of the hash: another seed, other clips.
    #[serde(default)]
    pub seed: u64,
}

impl Sample {
    /// Indices of the clips that belong to the sample, in their original order.
    #[must_use]
    pub fn draw(&self, ids: &[impl AsRef<str>]) -> Vec<usize> {
        let mut keyed: Vec<([u8; 32], usize)> = ids
            .iter()
            .enumerate()
            .map(|(i, id)| {
                (
                    sha256(format!("{}/{}", self.seed, id.as_ref()).as_bytes()),
                    i,
                )
            })
            .collect();
        keyed.sort_unstable();
        let mut chosen: Vec<usize> = keyed.into_iter().take(self.clips).map(|(_, i)| i).collect();
        chosen.sort_unstable();
        chosen
    }
}

/// The protocol names this hash; the rest of the program uses blake3.
fn sha256(message: &[u8]) -> [u8; 32] {
    Sha256::digest(message).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_is_sha_256() {
        let hex = |m: &str| {
            blake3::Hash::from_bytes(sha256(m.as_bytes()))
                .to_hex()
                .to_string()
        };
        // FIPS 180-4 examples.
        assert_eq!(
            hex("abc"),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
        );
        assert_eq!(
            hex("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq"),
            "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1"
        );
        assert_eq!(
            hex(""),
            "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
        );
    }

    #[test]
    fn a_sample_does_not_depend_on_the_order_of_clips() {
        let ids: Vec<String> = (0..50).map(|i| format!("clip/{i}")).collect();
        let reversed: Vec<String> = ids.iter().rev().cloned().collect();
        let sample = Sample { clips: 7, seed: 3 };
        let mut a: Vec<&String> = sample.draw(&ids).iter().map(|&i| &ids[i]).collect();
        let mut b: Vec<&String> = sample
            .draw(&reversed)
            .iter()
            .map(|&i| &reversed[i])
            .collect();
        a.sort();
        b.sort();
        assert_eq!((a.len(), &a), (7, &b));
        assert_eq!(Sample { clips: 99, seed: 0 }.draw(&ids).len(), 50);
    }
}
