//! `bench` and `plan`: every key, every flag's error, the baseline gate, deadlines, equal results.

mod common;

use common::{error_line, fails, ok, ok_json, run, tiny_blob};
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};

fn s(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A folder with `tiny.sfw`.
fn workplace() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("tiny.sfw");
    fs::write(&model, tiny_blob()).unwrap();
    (dir, model)
}

fn number(v: &Value) -> f64 {
    v.as_f64().unwrap_or_else(|| panic!("{v} is not a number"))
}

#[test]
fn every_key_is_there_and_the_rows_add_up() {
    let (dir, model) = workplace();
    let samples = dir.path().join("runs.csv");
    let json = ok_json(&[
        "bench",
        "-m",
        s(&model),
        "--size",
        "28x42,42x28",
        "--threads",
        "1,2",
        "--frames",
        "3",
        "--runs",
        "12",
        "--warmup",
        "2",
        "--percentiles",
        "50,95,99.9",
        "--profile-ops",
        "--samples",
        s(&samples),
        "--quiet",
    ]);
    for key in ["cpu", "governor", "mhz_before", "mhz_after", "load_average_before", "allowed_threads"] {
        assert!(json["machine"].get(key).is_some(), "machine.{key}");
    }
    let results = json["results"].as_array().unwrap();
    assert_eq!(results.len(), 4);
    for r in results {
        let keys = [
            "model",
            "preset",
            "precision",
            "isa",
            "threads",
            "frames",
            "width",
            "height",
            "runs",
            "p50_ms",
            "p90_ms",
            "p99_ms",
            "min_ms",
            "max_ms",
            "load_ms",
            "first_ms",
            "arena_bytes",
            "weights_bytes",
            "peak_rss_bytes",
            "gop",
            "gops_per_s",
            "stages",
            "mean_ms",
            "std_ms",
            "p50_low_ms",
            "p50_high_ms",
            "session_ms",
            "kernels",
            "peak_fraction",
            "samples_ns",
            "output_digest",
            "warmup_runs",
            "jitter_ms",
        ];
        for key in keys {
            assert!(r.get(key).is_some(), "{key}");
        }
        assert_eq!((&r["runs"], &r["precision"], &r["warmup_runs"]), (&json!(12), &json!("f32"), &json!(2)));
        // Twelve runs tell p90 and not more.
        assert!(number(&r["p90_ms"]) >= number(&r["p50_ms"]));
        for unknown in ["p95_ms", "p99_ms", "p99_9_ms", "jitter_ms"] {
            assert_eq!(r[unknown], Value::Null, "{unknown}");
        }
        let p50 = number(&r["p50_ms"]);
        assert!(number(&r["min_ms"]) <= p50 && p50 <= number(&r["max_ms"]));
        assert!(number(&r["p50_low_ms"]) <= p50 && p50 <= number(&r["p50_high_ms"]));
        assert!((number(&r["gops_per_s"]) - number(&r["gop"]) / p50 * 1e3).abs() < 1e-9 * number(&r["gops_per_s"]));
        let stages = r["stages"].as_array().unwrap();
        assert_eq!(stages.last().unwrap()["name"], "other");
        let sum = |key: &str| stages.iter().map(|s| number(&s[key])).sum::<f64>();
        assert!((sum("p50_ms") - p50).abs() < 1e-9, "stages and the total");
        assert!((sum("gop") - number(&r["gop"])).abs() < 1e-9);
        // A run of its own: kinds of operations and what is outside of them make its time.
        let ops = r["ops"].as_array().unwrap();
        let inside: f64 = ops.iter().map(|o| number(&o["ms"])).sum();
        assert!((inside / number(&r["profile_total_ms"]) - 1.0).abs() < 1e-9);
        assert_eq!(ops.last().unwrap()["name"], "outside ops");
        let gop: f64 = ops.iter().map(|o| number(&o["gop"])).sum();
        assert!((gop / number(&r["gop"]) - 1.0).abs() < 1e-9, "the profile counts what was planned");
        let gemm = ops.iter().find(|o| o["name"] == "gemm").unwrap();
        assert!(
            number(&gemm["calls"]) > 10.0 && number(&gemm["gops_per_s"]) > 0.0 && number(&gemm["gbytes_per_s"]) > 0.0
        );
    }
    // One and two threads: the same bits; another size: others.
    assert_eq!(results[0]["output_digest"], results[1]["output_digest"]);
    assert_ne!(results[0]["output_digest"], results[2]["output_digest"]);
    let text = fs::read_to_string(&samples).unwrap();
    assert_eq!(text.lines().count(), 1 + 4 * 12);
    assert!(text.starts_with("model,precision,isa,threads,frames,width,height,run,run_ns,response_ns\n"));
    let cells: Vec<&str> = text.lines().nth(1).unwrap().split(',').collect();
    assert_eq!((cells.len(), cells[1], cells[7]), (10, "f32", "1"));
    assert!(cells[8].parse::<u64>().unwrap() > 0);
}

