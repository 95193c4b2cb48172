//! Results as one page: what the verbs print with `--json` becomes tables and charts, scenes become pictures.
//!
//! A document is shown by its `schema`; of one that is not known every number is listed under its key. Charts are
//! inline SVG; the page fetches nothing.

use crate::growth;
use crate::html::{StripPicture, base64};
use serde_json::Value;
use sf_formats::Result;
use sf_formats::image_io::{self, Rgb8};
use std::fmt::Write;

const STYLE: &str = include_str!("../assets/report.css");
/// Colours of stages, told apart on light and dark ground.
pub(crate) const COLOURS: [&str; 10] =
    ["#4c78a8", "#f2a65a", "#54a24b", "#e45756", "#72b7b2", "#b279a2", "#c5a03f", "#8c6d5a", "#7f8fa6", "#d67195"];

/// Text that is safe in HTML.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The page of some sections.
pub(crate) fn page(title: &str, sections: &[String]) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\
         <link rel=\"icon\" href=\"data:,\"><title>{0}</title><style>\n{STYLE}</style></head>\n<body><h1>{0}</h1>\n\
         <p class=\"quiet\">streetforward {1}</p>\n{2}\n</body></html>\n",
        escape(title),
        env!("CARGO_PKG_VERSION"),
        sections.join("\n")
    )
}

/// One JSON document.
pub(crate) fn document(v: &Value, name: &str) -> String {
    let schema = v["schema"].as_str().unwrap_or_default();
    let kind = schema.strip_prefix("streetforward.").and_then(|s| s.split('/').next()).unwrap_or_default();
    let (heading, body) = match kind {
        "bench" => ("Latency", bench(v)),
        "peers" => ("Beside other runtimes", peers(v)),
        "compare" => ("Two models compared", compare(v)),
        "eval" => ("Accuracy", eval(v)),
        "demo" => ("Demonstration", session(v) + &eval(&v["eval"])),
        "run" => ("Run", session(v)),
        "render" => ("Rendering", samples(&numbers(&v["views"], "render_ms"), "picture", None)),
        _ => ("Result", flat(v)),
    };
    let mut note = format!("{name}, {schema}");
    for key in ["model", "a", "b"] {
        if let Some(path) = v[key].as_str().or(v[key]["path"].as_str()).or(v[key]["name"].as_str()) {
            let _ = write!(note, ", {key} {path}");
        }
    }
    format!("<section><h2>{heading}</h2><p class=\"quiet\">{}</p>{body}</section>", escape(&note))
}

/// A scene: its pictures, and a sheet (any picture) where there is one.
pub(crate) fn scene(name: &str, summary: &str, strip: &[StripPicture], sheet: Option<&Rgb8>) -> Result<String> {
    let data = |image: &Rgb8| -> Result<String> {
        Ok(format!("data:image/jpeg;base64,{}", base64(&image_io::encode_jpeg(image, 88)?)))
    };
    let mut body = String::new();
    for p in strip {
        let psnr = p.psnr_db.map_or(String::new(), |d| format!(", {d:.1} dB"));
        let what = if p.frame.is_some() { "source frame" } else { "never seen" };
        for (word, image) in [("real", p.real.as_ref()), ("rendered", Some(&p.rendered))] {
            if let Some(image) = image {
                let note = if word == "rendered" { psnr.as_str() } else { "" };
                let _ = write!(
                    body,
                    "<figure><img src=\"{}\" alt=\"{word}\"><figcaption>{:.2} s, {what}: {word}{note}</figcaption></figure>",
                    data(image)?,
                    p.time
                );
            }
        }
    }
    let sheet = match sheet {
        Some(image) => format!("<img class=\"sheet\" src=\"{}\" alt=\"overview\">", data(image)?),
        None => String::new(),
    };
    let pictures = if body.is_empty() { body } else { format!("<div class=\"pictures\">{body}</div>") };
    Ok(format!(
        "<section><h2>Scene</h2><p class=\"quiet\">{}</p>{sheet}{pictures}</section>",
        escape(&format!("{name}, {summary}"))
    ))
}

