//! `stream`: a folder that fills while it is watched, video through a pipe, and what is wrong with either.

mod common;

use common::{command, error_line, fails, files, ok, ran, run, tiny_blob};
use serde_json::Value;
use sf_formats::atomic::Overwrite;
use sf_formats::image_io::{self, Rgb8};
use sf_formats::npy;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

fn s(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A picture, gray so that it survives the way through video unchanged.
fn gray(w: u32, h: u32, shade: usize) -> Vec<u8> {
    (0..(w * h) as usize).map(|i| ((i * 7 + shade * 31) % 251) as u8).collect()
}

fn picture(path: &Path, w: u32, h: u32, shade: usize) {
    let data = gray(w, h, shade).into_iter().flat_map(|v| [v; 3]).collect();
    image_io::write_png(path, &Rgb8::new(w, h, data), Overwrite::Yes).unwrap();
}

/// A folder with `tiny.sfw` and an empty folder `in`.
fn workplace() -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let (model, folder) = (dir.path().join("tiny.sfw"), dir.path().join("in"));
    fs::write(&model, tiny_blob()).unwrap();
    fs::create_dir(&folder).unwrap();
    (dir, model, folder)
}

fn lines(text: &str) -> Vec<Value> {
    text.lines().map(|l| serde_json::from_str(l).unwrap_or_else(|e| panic!("{e} in {l}"))).collect()
}

/// Frames as YUV4MPEG2, full range, 4:4:4.
fn video(frames: usize, w: u32, h: u32) -> Vec<u8> {
    let mut bytes = format!("YUV4MPEG2 W{w} H{h} F20:1 Ip C444 XCOLORRANGE=FULL\n").into_bytes();
    for f in 0..frames {
        bytes.extend(b"FRAME\n");
        bytes.extend(gray(w, h, f));
        bytes.extend(vec![128; 2 * (w * h) as usize]);
    }
    bytes
}

/// Runs `stream -i -` on these bytes.
fn piped(bytes: Vec<u8>, args: &[&str]) -> common::Ran {
    let mut child = command(&[&["stream", "-i", "-"], args].concat())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut pipe = child.stdin.take().unwrap();
    // A stream that is refused is no longer read: a broken pipe here is right.
    let writer = std::thread::spawn(move || drop(pipe.write_all(&bytes)));
    let out = child.wait_with_output().unwrap();
    writer.join().unwrap();
    ran(out)
}

