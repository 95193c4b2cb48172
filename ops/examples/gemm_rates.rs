//! Speed of the int8 product against the measured int8 peak of this CPU:
//!
//! `cargo run --release -p sf-ops --example gemm_rates [ROUNDS [THREADS [MxKxN, or its beginning]]]`
//!
//! Every shape is checked against the definition first, then timed; times are medians of interleaved rounds. The peak of
//! two threads is two threads running the probe at once.

use sf_ops::gemm::{Act, Epilogue, PanelsS8, RowsS8, col_sums, gemm_s8, gemm_s8_sums, pack_s8, padded_k, panel_len_s8};
use sf_ops::{Ctx, Kernels, MatMut, par::Pool, peak, reference};
use std::time::{Duration, Instant};

/// Outputs of a shape checked against the definition: every row of so many columns.
const CHECKED: usize = 40;

/// (inputs, outputs) of a block of width 1024 and of a decoder of 1152, for 4 frames of 217, 221 and 745 tokens.
const LARGE: [(usize, usize); 5] = [(1024, 3072), (1024, 1024), (1024, 4096), (4096, 1024), (1152, 3456)];
/// The same of a small network, and few rows.
const SMALL: [(usize, usize); 4] = [(192, 192), (192, 576), (192, 768), (768, 192)];
const FEW: [usize; 6] = [1, 2, 4, 8, 12, 16];

fn shapes() -> Vec<(usize, usize, usize)> {
    let mut shapes = Vec::new();
    for m in [868, 884, 2980] {
        shapes.extend(LARGE.map(|(k, n)| (m, k, n)));
    }
    shapes.extend(SMALL.map(|(k, n)| (884, k, n)));
    shapes.extend(FEW.map(|m| (m, 1024, 1024)));
    shapes
}

struct Case {
    size: (usize, usize, usize),
    a: Vec<i8>,
    a_scales: Vec<f32>,
    w: Vec<i8>,
    panels: std::ops::Range<usize>,
    scales: Vec<f32>,
    sums: Vec<i32>,
    bias: Vec<f32>,
    out: Vec<f32>,
}

impl Case {
    fn new(size: (usize, usize, usize)) -> Case {
        let (m, k, n) = size;
        let mut state = 7u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((state >> 33) % 255) as i8
        };
        let mut value = || next().max(-127);
        let mut a = vec![0i8; m * padded_k(k)];
        for row in a.chunks_exact_mut(padded_k(k)) {
            row[..k].fill_with(&mut value);
        }
        let plain: Vec<i8> = (0..n * k).map(|_| value()).collect();
        // On a cache line, as in a weight file.
        let mut w = vec![0; panel_len_s8(n, k) + 64];
        let at = w.as_ptr().align_offset(64);
        let panels = at..at + panel_len_s8(n, k);
        pack_s8(&plain, n, k, &mut w[panels.clone()]);
        let sums = col_sums(&w[panels.clone()], n, k);
        let case = Case {
            size,
            a,
            a_scales: vec![0.01; m],
            w,
            panels,
            scales: vec![0.02; n],
            sums,
            bias: vec![0.5; n],
            out: vec![0.0; m * n],
        };
        case.check(&plain);
        case
    }

    fn rows(&self) -> RowsS8<'_> {
        RowsS8 { m: self.size.0, k: self.size.1, data: &self.a, scales: &self.a_scales }
    }

    fn panels(&self) -> PanelsS8<'_> {
        PanelsS8 {
            n: self.size.2,
            k: self.size.1,
            data: &self.w[self.panels.clone()],
            scales: &self.scales,
            col_sums: &self.sums,
        }
    }

    fn check(&self, plain: &[i8]) {
        let (m, k, n) = self.size;
        assert_eq!(k % 4, 0, "shapes of this list need no padding");
        let pool = Pool::new(2).expect("two threads");
        let mut y = vec![0; m * n];
        gemm_s8_sums(Ctx { pool: &pool, kernels: Kernels::best() }, self.rows(), self.panels(), &mut y);
        let cols = CHECKED.min(n);
        let expected = reference::gemm_s8(&self.a, &plain[(n - cols) * k..], k);
        for (y, e) in y.chunks_exact(n).zip(expected.chunks_exact(cols)) {
            assert_eq!(&y[n - cols..], e, "{m} x {k} x {n}");
        }
    }

    /// Seconds of one product.
    fn time(&mut self, pool: &Pool, act: Act) -> f64 {
        let (m, _, n) = self.size;
        let ctx = Ctx { pool, kernels: Kernels::best() };
        let mut out = std::mem::take(&mut self.out);
        let ep = Epilogue { bias: Some(&self.bias), act, ..Epilogue::default() };
        let start = Instant::now();
        gemm_s8(ctx, self.rows(), self.panels(), ep, MatMut::new(&mut out, m, n));
        let time = start.elapsed().as_secs_f64();
        self.out = out;
        time
    }
}

/// Time of a peak probe.
const PROBE: Duration = Duration::from_millis(40);

fn main() {
    let number = |i| std::env::args().nth(i).and_then(|v| v.parse::<usize>().ok());
    let rounds = number(1).unwrap_or(20);
    let threads = number(2).map_or(vec![1, 2], |n| vec![n]);
    let only = std::env::args().nth(3);
    let wanted =
        |&(m, k, n): &(usize, usize, usize)| only.as_ref().is_none_or(|o| format!("{m}x{k}x{n}").starts_with(o));
    println!("{}, {rounds} rounds", Kernels::best().product_s8.name);
    println!("threads     M     K     N        ms    GOP/s  of peak  with gelu");
    let mut cases: Vec<Case> = shapes().into_iter().filter(wanted).map(Case::new).collect();
    for threads in threads {
        let pool = Pool::new(threads).expect("threads");
        let mut peak = 0.0f64;
        let mut times = vec![[Vec::new(), Vec::new()]; cases.len()];
        for _ in 0..rounds {
            peak = peak.max(peak::together(threads, || peak::s8_ops_per_second(Kernels::best(), PROBE)));
            for (case, times) in cases.iter_mut().zip(&mut times) {
                for (times, act) in times.iter_mut().zip([Act::None, Act::Gelu]) {
                    times.push(case.time(&pool, act));
                }
            }
        }
        println!("{threads:7}  peak {:38.0}", peak * 1e-9);
        for (case, times) in cases.iter().zip(&mut times) {
            let median = times.each_mut().map(|t| {
                t.sort_by(f64::total_cmp);
                t[t.len() / 2]
            });
            let (m, k, n) = case.size;
            let ops = 2.0 * (m * k * n) as f64;
            let share = median.map(|t| 100.0 * ops / t / peak);
            println!(
                "{threads:7} {m:5} {k:5} {n:5} {:9.3} {:8.0} {:6.1} % {:8.1} %",
                median[0] * 1e3,
                ops / median[0] * 1e-9,
                share[0],
                share[1]
            );
        }
    }
}
