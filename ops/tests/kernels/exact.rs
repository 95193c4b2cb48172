//! Outputs without canaries: every buffer has exactly the length that the operation asks for, so that under guard pages
//! (`tests/guard.rs`) both its ends are watched. Integers against the plain loops with `==`, floats bit for bit between kernels.

use crate::common::{Random, Same, everywhere};
use sf_ops::attention::{
    FrameMask, Heads, attention, attention_s8, attention_s8_integers, scratch_len, scratch_len_s8,
};
use sf_ops::conv::{Conv, ConvTranspose, conv_out, conv_rows, conv_transpose, conv_transpose_rows, conv2d};
use sf_ops::conv_s8::{ConvS8, ConvTransposeS8, conv_rows_s8, conv_transpose_s8, conv2d_s8, conv2d_s8_sums};
use sf_ops::gemm::{
    Act, Epilogue, Panels, PanelsS8, RowsS8, RowsS8Mut, col_sums, gemm, gemm_s8, gemm_s8_quantize, gemm_s8_sums,
    pack_f16, pack_f32, pack_s8, padded_k, panel_len, panel_len_s8,
};
use sf_ops::hadamard::{Rotation, rotate_rows};
use sf_ops::quantize::{Before, Norm, quantize};
use sf_ops::reference::{self, Window};
use sf_ops::resize::{Corners, bilinear};
use sf_ops::rope::{AngleRound, QkNorm, RopeTable, qk_norm_rope};
use sf_ops::{Ctx, Hwc, HwcMut, Mat, MatMut, elementwise, layernorm};

/// Rows below, at and above the tiles of every kernel, against outputs and inputs off theirs.
const ROWS: [usize; 12] = [1, 2, 3, 4, 5, 6, 7, 11, 12, 13, 17, 25];
const OUTS: [usize; 7] = [1, 8, 15, 16, 17, 32, 33];
const INPUTS: [usize; 8] = [1, 3, 4, 7, 16, 17, 36, 129];

/// Every row count with every output count; inputs take turns.
fn sizes() -> impl Iterator<Item = (usize, usize, usize)> {
    ROWS.into_iter().flat_map(|m| OUTS.into_iter().map(move |n| (m, n))).enumerate().map(|(i, (m, n))| {
        // 5 and 8 have no common factor.
        (m, n, INPUTS[i * 5 % INPUTS.len()])
    })
}

fn bytes(r: &mut Random, n: usize) -> Vec<i8> {
    (0..n).map(|_| (r.below(255) as i32 - 127) as i8).collect()
}

fn signs(r: &mut Random, width: usize) -> Vec<u16> {
    (0..width / 16).map(|_| r.bits() as u16).collect()
}

/// int8 weights `[n, k]`.
struct Weights {
    n: usize,
    k: usize,
    panels: Vec<i8>,
    scales: Vec<f32>,
    sums: Vec<i32>,
}

impl Weights {
    fn new(r: &mut Random, rows: &[i8], n: usize, k: usize) -> Weights {
        let mut panels = vec![0; panel_len_s8(n, k)];
        pack_s8(rows, n, k, &mut panels);
        let sums = col_sums(&panels, n, k);
        Weights { n, k, panels, scales: r.vec(n), sums }
    }

    fn get(&self) -> PanelsS8<'_> {
        PanelsS8 { n: self.n, k: self.k, data: &self.panels, scales: &self.scales, col_sums: &self.sums }
    }
}

