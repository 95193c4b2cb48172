//! SHA-256 digests: of files, of tensors, as hexadecimal text.

use sha2::{Digest as _, Sha256};

/// A SHA-256 digest.
pub type Digest = [u8; 32];

/// SHA-256 of some bytes.
pub fn sha256(bytes: &[u8]) -> Digest {
    Sha256::digest(bytes).into()
}

/// Lower-case hexadecimal, 64 characters.
pub fn hex(digest: &Digest) -> String {
    let mut text = String::with_capacity(64);
    for b in digest {
        text.push(char::from_digit(u32::from(b >> 4), 16).unwrap_or('?'));
        text.push(char::from_digit(u32::from(b & 15), 16).unwrap_or('?'));
    }
    text
}

/// The digest a 64-character hexadecimal text names; upper case is accepted.
pub fn parse_hex(text: &str) -> Option<Digest> {
    let nibbles: Vec<u8> = text.chars().map(|c| c.to_digit(16).map(|d| d as u8)).collect::<Option<_>>()?;
    let mut digest = [0; 32];
    if nibbles.len() != 64 {
        return None;
    }
    for (byte, pair) in digest.iter_mut().zip(nibbles.chunks_exact(2)) {
        *byte = pair[0] << 4 | pair[1];
    }
    Some(digest)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The one-block example of FIPS 180-4 (message "abc").
    #[test]
    fn the_published_example() {
        let text = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(hex(&sha256(b"abc")), text);
        assert_eq!(parse_hex(text), Some(sha256(b"abc")));
        assert_eq!(parse_hex(&text[1..]), None);
        assert_eq!(parse_hex(&text.replace('b', "x")), None);
    }
}
