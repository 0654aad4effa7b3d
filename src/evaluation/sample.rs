//! Drawing a benchmark's clips ("3,000 random clips") so that anyone draws the same: by SHA-256 of `seed/clip_id`.

use serde::{Deserialize, Serialize};

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

/// SHA-256 (FIPS 180-4). The protocol names this hash; the rest of the program uses blake3.
fn sha256(message: &[u8]) -> [u8; 32] {
    let primes: Vec<u32> = (2_u32..312)
        .filter(|n| (2..*n).all(|d| n % d != 0))
        .collect();
    // The first 32 bits of the fractional parts of the cube (and square) roots of the primes.
    let fraction = |root: f64| (root.fract() * 4_294_967_296.0) as u32;
    let constants: Vec<u32> = primes
        .iter()
        .map(|&p| fraction(f64::from(p).cbrt()))
        .collect();
    let mut state: Vec<u32> = primes[..8]
        .iter()
        .map(|&p| fraction(f64::from(p).sqrt()))
        .collect();

    let mut padded = message.to_vec();
    padded.push(0x80);
    while padded.len() % 64 != 56 {
        padded.push(0);
    }
    padded.extend((message.len() as u64 * 8).to_be_bytes());

    for block in padded.chunks_exact(64) {
        let mut w = [0_u32; 64];
        for (slot, bytes) in w.iter_mut().zip(block.chunks_exact(4)) {
            *slot = u32::from_be_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
        }
        for i in 16..64 {
            let s0 = w[i - 15].rotate_right(7) ^ w[i - 15].rotate_right(18) ^ (w[i - 15] >> 3);
            let s1 = w[i - 2].rotate_right(17) ^ w[i - 2].rotate_right(19) ^ (w[i - 2] >> 10);
            w[i] = w[i - 16]
                .wrapping_add(s0)
                .wrapping_add(w[i - 7])
                .wrapping_add(s1);
        }
        let mut v: [u32; 8] = [0; 8];
        v.copy_from_slice(&state);
        for i in 0..64 {
            let s1 = v[4].rotate_right(6) ^ v[4].rotate_right(11) ^ v[4].rotate_right(25);
            let choice = (v[4] & v[5]) ^ (!v[4] & v[6]);
            let t1 = v[7]
                .wrapping_add(s1)
                .wrapping_add(choice)
                .wrapping_add(constants[i])
                .wrapping_add(w[i]);
            let s0 = v[0].rotate_right(2) ^ v[0].rotate_right(13) ^ v[0].rotate_right(22);
            let majority = (v[0] & v[1]) ^ (v[0] & v[2]) ^ (v[1] & v[2]);
            let t2 = s0.wrapping_add(majority);
            v = [
                t1.wrapping_add(t2),
                v[0],
                v[1],
                v[2],
                v[3].wrapping_add(t1),
                v[4],
                v[5],
                v[6],
            ];
        }
        for (s, v) in state.iter_mut().zip(v) {
            *s = s.wrapping_add(v);
        }
    }
    let mut digest = [0; 32];
    for (out, word) in digest.chunks_exact_mut(4).zip(state) {
        out.copy_from_slice(&word.to_be_bytes());
    }
    digest
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
