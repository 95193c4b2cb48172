//! Every bad-input case that `docs/bad-inputs.md` lists has a test, and every such test is listed.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The ids that a test's name starts with: `b02_b04_a_blob...` covers B02 and B04.
fn ids_of(name: &str) -> Vec<String> {
    name.split('_')
        .take_while(|part| {
            let b = part.as_bytes();
            b.len() == 3 && b"bcis".contains(&b[0]) && b[1].is_ascii_digit() && b[2].is_ascii_digit()
        })
        .map(str::to_uppercase)
        .collect()
}

fn rust_files(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_files(&path, out);
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
}

/// Case id -> the files, relative to the root, whose tests cover it.
fn tested() -> BTreeMap<String, BTreeSet<String>> {
    let mut found: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for krate in ["formats", "ops", "splat", "engine", "quant", "synth", "eval", "cli", "tests"] {
        for part in ["src", "tests"] {
            let folder = root().join(krate).join(part);
            let mut files = Vec::new();
            if folder.is_dir() {
                rust_files(&folder, &mut files);
            }
            for file in files {
                let text = fs::read_to_string(&file).unwrap();
                let name = file.strip_prefix(root()).unwrap().to_str().unwrap().to_string();
                let mut after_test = false;
                for line in text.lines().map(str::trim) {
                    if let Some(rest) = line.strip_prefix("fn ")
                        && after_test
                    {
                        for id in ids_of(rest) {
                            found.entry(id).or_default().insert(name.clone());
                        }
                    }
                    after_test = line == "#[test]" || (after_test && (line.starts_with('#') || line.starts_with("//")));
                }
            }
        }
    }
    found
}

#[test]
fn the_documented_cases_are_the_tested_ones() {
    let doc = fs::read_to_string(root().join("docs/bad-inputs.md")).unwrap();
    let mut listed: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for row in doc.lines().filter(|l| l.starts_with("| ")) {
        let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
        if !ids_of(&cells[0].to_lowercase()).is_empty() {
            let files = cells[3].split(", ").map(|f| f.trim_matches('`').to_string()).collect();
            listed.insert(cells[0].to_string(), files);
        }
    }
    let tested = tested();
    for id in tested.keys().chain(listed.keys()) {
        assert_eq!(listed.get(id), tested.get(id), "{id}: documented on the left, tested on the right");
    }
    for (group, count) in [("B", 34), ("C", 16), ("I", 20), ("S", 15)] {
        assert_eq!(listed.keys().filter(|id| id.starts_with(group)).count(), count, "cases of group {group}");
    }
}
