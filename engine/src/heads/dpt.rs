//! VGGT's DPT head: four taps become a pyramid, fused from coarse to fine (network specification 2.2).
//!
//! | level | size (of the patch grid) | channels |
//! |---|---|---|
//! | 0 | 4x | `channels[0]`, transposed convolution 4x4 |
//! | 1 | 2x | `channels[1]`, transposed convolution 2x2 |
//! | 2 | 1x | `channels[2]` |
//! | 3 | floor((n-1)/2)+1 | `channels[3]`, convolution 3x3 stride 2 |
//!
//! Fusion level i: y = coarser + RCU1(lateral); y = RCU2(y); out_conv; bilinear to the next finer level. The
//! 1x1 `out_conv` runs before the resize, not after it as in the published code: both are linear and the
//! bilinear weights sum to one, so they commute, and there are four times fewer pixels before.
//! RCU(x) = conv2(relu(conv1(relu(x)))) + relu(x), or + x with the `raw` skip.

use crate::arena::{carve, carved_len};
use crate::dims::Dims;
use crate::features::Features;
use crate::model::{Dpt, Unit};
use crate::net::{ConvLayer, Net};
use crate::probe::Probe;
use crate::tables::DptTables;
use sf_formats::Result;
use sf_formats::config::RcuSkip;
use sf_ops::conv;
use sf_ops::elementwise::{add_assign, relu};
use sf_ops::gemm::Act;
use sf_ops::mat::{Hwc, HwcMut, Mat, MatMut};
use sf_ops::resize::{Corners, bilinear};

/// Height and width.
pub(crate) type Size = (usize, usize);

/// Sizes of the four levels, finest first.
pub(crate) fn levels(d: &Dims) -> [Size; 4] {
    let half = |n| conv::conv_out(n, 3, 2, 1);
    let (r, c) = (d.rows, d.cols);
    [(4 * r, 4 * c), (2 * r, 2 * c), (r, c), (half(r), half(c))]
}

/// Pixels of a level.
pub(crate) fn area(s: Size) -> usize {
    s.0 * s.1
}

/// Four lateral maps, three general buffers (what each holds at its largest is listed in [`frame`]).
fn lens(head: &Dpt, d: &Dims) -> [usize; 7] {
    let (sizes, f) = (levels(d), head.features);
    let lateral = sizes.map(|s| area(s) * f);
    let inputs = head.norm_len();
    let resized = (0..4).map(|i| area(sizes[i]) * head.channels[i]).max().expect("four levels");
    let projected = d.patches * head.channels.into_iter().max().expect("four levels");
    let fused = area(sizes[0]) * f;
    let eightfold = 4 * area(sizes[0]);
    let a = (d.patches * inputs).max(resized).max(fused).max(eightfold * f / 2).max(d.pixels() * head.hidden);
    let b = projected.max(fused).max(d.pixels() * f / 2);
    let c = fused.max(eightfold * f);
    [lateral[0], lateral[1], lateral[2], lateral[3], a, b, c]
}

impl Dpt {
    /// Width of the taps.
    fn norm_len(&self) -> usize {
        self.projects[0].weight.k
    }
}

/// Values of working memory of [`frame`].
pub(crate) fn scratch_len(head: &Dpt, d: &Dims) -> usize {
    carved_len(lens(head, d))
}

/// One frame's work.
pub(crate) struct Pyramid<'a> {
    pub(crate) taps: [Features<'a>; 4],
    pub(crate) frame: usize,
    pub(crate) scratch: &'a mut [f32],
    /// `[height, width, channels]`.
    pub(crate) out: &'a mut [f32],
}

/// Convolutions of one head.
struct Layers<'a> {
    net: Net<'a>,
    head: &'a Dpt,
}

impl Layers<'_> {
    /// out = RCU(x); x may be overwritten by its rectified self.
    fn unit(&self, unit: &Unit, s: Size, x: &mut [f32], hidden: &mut [f32], out: &mut [f32]) {
        let f = self.head.features;
        let n = area(s) * f;
        let (x, hidden, out) = (&mut x[..n], &mut hidden[..n], &mut out[..n]);
        if self.head.skip == RcuSkip::Relu {
            relu(self.net.ctx, x);
        }
        let x = Hwc::new(x, s.0, s.1, f);
        let first = ConvLayer { act: Act::Relu, ..ConvLayer::same(&unit.conv1, 3).on_rectified() };
        self.net.conv(first, x, None, HwcMut::new(hidden, s.0, s.1, f));
        let hidden = Hwc::new(hidden, s.0, s.1, f);
        self.net.conv(ConvLayer::same(&unit.conv2, 3).on_rectified(), hidden, Some(x), HwcMut::new(out, s.0, s.1, f));
    }
}

