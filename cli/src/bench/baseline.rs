//! Comparison with an earlier `bench` report: medians, judged only where the samples can tell.
//!
//! A row is a regression when its median is more than the allowed share above the old one and the intervals that hold the
//! medians with 95 % probability do not meet. When they meet, or when one of them is wider than the allowed
//! share, the samples cannot tell: the row is reported as unclear, not as a failure.

use serde_json::Value;
use sf_formats::error::escape_path;
use sf_formats::open::read_regular;
use sf_formats::{Error, Result};
use std::path::Path;
use std::str::FromStr;

/// Longest report that is read.
const CAP: u64 = 64 << 20;

/// A share: `5%` or `0.05`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Share(pub(crate) f64);

impl FromStr for Share {
    type Err = String;

    fn from_str(text: &str) -> Result<Share, String> {
        let (digits, unit) = match text.strip_suffix('%') {
            Some(digits) => (digits, 0.01),
            None => (text, 1.0),
        };
        match digits.trim().parse::<f64>() {
            Ok(n) if n > 0.0 && n * unit <= 1000.0 => Ok(Share(n * unit)),
            _ => Err("a share above 0, as 5% or 0.05".into()),
        }
    }
}

/// What identifies a row of a report, and its median.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Timing {
    /// Values of [`KEYS`].
    key: Vec<Value>,
    p50: f64,
    /// What holds the median with 95 % probability; from the fastest to the slowest run of few.
    low: f64,
    high: f64,
}

/// Members of a result that must be equal for two rows to be comparable.
const KEYS: [&str; 8] = ["model", "preset", "precision", "isa", "threads", "frames", "width", "height"];

impl Timing {
    /// Of a member of `results`; `at` names it in messages.
    pub(crate) fn of(result: &Value, at: &str) -> Result<Timing> {
        let number = |key: &str| match result[key].as_f64() {
            Some(v) if v > 0.0 && v.is_finite() => Ok(v),
            _ => Err(Error::input(at, format!("{key} is not a time: not a bench report of this program"))),
        };
        let key = KEYS.iter().map(|k| result[*k].clone()).collect();
        let either = |first: &str, second: &str| number(first).or_else(|_| number(second));
        let (low, high) = (either("p50_low_ms", "min_ms")?, either("p50_high_ms", "max_ms")?);
        Ok(Timing { key, p50: number("p50_ms")?, low, high })
    }

    /// Width of the interval as a share of the median.
    fn spread(&self) -> f64 {
        (self.high - self.low) / self.p50
    }

    fn name(&self) -> String {
        let text = |v: &Value| match v {
            Value::String(s) => s.clone(),
            other => other.to_string(),
        };
        let shown = self.key.iter().filter(|v| !v.is_null()).map(text);
        shown.collect::<Vec<_>>().join(" ")
    }
}

/// What a comparison of one row says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Not slower than allowed.
    Fine,
    /// The samples cannot tell.
    Unclear,
    /// Slower than allowed.
    Slower,
}

/// Judges a median against an older one.
pub(crate) fn judge(old: &Timing, new: &Timing, allowed: Share) -> Verdict {
    let slower = new.p50 > old.p50 * (1.0 + allowed.0);
    let apart = new.low > old.high;
    match (slower, apart) {
        (true, true) => Verdict::Slower,
        (true, false) => Verdict::Unclear,
        (false, _) if old.spread().max(new.spread()) > 2.0 * allowed.0 => Verdict::Unclear,
        (false, _) => Verdict::Fine,
    }
}

/// An earlier report.
pub(crate) struct Baseline {
    rows: Vec<Timing>,
    /// Processor of the earlier report.
    pub(crate) cpu: Option<String>,
}

impl Baseline {
    /// Reads a report.
    pub(crate) fn open(path: &Path) -> Result<Baseline> {
        let at = escape_path(path);
        let bytes =
            read_regular(path, CAP)?.ok_or_else(|| Error::input(&at, "longer than 64 MiB: not a bench report"))?;
        let json: Value =
            serde_json::from_slice(&bytes).map_err(|e| Error::input(&at, format!("not a bench report: {e}")))?;
        if json["schema"] != "streetforward.bench/1" {
            return Err(Error::input(&at, "not a bench report: schema is not streetforward.bench/1"));
        }
        let results = json["results"].as_array().ok_or_else(|| Error::input(&at, "has no results"))?;
        let row = |(i, r)| Timing::of(r, &format!("{at}: results[{i}]"));
        let rows = results.iter().enumerate().map(row).collect::<Result<_>>()?;
        Ok(Baseline { rows, cpu: json["machine"]["cpu"].as_str().map(str::to_string) })
    }