#[test]
fn float_products() {
    for (m, n, k) in sizes() {
        let mut r = Random::new((m * 1009 + n * 31 + k) as u64);
        let (a, w, bias, before) = (r.vec(m * k), r.vec(n * k), r.vec(n), r.vec(m * n));
        let (mut full, mut half) = (vec![0.0; panel_len(n, k)], vec![0; panel_len(n, k)]);
        pack_f32(&w, n, k, &mut full);
        pack_f16(&w, n, k, &mut half);
        for w in [Panels::f32(&full, n, k), Panels::f16(&half, n, k)] {
            let mut same = Same::default();
            everywhere(|ctx, name| {
                let mut y = before.clone();
                let ep = Epilogue { bias: Some(&bias), act: Act::Gelu, gamma: Some(&bias), residual: true };
                gemm(ctx, Mat::new(&a, m, k), w, ep, MatMut::new(&mut y, m, n));
                same.check(&y, &format!("{m} x {n} x {k}, {name}"));
            });
        }
    }
}

#[test]
fn int8_products() {
    for (m, n, k) in sizes() {
        let mut r = Random::new((m * 1009 + n * 31 + k) as u64);
        let (plain, rows) = (bytes(&mut r, m * k), bytes(&mut r, n * k));
        let mut a = vec![0; m * padded_k(k)];
        for (a, row) in a.chunks_exact_mut(padded_k(k)).zip(plain.chunks_exact(k)) {
            a[..k].copy_from_slice(row);
        }
        let (w, scales, bias, before) = (Weights::new(&mut r, &rows, n, k), r.vec(m), r.vec(n), r.vec(m * n));
        let expected = reference::gemm_s8(&plain, &rows, k);
        let (mut same, mut quantized) = (Same::default(), Same::default());
        everywhere(|ctx, name| {
            let what = format!("{m} x {n} x {k}, {name}");
            let rows = RowsS8 { m, k, data: &a, scales: &scales };
            let mut sums = vec![0; m * n];
            gemm_s8_sums(ctx, rows, w.get(), &mut sums);
            assert!(sums == expected, "{what}");
            let mut y = before.clone();
            let ep = Epilogue { bias: Some(&bias), act: Act::Gelu, gamma: Some(&bias), residual: true };
            gemm_s8(ctx, rows, w.get(), ep, MatMut::new(&mut y, m, n));
            same.check(&y, &what);
            let (mut data, mut steps) = (vec![0; m * padded_k(n)], vec![0.0; m]);
            let out = RowsS8Mut { m, k: n, data: &mut data, scales: &mut steps };
            gemm_s8_quantize(ctx, rows, w.get(), Epilogue { residual: false, ..ep }, Before::default(), out);
            steps.extend(data.iter().map(|v| f32::from(*v)));
            quantized.check(&steps, &what);
        });
    }
}

#[test]
fn rows_of_every_width() {
    for cols in (1..=36).chain([48, 63, 64, 65, 128, 192, 257]) {
        let rows = 3;
        let mut r = Random::new(cols as u64);
        let (x, gain, offset) = (r.vec(rows * cols), r.vec(cols), r.vec(cols));
        let signs = signs(&mut r, cols);
        let rotation = cols.is_multiple_of(16).then(|| Rotation::new(cols, &signs));
        let expected: Vec<_> = x.chunks_exact(cols).map(reference::quantize).collect();
        let mut all = Same::default();
        everywhere(|ctx, name| {
            let what = format!("{cols} columns, {name}");
            let quantized = |before| {
                let (mut data, mut scales) = (vec![0; rows * padded_k(cols)], vec![0.0; rows]);
                let out = RowsS8Mut { m: rows, k: cols, data: &mut data, scales: &mut scales };
                quantize(ctx, Mat::new(&x, rows, cols), before, out);
                (data, scales)
            };
            let (data, scales) = quantized(Before::default());
            for (r, (row, scale)) in expected.iter().enumerate() {
                assert!(data[r * padded_k(cols)..][..cols] == *row && scales[r] == *scale, "{what}, row {r}");
            }
            let mut got = vec![0.0; rows * cols];
            layernorm::layernorm(
                ctx,
                Mat::new(&x, rows, cols),
                &gain,
                &offset,
                1e-6,
                MatMut::new(&mut got, rows, cols),
            );
            for affine in [None, Some((&gain[..], &offset[..]))] {
                let (data, scales) = quantized(Before { norm: Some(Norm { affine, eps: 1e-6 }), rotation });
                got.extend(data.iter().map(|v| f32::from(*v)).chain(scales));
            }
            if let Some(rotation) = rotation {
                let mut y = x.clone();
                rotate_rows(ctx, rotation, MatMut::new(&mut y, rows, cols));
                got.extend(y);
            }
            let ops: [fn(Ctx, &mut [f32]); 4] = [
                elementwise::relu,
                elementwise::exp_in_place,
                elementwise::sigmoid_in_place,
                elementwise::gelu_in_place,
            ];
            for op in ops {
                let mut y = x[..cols].to_vec();
                op(ctx, &mut y);
                got.extend(y);
            }
            let (mut sum, mut onto) = (vec![0.0; cols], gain.clone());
            elementwise::add(ctx, &gain, &offset, &mut sum);
            elementwise::add_assign(ctx, &mut onto, &offset);
            got.extend(sum.into_iter().chain(onto));
            all.check(&got, &what);
        });
    }
}