/// A number with four digits that count.
pub(crate) fn short(v: f64) -> String {
    match v.abs() {
        a if a == 0.0 || a >= 1000.0 => format!("{v:.0}"),
        a if a >= 100.0 => format!("{v:.1}"),
        a if a >= 10.0 => format!("{v:.2}"),
        a if a >= 0.01 => format!("{v:.4}").trim_end_matches('0').trim_end_matches('.').to_string(),
        _ => format!("{v:.2e}"),
    }
}

/// A scalar as text; none for lists, objects and null.
fn scalar(v: &Value) -> Option<String> {
    match v {
        Value::Bool(b) => Some(b.to_string()),
        Value::Number(n) if n.is_f64() => n.as_f64().map(short),
        Value::Number(n) => Some(n.to_string()),
        Value::String(s) => Some(escape(s)),
        _ => None,
    }
}

fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let line = |cells: &mut dyn Iterator<Item = String>, tag: &str| {
        format!("<tr>{}</tr>", cells.map(|c| format!("<{tag}>{c}</{tag}>")).collect::<String>())
    };
    let body: String = rows.iter().map(|r| line(&mut r.iter().cloned(), "td")).collect();
    let head = line(&mut head.iter().map(|h| escape(h)), "th");
    format!("<div class=\"wide\"><table>{head}{body}</table></div>")
}

/// The numbers under a key of each entry.
fn numbers(list: &Value, key: &str) -> Vec<f64> {
    list.as_array().into_iter().flatten().filter_map(|e| e[key].as_f64()).collect()
}

/// Name and milliseconds of stages.
fn stages(list: &Value) -> Vec<(String, f64)> {
    let entry = |s: &Value| {
        let ms = s["ms"].as_f64().or(s["p50_ms"].as_f64())?;
        Some((s["name"].as_str()?.to_string(), ms))
    };
    list.as_array().into_iter().flatten().filter_map(entry).filter(|s| s.1 > 0.0).collect()
}

/// A line of [`bars`].
struct Bar {
    label: String,
    /// Milliseconds of all.
    total: f64,
    /// Name and milliseconds of the parts.
    parts: Vec<(String, f64)>,
}

/// Stacked bars, one a line, with one scale.
fn bars(lines: &[Bar]) -> String {
    let most = lines.iter().map(|l| l.parts.iter().map(|s| s.1).sum::<f64>().max(l.total)).fold(0.0, f64::max);
    if most <= 0.0 {
        return String::new();
    }
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in lines.iter().flat_map(|l| &l.parts) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let colour = |name: &str| COLOURS[names.iter().position(|n| *n == name).unwrap_or(0) % COLOURS.len()];
    let mut svg = format!("<svg viewBox=\"0 0 960 {}\" role=\"img\">", 34 * lines.len());
    for (i, Bar { label, total, parts }) in lines.iter().enumerate() {
        let y = 34 * i;
        let _ = write!(svg, "<text class=\"strong\" x=\"0\" y=\"{}\">{}</text>", y + 20, escape(label));
        let mut x = 250.0;
        for (name, ms) in parts {
            let w = 620.0 * ms / most;
            let _ = write!(
                svg,
                "<rect x=\"{x:.1}\" y=\"{}\" width=\"{:.1}\" height=\"20\" fill=\"{}\"><title>{} {} ms</title></rect>",
                y + 6,
                w.max(0.3),
                colour(name),
                escape(name),
                short(*ms)
            );
            x += w;
        }
        let _ = write!(svg, "<text x=\"{:.1}\" y=\"{}\">{} ms</text>", x + 8.0, y + 20, short(*total));
    }
    svg.push_str("</svg><ul class=\"legend\">");
    for name in &names {
        let _ = write!(svg, "<li><i style=\"background:{}\"></i>{}</li>", colour(name), escape(name));
    }
    svg + "</ul>"
}