#[test]
fn random_networks_of_every_precision_and_instruction_set() {
    let args = ["bench", "--preset", "nano", "--heads", "linear", "--frames", "2", "--size", "56x42", "--quiet"];
    let more = ["--runs", "1", "--warmup", "0", "--precision", "f32,f16,int8", "--threads", "2"];
    let best = ok_json(&["doctor"])["kernels"]["isa"].as_str().unwrap().to_string();
    let isa = if best == "scalar" { best } else { format!("scalar,{best}") };
    let json = ok_json(&[&args[..], &more, &["--isa", &isa]].concat());
    let results = json["results"].as_array().unwrap();
    let per_precision = results.len() / 3;
    for (rows, name) in results.chunks(per_precision).zip(["f32", "f16", "int8"]) {
        for r in rows {
            assert_eq!(
                (&r["precision"], &r["preset"], &r["model"]),
                (&json!(name), &json!("nano-linear"), &Value::Null)
            );
            // Equal on every instruction set: the command would have failed otherwise.
            assert_eq!(r["output_digest"], rows[0]["output_digest"]);
        }
    }
    assert!(number(&results[0]["weights_bytes"]) > 1.7 * number(&results[per_precision]["weights_bytes"]));
    assert_eq!(number(&results[0]["int8_fraction"]), 0.0);
    assert!(number(&results[2 * per_precision]["int8_fraction"]) > 0.5);
}

#[test]
fn reports_in_every_format() {
    let (dir, model) = workplace();
    let at = |name: &str| dir.path().join(name);
    let base = ["bench", "-m", s(&model), "--size", "28x42", "--frames", "2", "--runs", "2", "--warmup", "1", "-q"];
    let files = format!("md,{},{}", s(&at("a.json")), s(&at("a.csv")));
    let text = ok(&[&base[..], &["-o", &files]].concat());
    assert!(text.starts_with("| model") && text.contains("tiny.sfw") && text.contains("n/a"), "{text}");
    assert!(text.contains("p99 needs 100 runs (fewest here: 2)"), "{text}");
    assert!(text.contains("| other") && text.contains("| total"), "{text}");
    let json: Value = serde_json::from_slice(&fs::read(at("a.json")).unwrap()).unwrap();
    assert_eq!(json["schema"], "streetforward.bench/1");
    let csv = fs::read_to_string(at("a.csv")).unwrap();
    let lines: Vec<Vec<&str>> = csv.lines().map(|l| l.split(',').collect()).collect();
    assert_eq!(lines.len(), 2);
    assert_eq!(lines[0].len(), lines[1].len());
    assert!(lines[0].contains(&"p50_ms") && lines[0].contains(&"motion_p50_ms"));
    // Existing files stay.
    assert!(fails(6, &[&base[..], &["-o", s(&at("a.json"))]].concat()).contains("--force"));
    ok(&[&base[..], &["-o", s(&at("a.json")), "--force"]].concat());
    assert!(fails(2, &[&base[..], &["-o", "md,csv"]].concat()).contains("standard output"));
    assert!(fails(2, &[&base[..], &["-o", "md", "--json"]].concat()).contains("standard output"));
}

#[test]
fn a_slower_median_fails_and_a_rerun_does_not() {
    let (dir, model) = workplace();
    let report = dir.path().join("old.json");
    let base = ["bench", "-m", s(&model), "--size", "28x42", "--frames", "2", "--runs", "20", "-q", "--threads", "1"];
    ok(&[&base[..], &["-o", s(&report)]].concat());
    let old: Value = serde_json::from_slice(&fs::read(&report).unwrap()).unwrap();
    let against = |file: &Path, allow: &str| run(&[&base[..], &["--baseline", s(file), "--fail-over", allow]].concat());
    let r = against(&report, "5000%");
    assert_eq!(r.code, 0, "{}", r.stderr);
    assert!(r.stdout.contains("against ") && r.stdout.contains("p50 "), "{}", r.stdout);
    // As if everything had been a thousand times as fast before: a loaded machine may make ten of itself.
    let mut faster = old.clone();
    for key in ["p50_ms", "p50_low_ms", "p50_high_ms", "min_ms", "max_ms"] {
        faster["results"][0][key] = json!(number(&old["results"][0][key]) / 1000.0);
    }
    let doctored = dir.path().join("faster.json");
    fs::write(&doctored, faster.to_string()).unwrap();
    let r = against(&doctored, "10%");
    assert_eq!(r.code, 1, "{}", r.stderr);
    assert!(r.stdout.contains("SLOWER"), "the report comes all the same: {}", r.stdout);
    let line = error_line(&r.stderr);
    assert!(line.contains("1 of 1 rows are slower") && line.contains("f32"), "{line}");
    // What is no baseline.
    let broken = dir.path().join("broken.json");
    let with = |text: &str| {
        fs::write(&broken, text).unwrap();
        fails(3, &[&base[..], &["--baseline", s(&broken)]].concat())
    };
    assert!(with("{").contains("not a bench report"));
    assert!(with("{\"schema\": \"streetforward.run/1\"}").contains("schema"));
    assert!(with("{\"schema\": \"streetforward.bench/1\"}").contains("results"));
    assert!(with("{\"schema\": \"streetforward.bench/1\", \"results\": [{\"p50_ms\": -1}]}").contains("results[0]"));
    let mut other = old;
    other["results"][0]["threads"] = json!(7);
    assert!(with(&other.to_string()).contains("none of its rows"));
    fails(6, &[&base[..], &["--baseline", "/nonexistent.json"]].concat());
}