    /// A line for every row, and those that are slower; an error when no row has a counterpart.
    pub(crate) fn compare(&self, rows: &[Timing], allowed: Share) -> Result<Comparison> {
        let mut comparison = Comparison::default();
        let mut known = 0;
        for new in rows {
            let Some(old) = self.rows.iter().find(|old| old.key == new.key) else {
                comparison.lines.push(format!("{}: not in the baseline", new.name()));
                continue;
            };
            known += 1;
            let verdict = judge(old, new, allowed);
            let change = 100.0 * (new.p50 / old.p50 - 1.0);
            let spread = 100.0 * old.spread().max(new.spread());
            let told = match verdict {
                Verdict::Fine => "fine".to_string(),
                Verdict::Slower => format!("SLOWER than {:.1} % allow", 100.0 * allowed.0),
                Verdict::Unclear => format!("unclear: medians are known to {spread:.1} %, more runs would tell"),
            };
            let line = format!("{}: p50 {:.3} -> {:.3} ms ({change:+.1} %), {told}", new.name(), old.p50, new.p50);
            if verdict == Verdict::Slower {
                comparison.slower.push(line.clone());
            }
            comparison.lines.push(line);
        }
        if known == 0 {
            return Err(Error::input("--baseline", "none of its rows has the settings of a row of this run"));
        }
        Ok(comparison)
    }
}

/// What a comparison found.
#[derive(Default)]
pub(crate) struct Comparison {
    pub(crate) lines: Vec<String>,
    pub(crate) slower: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// A row whose median is known to `spread` (a share, both sides together).
    fn row(p50: f64, spread: f64) -> Timing {
        let result = json!({
            "model": null, "preset": "nano", "precision": "f32", "isa": "avx2", "threads": 2, "frames": 4,
            "width": 252, "height": 168, "p50_ms": p50, "min_ms": 0.5 * p50, "max_ms": 2.0 * p50,
            "p50_low_ms": p50 * (1.0 - spread / 2.0), "p50_high_ms": p50 * (1.0 + spread / 2.0),
        });
        Timing::of(&result, "row").unwrap()
    }

    #[test]
    fn a_tenth_more_is_caught_and_noise_is_not_blamed() {
        let five = Share(0.05);
        assert_eq!(judge(&row(100.0, 0.02), &row(110.0, 0.02), five), Verdict::Slower);
        assert_eq!(judge(&row(100.0, 0.02), &row(104.0, 0.02), five), Verdict::Fine);
        assert_eq!(judge(&row(100.0, 0.02), &row(80.0, 0.02), five), Verdict::Fine);
        // The same tenth between medians that are known to a quarter.
        assert_eq!(judge(&row(100.0, 0.25), &row(110.0, 0.25), five), Verdict::Unclear);
        // No slowdown seen, but one of the allowed size would not have been seen either.
        assert_eq!(judge(&row(100.0, 0.25), &row(100.0, 0.25), five), Verdict::Unclear);
        assert_eq!(judge(&row(100.0, 0.25), &row(110.0, 0.25), Share(0.5)), Verdict::Fine);
    }

    #[test]
    fn rows_are_compared_with_their_own_kind() {
        let old = Baseline { rows: vec![row(100.0, 0.01)], cpu: None };
        let same = old.compare(&[row(110.0, 0.01)], Share(0.05)).unwrap();
        assert_eq!((same.lines.len(), same.slower.len()), (1, 1));
        assert!(
            same.slower[0].contains("nano f32 avx2 2 4 252 168: p50 100.000 -> 110.000 ms (+10.0 %)"),
            "{same:?}",
            same = same.slower
        );
        let mut other = row(500.0, 0.01);
        other.key[4] = json!(1);
        let both = old.compare(&[row(101.0, 0.01), other.clone()], Share(0.05)).unwrap();
        assert!(both.slower.is_empty() && both.lines[1].contains("not in the baseline"));
        assert_eq!(old.compare(&[other], Share(0.05)).err().unwrap().status() as i32, 3);
        // Fewer than six runs have no interval: from the fastest to the slowest.
        let few = json!({ "p50_ms": 10.0, "p50_low_ms": null, "p50_high_ms": null, "min_ms": 9.0, "max_ms": 12.0 });
        assert_eq!((Timing::of(&few, "few").unwrap().low, Timing::of(&few, "few").unwrap().high), (9.0, 12.0));
        assert_eq!(Timing::of(&json!({ "p50_ms": "x" }), "bad").unwrap_err().status() as i32, 3);
    }

    #[test]
    fn shares_are_read_and_refused() {
        assert_eq!("5%".parse(), Ok(Share(0.05)));
        assert_eq!("0.1".parse(), Ok(Share(0.1)));
        for bad in ["", "%", "-5%", "0", "x", "nan", "inf%"] {
            assert!(bad.parse::<Share>().is_err(), "{bad}");
        }
    }
}
