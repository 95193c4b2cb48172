//! [`Row`]: one configuration of `bench` and what was measured of it, as JSON and as lines of tables.

use crate::bench::measure::Pace;
use crate::bench::stats::{Percentile, Samples};
use crate::machine::Peak;
use crate::output::human_bytes;
use serde_json::{Map, Value, json};
use sf_formats::digest::{Digest, hex};
use sf_ops::opclock::{Accounts, Op};
use std::time::Duration;
use streetforward::{ClipShape, Cost};

/// Most samples of a row that a JSON report holds; `--samples` writes all.
const MAX_SAMPLES: usize = 10_000;

/// One configuration and what was measured of it.
pub(crate) struct Row {
    /// File, or none for random weights.
    pub(crate) model: Option<String>,
    pub(crate) preset: Option<String>,
    pub(crate) precision: &'static str,
    pub(crate) isa: &'static str,
    pub(crate) threads: usize,
    pub(crate) shape: ClipShape,
    pub(crate) kernels: Value,
    pub(crate) warmup: usize,
    pub(crate) samples: Samples,
    /// Times of the runs in their order.
    pub(crate) samples_ns: Vec<u64>,
    /// Arrival to result; as `samples` without a pace.
    pub(crate) responses: Samples,
    pub(crate) load_ms: f64,
    pub(crate) session_ms: f64,
    pub(crate) first_ms: f64,
    pub(crate) weights_bytes: u64,
    pub(crate) arena_bytes: u64,
    pub(crate) output_bytes: u64,
    pub(crate) peak_rss_bytes: Option<u64>,
    pub(crate) cost: Cost,
    pub(crate) peak: Peak,
    /// Median of every stage of the clock.
    pub(crate) stages: Vec<(&'static str, f64)>,
    pub(crate) pace: Option<(f64, Pace)>,
    /// Milliseconds, and how many runs took longer from arrival to result; skipped clips count.
    pub(crate) deadline: Option<(f64, u64)>,
    /// Place of the slowest run among those that count.
    pub(crate) worst_run: usize,
    pub(crate) profile: Option<(Accounts, Duration)>,
    /// One new frame a step with the results of all frames, with those of the newest, and the whole window in between.
    pub(crate) push: Option<[Samples; 3]>,
    pub(crate) digest: Digest,
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

impl Row {
    /// Giga-operations of a run, two per multiply-add.
    pub(crate) fn gop(&self) -> f64 {
        2e-9 * self.cost.macs() as f64
    }

    /// At the median.
    pub(crate) fn gops_per_s(&self) -> f64 {
        self.gop() / (self.samples.median() * 1e-3)
    }

    /// Time that the multiply-adds alone would take at the measured peaks, over the median.
    pub(crate) fn peak_share(&self) -> f64 {
        let float = 2.0 * (self.cost.macs() - self.cost.int8()) as f64 / self.peak.f32;
        let bytes = 2.0 * self.cost.int8() as f64 / self.peak.s8;
        (float + bytes) / (self.samples.median() * 1e-3)
    }

    /// Stages, and what of the median belongs to none of them.
    fn stages(&self) -> Vec<(&'static str, f64, f64)> {
        let gop = |name: &str| {
            let stage = self.cost.stages().iter().find(|s| s.name == name);
            2e-9 * stage.map_or(0, streetforward::StageCost::macs) as f64
        };
        let mut list: Vec<_> = self.stages.iter().map(|&(name, p50)| (name, p50, gop(name))).collect();
        let known: f64 = list.iter().map(|s| s.1).sum();
        list.push(("other", self.samples.median() - known, 0.0));
        list
    }

    /// Names of everything that tells two rows apart.
    pub(crate) fn name(&self) -> String {
        let model = self.model.as_deref().or(self.preset.as_deref()).unwrap_or("random");
        let s = self.shape;
        format!("{model} {} {} {} thr {} x {}x{}", self.precision, self.isa, self.threads, s.frames, s.width, s.height)
    }

    /// As the network's results must not depend on it: everything but instruction set and threads.
    pub(crate) fn same_result_as(&self, other: &Row) -> bool {
        (&self.model, &self.preset, self.precision, self.shape)
            == (&other.model, &other.preset, other.precision, other.shape)
    }

    /// One member of `results`.
    pub(crate) fn json(&self, percentiles: &[Percentile]) -> Value {
        let mut map = Map::new();
        let mut put = |key: &str, value: Value| map.insert(key.to_string(), value);
        put("model", json!(self.model));
        put("preset", json!(self.preset));
        put("precision", json!(self.precision));
        put("isa", json!(self.isa));
        put("threads", json!(self.threads));
        put("frames", json!(self.shape.frames));
        put("width", json!(self.shape.width));
        put("height", json!(self.shape.height));
        put("runs", json!(self.samples.len()));
        put("warmup_runs", json!(self.warmup));
        // The documented keys are always there; others are asked for.
        for p in [50.0, 90.0, 99.0].map(Percentile).iter().chain(percentiles) {
            put(&p.key(), json!(self.samples.percentile(*p)));
        }
        put("min_ms", json!(self.samples.min()));
        put("max_ms", json!(self.samples.max()));
        put("mean_ms", json!(self.samples.mean()));
        put("std_ms", json!(self.samples.std()));
        put("p50_low_ms", json!(self.samples.median_interval().map(|i| i.0)));
        put("p50_high_ms", json!(self.samples.median_interval().map(|i| i.1)));
        put("jitter_ms", json!(self.samples.jitter()));
        put("worst_run", json!(self.worst_run));
        put("load_ms", json!(self.load_ms));
        put("session_ms", json!(self.session_ms));
        put("first_ms", json!(self.first_ms));
        put("arena_bytes", json!(self.arena_bytes));
        put("output_bytes", json!(self.output_bytes));
        put("weights_bytes", json!(self.weights_bytes));
        put("peak_rss_bytes", json!(self.peak_rss_bytes));
        put("gop", json!(self.gop()));
        put("gops_per_s", json!(self.gops_per_s()));
        put("int8_fraction", json!(self.cost.int8() as f64 / self.cost.macs() as f64));
        put("peak_f32_gops_per_s", json!(self.peak.f32 * 1e-9));
        put("peak_s8_gops_per_s", json!(self.peak.s8 * 1e-9));
        put("peak_fraction", json!(self.peak_share()));
        put("kernels", self.kernels.clone());
        let stage = |(name, p50, gop): (&str, f64, f64)| json!({ "name": name, "p50_ms": p50, "gop": gop });
        put("stages", self.stages().into_iter().map(stage).collect());
        if let Some((period_ms, pace)) = &self.pace {
            put("period_ms", json!(period_ms));
            put("arrivals", json!(pace.arrivals));
            put("skipped", json!(pace.skipped));
            put("idle_cpu_share", json!(pace.idle_cpu_share));
            put("response_p50_ms", json!(self.responses.median()));
            put("response_p99_ms", json!(self.responses.percentile(Percentile(99.0))));
            put("response_max_ms", json!(self.responses.max()));
        }
        if let Some([push, newest, whole]) = &self.push {
            put("push_p50_ms", json!(push.median()));
            put("push_newest_p50_ms", json!(newest.median()));
            put("push_newest_p50_low_ms", json!(newest.median_interval().map(|i| i.0)));
            put("push_newest_p50_high_ms", json!(newest.median_interval().map(|i| i.1)));
            put("push_p50_low_ms", json!(push.median_interval().map(|i| i.0)));
            put("push_p50_high_ms", json!(push.median_interval().map(|i| i.1)));
            put("push_whole_p50_ms", json!(whole.median()));
            put("push_runs", json!(push.len()));
        }
        if let Some((deadline_ms, misses)) = self.deadline {
            put("deadline_ms", json!(deadline_ms));
            put("deadline_misses", json!(misses));
        }
        if let Some((_, total)) = self.profile {
            let op = |o: &OpRow| {
                json!({
                    "name": o.name, "calls": o.calls, "ms": o.ms, "gop": o.gop, "gops_per_s": o.gops_per_s(),
                    "gbytes_per_s": o.gbytes_per_s(), "peak_fraction": o.peak_fraction,
                })
            };
            put("profile_total_ms", json!(ms(total)));
            put("ops", self.ops().iter().map(op).collect());
        }
        put("samples_ns", self.samples_ns.iter().take(MAX_SAMPLES).copied().collect());
        put("output_digest", json!(hex(&self.digest)));
        Value::Object(map)
    }

    /// Kinds of operations of the profiled run that occurred, and what of it was in none.
    fn ops(&self) -> Vec<OpRow> {
        let Some((accounts, total)) = &self.profile else { return Vec::new() };
        let mut list: Vec<OpRow> = Vec::new();
        for (op, account) in Op::ALL.iter().zip(accounts).filter(|(_, a)| a.calls > 0) {
            let peak =
                if matches!(op, Op::GemmS8 | Op::AttentionS8 | Op::ConvS8) { self.peak.s8 } else { self.peak.f32 };
            let (time, ops) = (account.time.as_secs_f64(), 2.0 * account.work.macs as f64);
            list.push(OpRow {
                name: op.name(),
                calls: account.calls,
                ms: time * 1e3,
                gop: ops * 1e-9,
                gbytes: account.work.bytes as f64 * 1e-9,
                peak_fraction: (ops > 0.0).then(|| ops / time / peak),
            });
        }
        let inside: f64 = list.iter().map(|o| o.ms).sum();
        let ms = ms(*total) - inside;
        list.push(OpRow { name: "outside ops", calls: 0, ms, gop: 0.0, gbytes: 0.0, peak_fraction: None });
        list
    }
}

/// One kind of operation.
struct OpRow {
    name: &'static str,
    calls: u64,
    ms: f64,
    gop: f64,
    gbytes: f64,
    peak_fraction: Option<f64>,
}

impl OpRow {
    fn gops_per_s(&self) -> Option<f64> {
        (self.gop > 0.0).then(|| self.gop / (self.ms * 1e-3))
    }

    fn gbytes_per_s(&self) -> Option<f64> {
        (self.gbytes > 0.0).then(|| self.gbytes / (self.ms * 1e-3))
    }
}

/// A number with its digits, or that there is none.
fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "n/a".into(), |v| format!("{v:.digits$}"))
}

