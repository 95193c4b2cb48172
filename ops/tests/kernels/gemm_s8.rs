use crate::common::{CANARY, Random, Same, everywhere, same_bits};
use sf_ops::gemm::{
    Act, Epilogue, GEMM_S8, PanelsS8, RowsS8, RowsS8Mut, col_sums, gemm_s8, gemm_s8_quantize, gemm_s8_sums, pack_s8,
    padded_k, panel_len_s8,
};
use sf_ops::hadamard::Rotation;
use sf_ops::quantize::{Before, Norm, quantize};
use sf_ops::{Ctx, Kernels, Mat, MatMut, activation, reference};

/// Values of a case.
#[derive(Clone, Copy, Debug)]
enum Fill {
    /// Anything in [-127, 127], one in eight at an end.
    Random,
    /// Every activation and weight at an end, all of one sign: the largest sums and pairs.
    Ends(i8, i8),
}

struct Case {
    m: usize,
    n: usize,
    k: usize,
    a: Vec<i8>,
    padded: Vec<i8>,
    a_scales: Vec<f32>,
    w: Vec<i8>,
    panels: Vec<i8>,
    scales: Vec<f32>,
    sums: Vec<i32>,
    bias: Vec<f32>,
    gamma: Vec<f32>,
    out: Vec<f32>,
}

impl Case {
    fn new(m: usize, n: usize, k: usize, fill: Fill) -> Case {
        let mut r = Random::new((m * 1_000_003 + n * 1009 + k) as u64);
        let mut values = |count: usize, end: i8| -> Vec<i8> {
            let mut value = || match (fill, r.below(8)) {
                (Fill::Ends(..), _) => end,
                (_, 0) => [-127, 127][r.below(2)],
                _ => (r.below(255) as i32 - 127) as i8,
            };
            (0..count).map(|_| value()).collect()
        };
        let (ea, ew) = if let Fill::Ends(a, w) = fill { (a, w) } else { (0, 0) };
        let (a, w) = (values(m * k, ea), values(n * k, ew));
        let mut padded = vec![0; m * padded_k(k)];
        for i in 0..m {
            padded[i * padded_k(k)..][..k].copy_from_slice(&a[i * k..][..k]);
        }
        let mut panels = vec![77; panel_len_s8(n, k)];
        pack_s8(&w, n, k, &mut panels);
        let sums = col_sums(&panels, n, k);
        let mut positive = |n: usize| r.vec(n).iter().map(|v| v.abs() * 1e-3).collect::<Vec<f32>>();
        let (a_scales, scales) = (positive(m), positive(n));
        Case {
            m,
            n,
            k,
            a,
            padded,
            a_scales,
            w,
            panels,
            scales,
            sums,
            bias: r.vec(n),
            gamma: r.vec(n),
            out: r.vec(m * n),
        }
    }

