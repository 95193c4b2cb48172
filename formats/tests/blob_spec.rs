//! `docs/blob-format.md` says what the code does.

use sf_formats::blob_layout::{self as layout, Dtype, Field, Layout, header, record};
use sf_formats::meta::keys;

const SPEC: &str = include_str!("../../docs/blob-format.md");

/// Rows of the tables below a heading, cells trimmed.
fn rows(heading: &str) -> Vec<Vec<&'static str>> {
    let start = SPEC.find(&format!("\n## {heading}\n")).unwrap_or_else(|| panic!("no section {heading}"));
    let section = &SPEC[start + 4..];
    let section = &section[..section.find("\n## ").unwrap_or(section.len())];
    section
        .lines()
        .filter(|l| l.starts_with('|'))
        .map(|l| l.trim_matches('|').split('|').map(str::trim).collect())
        .collect()
}

fn cell<'a>(rows: &'a [Vec<&'static str>], key: &str) -> &'a str {
    let row = rows.iter().find(|r| r[0] == format!("`{key}`")).unwrap_or_else(|| panic!("no row {key}"));
    row[row.len() - 1]
}

#[test]
fn offsets_are_the_documented_ones() {
    for (heading, fields) in [("Header", &header::ALL[..]), ("Tensor records", &record::ALL[..])] {
        let documented: Vec<(String, usize, usize)> = rows(heading)
            .iter()
            .filter(|r| r[0].starts_with('`'))
            .map(|r| (r[0].trim_matches('`').to_string(), r[1].parse().unwrap(), r[2].parse().unwrap()))
            .collect();
        let coded: Vec<(String, usize, usize)> =
            fields.iter().map(|f: &Field| (f.name.to_string(), f.offset, f.size)).collect();
        assert_eq!(documented, coded, "{heading}");
    }
}

#[test]
fn constants_are_the_documented_ones() {
    let h = rows("Header");
    let magic: Vec<String> = layout::MAGIC_BYTES.iter().map(|b| format!("{b:02X}")).collect();
    assert!(cell(&h, "magic").starts_with(&magic.join(" ")));
    assert_eq!(cell(&h, "endianness"), format!("{:#010x}", layout::ENDIAN_WORD));
    assert!(cell(&h, "major").starts_with(&format!("{};", layout::VERSION.0)));
    assert!(cell(&h, "minor").starts_with(&format!("{};", layout::VERSION.1)));
    assert!(SPEC.starts_with(&format!(
        "# The weight blob, `.sfw`, version {}.{}\n",
        layout::VERSION.0,
        layout::VERSION.1
    )));
    assert_eq!(cell(&h, "header_length"), layout::HEADER.to_string());
    assert!(cell(&h, "architecture").starts_with(&format!("{},", layout::ARCHITECTURE_STREETFORWARD)));
    assert!(cell(&h, "digest_algorithm").starts_with(&format!("{},", layout::DIGEST_SHA256)));
    assert!(cell(&h, "table_length").starts_with(&format!("{} x", layout::RECORD)));
    assert!(cell(&h, "data_offset").ends_with(&format!("rounded up to {}", layout::DATA_ALIGN)));

    let r = rows("Tensor records");
    assert_eq!(cell(&r, "dtype"), Dtype::ALL.map(|d| format!("{} {}", d as u8, d.name())).join(", "));
    assert_eq!(cell(&r, "layout"), Layout::ALL.map(|l| format!("{} {}", l as u8, l.name())).join(", "));
    assert_eq!(cell(&r, "rank"), format!("1 to {}", layout::MAX_RANK));
    assert!(cell(&r, "dims").contains(&format!("1 to 2^{};", layout::MAX_DIM.ilog2())));
    assert!(cell(&r, "name_length").starts_with(&format!("1 to {};", layout::MAX_NAME)));
    assert!(cell(&r, "offset").ends_with(&format!("a multiple of {}", layout::TENSOR_ALIGN)));

    let m = rows("Metadata");
    for key in [
        keys::SOURCE_DIGEST,
        keys::SOURCE,
        keys::CONVERTER,
        keys::COMMAND,
        keys::LICENCE,
        keys::PRECISION,
        keys::GOLDEN,
        keys::QUANT_RECIPE,
        keys::QUANT_KEPT,
        keys::WEIGHT_SQNR,
    ] {
        assert!(!cell(&m, key).is_empty());
    }

    let steps = rows("Reading");
    let step = |n: &str| steps.iter().find(|r| r[0] == n).map(|r| r[1]).unwrap_or_else(|| panic!("no step {n}"));
    assert!(step("3").ends_with(&format!(
        "at least {} bytes, at most {} GiB",
        layout::MIN_FILE,
        layout::MAX_FILE >> 30
    )));
    assert!(step("4").starts_with(&format!("at most {} tensors", layout::MAX_TENSORS)));
    assert!(step("4").ends_with(&format!("at most {} MiB before the data", layout::MAX_HEAD >> 20)));
}
