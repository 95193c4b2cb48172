//! From the names in a checkpoint to the names of the network: wrapper prefixes, VGGT's names, what is
//! ignored; and the nearest name for a message.

use sf_formats::checkpoint::CheckpointTensor;
use sf_formats::error::escape;
use sf_formats::{Error, Result};
use std::collections::BTreeMap;

/// Prefixes that training wrappers put in front of every name.
pub const WRAPPERS: [&str; 4] = ["module.", "model.", "_orig_mod.", "ema_model."];

/// Beginnings of what is no part of the network.
const IGNORED: [&str; 8] = [
    "optimizer.",
    "optimizer_states.",
    "optimizer_state_dict.",
    "scheduler.",
    "lr_scheduler.",
    "lr_schedulers.",
    "scaler.",
    "rng_state",
];

/// The tensors of a checkpoint under the names of the network.
#[derive(Debug, Default)]
pub(crate) struct Names {
    /// Name of the network to index in the checkpoint.
    pub(crate) index: BTreeMap<String, usize>,
    /// Indices of `image_mean` and `image_std`, if stored.
    pub(crate) image: [Option<usize>; 2],
    /// Stripped prefix (as a whole) and number of tensors.
    pub(crate) stripped: BTreeMap<String, usize>,
    /// Names that are no part of the network.
    pub(crate) ignored: Vec<String>,
    /// Whether the names were VGGT's.
    pub(crate) vggt: bool,
}

/// Strips wrappers, maps VGGT's trunk, sets aside what is ignored; two tensors that end up with one
/// name are an error.
pub(crate) fn resolve(tensors: &[CheckpointTensor], at: &str) -> Result<Names> {
    let mut names = Names::default();
    let stripped: Vec<(&str, &str)> = tensors.iter().map(|t| strip(&t.name)).collect();
    names.vggt = stripped.iter().any(|(_, name)| name.starts_with("aggregator.frame_blocks."));
    for (i, &(prefix, name)) in stripped.iter().enumerate() {
        if !prefix.is_empty() {
            *names.stripped.entry(prefix.to_string()).or_default() += 1;
        }
        match name {
            "image_mean" => names.image[0] = Some(i),
            "image_std" => names.image[1] = Some(i),
            _ => {
                let mapped = match names.vggt {
                    true => from_vggt(name),
                    false => Some(name.to_string()),
                };
                let part = mapped.filter(|n| n != "encoder.mask_token" && !IGNORED.iter().any(|p| n.starts_with(p)));
                let Some(mapped) = part else {
                    names.ignored.push(tensors[i].name.clone());
                    continue;
                };
                if let Some(other) = names.index.insert(mapped, i) {
                    let shown = |i: usize| escape(tensors[i].name.as_bytes());
                    return Err(Error::model(
                        at,
                        format!(
                            "{} and {} are the same tensor of the network: keep one set of weights (plain or ema)",
                            shown(other),
                            shown(i)
                        ),
                    ));
                }
            }
        }
    }
    Ok(names)
}

/// Splits off all wrapper prefixes.
fn strip(name: &str) -> (&str, &str) {
    let mut rest = name;
    while let Some(next) = WRAPPERS.iter().find_map(|w| rest.strip_prefix(w)) {
        rest = next;
    }
    name.split_at(name.len() - rest.len())
}

/// VGGT's trunk under our names; its tokens and heads have no counterpart.
fn from_vggt(name: &str) -> Option<String> {
    let rest = name.strip_prefix("aggregator.")?;
    if let Some(encoder) = rest.strip_prefix("patch_embed.") {
        return Some(format!("encoder.{encoder}"));
    }
    for (kind, parity) in [("frame_blocks.", 0), ("global_blocks.", 1)] {
        if let Some((pair, block)) = rest.strip_prefix(kind).and_then(|r| r.split_once('.')) {
            let pair: u32 = pair.parse().ok().filter(|&p| p < 1 << 16)?;
            return Some(format!("decoder.{}.{block}", 2 * pair + parity));
        }
    }
    None
}

/// Whether a name matches a pattern of literal text, `*` (any run) and `?` (any one byte).
pub fn glob(pattern: &str, name: &str) -> bool {
    let (p, n) = (pattern.as_bytes(), name.as_bytes());
    let (mut i, mut j) = (0, 0);
    // Position of the last star and of the name when it was met: where to go on after a mismatch.
    let mut star: Option<(usize, usize)> = None;
    while j < n.len() {
        match p.get(i) {
            Some(b'*') => {
                star = Some((i, j));
                i += 1;
            }
            Some(&c) if c == b'?' || c == n[j] => {
                i += 1;
                j += 1;
            }
            _ => match star {
                Some((s, at)) => {
                    star = Some((s, at + 1));
                    i = s + 1;
                    j = at + 1;
                }
                None => return false,
            },
        }
    }
    p[i..].iter().all(|&c| c == b'*')
}

/// The candidate with the fewest edits to `name`, if at most a third of it differs.
pub(crate) fn nearest<'a>(name: &str, candidates: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let best = candidates.map(|c| (edits(name, c), c)).min()?;
    (best.0 * 3 <= name.len()).then_some(best.1)
}

/// Levenshtein distance.
fn edits(a: &str, b: &str) -> usize {
    let b = b.as_bytes();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.bytes().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, &y) in b.iter().enumerate() {
            let best = (diagonal + usize::from(x != y)).min(row[j] + 1).min(row[j + 1] + 1);
            diagonal = row[j + 1];
            row[j + 1] = best;
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrappers_come_off_in_any_order() {
        assert_eq!(strip("module._orig_mod.model.encoder.x"), ("module._orig_mod.model.", "encoder.x"));
        assert_eq!(strip("encoder.model.x"), ("", "encoder.model.x"));
        assert_eq!(strip("module."), ("module.", ""));
    }

    #[test]
    fn vggt_pairs_interleave() {
        let map = |n| from_vggt(n);
        assert_eq!(map("aggregator.frame_blocks.3.ls1.gamma").as_deref(), Some("decoder.6.ls1.gamma"));
        assert_eq!(map("aggregator.global_blocks.17.attn.qkv.bias").as_deref(), Some("decoder.35.attn.qkv.bias"));
        assert_eq!(map("aggregator.patch_embed.cls_token").as_deref(), Some("encoder.cls_token"));
        for dropped in ["aggregator.camera_token", "camera_head.trunk.0.norm1.bias", "aggregator.frame_blocks.x.y"] {
            assert_eq!(map(dropped), None);
        }
    }

    #[test]
    fn distances_are_known_ones() {
        assert_eq!(edits("kitten", "sitting"), 3);
        assert_eq!(edits("", "abc"), 3);
        assert_eq!(
            nearest("encoder.norm.weigth", ["encoder.norm.weight", "x"].into_iter()),
            Some("encoder.norm.weight")
        );
        assert_eq!(nearest("abc", ["xyz"].into_iter()), None);
    }
}