/// Milliseconds with microseconds where they matter.
fn millis(value: Option<f64>) -> String {
    number(value, if value.is_some_and(|v| v < 100.0) { 3 } else { 1 })
}

/// A table with right-aligned columns after the first.
fn markdown(head: &[String], rows: &[Vec<String>]) -> String {
    let width = |i: usize| rows.iter().map(|r| r[i].chars().count()).chain([head[i].chars().count(), 3]).max();
    let widths: Vec<usize> = (0..head.len()).map(|i| width(i).unwrap_or(3)).collect();
    let line = |cells: &[String]| {
        let cell = |(i, c): (usize, &String)| {
            let pad = " ".repeat(widths[i] - c.chars().count());
            if i == 0 { format!(" {c}{pad} |") } else { format!(" {pad}{c} |") }
        };
        format!("|{}\n", cells.iter().enumerate().map(cell).collect::<String>())
    };
    let rule = |(i, w): (usize, &usize)| {
        if i == 0 { format!("{}|", "-".repeat(w + 2)) } else { format!("{}:|", "-".repeat(w + 1)) }
    };
    let rules: String = widths.iter().enumerate().map(rule).collect();
    format!("{}|{rules}\n{}", line(head), rows.iter().map(|r| line(r)).collect::<String>())
}

/// The summary table and, below it, stages, pace and operations.
pub(crate) fn tables(rows: &[Row], percentiles: &[Percentile]) -> String {
    let owned = |list: &[&str]| list.iter().map(|s| s.to_string()).collect::<Vec<_>>();
    let mut head = owned(&["model", "prec", "isa", "thr", "frames", "size", "n"]);
    head.extend(percentiles.iter().map(|p| format!("{p} ms")));
    head.extend(owned(&["95% of p50", "min", "max", "first ms", "load ms", "RSS", "GOP", "GOP/s", "peak", "x f32"]));
    let summary = |r: &Row| {
        let model = r.model.as_deref().map(|m| m.rsplit('/').next().unwrap_or(m)).or(r.preset.as_deref());
        let mut cells = owned(&[model.unwrap_or("random"), r.precision, r.isa]);
        cells.extend([r.threads.to_string(), r.shape.frames.to_string()]);
        cells.push(format!("{}x{}", r.shape.width, r.shape.height));
        cells.push(r.samples.len().to_string());
        cells.extend(percentiles.iter().map(|p| millis(r.samples.percentile(*p))));
        let interval = r.samples.median_interval();
        cells.push(interval.map_or("n/a".into(), |(a, b)| format!("{}..{}", millis(Some(a)), millis(Some(b)))));
        cells.extend([r.samples.min(), r.samples.max(), r.first_ms].map(|t| millis(Some(t))));
        cells.push(number(Some(r.load_ms), 1));
        cells.push(r.peak_rss_bytes.map_or("n/a".into(), human_bytes));
        cells.extend([number(Some(r.gop()), 2), number(Some(r.gops_per_s()), 1)]);
        cells.push(format!("{:.0} %", 100.0 * r.peak_share()));
        let same = |o: &&Row| {
            let key = |r: &Row| (r.isa, r.threads, r.shape);
            o.precision == "f32" && key(o) == key(r) && (&o.preset, &o.model) == (&r.preset, &r.model)
        };
        cells.push(number(rows.iter().find(same).map(|f32| f32.samples.median() / r.samples.median()), 2));
        cells
    };
    let mut text = markdown(&head, &rows.iter().map(summary).collect::<Vec<_>>());

    let mut head = owned(&["stage, median ms"]);
    head.extend((1..=rows.len()).map(|i| format!("row {i}")));
    head.push("GOP, row 1".into());
    let stages: Vec<_> = rows.iter().map(Row::stages).collect();
    let mut lines: Vec<Vec<String>> = Vec::new();
    for (i, &(name, _, gop)) in stages[0].iter().enumerate() {
        let mut line = vec![name.to_string()];
        line.extend(stages.iter().map(|s| number(Some(s[i].1), 3)));
        line.push(number(Some(gop), 3));
        lines.push(line);
    }
    let mut total = vec!["total".to_string()];
    total.extend(rows.iter().map(|r| number(Some(r.samples.median()), 3)));
    total.push(number(Some(rows[0].gop()), 3));
    lines.push(total);
    text.push('\n');
    text.push_str(&markdown(&head, &lines));

    for (i, row) in rows.iter().enumerate() {
        if row.pace.is_some() || row.deadline.is_some() {
            text.push_str(&format!("\nrow {}: {}\n", i + 1, row.pace_text()));
        }
        if let Some(push) = &row.push {
            let [all, newest, whole] = push.each_ref().map(Samples::median);
            let times = [all, newest, whole].map(|t| millis(Some(t)));
            text.push_str(&format!(
                "\nrow {}: one new frame a step {} ms ({:.2} times faster), for the newest frame's results {} ms ({:.2} times), \
                 the whole window {} ms in between; {} steps, same bits\n",
                i + 1,
                times[0],
                whole / all,
                times[1],
                whole / newest,
                times[2],
                push[0].len(),
            ));
        }
        if let Some((_, total)) = row.profile {
            let head = owned(&["operation", "calls", "ms", "share", "GOP", "GOP/s", "GB/s", "peak"]);
            let line = |o: &OpRow| {
                vec![
                    o.name.to_string(),
                    o.calls.to_string(),
                    number(Some(o.ms), 3),
                    format!("{:.1} %", 100.0 * o.ms / ms(total)),
                    number(Some(o.gop), 3),
                    number(o.gops_per_s(), 1),
                    number(o.gbytes_per_s(), 1),
                    o.peak_fraction.map_or("n/a".into(), |p| format!("{:.0} %", 100.0 * p)),
                ]
            };
            text.push_str(&format!(
                "\nrow {}, a run of its own of {:.3} ms with every operation timed:\n",
                i + 1,
                ms(total)
            ));
            text.push_str(&markdown(&head, &row.ops().iter().map(line).collect::<Vec<_>>()));
        }
    }
    text
}

