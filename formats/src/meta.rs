//! Typed metadata of a blob: sorted key-value pairs in a tag-length-value encoding.
//!
//! ```text
//! u16 key length | u8 type | u8 0 | u32 value length | key | value
//! ```
//!
//! Keys are `[a-z0-9_.]`, 1 to 128 bytes, strictly ascending: there is one encoding of a set of pairs
//! and no room for a duplicate. Types: 1 i64, 2 f64, 3 bool (one byte, 0 or 1), 4 UTF-8 text, 5 list of
//! i64, 6 list of f64. Reals are finite.

use crate::config::Value;
use crate::error::{Error, Result, escape};
use std::collections::BTreeMap;

/// Keys that describe where a blob comes from.
pub mod keys {
    /// SHA-256 of the checkpoint file(s), hexadecimal.
    pub const SOURCE_DIGEST: &str = "source.digest";
    /// What the source was: format, file name.
    pub const SOURCE: &str = "source.describe";
    /// Version of the converter.
    pub const CONVERTER: &str = "converter.version";
    /// Command line, or what stood for it.
    pub const COMMAND: &str = "converter.command";
    /// Licence text of the weights.
    pub const LICENCE: &str = "licence.text";
    /// Requested precision: `f32`, `f16` or `int8`.
    pub const PRECISION: &str = "precision";
    /// SHA-256 of what the network predicts for a fixed clip, hexadecimal.
    pub const GOLDEN: &str = "golden.digest";
    /// Names of the measurements of [`CHECK_VALUES`], comma-separated.
    pub const CHECK_KEYS: &str = "check.keys";
    /// What the converter measured against the f32 model on clips; -1 where there was nothing to measure.
    pub const CHECK_VALUES: &str = "check.values";
    /// What the quantizer did, in words.
    pub const QUANT_RECIPE: &str = "quant.recipe";
    /// SHA-256, hexadecimal, of the moments of layers' inputs that the rounding was calibrated with.
    pub const CALIBRATION: &str = "quant.calibration";
    /// One line per matrix that is not int8: name, type, reason.
    pub const QUANT_KEPT: &str = "quant.kept";
    /// Signal to error of the stored weights in dB, one number per matrix in the order of the file.
    pub const WEIGHT_SQNR: &str = "quant.weight_sqnr_db";
}

/// Prefix of the model configuration's keys inside the file.
pub(crate) const CONFIG_PREFIX: &str = "config.";
/// Longest key in bytes.
pub(crate) const MAX_KEY: usize = 128;
/// Bytes before key and value of one entry.
pub(crate) const ENTRY: usize = 8;

/// Metadata beside the model configuration.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Meta(BTreeMap<String, Value>);

impl Meta {
    /// Nothing.
    pub fn new() -> Meta {
        Meta::default()
    }

    /// Sets a key, replacing what it had; for keys the format does not allow see [`Meta::check`].
    pub fn set(&mut self, key: &str, value: Value) {
        self.0.insert(key.to_string(), value);
    }

    /// Sets a text.
    pub fn set_text(&mut self, key: &str, text: &str) {
        self.set(key, Value::Text(text.to_string()));
    }

    /// The value of a key.
    pub fn get(&self, key: &str) -> Option<&Value> {
        self.0.get(key)
    }

    /// The text of a key.
    pub fn text(&self, key: &str) -> Option<&str> {
        match self.0.get(key) {
            Some(Value::Text(t)) => Some(t),
            _ => None,
        }
    }

    /// All pairs in ascending order of keys.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Value)> {
        self.0.iter().map(|(k, v)| (k.as_str(), v))
    }

    /// Whether every key and value can be written.
    pub fn check(&self) -> Result<()> {
        for (key, value) in &self.0 {
            let reals: &[f64] = match value {
                Value::Float(f) => std::slice::from_ref(f),
                Value::Floats(l) => l,
                _ => &[],
            };
            if !key_is_allowed(key.as_bytes()) || reals.iter().any(|f| !f.is_finite()) {
                return Err(Error::usage(format!(
                    "metadata {} needs a key of [a-z0-9_.], at most {MAX_KEY} bytes, and finite numbers",
                    escape(key.as_bytes())
                )));
            }
        }
        Ok(())
    }
}

fn key_is_allowed(key: &[u8]) -> bool {
    (1..=MAX_KEY).contains(&key.len()) && key.iter().all(|b| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'_' | b'.'))
}

/// Encodes pairs; they must have passed [`Meta::check`].
pub(crate) fn encode(pairs: &BTreeMap<String, Value>) -> Vec<u8> {
    let mut out = Vec::new();
    for (key, value) in pairs {
        let (kind, bytes): (u8, Vec<u8>) = match value {
            Value::Int(i) => (1, i.to_le_bytes().to_vec()),
            Value::Float(f) => (2, f.to_le_bytes().to_vec()),
            Value::Bool(b) => (3, vec![u8::from(*b)]),
            Value::Text(t) => (4, t.as_bytes().to_vec()),
            Value::Ints(l) => (5, l.iter().flat_map(|i| i.to_le_bytes()).collect()),
            Value::Floats(l) => (6, l.iter().flat_map(|f| f.to_le_bytes()).collect()),
        };
        out.extend_from_slice(&(key.len() as u16).to_le_bytes());
        out.extend_from_slice(&[kind, 0]);
        out.extend_from_slice(&(bytes.len() as u32).to_le_bytes());
        out.extend_from_slice(key.as_bytes());
        out.extend_from_slice(&bytes);
    }
    out
}