/// The raw map of one frame.
pub(crate) fn frame(net: Net, head: &Dpt, tables: &DptTables, d: &Dims, job: Pyramid, probe: &Probe) -> Result<()> {
    let layers = Layers { net, head };
    let sizes = levels(d);
    let f = head.features;
    let inputs = head.norm_len();
    let [l0, l1, l2, l3, a, b, c] = carve(job.scratch, lens(head, d));
    let mut lateral = [l0, l1, l2, l3];

    // Taps: a = normed tokens, b = projected, a = resized, lateral = to the common width.
    for (i, out) in lateral.iter_mut().enumerate() {
        let (s, ch) = (sizes[i], head.channels[i]);
        net.norm(
            &head.norm,
            job.taps[i].patches(job.frame),
            MatMut::new(&mut a[..d.patches * inputs], d.patches, inputs),
        );
        let projected = &mut b[..d.patches * ch];
        let normed = Mat::new(&a[..d.patches * inputs], d.patches, inputs);
        net.linear(&head.projects[i], Act::None, normed, MatMut::new(projected, d.patches, ch));
        for (y, row) in projected.chunks_exact_mut(d.cols * ch).enumerate() {
            tables.taps[i].add_row(y, row);
        }
        let x = Hwc::new(projected, d.rows, d.cols, ch);
        let resized = &mut a[..area(s) * ch];
        let x = match i {
            0 => {
                net.up(&head.up4, 4, x, HwcMut::new(resized, s.0, s.1, ch));
                Hwc::new(resized, s.0, s.1, ch)
            }
            1 => {
                net.up(&head.up2, 2, x, HwcMut::new(resized, s.0, s.1, ch));
                Hwc::new(resized, s.0, s.1, ch)
            }
            2 => x,
            _ => {
                let down = ConvLayer { stride: 2, ..ConvLayer::same(&head.down2, 3) };
                net.conv(down, x, None, HwcMut::new(resized, s.0, s.1, ch));
                Hwc::new(resized, s.0, s.1, ch)
            }
        };
        net.conv(ConvLayer::same(&head.lateral[i], 3), x, None, HwcMut::new(out, s.0, s.1, f));
        probe.check(format_args!("level {i} of a pyramid"))?;
    }

    // Fusion: c holds what came from the coarser level; a is each unit's hidden map.
    for i in (0..4).rev() {
        let (s, fusion) = (sizes[i], &head.fusion[i]);
        let n = area(s) * f;
        let finer = if i == 0 { (2 * s.0, 2 * s.1) } else { sizes[i - 1] };
        match &fusion.lateral {
            Some(unit) => {
                layers.unit(unit, s, lateral[i], a, b);
                probe.check(format_args!("a unit of a pyramid"))?;
                add_assign(net.ctx, &mut b[..n], &c[..n]);
                layers.unit(&fusion.unit, s, b, a, c);
            }
            None => layers.unit(&fusion.unit, s, lateral[i], a, c),
        }
        probe.check(format_args!("a unit of a pyramid"))?;
        let out = HwcMut::new(&mut a[..n], s.0, s.1, f);
        net.conv(ConvLayer::same(&fusion.out, 1), Hwc::new(&c[..n], s.0, s.1, f), None, out);
        let from = Hwc::new(&a[..n], s.0, s.1, f);
        bilinear(net.ctx, from, Corners::Aligned, HwcMut::new(&mut c[..area(finer) * f], finer.0, finer.1, f));
    }

    // Output: a = half the channels at 8x, b = the same at full size, a = hidden channels.
    let (s, half) = ((8 * d.rows, 8 * d.cols), f / 2);
    let small = &mut a[..area(s) * half];
    let fused = Hwc::new(&c[..area(s) * f], s.0, s.1, f);
    net.conv(ConvLayer::same(&head.output1, 3), fused, None, HwcMut::new(small, s.0, s.1, half));
    probe.check(format_args!("a pyramid"))?;
    let full = &mut b[..d.pixels() * half];
    let to = HwcMut::new(full, d.height, d.width, half);
    bilinear(net.ctx, Hwc::new(small, s.0, s.1, half), Corners::Aligned, to);
    net.ctx.pool.chunks(full, d.width * half, &|y, row, _| tables.full.add_row(y, row));
    let hidden = &mut a[..d.pixels() * head.hidden];
    let second = ConvLayer { act: Act::Relu, ..ConvLayer::same(&head.output2, 3) };
    let to = HwcMut::new(hidden, d.height, d.width, head.hidden);
    net.conv(second, Hwc::new(full, d.height, d.width, half), None, to);
    let hidden = Hwc::new(hidden, d.height, d.width, head.hidden);
    net.conv(
        ConvLayer::same(&head.last, 1).on_rectified(),
        hidden,
        None,
        HwcMut::new(job.out, d.height, d.width, head.out),
    );
    Ok(())
}