/// Value below which a share of sorted values lies.
fn percentile(sorted: &[f64], q: f64) -> f64 {
    sorted[((sorted.len() as f64 * q).ceil() as usize).clamp(1, sorted.len()) - 1]
}

/// A histogram of times with its percentiles. A percentile is drawn when enough samples lie beyond it to tell.
fn samples(ms: &[f64], what: &str, deadline: Option<f64>) -> String {
    let mut sorted: Vec<f64> = ms.iter().copied().filter(|v| v.is_finite()).collect();
    if sorted.len() < 2 {
        return String::new();
    }
    sorted.sort_by(f64::total_cmp);
    let (n, low) = (sorted.len(), sorted[0]);
    let high = sorted[n - 1].max(deadline.unwrap_or(0.0)).max(low * 1.0001 + 1e-9);
    let count = n.isqrt().clamp(4, 60);
    let mut bins = vec![0usize; count];
    for v in &sorted {
        bins[(((v - low) / (high - low) * count as f64) as usize).min(count - 1)] += 1;
    }
    let top = *bins.iter().max().unwrap_or(&1) as f64;
    let at = |v: f64| 20.0 + 920.0 * (v - low) / (high - low);
    let mut svg =
        "<svg viewBox=\"0 0 960 196\" role=\"img\"><line class=\"axis\" x1=\"20\" x2=\"940\" y1=\"160\" y2=\"160\"/>"
            .to_string();
    for (i, &b) in bins.iter().enumerate() {
        let (w, h) = (920.0 / count as f64, 120.0 * b as f64 / top);
        let _ = write!(
            svg,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{h:.1}\" fill=\"{}\"><title>{b}</title></rect>",
            20.0 + i as f64 * w,
            160.0 - h,
            (w - 1.0).max(0.5),
            COLOURS[0]
        );
    }
    let mut free = [f64::NEG_INFINITY; 2];
    let mut mark = |value: f64, label: String| {
        let x = at(value);
        // Labels near the right end stand on the left of their line.
        let wide = 7.0 * label.len() as f64;
        let (at, anchor, start) = if x > 820.0 { (x - 4.0, "end", x - wide) } else { (x + 4.0, "start", x) };
        let row = usize::from(start < free[0]);
        free[row] = start + wide;
        let y = 28 - 14 * row;
        let _ = write!(
            svg,
            "<line class=\"mark\" x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{}\" y2=\"160\"/>\
             <text x=\"{at:.1}\" y=\"{y}\" text-anchor=\"{anchor}\">{label}</text>",
            y + 4,
        );
    };
    // Ten samples beyond a percentile's neighbourhood, as the benchmark demands.
    for (q, name, need) in [(0.5, "p50", 2), (0.9, "p90", 10), (0.99, "p99", 100)] {
        if n >= need {
            let v = percentile(&sorted, q);
            mark(v, format!("{name} {}", short(v)));
        }
    }
    if let Some(d) = deadline {
        mark(d, format!("deadline {}", short(d)));
    }
    let _ = write!(
        svg,
        "<text x=\"20\" y=\"178\">{}</text><text x=\"940\" y=\"178\" text-anchor=\"end\">{} ms</text></svg>",
        short(low),
        short(high)
    );
    format!("<h3>{n} samples, ms a {what}</h3>{svg}")
}