/// Decodes exactly `entries` pairs that fill `bytes` exactly.
pub(crate) fn decode(mut bytes: &[u8], entries: u64, at: &str) -> Result<BTreeMap<String, Value>> {
    let bad = |key: &[u8], why: &str| Err(Error::model(at, format!("metadata {}: {why}", escape(key))));
    let mut pairs: BTreeMap<String, Value> = BTreeMap::new();
    for i in 0..entries {
        let Some((head, rest)) = bytes.split_at_checked(ENTRY) else {
            return bad(b"section", &format!("entry {i} of {entries} is cut off"));
        };
        let key_len = usize::from(u16::from_le_bytes([head[0], head[1]]));
        let value_len = u32::from_le_bytes([head[4], head[5], head[6], head[7]]) as usize;
        let Some((key, rest)) = rest.split_at_checked(key_len) else {
            return bad(b"section", &format!("the key of entry {i} is cut off"));
        };
        let Some((value, rest)) = rest.split_at_checked(value_len) else {
            return bad(key, &format!("its value of {value_len} bytes is cut off"));
        };
        bytes = rest;
        if !key_is_allowed(key) || head[3] != 0 {
            return bad(key, "the key or a reserved byte is not allowed");
        }
        let Ok(name) = std::str::from_utf8(key) else { return bad(key, "the key is not ASCII") };
        if pairs.last_key_value().is_some_and(|(last, _)| last.as_str() >= name) {
            return bad(key, "keys must ascend and occur once");
        }
        match decode_value(head[2], value) {
            Some(value) => pairs.insert(name.to_string(), value),
            None => return bad(key, &format!("type {} with {value_len} bytes is not a valid value", head[2])),
        };
    }
    if !bytes.is_empty() {
        return bad(b"section", &format!("{} bytes follow the last entry", bytes.len()));
    }
    Ok(pairs)
}

fn decode_value(kind: u8, bytes: &[u8]) -> Option<Value> {
    let int = |b: &[u8]| <[u8; 8]>::try_from(b).ok().map(i64::from_le_bytes);
    let real = |b: &[u8]| <[u8; 8]>::try_from(b).ok().map(f64::from_le_bytes).filter(|f| f.is_finite());
    match (kind, bytes) {
        (1, b) => int(b).map(Value::Int),
        (2, b) => real(b).map(Value::Float),
        (3, [0]) => Some(Value::Bool(false)),
        (3, [1]) => Some(Value::Bool(true)),
        (4, b) => std::str::from_utf8(b).ok().map(|t| Value::Text(t.to_string())),
        (5, b) if b.len() % 8 == 0 => b.chunks_exact(8).map(int).collect::<Option<_>>().map(Value::Ints),
        (6, b) if b.len() % 8 == 0 => b.chunks_exact(8).map(real).collect::<Option<_>>().map(Value::Floats),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> BTreeMap<String, Value> {
        let mut meta = Meta::new();
        meta.set("a.int", Value::Int(-3));
        meta.set("b.real", Value::Float(0.1));
        meta.set("c.flag", Value::Bool(true));
        meta.set_text("d.text", "straße\n");
        meta.set("e.ints", Value::Ints(vec![1, i64::MIN]));
        meta.set("f.reals", Value::Floats(vec![]));
        meta.check().unwrap();
        meta.0
    }

    #[test]
    fn every_type_survives() {
        let pairs = sample();
        let bytes = encode(&pairs);
        assert_eq!(decode(&bytes, 6, "m").unwrap(), pairs);
    }

    #[test]
    fn every_truncation_and_wrong_count_is_refused() {
        let bytes = encode(&sample());
        for n in 0..bytes.len() {
            assert_eq!(decode(&bytes[..n], 6, "m").unwrap_err().status() as i32, 4);
        }
        assert!(decode(&bytes, 5, "m").is_err());
        assert!(decode(&bytes, 7, "m").is_err());
        assert!(decode(&bytes, u64::MAX, "m").is_err());
    }

    #[test]
    fn duplicates_disorder_and_bad_values_are_refused() {
        let one = |key: &str, kind: u8, value: &[u8]| {
            let mut b = (key.len() as u16).to_le_bytes().to_vec();
            b.extend([kind, 0]);
            b.extend((value.len() as u32).to_le_bytes());
            b.extend(key.as_bytes());
            b.extend(value);
            b
        };
        let twice = [one("a", 3, &[1]), one("a", 3, &[0])].concat();
        assert!(decode(&twice, 2, "m").unwrap_err().to_string().contains("occur once"));
        let falling = [one("b", 3, &[1]), one("a", 3, &[0])].concat();
        assert!(decode(&falling, 2, "m").is_err());
        for (kind, value) in [
            (0, &b""[..]),
            (1, b"1234567"),
            (2, &f64::NAN.to_le_bytes()),
            (3, &[2]),
            (4, &[0xff]),
            (5, &[0; 9]),
            (6, &f64::INFINITY.to_le_bytes()),
            (7, b""),
        ] {
            assert!(decode(&one("a", kind, value), 1, "m").is_err(), "type {kind}");
        }
        for key in ["", "A", "a/b", "a b", "\u{e9}", &"k".repeat(129)] {
            assert!(decode(&one(key, 3, &[1]), 1, "m").is_err(), "{key}");
        }
        let mut meta = Meta::new();
        meta.set_text("Upper", "x");
        assert_eq!(meta.check().unwrap_err().status() as i32, 2);
    }
}
