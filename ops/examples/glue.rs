//! Runs every row-wise and element-wise op once on 64 rows of 1024 values, for counting instructions:
//!
//! ```text
//! cargo build --release -p sf-ops --example glue
//! valgrind --tool=callgrind --callgrind-out-file=glue.out target/release/examples/glue
//! callgrind_annotate glue.out
//! ```
//!
//! The exclusive count of a vector kernel over 65,536 values is its cost for each; `docs/kernels.md` has the table.
//! With the name of an op and a number of runs (`glue layernorm 2000`) it tells the median time of a value instead.

use sf_ops::gemm::{Act, Epilogue, PanelsS8, RowsS8, RowsS8Mut, gemm_s8, panel_len_s8};
use sf_ops::hadamard::{Rotation, rotate_rows};
use sf_ops::quantize::{Before, Norm, quantize};
use sf_ops::rope::{AngleRound, QkNorm, RopeTable, qk_norm_rope};
use sf_ops::{Ctx, Kernels, Mat, MatMut, elementwise, layernorm, par::Pool};
use std::time::Instant;

const ROWS: usize = 64;
const COLS: usize = 1024;

fn main() {
    let pool = Pool::new(1).expect("one thread");
    let ctx = Ctx { pool: &pool, kernels: Kernels::best() };
    println!("{}: {} values each", ctx.kernels.vector.name, ROWS * COLS);
    let x: Vec<f32> = (0..ROWS * COLS).map(|i| (i * 7919 % 4093) as f32 * 0.001 - 2.0).collect();
    let a = Mat::new(&x, ROWS, COLS);
    let mut y = x.clone();
    let wanted = std::env::args().nth(1);
    let runs: Option<usize> = std::env::args().nth(2).map(|n| n.parse().expect("a number of runs"));
    let mut op = |name: &str, run: &mut dyn FnMut(&mut [f32])| {
        if wanted.as_ref().is_some_and(|w| w != name) {
            return;
        }
        let mut times: Vec<f64> = (0..runs.unwrap_or(1).max(1))
            .map(|_| {
                let began = Instant::now();
                run(&mut y);
                began.elapsed().as_secs_f64()
            })
            .collect();
        times.sort_by(f64::total_cmp);
        match runs {
            Some(_) => println!("{name}: {:.4} ns a value", 1e9 * times[times.len() / 2] / (ROWS * COLS) as f64),
            None => println!("{name}"),
        }
    };
    op("layernorm", &mut |y| {
        layernorm::layernorm(ctx, a, &x[..COLS], &x[..COLS], 1e-6, MatMut::new(y, ROWS, COLS));
    });
    op("gelu", &mut |y| elementwise::gelu_in_place(ctx, y));
    op("exp", &mut |y| elementwise::exp_in_place(ctx, y));
    op("sigmoid", &mut |y| elementwise::sigmoid_in_place(ctx, y));
    op("relu", &mut |y| elementwise::relu(ctx, y));
    op("add", &mut |y| elementwise::add_assign(ctx, y, &x));
    let signs = vec![0x5a3c; COLS / 16];
    let rotation = Rotation::new(COLS, &signs);
    op("rotate", &mut |y| rotate_rows(ctx, rotation, MatMut::new(y, ROWS, COLS)));
    let (mut data, mut scales) = (vec![0i8; ROWS * COLS], vec![0.0f32; ROWS]);
    let norm = Some(Norm { affine: None, eps: 1e-6 });
    for (name, norm, rotation) in [
        ("quantize", None, None),
        ("quantize+norm", norm, None),
        ("quantize+rotation", None, Some(rotation)),
        ("quantize+norm+rotation", norm, Some(rotation)),
    ] {
        op(name, &mut |_| {
            let out = RowsS8Mut { m: ROWS, k: COLS, data: &mut data, scales: &mut scales };
            quantize(ctx, a, Before { norm, rotation }, out);
        });
    }
    // 64 rows of q | k of 512 values, and a part v.
    let positions: Vec<(u32, u32)> = (0..ROWS as u32).map(|i| (i / 8, i % 8)).collect();
    for d in [64, 72] {
        let heads = COLS / 2 / d;
        let cols = 3 * heads * d;
        let mut qkv: Vec<f32> = x.iter().cycle().take(ROWS * cols).copied().collect();
        let table = RopeTable::new(&positions, d, 100.0, AngleRound::None);
        let (g, o) = (&x[..d], &x[d..2 * d]);
        let norm = QkNorm { q_gain: g, q_offset: o, k_gain: g, k_offset: o, eps: 1e-5 };
        for (what, norm, rope) in
            [("norm", Some(norm), None), ("rope", None, Some(&table)), ("norm+rope", Some(norm), Some(&table))]
        {
            op(&format!("{what}{d}"), &mut |_| {
                qk_norm_rope(ctx, MatMut::new(&mut qkv, ROWS, cols), heads, norm, rope);
            });
        }
    }
    // The epilogue of a product of one step of inputs is nearly all of it.
    let (w, sums) = (vec![1i8; panel_len_s8(COLS, 4)], vec![4; COLS]);
    for (name, act, residual) in
        [("finish_s8", Act::None, false), ("finish_s8+gelu", Act::Gelu, false), ("finish_s8+residual", Act::None, true)]
    {
        op(name, &mut |y| {
            let rows = RowsS8 { m: ROWS, k: 4, data: &data[..ROWS * 4], scales: &x[..ROWS] };
            let w = PanelsS8 { n: COLS, k: 4, data: &w, scales: &x[..COLS], col_sums: &sums };
            let ep = Epilogue { bias: Some(&x[..COLS]), act, gamma: None, residual };
            gemm_s8(ctx, rows, w, ep, MatMut::new(y, ROWS, COLS));
        });
    }
}