    fn rows(&self) -> RowsS8<'_> {
        RowsS8 { m: self.m, k: self.k, data: &self.padded, scales: &self.a_scales }
    }

    fn weights(&self) -> PanelsS8<'_> {
        PanelsS8 { n: self.n, k: self.k, data: &self.panels, scales: &self.scales, col_sums: &self.sums }
    }

    fn epilogue(&self, kind: usize) -> Epilogue<'_> {
        let (bias, gamma) = (Some(&self.bias[..]), Some(&self.gamma[..]));
        match kind % 6 {
            0 => Epilogue::default(),
            1 => Epilogue { bias, ..Epilogue::default() },
            2 => Epilogue { bias, act: Act::Gelu, ..Epilogue::default() },
            3 => Epilogue { bias, act: Act::Relu, ..Epilogue::default() },
            4 => Epilogue { bias, gamma, act: Act::None, residual: true },
            _ => Epilogue { bias: None, gamma, act: Act::Gelu, residual: true },
        }
    }

    /// The exact sums; k = 0 gives zeros.
    fn expected_sums(&self) -> Vec<i32> {
        if self.k == 0 { vec![0; self.m * self.n] } else { reference::gemm_s8(&self.a, &self.w, self.k) }
    }

    /// Into a strided buffer with canaries, then dense.
    fn run(&self, ctx: Ctx, kind: usize) -> Vec<f32> {
        let stride = self.n + 3;
        let mut buffer = vec![CANARY; self.m * stride + 5];
        for r in 0..self.m {
            buffer[2 + r * stride..][..self.n].copy_from_slice(&self.out[r * self.n..][..self.n]);
        }
        let end = 2 + self.m * stride;
        let out = MatMut::with_stride(&mut buffer[2..end], self.m, self.n, stride);
        gemm_s8(ctx, self.rows(), self.weights(), self.epilogue(kind), out);
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

    /// The definition of the epilogue in scalar steps; bit-equal.
    fn expected(&self, sums: &[i32], kind: usize) -> Vec<f32> {
        let ep = self.epilogue(kind);
        let value = |i: usize| {
            let (row, col) = (i / self.n, i % self.n);
            let bias = ep.bias.map_or(0.0, |b| b[col]);
            let mut y = reference::dequantize(sums[i], (self.a_scales[row], self.scales[col]), bias);
            y = match ep.act {
                Act::None => y,
                Act::Gelu => activation::gelu(y),
                Act::Relu => reference::relu(y),
            };
            if let Some(g) = ep.gamma {
                y *= g[col];
            }
            if ep.residual { self.out[i] + y } else { y }
        };
        (0..sums.len()).map(value).collect()
    }

    fn check(&self, kind: usize) {
        let what = format!("{} x {} x {}, epilogue {kind}", self.m, self.n, self.k);
        let sums = self.expected_sums();
        let values = self.expected(&sums, kind);
        let mut same = Same::default();
        assert!(same.check(&values, &what));
        everywhere(|ctx, name| {
            let mut y = vec![i32::MIN; self.m * self.n + 2];
            let end = y.len() - 1;
            gemm_s8_sums(ctx, self.rows(), self.weights(), &mut y[1..end]);
            assert!(y[1..end] == sums && y[0] == i32::MIN && y[end] == i32::MIN, "sums of {what}, {name}");
            same.check(&self.run(ctx, kind), &format!("{what}, {name}"));
        });
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
                Case::new(m, n, ks[i % ks.len()], Fill::Random).check(i);
            }
        }
    }
}

#[test]
fn block_borders() {
    // k across the blocks of 1024; m and n across tasks; so much k that a task is one tile; no k, no rows.
    let cases = [
        (13, 33, 1023),
        (13, 33, 1024),
        (30, 48, 2053),
        (97, 20, 40),
        (200, 300, 24),
        (5, 600, 70),
        (26, 17, 30_000),
        (5, 7, 0),
        (0, 5, 3),
        (3, 0, 3),
    ];
    for (i, (m, n, k)) in cases.into_iter().enumerate() {
        Case::new(m, n, k, Fill::Random).check(i);
    }
}

#[test]
fn extremes_are_exact() {
    // The largest pair sums of the 16-bit steps, and the largest k: 65,536 * 127 * 127 and, inside, * 255 * 127.
    for (a, w) in [(127, 127), (127, -127), (-127, 127), (-127, -127)] {
        for k in [2, 5, 64, 65_536] {
            Case::new(7, 19, k, Fill::Ends(a, w)).check(1);
        }
    }
}

#[test]
fn every_pair_of_values_multiplies_exactly() {
    // One input: sum = a * w for all 255 x 255 pairs.
    let all: Vec<i8> = (-127..=127).collect();
    let (m, n) = (all.len(), all.len());
    let mut a = vec![0i8; m * 4];
    all.iter().zip(a.chunks_exact_mut(4)).for_each(|(v, row)| row[0] = *v);
    let mut panels = vec![0; panel_len_s8(n, 1)];
    pack_s8(&all, n, 1, &mut panels);
    let (ones, sums) = (vec![1.0; n], col_sums(&panels, n, 1));
    everywhere(|ctx, name| {
        let mut y = vec![0; m * n];
        let rows = RowsS8 { m, k: 1, data: &a, scales: &ones };
        let w = PanelsS8 { n, k: 1, data: &panels, scales: &ones, col_sums: &sums };
        gemm_s8_sums(ctx, rows, w, &mut y);
        for (i, y) in y.iter().enumerate() {
            assert_eq!(*y, i32::from(all[i / n]) * i32::from(all[i % n]), "{name}: pair {i}");
        }
    });
}

