//! Transformer block, Pi3 decoder and dense heads, by name from the weights (network specification 1.3,
//! 2.2).

use super::{Network, Weights};
use crate::embed::PositionEmbedding;
use crate::preprocess::Normaliser;
use crate::tables;
use sf_formats::config::{Head, RcuSkip, Trunk};
use sf_ops::attention::FrameMask;
use sf_ops::mat::{Hwc, Mat};
use sf_ops::reference as naive;
use sf_ops::resize::Corners;
use sf_ops::rope::{QkNorm, RopeTable};

/// Which optional parts a block has.
#[derive(Clone, Copy)]
pub(super) enum Kind {
    /// Layer scale.
    Encoder,
    /// Layer scale, q/k norms.
    Aa { qk_eps: f32 },
    /// Neither.
    Decoder,
}

/// What a block needs beside its weights.
#[derive(Clone, Copy)]
pub(super) struct Attention<'a> {
    pub(super) mask: FrameMask,
    pub(super) rope: Option<&'a RopeTable>,
    pub(super) dim: usize,
    pub(super) heads: usize,
    pub(super) eps: f32,
    pub(super) kind: Kind,
}

impl Attention<'_> {
    /// One frame that sees itself, no positions.
    pub(super) fn own_frame(t: &Trunk, kind: Kind, tokens: usize) -> Attention<'static> {
        Attention {
            mask: FrameMask { frames: 1, tokens, lo: 0, hi: 0 },
            rope: None,
            dim: t.dim as usize,
            heads: t.heads as usize,
            eps: t.eps as f32,
            kind,
        }
    }
}

pub(super) fn decoder_trunk(dim: u32, depth: u32, heads: u32, eps: f64) -> Trunk {
    Trunk { dim, depth, heads, registers: 0, mlp_ratio: 4, eps }
}

/// x += ls1 attention(norm1 x); x += ls2 mlp(norm2 x), in place on `[rows, dim]`.
pub(super) fn block(w: &Weights, p: &str, x: &mut [f32], a: Attention) {
    let dim = a.dim;
    let rows = x.len() / dim;
    let get = |name: &str| w.get(&format!("{p}.{name}"));
    let linear = |name: &str, x: &[f32]| {
        let b = get(&format!("{name}.bias"));
        let wt = get(&format!("{name}.weight"));
        let k = wt.len() / b.len();
        let x = w.input(&format!("{p}.{name}"), x, k);
        naive::linear(Mat::new(&x, rows, k), wt, Some(b))
    };
    let norm = |name: &str, x: &[f32]| {
        let (gain, offset) = (get(&format!("{name}.weight")), get(&format!("{name}.bias")));
        naive::layernorm(Mat::new(x, rows, dim), gain, offset, a.eps)
    };
    let add = |x: &mut [f32], y: &[f32], scale: &str| {
        let gamma = w.optional(&format!("{p}.{scale}.gamma"));
        for (i, (x, y)) in x.iter_mut().zip(y).enumerate() {
            *x += gamma.map_or(1.0, |g| g[i % dim]) * y;
        }
    };
    let mut qkv = linear("attn.qkv", &norm("norm1", x));
    let qk = match a.kind {
        Kind::Aa { qk_eps } => Some(QkNorm {
            q_gain: get("attn.q_norm.weight"),
            q_offset: get("attn.q_norm.bias"),
            k_gain: get("attn.k_norm.weight"),
            k_offset: get("attn.k_norm.bias"),
            eps: qk_eps,
        }),
        Kind::Encoder | Kind::Decoder => None,
    };
    naive::qk_norm_rope(&mut qkv, rows, a.heads, qk.as_ref(), a.rope);
    let mixed = naive::attention(Mat::new(&qkv, rows, 3 * dim), a.heads, a.mask);
    add(x, &linear("attn.proj", &mixed), "ls1");
    let hidden: Vec<f32> = linear("mlp.fc1", &norm("norm2", x)).into_iter().map(naive::gelu).collect();
    add(x, &linear("mlp.fc2", &hidden), "ls2");
}

/// Pi3's decoder on `[frames, registers + patches, inputs]`; patch tokens of `linear_out`.
pub(super) fn decoder(net: &Network, p: &str, x: &[f32], trunk: &Trunk, registers: usize) -> Vec<f32> {
    let d = &net.d;
    let per_frame = d.patches + registers;
    let rows = d.frames * per_frame;
    let linear = |name: &str, x: &[f32]| {
        let (w, b) = (net.w.get(&format!("{p}.{name}.weight")), net.w.get(&format!("{p}.{name}.bias")));
        naive::linear(Mat::new(x, rows, x.len() / rows), w, Some(b))
    };
    let mut x = linear("projects", x);
    let places = tables::rope_table(net.config, registers, (d.rows, d.cols), (trunk.dim / trunk.heads) as usize);
    for j in 0..trunk.depth {
        let mask = d.frame_mask(per_frame);
        let attention = Attention { mask, rope: Some(&places), ..Attention::own_frame(trunk, Kind::Decoder, 0) };
        block(net.w, &format!("{p}.blocks.{j}"), &mut x, attention);
    }
    net.patches(&linear("linear_out", &x), registers)
}