#[test]
fn deadlines_and_paces() {
    let (_dir, model) = workplace();
    let base = ["bench", "-m", s(&model), "--size", "28x42", "--frames", "2", "--runs", "5", "--warmup", "1", "-q"];
    let r = run(&[&base[..], &["--deadline-ms", "0.0001"]].concat());
    assert_eq!(r.code, 1);
    assert!(r.stdout.contains("5 misses"), "{}", r.stdout);
    assert!(error_line(&r.stderr).contains("5 misses of the 0.0001 ms deadline"));
    let json = ok_json(&[&base[..], &["--period-ms", "300", "--deadline-ms", "100000"]].concat());
    let r = &json["results"][0];
    assert_eq!((&r["period_ms"], &r["deadline_misses"]), (&json!(300.0), &r["skipped"]));
    assert!(number(&r["arrivals"]) >= 5.0);
    assert!(number(&r["response_max_ms"]) >= number(&r["response_p50_ms"]));
    // Four waits of some 300 ms each: parked threads take no processor time.
    if let Some(share) = r["idle_cpu_share"].as_f64() {
        assert!(share < 0.5, "{share} of a core while idle");
    }
}

#[test]
fn time_bounds_the_runs() {
    let (_dir, model) = workplace();
    let base = ["bench", "-m", s(&model), "--size", "28x42", "--frames", "2", "-q", "--max-secs", "1"];
    let json = ok_json(&[&base[..], &["--threads", "1,2"]].concat());
    for r in json["results"].as_array().unwrap() {
        assert!(number(&r["runs"]) >= 1.0);
        let spent = number(&r["runs"]) * number(&r["mean_ms"]);
        assert!(spent < 1000.0 + number(&r["max_ms"]), "{spent} ms");
    }
    let json = ok_json(&[&base[..], &["--runs", "1"]].concat());
    assert_eq!(json["results"][0]["runs"], 1);
}

#[test]
fn wrong_flags_of_bench() {
    let (_dir, model) = workplace();
    for bad in [
        &["--runs", "0"][..],
        &["--runs", "x"],
        &["--max-secs", "0"],
        &["--max-secs", "nan"],
        &["--warmup", "soon"],
        &["--percentiles", "100"],
        &["--percentiles", "50,x"],
        &["--period-ms", "-1"],
        &["--deadline-ms", "0"],
        &["--threads", "65"],
        &["--threads", "1,,2"],
        &["--frames", "0"],
        &["--size", "28"],
        &["--isa", "mmx"],
        &["--precision", "int2"],
        &["--preset", "huge"],
        &["--heads", "none"],
        &["-o", "x.txt"],
        &["--fail-over", "-5%"],
        &["--max-mem", "lots"],
        &["--load", "fly"],
        &["--baseline"],
    ] {
        fails(2, &[&["bench"], bad].concat());
    }
    fails(2, &["bench", "-m", s(&model), "--preset", "nano"]);
    assert!(fails(2, &["bench", "-m", s(&model), "--precision", "f16", "-q"]).contains("blob of f32"));
    assert!(fails(3, &["bench", "-m", s(&model), "--size", "29x28", "-q"]).contains("multiple of 14"));
    assert!(fails(5, &["bench", "-m", s(&model), "--max-mem", "1K", "-q"]).contains("budget"));
    fails(6, &["bench", "-m", "/nonexistent.sfw", "-q"]);
    fails(6, &["bench", "-m", s(&model), "--size", "28x42", "--runs", "1", "--samples", "/nonexistent/x.csv", "-q"]);
    let foreign = if cfg!(target_arch = "x86_64") { "neon" } else { "avx2" };
    fails(7, &["bench", "-m", s(&model), "--isa", foreign, "-q"]);
}