fn bench(v: &Value) -> String {
    let results: Vec<&Value> = v["results"].as_array().into_iter().flatten().collect();
    let columns = [
        ("model", "model"),
        ("precision", "precision"),
        ("isa", "isa"),
        ("threads", "threads"),
        ("frames", "frames"),
        ("size", "size"),
        ("runs", "runs"),
        ("min_ms", "min ms"),
        ("p50_ms", "p50 ms"),
        ("p90_ms", "p90 ms"),
        ("p99_ms", "p99 ms"),
        ("max_ms", "max ms"),
        ("first_ms", "first ms"),
        ("gops_per_s", "Gop/s"),
        ("peak_rss_bytes", "peak MiB"),
    ];
    let cell = |r: &Value, key: &str| match key {
        "peak_rss_bytes" => r[key].as_f64().map(|b| short(b / f64::from(1 << 20))),
        "size" => r["width"].as_u64().zip(r["height"].as_u64()).map(|(w, h)| format!("{w}x{h}")),
        _ => scalar(&r[key]),
    };
    // Columns that nothing fills are left out.
    let used: Vec<_> = columns.into_iter().filter(|c| results.iter().any(|r| cell(r, c.0).is_some())).collect();
    let rows: Vec<Vec<String>> =
        results.iter().map(|r| used.iter().map(|c| cell(r, c.0).unwrap_or_else(|| "n/a".into())).collect()).collect();
    let heads: Vec<&str> = used.iter().map(|c| c.1).collect();
    let name = |r: &Value| {
        let part = |key: &str, unit: &str| scalar(&r[key]).map(|s| format!("{s}{unit}"));
        let threads = part("threads", if r["threads"] == 1 { " thread" } else { " threads" });
        let model = r["model"].as_str().map(|path| escape(path.rsplit('/').next().unwrap_or(path)));
        let parts = [part("preset", "").or(model), part("precision", ""), threads, part("frames", " frames")];
        parts.into_iter().flatten().collect::<Vec<_>>().join(" ")
    };
    let bar =
        |r: &&Value| Bar { label: name(r), total: r["p50_ms"].as_f64().unwrap_or(0.0), parts: stages(&r["stages"]) };
    let lines: Vec<Bar> = results.iter().map(bar).collect();
    let mut out = table(&heads, &rows) + &growth::charts(&results) + "<h3>Stages</h3>" + &bars(&lines);
    for r in &results {
        let ms: Vec<f64> = match (r["samples_ms"].as_array(), r["samples_ns"].as_array()) {
            (Some(list), _) => list.iter().filter_map(Value::as_f64).collect(),
            (_, Some(list)) => list.iter().filter_map(Value::as_f64).map(|ns| ns / 1e6).collect(),
            _ => Vec::new(),
        };
        let chart = samples(&ms, "run", r["deadline_ms"].as_f64().or(v["deadline_ms"].as_f64()));
        if !chart.is_empty() {
            out.push_str(&chart.replacen("<h3>", &format!("<h3>{}: ", name(r)), 1));
        }
    }
    out
}

