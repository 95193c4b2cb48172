//! Parts of the network alone, on random values.
//!
//! | kind | sizes | what |
//! |---|---|---|
//! | `gemm` | m k n | int8 rows times int8 weights, bias, f32 out |
//! | `linear` | m k n | the same from f32 rows: rotated, quantized, multiplied |
//! | `conv` | h w c n | 3x3, f32 map in and out, ReLU |
//! | `attention` | frames tokens heads d lo hi | int8 attention of frames over the frames in sight |
//! | `block` | frames tokens dim heads lo hi | a transformer block in int8, ratio 4, norms folded, no q/k norm, rotary positions |

use crate::Work;
use sf_ops::attention::{FrameMask, Heads, attention_s8, scratch_len_s8};
use sf_ops::gemm::{Act, Epilogue, PanelsS8, RowsS8, RowsS8Mut, col_sums, gemm_s8, pack_s8, padded_k, panel_len_s8};
use sf_ops::hadamard::{self, Rotation};
use sf_ops::par::Pool;
use sf_ops::quantize::{Before, Norm, quantize};
use sf_ops::rope::{AngleRound, RopeTable};
use sf_ops::{Ctx, Kernels, Mat, MatMut};

type Job = Box<dyn FnMut(Ctx)>;

struct Timed {
    pool: Pool,
    kernels: &'static Kernels,
    job: Job,
}

impl Work for Timed {
    fn run(&mut self) -> Result<(), String> {
        (self.job)(Ctx { pool: &self.pool, kernels: self.kernels });
        Ok(())
    }
}

pub(crate) fn open(args: &[String]) -> Result<Box<dyn Work>, String> {
    let [threads, kind, sizes @ ..] = args else { return Err("work THREADS KIND SIZE...".into()) };
    let threads = threads.parse().map_err(|_| format!("{threads}: not a number"))?;
    let sizes: Vec<i64> =
        sizes.iter().map(|s| s.parse().map_err(|_| format!("{s}: not a number"))).collect::<Result<_, _>>()?;
    let size = |i: usize| sizes[i] as usize;
    let pool = Pool::new(threads).map_err(|e| e.to_string())?;
    let kernels = Kernels::from_env()?;
    let mask = || FrameMask { frames: size(0), tokens: size(1), lo: sizes[4] as i32, hi: sizes[5] as i32 };
    let job: Job = match (kind.as_str(), sizes.len()) {
        ("gemm", 3) => gemm(size(0), size(1), size(2)),
        ("linear", 3) => linear(size(0), size(1), size(2)),
        ("conv", 4) => {
            let ctx = Ctx { pool: &pool, kernels };
            sf_bench::conv_s8(ctx, ((size(0), size(1), size(2)), size(3), (3, 1, 1))).run
        }
        ("attention", 6) => attention(mask(), size(2), size(3)),
        ("block", 6) => block(mask(), size(2), size(3)),
        _ => return Err(format!("{kind} with {} sizes is not known", sizes.len())),
    };
    Ok(Box::new(Timed { pool, kernels, job }))
}

/// Values in [-1, 1) from a linear congruential generator.
fn values(seed: u64, n: usize) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u32 << 23) as f32 - 1.0
    };
    (0..n).map(|_| next()).collect()
}

/// int8 weights as a layer holds them, panels on a cache line as in a weight file.
struct Weights {
    n: usize,
    k: usize,
    panels: Vec<i8>,
    at: usize,
    scales: Vec<f32>,
    sums: Vec<i32>,
    bias: Vec<f32>,
    signs: Vec<u16>,
}

impl Weights {
    fn new(seed: u64, k: usize, n: usize) -> Weights {
        let rows: Vec<i8> = values(seed, n * k).iter().map(|v| (v * 127.0) as i8).collect();
        let mut panels = vec![0; panel_len_s8(n, k) + 64];
        let at = panels.as_ptr().align_offset(64);
        pack_s8(&rows, n, k, &mut panels[at..at + panel_len_s8(n, k)]);
        let sums = col_sums(&panels[at..at + panel_len_s8(n, k)], n, k);
        // Outputs of about unit size for inputs of unit size.
        let scales = vec![1.0 / (73.0 * (k as f32).sqrt()); n];
        Weights { n, k, panels, at, scales, sums, bias: values(seed + 1, n), signs: vec![0x5a5a; k / 16] }
    }

    fn panels(&self) -> PanelsS8<'_> {
        let data = &self.panels[self.at..self.at + panel_len_s8(self.n, self.k)];
        PanelsS8 { n: self.n, k: self.k, data, scales: &self.scales, col_sums: &self.sums }
    }
}

/// Quantized rows.
#[derive(Default)]
struct Rows {
    data: Vec<i8>,
    scales: Vec<f32>,
}

impl Rows {
    fn new(m: usize, k: usize) -> Rows {
        Rows { data: vec![0; m * padded_k(k)], scales: vec![0.0; m] }
    }