#[test]
fn a_plan_adds_up() {
    let (_dir, model) = workplace();
    let args = ["plan", "-m", s(&model), "--frames", "3", "--size", "56x42", "--threads", "2", "-q"];
    let json = ok_json(&args);
    let n = |key: &str| number(&json[key]);
    for key in ["parameters", "weights_bytes", "free_bytes", "peak_f32_gops_per_s", "peak_s8_gops_per_s", "isa"] {
        assert!(!json[key].is_null(), "{key}");
    }
    assert_eq!((&json["fits_max_mem"], &json["fits_memory"]), (&json!(true), &json!(true)));
    let parts = ["weights", "arena", "threads", "tables", "output", "input", "process"];
    let network: f64 = parts.iter().map(|part| n(&format!("{part}_bytes"))).sum();
    assert_eq!(n("network_peak_bytes"), network);
    assert_eq!(n("peak_bytes"), network + n("scene_bytes"));
    let pixels = 3.0 * 56.0 * 42.0;
    assert_eq!((n("input_bytes"), n("scene_bytes")), (3.0 * pixels, 88.0 * pixels));
    let sum = |list: &Value, key: &str| list.as_array().unwrap().iter().map(|s| number(&s[key])).sum::<f64>();
    assert!((sum(&json["stages"], "gop") / n("gop") - 1.0).abs() < 1e-12);
    // Areas start on lines of 64 bytes.
    let areas = sum(&json["arena"], "bytes");
    assert!(areas <= n("arena_bytes") && n("arena_bytes") < areas + 5.0 * 64.0);
    let (fast, slow) = (number(&json["estimate_s"][0]), number(&json["estimate_s"][1]));
    assert!(0.0 < fast && fast < slow);
    // What bench runs is what was planned.
    let bench =
        ok_json(&["bench", "-m", s(&model), "--frames", "3", "--size", "56x42", "--threads", "2", "--runs", "1", "-q"]);
    for key in ["gop", "arena_bytes", "output_bytes", "weights_bytes"] {
        assert_eq!(bench["results"][0][key], json[key], "{key}");
    }
    let text = ok(&args);
    for part in ["tokens", "arena", "network", "peak", "fits", "motion", "an estimate"] {
        assert!(text.contains(part), "{part} in {text}");
    }
}

/// The planned peak of a whole process is what the system sees.
#[test]
fn the_planned_peak_is_what_is_held() {
    let shape = ["--preset", "nano", "--frames", "4", "--size", "252x168", "--threads", "2", "-q"];
    let plan = ok_json(&[&["plan"], &shape[..]].concat());
    let bench = ok_json(&[&["bench", "--runs", "1", "--warmup", "0"], &shape[..]].concat());
    let (planned, held) = (number(&plan["network_peak_bytes"]), number(&bench["results"][0]["peak_rss_bytes"]));
    assert!((held / planned - 1.0).abs() < 0.05, "{held} bytes held, {planned} planned");
}

#[test]
fn plans_that_do_not_fit_are_told_and_fail() {
    let (_dir, model) = workplace();
    let r = run(&["plan", "-m", s(&model), "--size", "56x42", "--max-mem", "10K", "-q"]);
    assert_eq!(r.code, 5);
    assert!(r.stdout.contains("DOES NOT FIT"), "{}", r.stdout);
    assert!(error_line(&r.stderr).contains("the budget is 10.0 KiB"), "{}", r.stderr);
    for bad in [
        &["--frames", "x"][..],
        &["--frames", "0"],
        &["--size", "56"],
        &["--threads", "65"],
        &["--precision", "int2"],
        &["--preset", "nano"],
        &["--isa", "mmx"],
        &["--max-mem", "lots"],
    ] {
        fails(2, &[&["plan", "-m", s(&model), "-q"], bad].concat());
    }
    fails(3, &["plan", "-m", s(&model), "--size", "57x42", "-q"]);
    fails(5, &["plan", "-m", s(&model), "--frames", "5000", "-q"]);
    fails(6, &["plan", "-m", "/nonexistent.sfw", "-q"]);
}

/// Steps of one new frame are timed beside runs of the whole window; that they have the same bits is checked by the command.
#[test]
fn pushes_are_timed_beside_the_whole_window() {
    let (_dir, model) = workplace();
    let args = ["bench", "-m", s(&model), "--size", "28x42", "--frames", "3", "--runs", "4", "--warmup", "1", "-q"];
    let json = ok_json(&[&args[..], &["--push"]].concat());
    let row = &json["results"][0];
    assert_eq!(row["push_runs"], 4);
    assert!(number(&row["push_p50_ms"]) > 0.0 && number(&row["push_whole_p50_ms"]) > 0.0);
    assert!(number(&row["push_newest_p50_ms"]) > 0.0);
    assert!(ok_json(&args)["results"][0].get("push_runs").is_none());
    assert!(ok(&[&args[..], &["--push"]].concat()).contains("one new frame a step"));
    fails(2, &[&args[..], &["--push", "--period-ms", "10"]].concat());
}
