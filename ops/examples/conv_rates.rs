//! Speed of int8 convolutions against the measured int8 peak of this CPU:
//!
//! `cargo run --release -p sf-ops --example conv_rates [ROUNDS [THREADS]]`
//!
//! f32 in, f32 out: the quantization of the map is part of the time. A small image of each layer is checked against the definition first;
//! times are medians of rounds, each with a probe of the peak (the largest counts).

use sf_ops::conv_s8::{ConvS8, conv_rows_s8, conv2d_s8, conv2d_s8_sums};
use sf_ops::gemm::{Act, PanelsS8, col_sums, pack_s8, panel_len_s8};
use sf_ops::reference::{self, Window};
use sf_ops::{Ctx, Hwc, HwcMut, Kernels, par::Pool, peak};
use std::time::{Duration, Instant};

/// (height, width, in, out) of 3 x 3 layers: a DPT head at 4 times the patch grid, and half-resolution layers of a small network.
const LAYERS: [(usize, usize, usize, usize); 4] =
    [(96, 144, 256, 256), (160, 296, 256, 256), (189, 259, 40, 32), (189, 259, 32, 44)];

struct Case {
    size: (usize, usize, usize, usize),
    x: Vec<f32>,
    w: Vec<i8>,
    scales: Vec<f32>,
    sums: Vec<i32>,
    out: Vec<f32>,
}

impl Case {
    fn new(ctx: Ctx, size: (usize, usize, usize, usize)) -> Case {
        let (h, w, c, n) = size;
        assert_eq!(c % 4, 0, "channels of this list need no padding");
        let mut state = 7u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u32 << 23) as f32 - 1.0
        };
        let x: Vec<f32> = (0..h * w * c).map(|_| next()).collect();
        let plain: Vec<i8> = (0..n * c * 9).map(|_| (next() * 127.0) as i8).collect();
        let mut panels = vec![0; panel_len_s8(n, 9 * c)];
        pack_s8(&conv_rows_s8(&plain, n, c, 3), n, 9 * c, &mut panels);
        let sums = col_sums(&panels, n, 9 * c);
        let case = Case { size, x, w: panels, scales: vec![0.01; n], sums, out: vec![0.0; h * w * n] };
        let small = Hwc::new(&case.x[..5 * 7 * c], 5, 7, c);
        let (expected, _) = reference::conv2d_s8(small, &plain, Window { kernel: 3, stride: 1, pad: 1 }, false);
        let mut got = vec![0; expected.len()];
        conv2d_s8_sums(ctx, small, &case.layer(), &mut got);
        assert!(got == expected, "{size:?}");
        case
    }

    fn layer(&self) -> ConvS8<'_> {
        let (_, _, c, n) = self.size;
        let weight = PanelsS8 { n, k: 9 * c, data: &self.w, scales: &self.scales, col_sums: &self.sums };
        let (relu_input, act) = (Act::None, Act::Relu);
        ConvS8 { weight, bias: None, kernel: 3, stride: 1, pad: 1, relu_input, act, relu_sum: false }
    }

    /// Seconds of one layer.
    fn time(&mut self, ctx: Ctx) -> f64 {
        let (h, w, c, n) = self.size;
        let mut out = std::mem::take(&mut self.out);
        let start = Instant::now();
        conv2d_s8(ctx, Hwc::new(&self.x, h, w, c), &self.layer(), None, HwcMut::new(&mut out, h, w, n));
        let time = start.elapsed().as_secs_f64();
        self.out = out;
        time
    }
}

/// Time of a peak probe.
const PROBE: Duration = Duration::from_millis(40);

fn main() {
    let number = |i| std::env::args().nth(i).and_then(|v| v.parse::<usize>().ok());
    let rounds = number(1).unwrap_or(9);
    let threads = number(2).map_or(vec![1, 2], |n| vec![n]);
    println!("{}, {rounds} rounds", Kernels::best().product_s8.name);
    println!("threads      map   in  out        ms    GOP/s  of peak");
    for threads in threads {
        let pool = Pool::new(threads).expect("threads");
        let ctx = Ctx { pool: &pool, kernels: Kernels::best() };
        let mut cases: Vec<Case> = LAYERS.into_iter().map(|size| Case::new(ctx, size)).collect();
        let mut peak = 0.0f64;
        let mut times = vec![Vec::new(); cases.len()];
        for _ in 0..rounds {
            peak = peak.max(peak::together(threads, || peak::s8_ops_per_second(Kernels::best(), PROBE)));
            for (case, times) in cases.iter_mut().zip(&mut times) {
                times.push(case.time(ctx));
            }
        }
        println!("{threads:7}  peak {:28.0}", peak * 1e-9);
        for (case, times) in cases.iter().zip(&mut times) {
            times.sort_by(f64::total_cmp);
            let (h, w, c, n) = case.size;
            let (time, ops) = (times[rounds / 2], 18.0 * (h * w * c * n) as f64);
            let share = 100.0 * ops / time / peak;
            println!(
                "{threads:7} {:>8} {c:4} {n:4} {:9.3} {:8.0} {share:6.1} %",
                format!("{h}x{w}"),
                time * 1e3,
                ops / time * 1e-9
            );
        }
    }
}
