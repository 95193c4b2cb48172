//! The process itself: usage errors, exit codes, standard streams.

mod common;

use common::{command, error_line, fails, ok, ok_json, ran, run};
use std::fs::File;
use std::process::{Command, Stdio};

#[test]
fn help_and_version_are_results() {
    let help = ok(&["--help"]);
    assert!(help.contains("Usage: streetforward") && help.contains("doctor"), "{help}");
    assert!(ok(&["doctor", "--help"]).contains("--json"));
    assert_eq!(ok(&["--version"]), format!("streetforward {}\n", env!("CARGO_PKG_VERSION")));
}

#[test]
fn wrong_arguments_are_exit_2_and_one_line() {
    assert!(fails(2, &[] as &[&str]).contains("no command given"));
    assert!(fails(2, &["docto"]).contains("did you mean 'doctor'?"));
    assert!(fails(2, &["doctor", "--jsno"]).contains("did you mean '--json'?"));
    assert!(fails(2, &["doctor", "extra"]).contains("'extra'"));
    assert!(fails(2, &["doctor", "--json=3"]).contains("--json"));
    // Raw bytes of the command line do not reach the terminal.
    fails(2, &["\u{1b}[31mred\nline"]);
    fails(2, &["x".repeat(5000)]);
}

#[test]
fn remarks_go_to_stderr_and_results_to_stdout() {
    let r = run(&["doctor"]);
    assert_eq!((r.code, r.stderr.as_str()), (0, ""));
    assert!(r.stdout.contains("threads"));
    let json = ok_json(&["doctor"]);
    assert!(json["allowed_threads"].as_u64().unwrap() >= 1);
    assert_eq!(json["version"], env!("CARGO_PKG_VERSION"));
}

#[test]
fn p08_lost_output_is_exit_6() {
    // The reader is gone.
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let r = ran(command(&["doctor"]).stdout(writer).output().unwrap());
    assert_eq!(r.code, 6, "{}", r.stderr);
    assert!(error_line(&r.stderr).contains("standard output"));
    // The device is full.
    if let Ok(full) = File::options().write(true).open("/dev/full") {
        let r = ran(command(&["doctor", "--json"]).stdout(full).output().unwrap());
        assert_eq!(r.code, 6, "{}", r.stderr);
        error_line(&r.stderr);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn p08_closed_stdout_is_exit_6() {
    let binary = env!("CARGO_BIN_EXE_streetforward");
    let script = format!("exec '{binary}' doctor >&-");
    let r = ran(Command::new("sh").args(["-c", &script]).stdin(Stdio::null()).output().unwrap());
    assert_eq!(r.code, 6, "{}", r.stderr);
    assert!(error_line(&r.stderr).contains("closed"));
    // A closed standard error changes nothing.
    let script = format!("exec '{binary}' doctor 2>&-");
    let r = ran(Command::new("sh").args(["-c", &script]).stdin(Stdio::null()).output().unwrap());
    assert_eq!(r.code, 0);
}

#[test]
fn p18_an_instruction_set_that_is_not_here() {
    let foreign = if cfg!(target_arch = "x86_64") { "neon" } else { "avx2" };
    let line = fails(7, &["doctor", "--isa", foreign]);
    assert!(line.contains(foreign) && line.contains("scalar"), "{line}");
    assert!(fails(2, &["doctor", "--isa", "mmx"]).contains("scalar"));
    let kernels = &ok_json(&["doctor", "--isa", "scalar"])["kernels"];
    assert_eq!(kernels["isa"], "scalar");
    // The row of every family.
    for (family, row) in sf_ops::Kernels::capped(sf_ops::cpu::Isa::Scalar).unwrap().rows() {
        assert_eq!(kernels[family], row);
        assert!(row.ends_with("_scalar"), "{family}: {row}");
    }
    // The environment can only lower, and a value it does not know is not ignored.
    let with = |value| ran(command(&["doctor", "--json"]).env("STREETFORWARD_CPU", value).output().unwrap());
    let r = with("scalar");
    assert!(r.code == 0 && r.stdout.contains("\"isa\": \"scalar\""), "{}", r.stdout);
    let r = with("warp9");
    assert_eq!(r.code, 7);
    assert!(error_line(&r.stderr).contains("STREETFORWARD_CPU"));
}

/// `synth` writes many files for seconds: what stays of it when it cannot finish?
fn long_synth(out: &std::path::Path) -> Command {
    let mut c = command(&["synth", "--frames", "400", "--size", "640x360", "-o"]);
    c.arg(out).stderr(Stdio::piped()).stdout(Stdio::piped());
    c
}

/// A long `synth` that gets a signal once it writes.
fn signalled(signal: &str, out: &std::path::Path) -> std::process::Output {
    let child = long_synth(out).spawn().unwrap();
    for _ in 0..2000 {
        if !common::files(out.parent().unwrap()).is_empty() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let kill = Command::new("sh").args(["-c", &format!("kill -{signal} {}", child.id())]).status().unwrap();
    assert!(kill.success());
    child.wait_with_output().unwrap()
}

#[test]
fn p17_an_interrupt_is_exit_130_and_leaves_nothing() {
    for (signal, code) in [("INT", 130), ("TERM", 143)] {
        let dir = tempfile::tempdir().unwrap();
        let r = ran(signalled(signal, &dir.path().join("clip")));
        assert_eq!(r.code, code, "{}", r.stderr);
        assert!(error_line(&r.stderr).contains("interrupted"));
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}

#[test]
fn c13_a_file_size_limit_is_exit_6_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("clip");
    // One block of 512 bytes (1024 in some shells).
    let script = "ulimit -f 1; exec \"$0\" synth --frames 2 -o \"$1\"";
    let mut c = Command::new("sh");
    c.args(["-c", script, env!("CARGO_BIN_EXE_streetforward")]).arg(&out);
    let r = ran(c.stdin(Stdio::null()).output().unwrap());
    assert_eq!(r.code, 6, "{}", r.stderr);
    error_line(&r.stderr);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn c14_what_a_killed_command_leaves_is_cleaned_by_the_next() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("clip");
    let killed = signalled("KILL", &out);
    assert_eq!(killed.status.code(), None);
    assert!(!out.exists());
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "the temporary folder is left");
    ok(&["synth", "--frames", "1", "--size", "28x28", "-o", out.to_str().unwrap()]);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "the clip alone");
}

#[test]
fn b32_a_bus_error_is_exit_9() {
    let dir = tempfile::tempdir().unwrap();
    let r = ran(signalled("BUS", &dir.path().join("clip")));
    assert_eq!(r.code, 9, "{}", r.stderr);
    assert!(error_line(&r.stderr).contains("cut off while in use"));
}