#[test]
fn heads_of_every_width() {
    for (d, tokens) in [(4, 5), (8, 16), (20, 3), (32, 33), (36, 64), (40, 17), (56, 65), (64, 40), (72, 37), (80, 13)]
    {
        let (mask, heads) = (FrameMask { frames: 2, tokens, lo: -1, hi: 0 }, 2);
        let (rows, c) = (mask.frames * tokens, heads * d);
        let mut r = Random::new((d * 100 + tokens) as u64);
        let (x, signs) = (r.vec(rows * 3 * c), signs(&mut r, d));
        // Vectors of their own, so that each ends at a page.
        let g: Vec<Vec<f32>> = (0..4).map(|_| r.vec(d)).collect();
        let norm = QkNorm { q_gain: &g[0], q_offset: &g[1], k_gain: &g[2], k_offset: &g[3], eps: 1e-5 };
        let positions: Vec<(u32, u32)> = (0..tokens as u32).map(|i| (i / 6, i % 6)).collect();
        let table = RopeTable::new(&positions, d, 100.0, AngleRound::None);
        let rotation = d.is_multiple_of(16).then(|| Rotation::new(d, &signs));
        let qkv = Mat::new(&x, rows, 3 * c);
        let plain = Heads { qkv, heads, norm: None, rope: None, rotation: None };
        let (expected, integers) = reference::attention_s8(qkv, heads, mask);
        let mut all = Same::default();
        everywhere(|ctx, name| {
            let what = format!("{tokens} tokens, width {d}, {name}");
            assert!(attention_s8_integers(ctx, plain, mask) == integers, "{what}");
            let int8 = |x: Heads| {
                let mut scratch = vec![0.0; scratch_len_s8(&mask, heads, d, ctx.pool.threads())];
                let mut y = vec![0.0; rows * c];
                attention_s8(ctx, x, mask, &mut scratch, MatMut::new(&mut y, rows, c));
                y
            };
            assert!(int8(plain) == expected, "{what}");
            let mut got = int8(Heads { norm: Some(norm), rope: Some(&table), rotation, ..plain });
            let mut turned = x.clone();
            qk_norm_rope(ctx, MatMut::new(&mut turned, rows, 3 * c), heads, Some(norm), Some(&table));
            let mut scratch = vec![0.0; scratch_len(&mask, heads, d, ctx.pool.threads())];
            let mut y = vec![0.0; rows * c];
            attention(ctx, Mat::new(&turned, rows, 3 * c), heads, mask, &mut scratch, MatMut::new(&mut y, rows, c));
            got.extend(turned.into_iter().chain(y));
            all.check(&got, &what);
        });
    }
}