/// This engine beside other runtimes, as `bench/peers` measures them.
fn peers(v: &Value) -> String {
    let results: Vec<&Value> = v["results"].as_array().into_iter().flatten().collect();
    let name = |r: &Value| {
        let part = |key: &str| r[key].as_str().unwrap_or_default().to_string();
        let note = Some(part("note")).filter(|n| !n.is_empty()).map_or(String::new(), |n| format!(" ({n})"));
        format!("{} {}{note}", part("runtime"), part("precision"))
    };
    let ran: Vec<&&Value> = results.iter().filter(|r| r["median_ms"].is_number()).collect();
    let row = |r: &&&Value| {
        let mut cells = vec![escape(&name(r))];
        let of = |v: &Value, unit: f64| v.as_f64().map_or("n/a".into(), |x| short(x / unit));
        cells.push(of(&r["median_ms"], 1.0));
        cells.push(format!("{} to {}", of(&r["round_low_ms"], 1.0), of(&r["round_high_ms"], 1.0)));
        let hundredths = |v: &Value| v.as_f64().map_or("n/a".into(), |x| format!("{x:.2}"));
        cells.extend([&r["times_ours"], &r["cold_start_s"]].map(hundredths));
        cells.push(of(&r["peak_rss_bytes"], f64::from(1 << 20)));
        cells.extend(["depth_absrel", "rotation_deg", "velocity_epe"].map(|key| of(&r["error"][key], 1.0)));
        cells
    };
    let heads = ["runtime", "ms", "rounds", "x ours", "start s", "peak MiB", "depth", "degrees", "velocity"];
    let bar = |r: &&&Value| {
        let total = r["median_ms"].as_f64().unwrap_or(0.0);
        let (ours, other) = (("StreetForward".to_string(), total), ("others".to_string(), total));
        Bar { label: name(r), total, parts: vec![if r["runtime"] == "StreetForward" { ours } else { other }] }
    };
    let facts = format!(
        "<p class=\"quiet\">{} frames of {}x{}, {} threads, {}; start: process to first result; errors against f32: \
         relative depth, rotation, velocity in units per second</p>",
        v["frames"],
        v["width"],
        v["height"],
        v["threads"],
        escape(
            &[&v["network"], &v["machine"]["cpu"], &v["machine"]["date"]].map(|t| t.as_str().unwrap_or("?")).join(", ")
        )
    );
    let mut out = facts + &table(&heads, &ran.iter().map(row).collect::<Vec<_>>()) + "<h3>Median</h3>";
    out += &bars(&ran.iter().map(bar).collect::<Vec<_>>());
    for r in results.iter().filter(|r| !r["median_ms"].is_number()) {
        let why = r["failure"].as_str().unwrap_or("did not run");
        let _ = write!(out, "<p class=\"quiet\">{}: {}</p>", escape(&name(r)), escape(why));
    }
    out
}

/// Latency of a run or a demonstration.
fn session(v: &Value) -> String {
    let facts = [
        ("frames", scalar(&v["clip"]["frames"])),
        ("size", v["width"].as_u64().zip(v["height"].as_u64()).map(|(w, h)| format!("{w}x{h}"))),
        ("Gaussians", scalar(&v["gaussians"])),
        ("threads", scalar(&v["session"]["threads"])),
        ("instruction set", scalar(&v["session"]["isa"])),
        ("network ms", scalar(&v["run_ms"])),
        ("first run ms", scalar(&v["first_ms"])),
        ("rendered picture ms", scalar(&v["render_ms"])),
        ("arena MiB", v["session"]["arena_bytes"].as_f64().map(|b| short(b / f64::from(1 << 20)))),
        ("peak MiB", v["peak_rss_bytes"].as_f64().map(|b| short(b / f64::from(1 << 20)))),
    ];
    let used: Vec<_> = facts.into_iter().filter_map(|(k, v)| Some((k, v?))).collect();
    let heads: Vec<&str> = used.iter().map(|f| f.0).collect();
    let facts = table(&heads, &[used.iter().map(|f| f.1.clone()).collect()]);
    let total = v["run_ms"].as_f64().unwrap_or(0.0);
    facts + "<h3>Stages</h3>" + &bars(&[Bar { label: "network".into(), total, parts: stages(&v["session"]["stages"]) }])
}

/// Metrics of the model beside ablations and baselines.
fn eval(v: &Value) -> String {
    let mut columns: Vec<(String, &Value)> = vec![("model".into(), v)];
    for group in ["ablations", "baselines"] {
        columns.extend(v[group].as_object().into_iter().flatten().map(|(k, m)| (k.replace('_', " "), m)));
    }
    let part = |pick: &dyn Fn(&'_ Value) -> Value| {
        let picked: Vec<Value> = columns.iter().map(|c| pick(c.1)).collect();
        let keys: Vec<String> = picked[0]
            .as_object()
            .into_iter()
            .flatten()
            .filter(|(k, m)| m.is_number() && !k.ends_with("frames") && *k != "clips")
            .map(|(k, _)| k.clone())
            .collect();
        let rows: Vec<Vec<String>> = keys
            .iter()
            .map(|k| {
                let cells = picked.iter().map(|m| scalar(&m[k.as_str()]).unwrap_or_else(|| "-".into()));
                std::iter::once(escape(k)).chain(cells).collect()
            })
            .collect();
        let heads: Vec<&str> = std::iter::once("metric").chain(columns.iter().map(|c| c.0.as_str())).collect();
        table(&heads, &rows)
    };
    let mut out = part(&|m| m.clone());
    for (key, title) in
        [("interpolation", "Between the given frames"), ("extrapolation", "Beyond the last given frame")]
    {
        if v[key].is_object() {
            let _ = write!(out, "<details><summary>{title}</summary>{}</details>", part(&|m| m[key].clone()));
        }
    }
    out
}

