//! Strict JSON from untrusted files.
//!
//! `serde_json` checks the grammar and UTF-8 but keeps the last of two equal keys, so two readers of
//! one file can see different contents. Here equal keys are refused, and depth and the number of
//! values are bounded before any tree is built: memory stays in proportion to the file.

use serde_json::Value;
use std::collections::HashSet;

/// Deepest nesting that is read; our files and those of the field need at most six.
const MAX_DEPTH: usize = 24;
/// Most values in one file: 40 000 tensors of a header, or 30 000 camera frames.
const MAX_VALUES: usize = 1 << 20;

/// Parses `text`; the error says what is wrong, not where the text came from.
pub(crate) fn parse(text: &[u8]) -> Result<Value, String> {
    let text = std::str::from_utf8(text).map_err(|e| format!("is not UTF-8 at byte {}", e.valid_up_to()))?;
    scan(text)?;
    serde_json::from_str(text).map_err(|e| format!("is not valid JSON: {e}"))
}

/// Bounds depth and count and refuses equal keys. Accepts a superset of JSON: the grammar is checked
/// afterwards.
fn scan(text: &str) -> Result<(), String> {
    let b = text.as_bytes();
    // One set of keys per open object, `None` for an open array.
    let mut open: Vec<Option<HashSet<String>>> = Vec::new();
    let (mut i, mut values) = (0, 0usize);
    while i < b.len() {
        match b[i] {
            b'{' | b'[' => {
                values += 1;
                if open.len() == MAX_DEPTH {
                    return Err(format!("nests deeper than {MAX_DEPTH} levels at byte {i}"));
                }
                open.push((b[i] == b'{').then(HashSet::new));
                i += 1;
            }
            b'}' | b']' => {
                open.pop();
                i += 1;
            }
            b',' => {
                values += 1;
                i += 1;
            }
            b'"' => {
                let start = i;
                i += 1;
                while i < b.len() && b[i] != b'"' {
                    i += if b[i] == b'\\' { 2 } else { 1 };
                }
                i = (i + 1).min(b.len());
                let colon = b[i..].iter().find(|c| !c.is_ascii_whitespace()) == Some(&b':');
                if let (true, Some(Some(keys)), Some(raw)) = (colon, open.last_mut(), text.get(start..i)) {
                    // Escapes are resolved first: "a" and "\u0061" are the same key.
                    let key: String = serde_json::from_str(raw).map_err(|e| format!("has a bad key: {e}"))?;
                    if keys.contains(&key) {
                        return Err(format!("has the key '{}' twice", crate::error::escape(key.as_bytes())));
                    }
                    keys.insert(key);
                }
            }
            _ => i += 1,
        }
        if values > MAX_VALUES {
            return Err(format!("holds more than {MAX_VALUES} values"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_keys_are_refused_per_object() {
        assert!(parse(br#"{"a": {"x": 1}, "b": {"x": "a:,{"}, "c": [{"x": 1}, {"x": 2}]}"#).is_ok());
        assert!(parse(br#"{"a": 1, "b": 2, "a": 3}"#).unwrap_err().contains("'a' twice"));
        assert!(parse(br#"{"a": 1, "\u0061" : 3}"#).unwrap_err().contains("'a' twice"));
        assert!(parse(br#"[{"k\"": 1, "k\"": 3}]"#).unwrap_err().contains("twice"));
    }

    #[test]
    fn depth_count_and_encoding_are_bounded() {
        assert!(parse("[".repeat(100_000).as_bytes()).unwrap_err().contains("deeper"));
        let many = format!("[{}0]", "0,".repeat(MAX_VALUES + 1));
        assert!(parse(many.as_bytes()).unwrap_err().contains("values"));
        assert!(parse(b"{\"a\xff\": 1}").unwrap_err().contains("UTF-8 at byte 3"));
        for bad in ["", "{", "\"", "\"\\", "{\"a\"", "nul", "{\"a\": 1e999}", "]", "{\"a\": NaN}"] {
            assert!(parse(bad.as_bytes()).is_err(), "{bad}");
        }
    }
}