    /// A layer from f32 rows; with a norm in front whose gain and offset are folded.
    fn layer(&mut self, ctx: Ctx, w: &Weights, norm: bool, x: Mat, ep: Epilogue, out: MatMut) {
        let (m, k) = (x.rows, x.cols);
        let norm = norm.then_some(Norm { affine: None, eps: 1e-6 });
        let rotation = Some(Rotation::new(k, &w.signs));
        let to = RowsS8Mut { m, k, data: &mut self.data[..m * padded_k(k)], scales: &mut self.scales[..m] };
        quantize(ctx, x, Before { norm, rotation }, to);
        let rows = RowsS8 { m, k, data: &self.data[..m * padded_k(k)], scales: &self.scales[..m] };
        gemm_s8(ctx, rows, w.panels(), Epilogue { bias: Some(&w.bias), ..ep }, out);
    }
}

fn gemm(m: usize, k: usize, n: usize) -> Job {
    let (w, mut y) = (Weights::new(1, k, n), vec![0.0; m * n]);
    let a: Vec<i8> = values(2, m * padded_k(k)).iter().map(|v| (v * 127.0) as i8).collect();
    let scales = vec![0.01; m];
    Box::new(move |ctx| {
        let rows = RowsS8 { m, k, data: &a, scales: &scales };
        gemm_s8(
            ctx,
            rows,
            w.panels(),
            Epilogue { bias: Some(&w.bias), ..Epilogue::default() },
            MatMut::new(&mut y, m, n),
        );
    })
}

fn linear(m: usize, k: usize, n: usize) -> Job {
    let (w, x, mut y, mut rows) = (Weights::new(1, k, n), values(2, m * k), vec![0.0; m * n], Rows::new(m, k));
    Box::new(move |ctx| {
        rows.layer(ctx, &w, false, Mat::new(&x, m, k), Epilogue::default(), MatMut::new(&mut y, m, n));
    })
}

/// Positions of `tokens` tokens, 18 a row.
fn rope(tokens: usize, d: usize) -> RopeTable {
    let at: Vec<(u32, u32)> = (0..tokens as u32).map(|t| (1 + t / 18, 1 + t % 18)).collect();
    RopeTable::new(&at, d, 100.0, AngleRound::None)
}

fn attention(mask: FrameMask, heads: usize, d: usize) -> Job {
    let (rows, dim) = (mask.frames * mask.tokens, heads * d);
    let (qkv, mut out) = (values(1, rows * 3 * dim), vec![0.0; rows * dim]);
    let mut scratch = Vec::new();
    Box::new(move |ctx| {
        scratch.resize(scratch_len_s8(&mask, heads, d, ctx.pool.threads()), 0.0);
        let x = Heads { qkv: Mat::new(&qkv, rows, 3 * dim), heads, norm: None, rope: None, rotation: None };
        attention_s8(ctx, x, mask, &mut scratch, MatMut::new(&mut out, rows, dim));
    })
}

/// The calls of `engine/src/block.rs` for a block whose layers are all int8.
fn block(mask: FrameMask, dim: usize, heads: usize) -> Job {
    let (m, d) = (mask.frames * mask.tokens, dim / heads);
    let [qkv, proj, fc1, fc2] = [(dim, 3 * dim), (dim, dim), (dim, 4 * dim), (4 * dim, dim)]
        .map(|(k, n)| Weights::new(k as u64 + n as u64, k, n));
    let start = values(3, m * dim);
    let (mut x, mut mixed, mut wide) = (start.clone(), vec![0.0; m * dim], vec![0.0; m * 4 * dim]);
    let (table, signs) = (rope(mask.tokens, d), vec![0x5a5a_u16; d / 16]);
    let mut rows = Rows::new(m, 4 * dim);
    let mut scratch = Vec::new();
    Box::new(move |ctx| {
        scratch.resize(scratch_len_s8(&mask, heads, d, ctx.pool.threads()), 0.0);
        x.copy_from_slice(&start);
        let plain = Epilogue::default();
        rows.layer(ctx, &qkv, true, Mat::new(&x, m, dim), plain, MatMut::new(&mut wide[..m * 3 * dim], m, 3 * dim));
        let rotation = (hadamard::block(d) >= 16).then(|| Rotation::new(d, &signs));
        let qkv = Mat::new(&wide[..m * 3 * dim], m, 3 * dim);
        let from = Heads { qkv, heads, norm: None, rope: Some(&table), rotation };
        attention_s8(ctx, from, mask, &mut scratch, MatMut::new(&mut mixed, m, dim));
        let onto = Epilogue { residual: true, ..Epilogue::default() };
        rows.layer(ctx, &proj, false, Mat::new(&mixed, m, dim), onto, MatMut::new(&mut x, m, dim));
        let gelu = Epilogue { act: Act::Gelu, ..Epilogue::default() };
        rows.layer(ctx, &fc1, true, Mat::new(&x, m, dim), gelu, MatMut::new(&mut wide, m, 4 * dim));
        let onto = Epilogue { residual: true, ..Epilogue::default() };
        rows.layer(ctx, &fc2, false, Mat::new(&wide, m, 4 * dim), onto, MatMut::new(&mut x, m, dim));
    })
}