#[test]
fn a_folder_that_fills_gives_the_results_of_its_windows() {
    let (dir, model, folder) = workplace();
    let out = dir.path().join("out");
    // Two are there already, in natural order 2 before 10.
    picture(&folder.join("2.png"), 56, 42, 0);
    picture(&folder.join("10.png"), 56, 42, 1);
    fs::write(folder.join("notes.txt"), "not a picture").unwrap();
    let args = ["stream", "--watch", s(&folder), "-m", s(&model), "--frames", "3", "--fps", "4", "--until-idle", "8"];
    let more = ["-o", s(&out), "--emit", "depth,scene", "--scene-every", "2", "-q"];
    let child = command(&[&args[..], &more].concat()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let feeder = {
        let (folder, staging) = (folder.clone(), dir.path().to_path_buf());
        std::thread::spawn(move || {
            let pause = || std::thread::sleep(Duration::from_millis(200));
            // Renamed into place.
            picture(&staging.join("next.png"), 56, 42, 2);
            fs::rename(staging.join("next.png"), folder.join("11.png")).unwrap();
            pause();
            // Growing where it is.
            picture(&staging.join("slow.png"), 56, 42, 3);
            let bytes = fs::read(staging.join("slow.png")).unwrap();
            let mut file = fs::File::create(folder.join("100.png")).unwrap();
            file.write_all(&bytes[..bytes.len() / 2]).unwrap();
            file.flush().unwrap();
            pause();
            file.write_all(&bytes[bytes.len() / 2..]).unwrap();
            drop(file);
            pause();
            picture(&staging.join("last.png"), 56, 42, 4);
            fs::rename(staging.join("last.png"), folder.join("101.png")).unwrap();
        })
    };
    feeder.join().unwrap();
    let r = ran(child.wait_with_output().unwrap());
    assert_eq!(r.code, 0, "{}", r.stderr);
    let steps = lines(&r.stdout);
    let names: Vec<&str> = steps.iter().map(|l| l["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["11.png", "100.png", "101.png"]);
    for (i, line) in steps.iter().enumerate() {
        assert_eq!(line["schema"], "streetforward.stream/1");
        assert_eq!((line["step"].as_u64(), line["frame"].as_u64()), (Some(i as u64), Some(i as u64 + 2)));
        assert_eq!(line["time_s"].as_f64(), Some((i + 2) as f64 / 4.0));
        assert_eq!((line["poses"].as_array().unwrap().len(), &line["poses"][2]), (3, &line["pose"]));
        assert_eq!((line["width"].as_u64(), line["height"].as_u64()), (Some(56), Some(42)));
        assert!(line["latency_ms"].as_f64().unwrap() >= line["run_ms"].as_f64().unwrap());
        assert_eq!((&line["deadline_missed"], line["skipped"].as_u64()), (&Value::Bool(false), Some(0)));
    }
    // The last window, as `run` sees it.
    let batch = dir.path().join("batch");
    let times = ["--times", "0.5,0.75,1"];
    let clip = ["run", "-m", s(&model), "-i", s(&folder), "-o", s(&batch), "--frames", "2,3,4", "-q"];
    ok(&[&clip[..], &times, &["--emit", "scene,depth,poses"]].concat());
    let npy::Array { shape, values: npy::Values::F64(poses) } = npy::read(&batch.join("poses.npy")).unwrap() else {
        panic!("poses are f64");
    };
    assert_eq!(shape, [3, 4, 4]);
    let list = |v: &Value| v.as_array().unwrap().clone();
    let streamed: Vec<f64> = list(&steps[2]["poses"])
        .iter()
        .flat_map(list)
        .flat_map(|row| list(&row))
        .map(|v| v.as_f64().unwrap())
        .collect();
    assert_eq!(streamed, poses, "the same bits as a run on the window");
    let read = |p: PathBuf| fs::read(&p).unwrap_or_else(|e| panic!("{e}: {}", p.display()));
    assert_eq!(read(out.join("depth/000004.png")), read(batch.join("depth/000002.png")));
    assert_eq!(read(out.join("scene-000004/scene.ply")), read(batch.join("scene.ply")));
    // A scene for steps 0 and 2.
    let all: Vec<String> = files(&out).iter().map(|f| s(f).to_string()).collect();
    assert!(all.iter().any(|f| f.starts_with("scene-000002/")) && !all.iter().any(|f| f.starts_with("scene-000003")));
    assert_eq!(all.iter().filter(|f| f.starts_with("depth/")).count(), 3);
    assert!(steps[2]["files"].as_array().unwrap().iter().any(|f| f == "depth/000004.png"));
}

#[test]
fn the_newest_picture_may_be_all_that_counts() {
    let (_dir, model, folder) = workplace();
    for i in 0..5 {
        picture(&folder.join(format!("{i}.png")), 28, 42, i);
    }
    let args = ["stream", "--watch", s(&folder), "-m", s(&model), "--frames", "1", "--until-idle", "0.2", "-q"];
    let steps = lines(&ok(&[&args[..], &["--latest"]].concat()));
    assert_eq!(steps.len(), 1);
    assert_eq!((steps[0]["name"].as_str(), steps[0]["skipped"].as_u64()), (Some("4.png"), Some(4)));
    assert_eq!((steps[0]["frame"].as_u64(), &steps[0]["no_motion"]), (Some(4), &Value::Bool(true)));
    assert_eq!(lines(&ok(&args)).len(), 5);
}

#[test]
fn video_through_a_pipe() {
    let (dir, model, folder) = workplace();
    let r = piped(video(4, 56, 42), &["-m", s(&model), "--frames", "3"]);
    assert_eq!(r.code, 0, "{}", r.stderr);
    assert!(r.stderr.contains("2 steps, latency p50"), "{}", r.stderr);
    let steps = lines(&r.stdout);
    assert_eq!(steps.len(), 2);
    assert_eq!(steps[1]["time_s"].as_f64(), Some(3.0 / 20.0), "the video's own rate");
    // The same pictures from a folder.
    for i in 0..4 {
        picture(&folder.join(format!("{i}.png")), 56, 42, i);
    }
    let args = ["stream", "--watch", s(&folder), "-m", s(&model), "--frames", "3", "--fps", "20", "-q"];
    let watched = lines(&ok(&[&args[..], &["--until-idle", "0.2"]].concat()));
    for key in ["pose", "poses", "intrinsics", "times_s"] {
        assert_eq!(steps[1][key], watched[1][key], "{key}");
    }
    // From a file, and with another rate.
    let file = dir.path().join("v.y4m");
    fs::write(&file, video(3, 56, 42)).unwrap();
    let steps = lines(&ok(&["stream", "-i", s(&file), "-m", s(&model), "--frames", "3", "--fps", "10", "-q"]));
    assert_eq!(steps[0]["times_s"], serde_json::json!([0.0, 0.1, 0.2]));
}

#[test]
fn a_late_step_fails_at_the_end() {
    let (_dir, model, _) = workplace();
    let r = piped(video(3, 56, 42), &["-m", s(&model), "--frames", "2", "--deadline-ms", "0.001", "-q"]);
    assert_eq!(r.code, 1);
    let steps = lines(&r.stdout);
    assert!(steps.len() == 2 && steps.iter().all(|l| l["deadline_missed"] == true));
    assert!(error_line(&r.stderr).contains("2 of 2 steps missed the deadline of 0.001 ms"));
}

#[test]
fn damaged_video_is_named() {
    let (_dir, model, _) = workplace();
    let m = s(&model);
    let whole = video(2, 56, 42);
    let r = piped(whole[..whole.len() - 7].to_vec(), &["-m", m, "--frames", "1", "-q"]);
    assert_eq!((r.code, lines(&r.stdout).len()), (3, 1), "the first frame's result is out already");
    assert!(error_line(&r.stderr).contains("standard input: frame 1: is cut off"), "{}", r.stderr);
    for (bytes, code, why) in [
        (&b""[..], 3, "is empty"),
        (b"RIFFxxxx\n", 3, "YUV4MPEG2"),
        (b"YUV4MPEG2 W56 H42 F25:1 It C420jpeg\n", 7, "interlaced"),
        (b"YUV4MPEG2 W56 H42 C422\n", 7, "C422"),
        (b"YUV4MPEG2 W56 F25:1\n", 3, "height"),
        (b"YUV4MPEG2 W56 H42 F25:1\n", 3, "0 pictures came, a step needs 4"),
    ] {
        let r = piped(bytes.to_vec(), &["-m", m, "-q"]);
        assert_eq!(r.code, code, "{}", r.stderr);
        assert!(error_line(&r.stderr).contains(why), "{}", r.stderr);
    }
}

#[test]
fn wrong_flags_and_folders() {
    let (dir, model, folder) = workplace();
    let (m, f) = (s(&model), s(&folder));
    fails(2, &["stream", "-m", m]);
    fails(2, &["stream", "-m", m, "--watch", f, "-i", "-"]);
    for bad in [
        &["--frames", "0"][..],
        &["--fps", "0"],
        &["--until-idle", "x"],
        &["--deadline-ms", "-1"],
        &["--size", "56"],
        &["--emit", "depth"],
        &["--scene-every", "2"],
        &["--precision", "int2"],
        &["--threads", "65"],
    ] {
        fails(2, &[&["stream", "-m", m, "--watch", f], bad].concat());
    }
    fails(2, &["stream", "-m", m, "-i", "-", "--latest"]);
    fails(2, &["stream", "-m", m, "-i", "-", "--until-idle", "1"]);
    fails(6, &["stream", "-m", m, "--watch", "/nonexistent", "--until-idle", "0.1"]);
    assert!(fails(3, &["stream", "-m", m, "--watch", m, "--until-idle", "0.1"]).contains("not a folder"));
    fails(6, &["stream", "-m", m, "-i", "/nonexistent.y4m"]);
    fails(6, &["stream", "-m", "/nonexistent.sfw", "--watch", f, "--until-idle", "0.1"]);
    assert!(fails(3, &["stream", "-m", m, "--watch", f, "--until-idle", "0.1", "-q"]).contains("0 pictures came"));
    // Results of another run stay.
    let out = dir.path().join("out");
    fs::create_dir(&out).unwrap();
    fs::write(out.join("mine"), "x").unwrap();
    let line = fails(6, &["stream", "-m", m, "--watch", f, "--until-idle", "0.1", "-o", s(&out)]);
    assert!(line.contains("--force"), "{line}");
    // A picture of another size, one that is none, one that came late.
    picture(&folder.join("1.png"), 56, 42, 0);
    picture(&folder.join("2.png"), 42, 56, 0);
    let args = ["stream", "-m", m, "--watch", f, "--until-idle", "0.2", "--frames", "2", "-q"];
    assert!(fails(3, &args).contains("--resize"));
    assert_eq!(lines(&ok(&[&args[..], &["--resize"]].concat())).len(), 1);
    fs::write(folder.join("2.png"), "nothing").unwrap();
    let r = run(&args);
    assert_eq!(r.code, 3, "{}", r.stderr);
    assert!(error_line(&r.stderr).contains("2.png"), "{}", r.stderr);
}
