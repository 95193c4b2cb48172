//! One hash of the output bits of every op, the same on every architecture. A change here is a change of the
//! product's numbers: it belongs in the changelog.

use crate::common::{Random, everywhere};
use sf_ops::attention::{FrameMask, Heads, attention, attention_s8, scratch_len, scratch_len_s8};
use sf_ops::conv::{Conv, ConvTranspose, conv_transpose, conv2d};
use sf_ops::conv_s8::{ConvS8, ConvTransposeS8, conv_rows_s8, conv_transpose_s8, conv2d_s8};
use sf_ops::gemm::{
    Act, Epilogue, Panels, PanelsS8, RowsS8, RowsS8Mut, col_sums, gemm, gemm_s8, pack_f16, pack_f32, pack_s8, padded_k,
    panel_len, panel_len_s8,
};
use sf_ops::hadamard::Rotation;
use sf_ops::quantize::{Before, Norm, quantize};
use sf_ops::resize::{Corners, Filter, bilinear, position_table, resample_u8};
use sf_ops::rope::{AngleRound, QkNorm, RopeTable, qk_norm_rope};
use sf_ops::{Ctx, Hwc, HwcMut, Mat, MatMut, elementwise, layernorm, trig};

/// FNV-1a over bytes.
struct Hash(u64);