/// Decoder, linear layer, pixel shuffle: `[frames, height, width, out]`.
pub(super) fn linear_head(net: &Network, name: &str, x: &[f32], head: &Head, registers: usize) -> Vec<f32> {
    let d = &net.d;
    let trunk = decoder_trunk(head.dim, head.depth, head.heads, head.eps);
    let decoded = decoder(net, &format!("{name}_decoder"), x, &trunk, registers);
    let dim = head.dim as usize;
    let w = net.w.get(&format!("{name}_head.proj.weight"));
    let b = net.w.get(&format!("{name}_head.proj.bias"));
    let mut out = Vec::new();
    for frame in decoded.chunks_exact(d.patches * dim) {
        let pixels = naive::linear(Mat::new(frame, d.patches, dim), w, Some(b));
        let pixels = Mat::new(&pixels, d.patches, b.len());
        out.extend(naive::pixel_shuffle(pixels, (d.rows, d.cols), net.config.patch as usize));
    }
    out
}

/// relu(conv 3x3 stride 2) of every normalised image: `[frames, height/2, width/2, guide.channels]`.
pub(super) fn image_stem(net: &Network) -> Vec<f32> {
    let d = &net.d;
    let normaliser = Normaliser::new(net.config);
    let mut out = Vec::new();
    for f in 0..d.frames {
        let mut image = vec![0.0; d.pixels() * 3];
        normaliser.apply(net.input.frame(f), &mut image);
        let image = Map { data: image, h: d.height, w: d.width };
        out.extend(image.conv(net.w, "image_stem", 3, 2).map(naive::relu).data);
    }
    out
}

/// Decoder, linear layer to half resolution, convolutions beside the image stem, pixel shuffle:
/// `[frames, height, width, out]`.
pub(super) fn guided_head(
    net: &Network,
    name: &str,
    (x, guide): (&[f32], &[f32]),
    head: &Head,
    registers: usize,
) -> Vec<f32> {
    let d = &net.d;
    let (h, w, dim) = (d.height / 2, d.width / 2, head.dim as usize);
    let trunk = decoder_trunk(head.dim, head.depth, head.heads, head.eps);
    let decoded = decoder(net, &format!("{name}_decoder"), x, &trunk, registers);
    let proj = net.w.get(&format!("{name}_head.proj.weight"));
    let bias = net.w.get(&format!("{name}_head.proj.bias"));
    let conv = |i: usize, x: &Map| x.conv(net.w, &format!("{name}_head.conv.{i}"), 3, 1);
    let mut out = Vec::new();
    for (tokens, guide) in decoded.chunks_exact(d.patches * dim).zip(guide.chunks_exact(guide.len() / d.frames)) {
        let spread = naive::linear(Mat::new(tokens, d.patches, dim), proj, Some(bias));
        let spread = Mat::new(&spread, d.patches, bias.len());
        let features = naive::pixel_shuffle(spread, (d.rows, d.cols), net.config.patch as usize / 2);
        let pixels = features.chunks_exact(head.hidden as usize).zip(guide.chunks_exact(guide.len() / (h * w)));
        let joined = Map { data: pixels.flat_map(|(f, g)| [f, g].concat()).collect(), h, w };
        let x = conv(0, &joined).map(naive::relu);
        let y = conv(1, &x).map(naive::relu);
        let y = conv(2, &y).plus(&x).map(naive::relu);
        let o = conv(3, &y);
        out.extend(naive::pixel_shuffle(Mat::new(&o.data, h * w, 4 * head.out as usize), (h, w), 2));
    }
    out
}

/// A map with its size, channels last.
struct Map {
    data: Vec<f32>,
    h: usize,
    w: usize,
}

