//! A second run of any op allocates nothing.

use sf_ops::attention::{FrameMask, Heads, attention, attention_s8, scratch_len, scratch_len_s8};
use sf_ops::conv::{Conv, ConvTranspose, conv_transpose, conv2d};
use sf_ops::conv_s8::{ConvS8, conv2d_s8};
use sf_ops::gemm::{
    Act, Epilogue, Panels, PanelsS8, RowsS8, RowsS8Mut, gemm, gemm_s8, pack_f32, panel_len, panel_len_s8,
};
use sf_ops::hadamard::Rotation;
use sf_ops::quantize::{Before, Norm, quantize};
use sf_ops::resize::{Corners, bilinear};
use sf_ops::rope::{AngleRound, RopeTable, qk_norm_rope};
use sf_ops::{Ctx, Hwc, HwcMut, Kernels, Mat, MatMut, elementwise, layernorm, par::Pool};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call goes to the system allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, SeqCst);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, p: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(p, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

// The only test of this binary, so that nothing else allocates meanwhile.
#[test]
fn the_second_run_allocates_nothing() {
    let pool = Pool::new(2).unwrap();
    let ctx = Ctx { pool: &pool, kernels: Kernels::best() };
    let (frames, tokens, heads, d) = (2, 70, 3, 64);
    let (rows, c) = (frames * tokens, heads * d);
    let x: Vec<f32> = (0..rows * 3 * c).map(|i| (i % 97) as f32 * 0.01).collect();
    let mut panels = vec![0.0; panel_len(c, 9 * c)];
    pack_f32(&vec![0.01; c * 9 * c], c, 9 * c, &mut panels);
    let mask = FrameMask { frames, tokens, lo: 0, hi: 1 };
    let mut scratch = vec![0.0; scratch_len(&mask, heads, d, 2).max(scratch_len_s8(&mask, heads, d, 2))];
    let positions: Vec<(u32, u32)> = (0..tokens as u32).map(|i| (i / 10, i % 10)).collect();
    let table = RopeTable::new(&positions, d, 100.0, AngleRound::None);
    let mut qkv = x.clone();
    let mut y = vec![0.0; rows * c];
    let mut big = vec![0.0; 4 * rows * c];
    let conv = Conv {
        weight: Panels::f32(&panels, c, 9 * c),
        bias: None,
        kernel: 3,
        stride: 1,
        pad: 1,
        relu_input: Act::Relu,
        act: Act::Relu,
    };
    let up = ConvTranspose { weight: Panels::f32(&panels[..panel_len(c, c)], c, c), bias: None, kernel: 2 };
    let (mut bytes, mut scales) = (vec![0i8; rows * c], vec![0.0; rows]);
    let (bytes_w, sums) = (vec![3i8; panel_len_s8(c, c)], vec![3 * c as i32; c]);
    let conv_w = vec![3i8; panel_len_s8(c, 9 * c)];
    let conv_sums = vec![27 * c as i32; c];
    let conv_s8 = ConvS8 {
        weight: PanelsS8 { n: c, k: 9 * c, data: &conv_w, scales: &x[..c], col_sums: &conv_sums },
        bias: None,
        kernel: 3,
        stride: 1,
        pad: 1,
        relu_input: Act::Relu,
        act: Act::None,
        relu_sum: false,
    };
    let signs = vec![0x5a5a; c / 16];
    let mut round = || {
        let a = Mat::new(&x[..rows * c], rows, c);
        let ep = Epilogue { act: Act::Gelu, residual: true, ..Epilogue::default() };
        gemm(ctx, a, Panels::f32(&panels[..panel_len(c, c)], c, c), ep, MatMut::new(&mut y, rows, c));
        layernorm::layernorm(ctx, a, &x[..c], &x[..c], 1e-6, MatMut::new(&mut y, rows, c));
        qk_norm_rope(ctx, MatMut::new(&mut qkv, rows, 3 * c), heads, None, Some(&table));
        attention(ctx, Mat::new(&qkv, rows, 3 * c), heads, mask, &mut scratch, MatMut::new(&mut y, rows, c));
        let x_s8 = Heads { qkv: Mat::new(&qkv, rows, 3 * c), heads, norm: None, rope: Some(&table), rotation: None };
        attention_s8(ctx, x_s8, mask, &mut scratch, MatMut::new(&mut y, rows, c));
        elementwise::gelu_in_place(ctx, &mut y);
        let image = Hwc::new(&x[..rows * c], 10, 14, c);
        let norm = Norm { affine: None, eps: 1e-6 };
        let before = Before { norm: Some(norm), rotation: Some(Rotation::new(c, &signs)) };
        quantize(ctx, a, before, RowsS8Mut { m: rows, k: c, data: &mut bytes, scales: &mut scales });
        let quantized = RowsS8 { m: rows, k: c, data: &bytes, scales: &scales };
        let w = PanelsS8 { n: c, k: c, data: &bytes_w, scales: &x[..c], col_sums: &sums };
        gemm_s8(ctx, quantized, w, ep, MatMut::new(&mut y, rows, c));
        conv2d(ctx, image, &conv, None, HwcMut::new(&mut y, 10, 14, c));
        conv2d_s8(ctx, image, &conv_s8, None, HwcMut::new(&mut y, 10, 14, c));
        conv_transpose(ctx, image, &up, HwcMut::new(&mut big[..rows * c], 20, 28, c / 4));
        bilinear(ctx, image, Corners::Aligned, HwcMut::new(&mut big, 20, 28, c));
    };
    round();
    let before = ALLOCATIONS.load(SeqCst);
    for _ in 0..5 {
        round();
    }
    assert_eq!(ALLOCATIONS.load(SeqCst) - before, 0, "allocations in five further rounds");
}