fn compare(v: &Value) -> String {
    let gates = v["gates"].as_array().cloned().unwrap_or_default();
    let rows: Vec<Vec<String>> = v["outputs"]
        .as_object()
        .into_iter()
        .flatten()
        .map(|(key, value)| {
            let gate = gates.iter().find(|g| g["key"] == key.as_str());
            let mark = gate.map_or(String::new(), |g| {
                let (class, word) = if g["pass"] == true { ("pass", "pass") } else { ("fail", "FAIL") };
                format!("<span class=\"{class}\">{word}</span> ({})", scalar(&g["limit"]).unwrap_or_default())
            });
            vec![escape(key), scalar(value).unwrap_or_else(|| "-".into()), mark]
        })
        .collect();
    let mut out = String::new();
    if let Some(pass) = v["pass"].as_bool() {
        let (class, word) = if pass { ("pass", "All gates pass.") } else { ("fail", "A gate fails.") };
        let _ = write!(out, "<p class=\"{class}\">{word}</p>");
    }
    out += &table(&["output", "B against A", "gate"], &rows);
    let list: Vec<(&str, f64, Option<f64>)> = v["stages"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|s| Some((s["name"].as_str()?, s["sqnr_db"].as_f64()?, s["cosine"].as_f64())))
        .collect();
    if list.is_empty() {
        return out;
    }
    // 60 dB is as good as f16 arithmetic gets.
    let mut svg = format!(
        "<h3>Signal to quantization noise by stage, dB</h3><svg viewBox=\"0 0 960 {}\" role=\"img\">",
        18 * list.len()
    );
    for (i, (name, db, cosine)) in list.iter().enumerate() {
        let (y, w) = (18 * i, 580.0 * db.clamp(0.0, 60.0) / 60.0);
        let cosine = cosine.map_or(String::new(), |c| format!(", cosine {c:.5}"));
        let _ = write!(
            svg,
            "<text class=\"strong\" x=\"0\" y=\"{0}\">{1}</text><rect x=\"250\" y=\"{2}\" width=\"{w:.1}\" height=\"11\" fill=\"{3}\"/>\
             <text x=\"{4:.1}\" y=\"{0}\">{db:.1}{cosine}</text>",
            y + 12,
            escape(name),
            y + 3,
            COLOURS[0],
            256.0 + w
        );
    }
    out + &svg + "</svg>"
}