#[test]
fn outputs_quantized_at_once_equal_the_two_steps() {
    for (m, n, k) in [(1, 16, 24), (5, 48, 30), (17, 33, 8), (70, 192, 64), (40, 1040, 20), (131, 512, 16), (0, 16, 4)]
    {
        let case = Case::new(m, n, k, Fill::Random);
        let signs: Vec<u16> = (0..n as u32 / 16).map(|i| (i * 40_503) as u16).collect();
        let rotation = n.is_multiple_of(16).then(|| Rotation::new(n, &signs));
        for (kind, norm) in [(2, None), (1, Some(Norm { affine: None, eps: 1e-6 }))] {
            let before = Before { norm, rotation };
            everywhere(|ctx, name| {
                let mut y = vec![0.0; m * n];
                gemm_s8(ctx, case.rows(), case.weights(), case.epilogue(kind), MatMut::new(&mut y, m, n));
                let (mut bytes, mut scales) = (vec![0; m * padded_k(n)], vec![0.0; m]);
                let rows = RowsS8Mut { m, k: n, data: &mut bytes, scales: &mut scales };
                quantize(ctx, Mat::new(&y, m, n), before, rows);
                let (mut b, mut s) = (vec![-128; m * padded_k(n)], vec![CANARY; m]);
                let rows = RowsS8Mut { m, k: n, data: &mut b, scales: &mut s };
                gemm_s8_quantize(ctx, case.rows(), case.weights(), case.epilogue(kind), before, rows);
                assert!(b == bytes, "{m} x {n} x {k}, {name}");
                same_bits(&s, &scales, name);
            });
        }
    }
}

#[test]
fn a_row_of_scale_nan_stays_seen() {
    let mut case = Case::new(4, 20, 10, Fill::Random);
    case.a_scales[1] = f32::NAN;
    everywhere(|ctx, name| {
        for kind in 0..6 {
            let y = case.run(ctx, kind);
            assert!(y[20..40].iter().all(|v| v.is_nan()), "{name}: NaN vanished in epilogue {kind}");
            assert!(y[..20].iter().all(|v| v.is_finite()), "{name}: NaN leaked to another row");
        }
    });
}

#[test]
fn the_table_is_well_formed() {
    for row in GEMM_S8 {
        let isa = row.name.rsplit('_').next().unwrap();
        assert_eq!(row.name, format!("gemm_s8_{}x{}_{isa}", row.mr, row.nr));
        assert!(row.rows.is_sorted() && row.rows.first() == Some(&1) && row.rows.last() == Some(&row.mr));
    }
    // Every row that this CPU can run is the choice of some cap.
    for row in GEMM_S8.iter().filter(|r| sf_ops::cpu::Features::detected().has(r.needs)) {
        assert!(
            Kernels::available().any(|k| [k.gemm_s8.name, k.product_s8.name].contains(&row.name)),
            "{} is never chosen",
            row.name
        );
    }
}

#[test]
#[should_panic(expected = "inputs of an int8 product")]
fn a_wrong_shape_panics() {
    let case = Case::new(2, 3, 4, Fill::Random);
    let pool = sf_ops::par::Pool::new(1).unwrap();
    let rows = RowsS8 { m: 1, k: 8, data: &case.padded, scales: &case.a_scales[..1] };
    gemm_s8_sums(Ctx { pool: &pool, kernels: Kernels::best() }, rows, case.weights(), &mut [0; 3]);
}
