//! Every x86-64 tile must be one tight loop: its multiply-adds, no call and, in release builds, no vector spilled
//! to the stack. A trait method that was not inlined gives right results tens of times slower, and nothing else tells.
//!
//! Disassembles this test's own binary (sf-ops is optimised in every profile) with `objdump`.

#![cfg(all(target_arch = "x86_64", target_os = "linux"))]

use sf_ops::Ctx;
use sf_ops::gemm::{Epilogue, GEMM_F, Panels, WeightType, gemm, panel_len};
use sf_ops::{Kernels, Mat, MatMut, par::Pool};
use std::process::Command;

/// One loop: instructions from a backward jump's target to the jump.
struct Loop {
    multiply_adds: usize,
    clean: bool,
}

/// Address of an instruction line `  addr:\tmnemonic operands`.
fn address(line: &str) -> Option<u64> {
    u64::from_str_radix(line.trim_start().split(':').next()?, 16).ok()
}

/// Whether a vector goes to or comes from the stack. Only asked of release builds: with debug assertions the
/// weights pass through it.
fn spills(line: &str) -> bool {
    !cfg!(debug_assertions) && line.contains("mm") && (line.contains("(%rsp") || line.contains("(%rbp"))
}

/// Loops of one function's listing, without those that hold another loop's jump.
fn loops(lines: &[&str]) -> Vec<Loop> {
    let mut found = Vec::new();
    for (i, line) in lines.iter().enumerate() {
        let mut words = line.split('\t').nth(1).unwrap_or("").split_whitespace();
        let (Some(op), Some(target)) = (words.next(), words.next()) else { continue };
        let (Some(at), Ok(target)) = (address(line), u64::from_str_radix(target, 16)) else { continue };
        if !op.starts_with('j') || target >= at {
            continue;
        }
        let Some(start) = lines[..i].iter().position(|l| address(l) == Some(target)) else { continue };
        let body = &lines[start..=i];
        found.push(Loop {
            multiply_adds: body.iter().filter(|l| l.contains("vfmadd")).count(),
            clean: !body.iter().any(|l| l.contains("call") || spills(l)),
        });
    }
    found
}

#[test]
fn tiles_are_tight_loops() {
    // Keeps the kernels in the binary.
    let pool = Pool::new(1).unwrap();
    let w = vec![0.0; panel_len(1, 1)];
    let mut y = [0.0];
    for kernels in Kernels::available() {
        let out = MatMut::new(&mut y, 1, 1);
        gemm(Ctx { pool: &pool, kernels }, Mat::new(&[1.0], 1, 1), Panels::f32(&w, 1, 1), Epilogue::default(), out);
    }
    let exe = std::env::current_exe().unwrap();
    let Ok(dump) = Command::new("objdump").args(["-d", "--no-show-raw-insn"]).arg(exe).output() else {
        println!("not run: tiles_are_tight_loops needs objdump");
        return;
    };
    let text = String::from_utf8(dump.stdout).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    for row in GEMM_F.iter().filter(|r| !r.name.ends_with("_scalar")) {
        let isa = row.name.rsplit('_').next().unwrap();
        let entry = if row.weights == WeightType::F32 { "gemm_f32" } else { "gemm_f16" };
        let start = lines
            .iter()
            .position(|l| l.ends_with(">:") && l.contains(isa) && l.contains(entry))
            .unwrap_or_else(|| panic!("{} is not in the binary", row.name));
        let end = lines[start..].iter().position(|l| l.is_empty()).map_or(lines.len(), |n| start + n);
        let loops = loops(&lines[start..end]);
        // AVX2 vectors of 16 lanes are two registers.
        let registers = row.nr / if isa == "avx2" { 8 } else { 16 };
        for rows in row.rows {
            // The compiler may unroll small tiles.
            let wanted = rows * registers;
            let tight = loops.iter().any(|l| l.clean && l.multiply_adds > 0 && l.multiply_adds % wanted == 0);
            assert!(tight, "{}: no tight loop for {rows} rows ({wanted} multiply-adds)", row.name);
        }
        let full = row.mr * registers;
        assert!(loops.iter().any(|l| l.clean && l.multiply_adds == full), "{}: full tile of {full}", row.name);
    }
}