/// Every scalar under its path.
fn flat(v: &Value) -> String {
    fn walk(v: &Value, path: &str, rows: &mut Vec<Vec<String>>) {
        if let Some(text) = scalar(v) {
            rows.push(vec![escape(path), text]);
        }
        let under = |key: &str| if path.is_empty() { key.to_string() } else { format!("{path}.{key}") };
        for (k, inner) in v.as_object().into_iter().flatten() {
            walk(inner, &under(k), rows);
        }
        // The first entries show what a long list holds.
        for (i, inner) in v.as_array().into_iter().flatten().enumerate().take(20) {
            walk(inner, &under(&i.to_string()), rows);
        }
    }
    let mut rows = Vec::new();
    walk(v, "", &mut rows);
    table(&["key", "value"], &rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_bench_shows_its_numbers_and_no_percentile_that_it_cannot_know() {
        let ms: Vec<f64> = (0..40).map(|i| 100.0 + f64::from(i)).collect();
        let v = json!({"schema": "streetforward.bench/1", "results": [
            {"model": "a<b.sfw", "precision": "int8", "threads": 2, "frames": 4, "runs": 40, "p50_ms": 119.5,
             "p90_ms": 135.0, "p99_ms": null, "samples_ms": ms, "deadline_ms": 130.0,
             "stages": [{"name": "encoder", "p50_ms": 70.0}, {"name": "heads", "p50_ms": 49.5}]}]});
        let text = document(&v, "bench.json");
        for part in ["a&lt;b.sfw", "119.5", "encoder", "heads", "p50 119", "p90 135", "deadline 130", "40 samples"] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(!text.contains("p99 ") && !text.contains("a<b"), "{text}");
        // Stages share the line by their times.
        let widths: Vec<f64> = text
            .split("height=\"20\"")
            .zip(text.split("height=\"20\"").skip(1))
            .filter_map(|(before, _)| before.rsplit("width=\"").next()?.trim_end_matches(['"', ' ']).parse().ok())
            .collect();
        assert!((widths[0] / widths[1] - 70.0 / 49.5).abs() < 0.01, "{widths:?}");
    }

    #[test]
    fn peers_stand_side_by_side_and_those_that_cannot_say_why() {
        let v = json!({"schema": "streetforward.peers/1", "network": "nano", "frames": 4, "width": 252, "height": 168,
            "threads": 2, "machine": {"cpu": "C", "date": "D"}, "results": [
                {"runtime": "StreetForward", "precision": "int8", "note": "", "median_ms": 50.0, "times_ours": 1.0,
                 "round_low_ms": 49.0, "round_high_ms": 51.0, "cold_start_s": 0.1, "peak_rss_bytes": 1 << 25,
                 "error": {"depth_absrel": 0.0021}},
                {"runtime": "O<", "precision": "f32", "note": "n", "median_ms": 125.0, "times_ours": 2.5, "error": null},
                {"runtime": "O<", "precision": "bf16", "note": "hint", "failure": "no such instructions"}]});
        let text = document(&v, "p");
        for part in
            ["StreetForward int8", "O&lt; f32 (n)", "2.5", "2.10e-3", "32.00", "bf16 (hint): no such instructions"]
        {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(!text.contains("O<"), "{text}");
    }

    #[test]
    fn tables_of_accuracy_gates_and_unknown_documents() {
        let v = json!({"schema": "streetforward.eval/1", "clips": 1, "psnr_full_db": 24.25, "velocity_epe": null,
            "interpolation": {"psnr_full_db": 25.5}, "ablations": {"static_only": {"psnr_full_db": 20.125}}});
        let text = document(&v, "e");
        for part in ["psnr_full_db", "24.25", "20.12", "static only", "Between the given", "25.50"] {
            assert!(text.contains(part), "{part}: {text}");
        }
        let v = json!({"schema": "streetforward.compare/1", "outputs": {"depth_absrel": 0.0125, "render_psnr_db": 40.0},
            "gates": [{"key": "depth_absrel", "limit": 0.01, "pass": false}], "pass": false,
            "stages": [{"name": "decoder.0", "cosine": 0.9999, "sqnr_db": 37.25}]});
        let text = document(&v, "c");
        for part in ["FAIL", "A gate fails", "0.0125", "decoder.0", "37.2"] {
            assert!(text.contains(part), "{part}: {text}");
        }
        let text = document(&json!({"schema": "other/9", "a": {"b": [1, "<x>"]}}), "o");
        assert!(text.contains("a.b.0") && text.contains("&lt;x&gt;"), "{text}");
        assert_eq!([0.0, 1234.5, 5.25, 0.002].map(short), ["0", "1234", "5.25", "2.00e-3"]);
    }
}
