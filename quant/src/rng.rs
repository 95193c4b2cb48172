//! Random numbers by position: value i of a stream is a function of (seed, name, i) alone.
//!
//! So tensors can be made in any order, on any machine, with the same bits: integer arithmetic and one
//! correctly rounded multiplication, no library sine or logarithm.

use sf_formats::digest::sha256;

/// The stream of one name.
#[derive(Clone, Copy, Debug)]
pub struct Stream {
    key: [u64; 2],
}

impl Stream {
    /// Keyed by SHA-256 of seed and name.
    pub fn new(seed: u64, name: &str) -> Stream {
        let mut bytes = seed.to_le_bytes().to_vec();
        bytes.extend_from_slice(name.as_bytes());
        let digest = sha256(&bytes);
        let word = |at: usize| digest[at..at + 8].iter().rev().fold(0, |w, &b| w << 8 | u64::from(b));
        Stream { key: [word(0), word(8)] }
    }

    /// 64 uniform bits at a position: two rounds of the SplitMix64 finalizer around the second key.
    pub fn bits(&self, position: u64) -> u64 {
        let weyl = self.key[0].wrapping_add(position.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        mix(mix(weyl) ^ self.key[1])
    }

    /// A value of mean 0 and deviation 1, close to normal: the sum of eight uniform 16-bit numbers,
    /// which ends at 4.9 deviations.
    pub fn normal(&self, position: u64) -> f64 {
        let sum: i64 = [self.bits(2 * position), self.bits(2 * position + 1)]
            .iter()
            .flat_map(|w| [w & 0xffff, w >> 16 & 0xffff, w >> 32 & 0xffff, w >> 48])
            .map(|u| u as i64)
            .sum();
        // Mean of the sum 4 * 65535; variance 8 * (2^32 - 1) / 12.
        (sum - 4 * 65535) as f64 / (f64::from(u32::MAX) * 2.0 / 3.0).sqrt()
    }
}

fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_those_of_a_normal() {
        let s = Stream::new(7, "a");
        let n = 200_000;
        let (mut m1, mut m2, mut m4) = (0.0, 0.0, 0.0);
        for i in 0..n {
            let v = s.normal(i);
            m1 += v;
            m2 += v * v;
            m4 += v * v * v * v;
        }
        let n = n as f64;
        // Five standard errors: 1/sqrt(n), sqrt(2/n), sqrt(96/n); eight summands lower the kurtosis by 0.15.
        assert!((m1 / n).abs() < 5.0 / n.sqrt());
        assert!((m2 / n - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
        assert!((m4 / n - 2.85).abs() < 5.0 * (96.0 / n).sqrt());
    }

    #[test]
    fn streams_differ_and_do_not_depend_on_order() {
        let (a, b, c) = (Stream::new(0, "x"), Stream::new(0, "y"), Stream::new(1, "x"));
        assert!(a.bits(0) != b.bits(0) && a.bits(0) != c.bits(0) && a.bits(0) != a.bits(1));
        let forward: Vec<u64> = (0..9).map(|i| a.bits(i)).collect();
        let backward: Vec<u64> = (0..9).rev().map(|i| a.bits(i)).collect();
        assert!(forward.iter().eq(backward.iter().rev()));
    }
}
