//! How cost grows with the clip: time and memory of a benchmark's rows against their operations and pixels, on logarithmic
//! axes, as inline SVG.

use crate::report::{COLOURS, escape, short};
use serde_json::Value;
use std::fmt::Write;

/// Rows of one network and thread count are a series; a series of fewer points shows no growth.
const FEWEST: usize = 3;

/// A row as a point.
struct Point {
    x: f64,
    y: f64,
    label: String,
}

struct Series {
    name: String,
    points: Vec<Point>,
}

/// What a chart shows.
struct Chart {
    title: &'static str,
    x: (&'static str, fn(&Value) -> Option<f64>),
    y: (&'static str, fn(&Value) -> Option<f64>),
}

const CHARTS: [Chart; 2] = [
    Chart {
        title: "Time against operations; dashed: time in proportion, through the first point",
        x: ("billion operations", |r| r["gop"].as_f64()),
        y: ("ms, median", |r| r["p50_ms"].as_f64()),
    },
    Chart {
        title: "Working memory and results against pixels",
        x: ("million pixels of the clip", |r| {
            Some(r["frames"].as_f64()? * r["width"].as_f64()? * r["height"].as_f64()? / 1e6)
        }),
        y: ("MiB", |r| Some((r["arena_bytes"].as_f64()? + r["output_bytes"].as_f64()?) / f64::from(1 << 20))),
    },
];

/// Both charts of a benchmark's results; nothing when no series is long enough.
pub(crate) fn charts(results: &[&Value]) -> String {
    CHARTS.iter().map(|c| draw(c, &series(results, c))).collect()
}

fn series(results: &[&Value], chart: &Chart) -> Vec<Series> {
    let mut list: Vec<Series> = Vec::new();
    for r in results {
        let text = |key: &str| r[key].as_str().unwrap_or_default();
        let model = if text("preset").is_empty() { text("model") } else { text("preset") };
        let name = format!("{model} {} {} threads", text("precision"), r["threads"]);
        let (Some(x), Some(y)) = ((chart.x.1)(r), (chart.y.1)(r)) else { continue };
        if x <= 0.0 || y <= 0.0 {
            continue;
        }
        let point = Point { x, y, label: format!("{} x {}x{}", r["frames"], r["width"], r["height"]) };
        match list.iter_mut().find(|s| s.name == name) {
            Some(s) => s.points.push(point),
            None => list.push(Series { name, points: vec![point] }),
        }
    }
    list.retain(|s| s.points.len() >= FEWEST);
    list.iter_mut().for_each(|s| s.points.sort_by(|a, b| a.x.total_cmp(&b.x)));
    list
}

/// 1, 2, 5, 10, 20, ... inside a range.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let decades = low.log10().floor() as i32..=high.log10().ceil() as i32;
    let all = decades.flat_map(|d| [1.0, 2.0, 5.0].map(|m| m * 10f64.powi(d)));
    all.filter(|t| (low..=high).contains(t)).collect()
}

fn draw(chart: &Chart, list: &[Series]) -> String {
    if list.is_empty() {
        return String::new();
    }
    let range = |of: fn(&Point) -> f64| {
        let all = || list.iter().flat_map(|s| &s.points).map(of);
        (all().fold(f64::MAX, f64::min) / 1.2, all().fold(0.0, f64::max) * 1.2)
    };
    let (xs, mut ys) = (range(|p| p.x), range(|p| p.y));
    let in_proportion = chart.y.0.starts_with("ms");
    // Where the line of time in proportion ends.
    let end = |s: &Series| s.points[0].y * s.points[s.points.len() - 1].x / s.points[0].x;
    if in_proportion {
        ys.1 = list.iter().map(end).fold(ys.1, f64::max);
    }
    let place = |v: f64, (low, high): (f64, f64)| (v / low).ln() / (high / low).ln();
    let (at_x, at_y) = (|v: f64| 60.0 + 860.0 * place(v, xs), |v: f64| 330.0 - 310.0 * place(v, ys));
    let mut svg = format!("<h3>{}</h3><svg viewBox=\"0 0 960 372\" role=\"img\">", escape(chart.title));
    for t in ticks(xs.0, xs.1) {
        let x = at_x(t);
        let _ = write!(
            svg,
            "<line class=\"axis\" x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"20\" y2=\"330\"/>\
             <text x=\"{x:.1}\" y=\"346\" text-anchor=\"middle\">{}</text>",
            short(t)
        );
    }
    for t in ticks(ys.0, ys.1) {
        let y = at_y(t);
        let _ = write!(
            svg,
            "<line class=\"axis\" x1=\"60\" x2=\"920\" y1=\"{y:.1}\" y2=\"{y:.1}\"/>\
             <text x=\"54\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            y + 4.0,
            short(t)
        );
    }
    let _ = write!(
        svg,
        "<text x=\"920\" y=\"364\" text-anchor=\"end\">{}</text><text x=\"60\" y=\"12\">{}</text>",
        chart.x.0, chart.y.0
    );
    for (i, s) in list.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let (first, last) = (&s.points[0], &s.points[s.points.len() - 1]);
        if in_proportion {
            let _ = write!(
                svg,
                "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"{colour}\" stroke-dasharray=\"4 4\" opacity=\".6\"/>",
                at_x(first.x),
                at_y(first.y),
                at_x(last.x),
                at_y(end(s))
            );
        }
        for p in &s.points {
            let _ = write!(
                svg,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"4\" fill=\"{colour}\"><title>{}: {} at {}</title></circle>",
                at_x(p.x),
                at_y(p.y),
                escape(&p.label),
                short(p.y),
                short(p.x)
            );
        }
    }
    svg.push_str("</svg><ul class=\"legend\">");
    for (i, s) in list.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let _ = write!(svg, "<li><i style=\"background:{colour}\"></i>{}</li>", escape(&s.name));
    }
    svg + "</ul>"
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn row(frames: u32, gop: f64, ms: f64) -> Value {
        json!({"preset": "na<no", "precision": "int8", "threads": 2, "frames": frames, "width": 252, "height": 168,
               "gop": gop, "p50_ms": ms, "arena_bytes": 1 << 20, "output_bytes": 1 << 20})
    }

    #[test]
    fn three_sizes_are_a_chart_and_two_are_not() {
        let rows = [row(4, 20.0, 200.0), row(1, 5.0, 50.0), row(2, 10.0, 100.0)];
        let two: Vec<&Value> = rows[..2].iter().collect();
        assert_eq!(charts(&two), "");
        let all: Vec<&Value> = rows.iter().collect();
        let text = charts(&all);
        assert_eq!(text.matches("<circle").count(), 6);
        assert!(text.contains("na&lt;no int8 2 threads") && !text.contains("na<no"), "{text}");
        // In proportion: the points lie on the dashed line, which ends where the largest point is.
        let points = &series(&all, &CHARTS[0])[0].points;
        assert_eq!(points.iter().map(|p| p.x).collect::<Vec<_>>(), [5.0, 10.0, 20.0]);
        let circle = text.split("<circle cx=\"").nth(3).unwrap().split('"').next().unwrap();
        let dashed = text.split("x2=\"").find(|p| p.contains("stroke-dasharray")).unwrap().split('"').next().unwrap();
        assert_eq!(circle, dashed);
    }

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.9, 21.0), [1.0, 2.0, 5.0, 10.0, 20.0]);
        assert_eq!(ticks(3.0, 4.0), [0.0; 0]);
    }
}
