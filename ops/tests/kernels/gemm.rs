use crate::common::{CANARY, Random, Same, everywhere};
use crate::tolerance;
use sf_ops::gemm::{Act, Epilogue, Panels, gemm, pack_f16, pack_f32, panel_len, unpack};
use sf_ops::{Ctx, Mat, MatMut, reference};

struct Case {
    m: usize,
    n: usize,
    k: usize,
    a: Vec<f32>,
    f32: Vec<f32>,
    f16: Vec<u16>,
    bias: Vec<f32>,
    gamma: Vec<f32>,
    out: Vec<f32>,
}

impl Case {
    fn new(m: usize, n: usize, k: usize) -> Case {
        let mut r = Random::new((m * 1_000_003 + n * 1009 + k) as u64);
        let w = r.vec(n * k);
        let (mut f32, mut f16) = (vec![0.0; panel_len(n, k)], vec![0; panel_len(n, k)]);
        pack_f32(&w, n, k, &mut f32);
        pack_f16(&w, n, k, &mut f16);
        Case { m, n, k, a: r.vec(m * k), f32, f16, bias: r.vec(n), gamma: r.vec(n), out: r.vec(m * n) }
    }

    fn panels(&self, half: bool) -> Panels<'_> {
        if half { Panels::f16(&self.f16, self.n, self.k) } else { Panels::f32(&self.f32, self.n, self.k) }
    }

    fn epilogue(&self, kind: usize) -> Epilogue<'_> {
        match kind % 5 {
            0 => Epilogue::default(),
            1 => Epilogue { bias: Some(&self.bias), ..Epilogue::default() },
            2 => Epilogue { bias: Some(&self.bias), act: Act::Gelu, ..Epilogue::default() },
            3 => Epilogue { bias: Some(&self.bias), act: Act::Relu, ..Epilogue::default() },
            _ => Epilogue { bias: Some(&self.bias), gamma: Some(&self.gamma), residual: true, act: Act::None },
        }
    }

    /// Into a strided buffer with canaries, then dense.
    fn run(&self, ctx: Ctx, half: bool, kind: usize) -> Vec<f32> {
        let stride = self.n + 3;
        let mut buffer = vec![CANARY; self.m * stride + 5];
        for r in 0..self.m {
            buffer[2 + r * stride..][..self.n].copy_from_slice(&self.out[r * self.n..][..self.n]);
        }
        let end = 2 + self.m * stride;
        let a = Mat::new(&self.a, self.m, self.k);
        let out = MatMut::with_stride(&mut buffer[2..end], self.m, self.n, stride);
        gemm(ctx, a, self.panels(half), self.epilogue(kind), out);
        let mut dense = Vec::new();
        for (i, v) in buffer.iter().enumerate() {
            if i >= 2 && i < end && (i - 2) % stride < self.n {
                dense.push(*v);
            } else {
                assert!(*v == CANARY, "{} x {} x {}: wrote beyond the output at {i}", self.m, self.n, self.k);
            }
        }
        dense
    }

    fn check(&self, half: bool, kind: usize) {
        let mut same = Same::default();
        everywhere(|ctx, name| {
            let what = format!("{} x {} x {}, f16 {half}, epilogue {kind}, {name}", self.m, self.n, self.k);
            let y = self.run(ctx, half, kind);
            if same.check(&y, &what) {
                self.judge(&y, half, kind, &what);
            }
        });
    }

    fn judge(&self, y: &[f32], half: bool, kind: usize, what: &str) {
        let w = unpack(self.panels(half));
        let ep = self.epilogue(kind);
        let a = Mat::new(&self.a, self.m, self.k);
        let sums = reference::linear(a, &w, ep.bias);
        let abs = |x: &[f32]| x.iter().map(|v| v.abs()).collect::<Vec<f32>>();
        let (a_abs, w_abs) = (abs(&self.a), abs(&w));
        let zeros = vec![0.0; self.n];
        let sums = if self.k == 0 && ep.bias.is_none() { vec![0.0; self.m * self.n] } else { sums };
        let sizes = reference::linear(Mat::new(&a_abs, self.m, self.k), &w_abs, Some(&zeros));
        for (i, y) in y.iter().enumerate() {
            let col = i % self.n;
            let gamma = ep.gamma.map_or(1.0, |g| g[col]);
            let before = if ep.residual { self.out[i] } else { 0.0 };
            let expected = before + reference::activate(sums[i], ep.act) * gamma;
            let allowed = tolerance::dot(self.k, sizes[i] + 2.0) * 1.2;
            assert!(
                (y - expected).abs() <= allowed,
                "{what}: output {i} is {y}, expected {expected} within {allowed:e}"
            );
        }
    }
}