impl Map {
    fn view(&self) -> Hwc<'_> {
        Hwc::new(&self.data, self.h, self.w, self.data.len() / (self.h * self.w))
    }

    /// Convolution with a named layer, padding kernel / 2.
    fn conv(&self, w: &Weights, name: &str, kernel: usize, stride: usize) -> Map {
        let weight = w.get(&format!("{name}.weight"));
        let bias = w.optional(&format!("{name}.bias"));
        let window = naive::Window { kernel, stride, pad: kernel / 2 };
        let out = |n| sf_ops::conv::conv_out(n, kernel, stride, kernel / 2);
        Map { data: naive::conv2d(self.view(), weight, bias, window), h: out(self.h), w: out(self.w) }
    }

    fn map(&self, f: impl Fn(f32) -> f32) -> Map {
        Map { data: self.data.iter().map(|&v| f(v)).collect(), h: self.h, w: self.w }
    }

    fn plus(mut self, other: &Map) -> Map {
        assert_eq!((self.h, self.w), (other.h, other.w), "sizes of a sum");
        self.data.iter_mut().zip(&other.data).for_each(|(a, b)| *a += b);
        self
    }

    fn resized(&self, h: usize, w: usize) -> Map {
        Map { data: naive::bilinear(self.view(), Corners::Aligned, h, w), h, w }
    }

    fn with_positions(mut self, aspect: f64) -> Map {
        let channels = self.view().c;
        let table = PositionEmbedding::new(self.h, self.w, channels, aspect);
        self.data.chunks_exact_mut(self.w * channels).enumerate().for_each(|(y, row)| table.add_row(y, row));
        self
    }
}

struct Dpt<'a> {
    w: &'a Weights,
    p: String,
    skip: RcuSkip,
}

impl Dpt<'_> {
    fn conv(&self, name: &str, x: &Map, kernel: usize, stride: usize) -> Map {
        x.conv(self.w, &format!("{}.{name}", self.p), kernel, stride)
    }

    fn up(&self, name: &str, x: &Map, kernel: usize) -> Map {
        let w = self.w.get(&format!("{}.{name}.weight", self.p));
        let b = self.w.get(&format!("{}.{name}.bias", self.p));
        Map { data: naive::conv_transpose(x.view(), w, Some(b), kernel), h: x.h * kernel, w: x.w * kernel }
    }

    /// conv2(relu(conv1(relu x))) plus relu(x) or x.
    fn unit(&self, name: &str, x: &Map) -> Map {
        let r = x.map(naive::relu);
        let hidden = self.conv(&format!("{name}.conv1"), &r, 3, 1).map(naive::relu);
        let y = self.conv(&format!("{name}.conv2"), &hidden, 3, 1);
        match self.skip {
            RcuSkip::Relu => y.plus(&r),
            RcuSkip::Raw => y.plus(x),
        }
    }
}

/// VGGT's pyramid on four taps of patch tokens `[frames, patches, inputs]`: `[frames, height, width, out]`.
pub(super) fn dpt(net: &Network, name: &str, taps: &[Vec<f32>], head: &Head) -> Vec<f32> {
    let d = &net.d;
    let aspect = d.width as f64 / d.height as f64;
    let dpt = Dpt { w: net.w, p: format!("{name}_head"), skip: head.rcu_skip };
    let (gain, offset) = (net.w.get(&format!("{name}_head.norm.weight")), net.w.get(&format!("{name}_head.norm.bias")));
    let inputs = gain.len();
    let mut out = Vec::new();
    for f in 0..d.frames {
        let laterals: Vec<Map> = (0..4)
            .map(|i| {
                let tokens = Mat::new(&taps[i][f * d.patches * inputs..][..d.patches * inputs], d.patches, inputs);
                let data = naive::layernorm(tokens, gain, offset, head.eps as f32);
                let x = Map { data, h: d.rows, w: d.cols };
                let x = dpt.conv(&format!("projects.{i}"), &x, 1, 1).with_positions(aspect);
                let x = match i {
                    0 => dpt.up("resize_layers.0", &x, 4),
                    1 => dpt.up("resize_layers.1", &x, 2),
                    2 => x,
                    _ => dpt.conv("resize_layers.3", &x, 3, 2),
                };
                dpt.conv(&format!("scratch.layer{}_rn", i + 1), &x, 3, 1)
            })
            .collect();
        let mut top: Option<Map> = None;
        for i in (0..4).rev() {
            let r = format!("scratch.refinenet{}", i + 1);
            let lateral = &laterals[i];
            let y = match top {
                None => lateral.map(|v| v),
                Some(top) => top.plus(&dpt.unit(&format!("{r}.resConfUnit1"), lateral)),
            };
            let y = dpt.unit(&format!("{r}.resConfUnit2"), &y);
            let (h, w) = if i == 0 { (2 * y.h, 2 * y.w) } else { (laterals[i - 1].h, laterals[i - 1].w) };
            top = Some(dpt.conv(&format!("{r}.out_conv"), &y.resized(h, w), 1, 1));
        }
        let y = dpt.conv("scratch.output_conv1", &top.expect("four levels"), 3, 1);
        let y = y.resized(d.height, d.width).with_positions(aspect);
        let y = dpt.conv("scratch.output_conv2.0", &y, 3, 1).map(naive::relu);
        out.extend(dpt.conv("scratch.output_conv2.2", &y, 1, 1).data);
    }
    out
}