impl Row {
    /// Pace and deadline in one line.
    fn pace_text(&self) -> String {
        let mut parts = Vec::new();
        if let Some((period_ms, pace)) = &self.pace {
            let idle = pace.idle_cpu_share.map_or("n/a".into(), |s| format!("{:.1} %", 100.0 * s));
            parts.push(format!(
                "{} clips every {period_ms} ms, {} skipped, arrival to result {} ms (worst {}), {idle} of a core while idle",
                pace.arrivals,
                pace.skipped,
                millis(Some(self.responses.median())),
                millis(Some(self.responses.max())),
            ));
        }
        if let Some((deadline_ms, misses)) = self.deadline {
            parts.push(format!("{misses} misses of the {deadline_ms} ms deadline"));
        }
        parts.push(format!("jitter p99 - p50 {} ms", millis(self.samples.jitter())));
        parts.push(format!("worst run {} of {}", self.worst_run, self.samples.len()));
        parts.join("; ")
    }
}

/// The rows as comma-separated values with a header.
pub(crate) fn csv(rows: &[Row], percentiles: &[Percentile]) -> String {
    let mut text = String::new();
    for (i, row) in rows.iter().enumerate() {
        let Value::Object(map) = row.json(percentiles) else { continue };
        // Flat members only; stages get a column each.
        let flat: Vec<(String, String)> =
            map.into_iter().filter(|(_, v)| !v.is_array() && !v.is_object()).map(|(k, v)| (k, csv_cell(&v))).collect();
        let stages = row.stages().into_iter().map(|(name, p50, _)| (format!("{name}_p50_ms"), p50.to_string()));
        let all: Vec<(String, String)> = flat.into_iter().chain(stages).collect();
        let line = |part: fn(&(String, String)) -> &str| all.iter().map(part).collect::<Vec<_>>().join(",") + "\n";
        if i == 0 {
            text.push_str(&line(|(k, _)| k));
        }
        text.push_str(&line(|(_, v)| v));
    }
    text
}

/// A value for a comma-separated line: nothing for null, quoted where it must be.
pub(crate) fn csv_cell(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(s) if s.contains([',', '"', '\n', '\r']) => format!("\"{}\"", s.replace('"', "\"\"")),
        Value::String(s) => s.clone(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_aligned_and_csv_cells_quoted() {
        let head = ["a".to_string(), "number".to_string()];
        let rows = [vec!["first".to_string(), "1".to_string()], vec!["x".to_string(), "22".to_string()]];
        let want = "| a     | number |\n|-------|-------:|\n| first |      1 |\n| x     |     22 |\n";
        assert_eq!(markdown(&head, &rows), want);
        assert_eq!(csv_cell(&json!("a,\"b\"")), "\"a,\"\"b\"\"\"");
        assert_eq!(csv_cell(&json!(null)), "");
        assert_eq!(csv_cell(&json!(1.5)), "1.5");
    }

    #[test]
    fn milliseconds_keep_microseconds_while_they_are_few() {
        assert_eq!(millis(Some(2.345678)), "2.346");
        assert_eq!(millis(Some(1234.567)), "1234.6");
        assert_eq!(millis(None), "n/a");
    }
}