impl Hash {
    fn bytes(&mut self, bytes: impl IntoIterator<Item = u8>) {
        for b in bytes {
            self.0 = (self.0 ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    fn values(&mut self, x: &[f32]) {
        self.bytes(x.iter().flat_map(|v| v.to_bits().to_le_bytes()));
    }
}

/// Every op on seeded values, sizes off the lanes.
fn run(ctx: Ctx) -> Vec<(&'static str, u64)> {
    let mut r = Random::new(2026);
    let mut out = Vec::new();
    let mut add = |name, fill: &mut dyn FnMut(&mut Hash)| {
        let mut h = Hash(0xcbf2_9ce4_8422_2325);
        fill(&mut h);
        out.push((name, h.0));
    };

    let (m, n, k) = (29, 53, 300);
    let (a, w, bias) = (r.vec(m * k), r.vec(n * k), r.vec(n));
    let (mut full, mut half) = (vec![0.0; panel_len(n, k)], vec![0; panel_len(n, k)]);
    pack_f32(&w, n, k, &mut full);
    pack_f16(&w, n, k, &mut half);
    add("gemm", &mut |h| {
        for w in [Panels::f32(&full, n, k), Panels::f16(&half, n, k)] {
            let mut y = vec![0.25; m * n];
            let ep = Epilogue { bias: Some(&bias), act: Act::Gelu, gamma: Some(&bias), residual: true };
            gemm(ctx, Mat::new(&a, m, k), w, ep, MatMut::new(&mut y, m, n));
            h.values(&y);
        }
    });

    let (x, g) = (r.vec(7 * 1027), r.vec(1027));
    add("layernorm", &mut |h| {
        let mut y = vec![0.0; x.len()];
        layernorm::layernorm(ctx, Mat::new(&x, 7, 1027), &g, &g, 1e-6, MatMut::new(&mut y, 7, 1027));
        h.values(&y);
    });

    let (heads, d, frames, tokens) = (3, 20, 3, 101);
    let qkv = r.vec(frames * tokens * 3 * heads * d);
    let positions: Vec<(u32, u32)> = (0..tokens as u32).map(|i| (i / 10, i % 10)).collect();
    let table = RopeTable::new(&positions, d, 100.0, AngleRound::None);
    let norm =
        QkNorm { q_gain: &g[..d], q_offset: &g[d..2 * d], k_gain: &g[5..5 + d], k_offset: &g[9..9 + d], eps: 1e-5 };
    let mut turned = qkv.clone();
    add("rope", &mut |h| {
        qk_norm_rope(ctx, MatMut::new(&mut turned, frames * tokens, 3 * heads * d), heads, Some(norm), Some(&table));
        h.values(&turned);
    });
    add("attention", &mut |h| {
        let mask = FrameMask { frames, tokens, lo: -1, hi: 0 };
        let mut scratch = vec![0.0; scratch_len(&mask, heads, d, ctx.pool.threads())];
        let mut y = vec![0.0; frames * tokens * heads * d];
        let out = MatMut::new(&mut y, frames * tokens, heads * d);
        attention(ctx, Mat::new(&turned, frames * tokens, 3 * heads * d), heads, mask, &mut scratch, out);
        h.values(&y);
    });
    add("attention_s8", &mut |h| {
        // Norm and embedding inside, then a rotation and no norm.
        let wide: Vec<f32> = qkv.iter().chain(&turned).take(2 * 101 * 3 * 48).copied().collect();
        let wide = Mat::new(&wide, 2 * 101, 3 * 48);
        let signs = [0x1b3d, 0x7f21, 0x0456];
        let inside = Heads {
            qkv: Mat::new(&qkv, frames * tokens, 3 * heads * d),
            heads,
            norm: Some(norm),
            rope: Some(&table),
            rotation: None,
        };
        let rotated = Heads { qkv: wide, heads: 1, norm: None, rope: None, rotation: Some(Rotation::new(48, &signs)) };
        for (x, mask) in [
            (inside, FrameMask { frames, tokens, lo: -1, hi: 0 }),
            (rotated, FrameMask { frames: 2, tokens, lo: 0, hi: 0 }),
        ] {
            let mut scratch = vec![0.0; scratch_len_s8(&mask, x.heads, x.head_dim(), ctx.pool.threads())];
            let cols = x.heads * x.head_dim();
            let mut y = vec![0.0; x.qkv.rows * cols];
            attention_s8(ctx, x, mask, &mut scratch, MatMut::new(&mut y, x.qkv.rows, cols));
            h.values(&y);
        }
    });

    let (m, n, k) = (29, 53, 1104);
    let bytes: Vec<i8> = (0..n * k).map(|i| (i * 89 % 255) as u8 as i8).map(|v| v.max(-127)).collect();
    let mut packed = vec![0; panel_len_s8(n, k)];
    pack_s8(&bytes, n, k, &mut packed);
    let (sums, step) = (col_sums(&packed, n, k), vec![0.003; n]);
    let signs: Vec<u16> = (0..k as u32 / 16).map(|i| (i * 40_503) as u16).collect();
    let tokens_in: Vec<f32> = (0..m * k).map(|i| ((i * 7919 % 4093) as f32 - 2046.0) * 0.0007).collect();
    add("int8", &mut |h| {
        let (mut data, mut scales) = (vec![0; m * padded_k(k)], vec![0.0; m]);
        let norm = Norm { affine: Some((&tokens_in[..k], &tokens_in[7..k + 7])), eps: 1e-6 };
        let before = Before { norm: Some(norm), rotation: Some(Rotation::new(k, &signs)) };
        let rows = RowsS8Mut { m, k, data: &mut data, scales: &mut scales };
        quantize(ctx, Mat::new(&tokens_in, m, k), before, rows);
        h.bytes(data.iter().map(|v| *v as u8));
        h.values(&scales);
        let w = PanelsS8 { n, k, data: &packed, scales: &step, col_sums: &sums };
        let ep = Epilogue { bias: Some(&bias), act: Act::Gelu, gamma: Some(&bias), residual: true };
        let mut y = vec![0.25; m * n];
        let rows = RowsS8 { m, k, data: &data, scales: &scales };
        gemm_s8(ctx, rows, w, ep, MatMut::new(&mut y, m, n));
        h.values(&y);
    });

    add("conv_s8", &mut |h| {
        let image: Vec<f32> = (0..21 * 17 * 10).map(|i| ((i * 6151 % 4093) as f32 - 2046.0) * 0.0007).collect();
        for (kernel, stride, pad, oh, ow) in [(3, 1, 1, 21, 17), (3, 2, 1, 11, 9), (1, 1, 0, 21, 17)] {
            let k = kernel * kernel * 12;
            let (n, rows) = (19, conv_rows_s8(&bytes[..19 * kernel * kernel * 10], 19, 10, kernel));
            let mut panels = vec![0; panel_len_s8(n, k)];
            pack_s8(&rows, n, k, &mut panels);
            let sums = col_sums(&panels, n, k);
            let conv = ConvS8 {
                weight: PanelsS8 { n, k, data: &panels, scales: &step[..n], col_sums: &sums },
                bias: Some(&bias[..n]),
                kernel,
                stride,
                pad,
                relu_input: Act::Relu,
                act: Act::None,
                relu_sum: true,
            };
            let before = vec![0.25; oh * ow * n];
            let mut y = vec![0.0; oh * ow * n];
            let out = HwcMut::new(&mut y, oh, ow, n);
            conv2d_s8(ctx, Hwc::new(&image, 21, 17, 10), &conv, Some(Hwc::new(&before, oh, ow, n)), out);
            h.values(&y);
        }
        let (n, k) = (28, 10);
        let mut panels = vec![0; panel_len_s8(n, k)];
        pack_s8(&bytes[..n * k], n, k, &mut panels);
        let sums = col_sums(&panels, n, k);
        let weight = PanelsS8 { n, k, data: &panels, scales: &step[..n], col_sums: &sums };
        let conv = ConvTransposeS8 { weight, bias: Some(&bias[..7]), kernel: 2 };
        let mut y = vec![0.0; 42 * 34 * 7];
        conv_transpose_s8(ctx, Hwc::new(&image, 21, 17, 10), &conv, HwcMut::new(&mut y, 42, 34, 7));
        h.values(&y);
    });

    let image = r.vec(9 * 11 * 5);
    let kernel = r.vec(19 * 45);
    let mut panels = vec![0.0; panel_len(19, 45)];
    pack_f32(&kernel, 19, 45, &mut panels);
    add("conv2d", &mut |h| {
        let conv = Conv {
            weight: Panels::f32(&panels, 19, 45),
            bias: Some(&bias[..19]),
            kernel: 3,
            stride: 2,
            pad: 1,
            relu_input: Act::Relu,
            act: Act::None,
        };
        let mut y = vec![0.0; 5 * 6 * 19];
        conv2d(ctx, Hwc::new(&image, 9, 11, 5), &conv, None, HwcMut::new(&mut y, 5, 6, 19));
        h.values(&y);
    });
    let mut panels = vec![0.0; panel_len(28, 5)];
    pack_f32(&kernel[..140], 28, 5, &mut panels);
    add("conv_transpose", &mut |h| {
        let conv = ConvTranspose { weight: Panels::f32(&panels, 28, 5), bias: Some(&bias[..7]), kernel: 2 };
        let mut y = vec![0.0; 18 * 22 * 7];
        conv_transpose(ctx, Hwc::new(&image, 9, 11, 5), &conv, HwcMut::new(&mut y, 18, 22, 7));
        h.values(&y);
    });
    add("bilinear", &mut |h| {
        for corners in [Corners::Aligned, Corners::Half] {
            let mut y = vec![0.0; 20 * 13 * 5];
            bilinear(ctx, Hwc::new(&image, 9, 11, 5), corners, HwcMut::new(&mut y, 20, 13, 5));
            h.values(&y);
        }
    });
    add("lanes", &mut |h| {
        let ops: [fn(Ctx, &mut [f32]); 3] =
            [elementwise::exp_in_place, elementwise::sigmoid_in_place, elementwise::gelu_in_place];
        for op in ops {
            let mut y: Vec<f32> = (0..4001).map(|i| (i - 2000) as f32 * 0.0123).collect();
            op(ctx, &mut y);
            h.values(&y);
        }
    });
    add("tables", &mut |h| {
        h.values(&position_table(&x[..49 * 3], 7, 3, (4, 9)));
        let rgb: Vec<u8> = (0..17 * 13 * 3).map(|i| (i * 37 % 251) as u8).collect();
        h.bytes(resample_u8(&rgb, (17, 13), Filter::Lanczos3, (8, 20)));
        for i in 0..200 {
            let v = f64::from(i) * 0.371 - 20.0;
            let (s, c) = trig::sin_cos(v);
            for y in [s, c, trig::exp(v), trig::ln(v.abs() + 0.1)] {
                h.bytes(y.to_bits().to_le_bytes());
            }
        }
    });
    out
}

#[test]
fn one_hash_on_every_architecture() {
    let expected: [(&str, u64); 12] = [
        ("gemm", 0x7070_51eb_ff96_5f5e),
        ("layernorm", 0xdb34_e22b_c977_8941),
        ("rope", 0xa9fc_176d_24de_7e1c),
        ("attention", 0x60ab_c85b_fb17_8428),
        ("attention_s8", 0xad28_4c77_377a_95a1),
        ("int8", 0x597a_8bfe_864f_0bf8),
        ("conv_s8", 0x4085_a0d9_fe30_f4c1),
        ("conv2d", 0x5dd3_78aa_c81e_9282),
        ("conv_transpose", 0xe266_fa32_c915_87fd),
        ("bilinear", 0x3aeb_e860_cceb_c040),
        ("lanes", 0x12fe_b6fd_2fbd_219b),
        ("tables", 0x8d43_277e_29b8_7224),
    ];
    everywhere(|ctx, name| {
        let got = run(ctx);
        let text: Vec<String> = got.iter().map(|(op, h)| format!("(\"{op}\", {h:#018x})")).collect();
        assert!(got == expected, "{name} gives\n{}", text.join(",\n"));
    });
}
