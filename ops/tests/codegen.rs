//! Every x86-64 tile must be one tight loop: its multiply-adds (or byte dot products), no call and, in release builds, no vector spilled
//! to the stack. A trait method that was not inlined gives right results tens of times slower, and nothing else tells.
//!
//! Disassembles this test's own binary (sf-ops is optimised in every profile) with `objdump`.

#![cfg(all(target_arch = "x86_64", target_os = "linux"))]

use sf_ops::Ctx;
use sf_ops::gemm::{Epilogue, GEMM_F, GEMM_S8, Panels, PanelsS8, RowsS8, WeightType, gemm, gemm_s8_sums, panel_len};
use sf_ops::{Kernels, Mat, MatMut, par::Pool};
use std::process::Command;

/// The one instruction that does the work of a kernel of instruction set `isa`.
fn work(entry: &str, isa: &str) -> &'static str {
    match (entry, isa) {
        ("gemm_s8" | "conv_s8" | "column_s8" | "product_s8", "avx2") => "vpmaddubsw",
        ("gemm_s8" | "conv_s8" | "column_s8" | "product_s8", "avx2wide") => "vpmaddwd",
        ("gemm_s8" | "conv_s8" | "column_s8" | "product_s8", _) => "vpdpbusd",
        _ => "vfmadd",
    }
}

/// What the tables of both families say of a kernel.
struct Tile {
    name: &'static str,
    entry: &'static str,
    rows: &'static [usize],
    mr: usize,
    nr: usize,
}

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
/// weights pass through it. `%rbp` is the stack where a function has a frame, else a register like others.
fn spills(line: &str, frame: bool) -> bool {
    let stack = line.contains("(%rsp") || frame && line.contains("(%rbp");
    !cfg!(debug_assertions) && line.contains("mm") && stack
}

/// Loops of one function's listing, without those that hold another loop's jump.
fn loops(lines: &[&str], work: &str) -> Vec<Loop> {
    let mut found = Vec::new();
    let frame = lines.iter().any(|l| l.contains("mov ") && l.ends_with("%rsp,%rbp"));
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
            multiply_adds: body.iter().filter(|l| l.contains(work)).count(),
            clean: !body.iter().any(|l| l.contains("call") || spills(l, frame)),
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
        let rows = RowsS8 { m: 1, k: 1, data: &[1; 4], scales: &[1.0] };
        let w = PanelsS8 { n: 1, k: 1, data: &[1; 64], scales: &[1.0], col_sums: &[1] };
        gemm_s8_sums(Ctx { pool: &pool, kernels }, rows, w, &mut [0]);
    }
    let exe = std::env::current_exe().unwrap();
    let Ok(dump) = Command::new("objdump").args(["-d", "--no-show-raw-insn"]).arg(exe).output() else {
        println!("not run: tiles_are_tight_loops needs objdump");
        return;
    };
    let text = String::from_utf8(dump.stdout).unwrap();
    let lines: Vec<&str> = text.lines().collect();
    // Packed rows, and windows in place.
    let float = GEMM_F.iter().flat_map(|r| {
        let f16 = r.weights == WeightType::F16;
        let entries = if f16 { ["gemm_f16", "conv_f16"] } else { ["gemm_f32", "conv_f32"] };
        entries.map(|entry| Tile { name: r.name, entry, rows: r.rows, mr: r.mr, nr: r.nr })
    });
    let int8 = GEMM_S8.iter().flat_map(|r| {
        ["gemm_s8", "conv_s8"].map(|entry| Tile { name: r.name, entry, rows: r.rows, mr: r.mr, nr: r.nr })
    });
    // Full tiles below one another; a rest goes to the first entry.
    let columns = GEMM_S8.iter().flat_map(|r| {
        let full = &r.rows[r.rows.len() - 1..];
        ["column_s8", "product_s8"].map(|entry| Tile { name: r.name, entry, rows: full, mr: r.mr, nr: r.nr })
    });
    for row in float.chain(int8).chain(columns).filter(|r| !r.name.ends_with("_scalar")) {
        let isa = row.name.rsplit('_').next().unwrap();
        // The mangled name holds module and function with their lengths: `6avx512`, not `10avx512vnni`.
        let module = format!("{}{isa}", isa.len());
        let start = lines
            .iter()
            .position(|l| l.ends_with(">:") && l.contains(&module) && l.contains(row.entry))
            .unwrap_or_else(|| panic!("{} {} is not in the binary", row.name, row.entry));
        let end = lines[start..].iter().position(|l| l.is_empty()).map_or(lines.len(), |n| start + n);
        let loops = loops(&lines[start..end], work(row.entry, isa));
        // AVX2 and AVX-VNNI vectors of 16 lanes are two registers.
        let registers = row.nr / if isa.starts_with("avx512") { 16 } else { 8 };
        for rows in row.rows {
            // The compiler may unroll small tiles.
            let wanted = rows * registers;
            let tight = loops.iter().any(|l| l.clean && l.multiply_adds > 0 && l.multiply_adds % wanted == 0);
            assert!(tight, "{} {}: no tight loop for {rows} rows ({wanted} multiply-adds)", row.name, row.entry);
        }
        let full = row.mr * registers;
        let tight = loops.iter().any(|l| l.clean && l.multiply_adds == full);
        assert!(tight, "{} {}: full tile of {full}", row.name, row.entry);
    }
}