#[test]
fn images_of_every_width() {
    let windows = [(1, 1, 0), (3, 1, 1), (3, 2, 1), (2, 2, 0), (3, 1, 0)];
    for w in 3..=27 {
        let (kernel, stride, pad) = windows[w % windows.len()];
        let (h, c, n) = (4, [1, 3, 4, 7, 16, 20][w % 6], [1, 15, 16, 17, 33][w / 2 % 5]);
        let mut r = Random::new(w as u64);
        let (x, bias) = (r.vec(h * w * c), r.vec(n));
        let image = Hwc::new(&x, h, w, c);
        let (oh, ow) = (conv_out(h, kernel, stride, pad), conv_out(w, kernel, stride, pad));
        let before = r.vec(oh * ow * n);
        let (floats, plain) = (r.vec(n * c * kernel * kernel), bytes(&mut r, n * c * kernel * kernel));
        let k = kernel * kernel * c;
        let (mut full, mut half) = (vec![0.0; panel_len(n, k)], vec![0; panel_len(n, k)]);
        pack_f32(&conv_rows(&floats, n, c, kernel), n, k, &mut full);
        pack_f16(&conv_rows(&floats, n, c, kernel), n, k, &mut half);
        let int8 = Weights::new(&mut r, &conv_rows_s8(&plain, n, c, kernel), n, kernel * kernel * padded_k(c));
        let (sums, _) = reference::conv2d_s8(image, &plain, Window { kernel, stride, pad }, true);
        // A transposed convolution of the same image.
        let (outs, area) = (4 * n, 4);
        let up_floats = r.vec(c * n * area);
        let mut up = vec![0.0; panel_len(outs, c)];
        pack_f32(&conv_transpose_rows(&up_floats, c, n, 2), outs, c, &mut up);
        let up_rows = bytes(&mut r, outs * c);
        let up_s8 = Weights::new(&mut r, &up_rows, outs, c);
        let mut all = Same::default();
        everywhere(|ctx, name| {
            let what = format!("{h} x {w} x {c} -> {n}, kernel {kernel}, stride {stride}, {name}");
            let mut got = Vec::new();
            for weight in [Panels::f32(&full, n, k), Panels::f16(&half, n, k)] {
                let (relu_input, act) = (Act::Relu, Act::None);
                let conv = Conv { weight, bias: Some(&bias), kernel, stride, pad, relu_input, act };
                let mut y = vec![0.0; oh * ow * n];
                let out = HwcMut::new(&mut y, oh, ow, n);
                conv2d(ctx, image, &conv, Some(Hwc::new(&before, oh, ow, n)), out);
                got.extend(y);
            }
            let conv = ConvS8 {
                weight: int8.get(),
                bias: Some(&bias),
                kernel,
                stride,
                pad,
                relu_input: Act::Relu,
                act: Act::None,
                relu_sum: true,
            };
            let mut integers = vec![0; oh * ow * n];
            conv2d_s8_sums(ctx, image, &conv, &mut integers);
            assert!(integers == sums, "{what}");
            let mut y = vec![0.0; oh * ow * n];
            let out = HwcMut::new(&mut y, oh, ow, n);
            conv2d_s8(ctx, image, &conv, Some(Hwc::new(&before, oh, ow, n)), out);
            got.extend(y);
            let mut y = vec![0.0; h * w * outs];
            let transposed = ConvTranspose { weight: Panels::f32(&up, outs, c), bias: Some(&bias), kernel: 2 };
            conv_transpose(ctx, image, &transposed, HwcMut::new(&mut y, 2 * h, 2 * w, n));
            got.extend(&y);
            let transposed = ConvTransposeS8 { weight: up_s8.get(), bias: Some(&bias), kernel: 2 };
            conv_transpose_s8(ctx, image, &transposed, HwcMut::new(&mut y, 2 * h, 2 * w, n));
            got.extend(&y);
            let mut y = vec![0.0; 7 * (w + 5) * c];
            bilinear(ctx, image, Corners::Half, HwcMut::new(&mut y, 7, w + 5, c));
            got.extend(&y);
            all.check(&got, &what);
        });
    }
}