#[test]
fn tails_of_every_tile() {
    // Two full tiles of the tallest kernel and one row; panels one below, at and above 16 and 32.
    let ks = [1, 2, 3, 4, 5, 6, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 64, 65, 257];
    for m in 1..=25 {
        for (j, n) in [1, 15, 16, 17, 31, 32, 33, 65].into_iter().enumerate() {
            // Every k meets every n and every epilogue over the sweep of m, without the full product of cases.
            for step in 0..3 {
                let i = m * 7 + j * 3 + step * 5;
                Case::new(m, n, ks[i % ks.len()]).check(i % 2 == 1, i);
            }
        }
    }
}

#[test]
fn block_borders() {
    // k across the blocks of 256; m and n across tasks; so much k that a task is one tile; no k at all.
    for (i, (m, n, k)) in [
        (13, 33, 255),
        (13, 33, 256),
        (30, 48, 513),
        (97, 20, 40),
        (200, 300, 24),
        (3, 400, 70),
        (26, 17, 9216),
        (5, 7, 0),
    ]
    .into_iter()
    .enumerate()
    {
        let case = Case::new(m, n, k);
        case.check(false, i);
        case.check(true, i + 1);
    }
    Case::new(0, 5, 3).check(false, 0);
}

#[test]
fn every_half_value_decodes_exactly() {
    // Identity times every bit pattern: 65,536 weights come out as they went in (NaN as NaN).
    let bits: Vec<u16> = (0..=u16::MAX).collect();
    let mut panels = vec![0u16; 65_536];
    // n = 4096 outputs of k = 16 inputs.
    let (n, k) = (4096, 16);
    for o in 0..n {
        for i in 0..k {
            panels[(o / 16 * k + i) * 16 + o % 16] = bits[o * k + i];
        }
    }
    everywhere(|ctx, name| {
        for i in 0..k {
            // One input at a time, because infinity times zero is NaN.
            let column: Vec<u16> = (0..n).map(|o| bits[o * k + i]).collect();
            let mut one = vec![0u16; n];
            for o in 0..n {
                one[o / 16 * 16 + o % 16] = column[o];
            }
            let mut y = vec![0.0f32; n];
            gemm(ctx, Mat::new(&[1.0], 1, 1), Panels::f16(&one, n, 1), Epilogue::default(), MatMut::new(&mut y, 1, n));
            for o in 0..n {
                let h = half::f16::from_bits(column[o]);
                let ok = if h.is_nan() { y[o].is_nan() } else { y[o] == h.to_f32() };
                assert!(ok, "{name}: half {:#06x} decodes to {}", column[o], y[o]);
            }
        }
    });
    let all = unpack(Panels::f16(&panels, n, k));
    for (v, b) in all.iter().zip(&bits) {
        let h = half::f16::from_bits(*b);
        assert!(*v == h.to_f32() || h.is_nan() && v.is_nan());
    }
}

#[test]
fn packing_rounds_to_nearest_even() {
    let mut out = [0u16; 16 * 6];
    // 1 + 2^-11 and 1 + 3 * 2^-11 are ties; 65520 is the first value that rounds to infinity.
    pack_f16(&[1.0 + 0.5f32.powi(11), 1.0 + 3.0 * 0.5f32.powi(11), 65519.0, 65520.0, -0.0, 6e-8], 1, 6, &mut out);
    let row: Vec<u16> = (0..6).map(|i| out[i * 16]).collect();
    assert_eq!(row, [0x3c00, 0x3c02, 0x7bff, 0x7c00, 0x8000, 0x0001]);
}

#[test]
fn non_finite_values_pass_through() {
    let mut case = Case::new(4, 20, 10);
    case.a[13] = f32::NAN;
    case.a[25] = f32::INFINITY;
    everywhere(|ctx, name| {
        for kind in 0..5 {
            let y = case.run(ctx, false, kind);
            assert!(y[20..40].iter().all(|v| v.is_nan()), "{name}: NaN vanished in epilogue {kind}");
            assert!(y[..20].iter().all(|v| v.is_finite()), "{name}: NaN leaked to another row");
        }
    });
}

#[test]
#[should_panic(expected = "inputs of a matrix product")]
fn a_wrong_shape_panics_with_numbers() {
    let case = Case::new(2, 3, 4);
    let pool = sf_ops::par::Pool::new(1).unwrap();
    let ctx = Ctx { pool: &pool, kernels: sf_ops::Kernels::best() };
    let mut y = [0.0; 6];
    gemm(ctx, Mat::new(&case.a[..6], 2, 3), case.panels(false), Epilogue::default(), MatMut::new(&mut y, 2, 3));
}
