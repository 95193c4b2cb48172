//! What a session holds beside its arena and results: the working memory of its threads and the tables of its shape.
//!
//! Sizes only, for [`Plan`](crate::Plan); the functions that announce a kernel's working memory stand beside the kernels.

use crate::dims::Dims;
use crate::heads::dpt;
use crate::model::{Block, Decoder, DenseHead, Dpt, Guided, Linear, Model};
use crate::net;
use crate::tables::{Tokens, causal_tokens};
use sf_ops::{conv, conv_s8, gemm};

/// Height, width, channels of a convolution's input.
type Map = (usize, usize, usize);

/// Most values that an operation of the network asks of each thread of the pool.
struct Most(usize);

impl Most {
    fn take(&mut self, values: usize) {
        self.0 = self.0.max(values);
    }

    fn linear(&mut self, l: &Linear) {
        let k = l.weight.k;
        // The rotation works on one row.
        self.take(if l.weight.is_int8() { gemm::working_memory_s8(k).max(k) } else { gemm::working_memory(k) });
    }

    fn linears<'a>(&mut self, list: impl IntoIterator<Item = &'a Linear>) {
        list.into_iter().for_each(|l| self.linear(l));
    }

    /// A convolution padded by half its kernel.
    fn conv(&mut self, l: &Linear, x: Map, kernel: usize, stride: usize) {
        let pad = kernel / 2;
        self.take(match (l.weight.is_int8(), kernel > stride) {
            (true, _) => conv_s8::working_memory_conv_s8(x, kernel, stride, pad),
            (false, true) => conv::working_memory_conv(x, kernel, stride, pad),
            // Windows that do not overlap are rows of a product.
            (false, false) => gemm::working_memory(l.weight.k),
        });
    }

    /// A transposed convolution: pixels are the rows of a product.
    fn up(&mut self, l: &Linear, x: Map) {
        self.conv(l, x, 1, 1);
    }

    fn blocks(&mut self, blocks: &[Block]) {
        for b in blocks {
            self.linears([&b.qkv, &b.proj, &b.fc1, &b.fc2]);
            if net::is_pair(&b.fc1.weight, &b.fc2.weight) {
                self.take(gemm::working_memory_s8_quantize(b.dim, b.hidden));
            }
            // Query and key norms and the rotary embedding of a row, where attention does not do them.
            let head = (b.dim / b.heads).next_multiple_of(16);
            self.take(2 * b.heads * head + 16);
        }
    }

    fn decoder(&mut self, d: &Decoder) {
        self.linears([&d.projects, &d.linear_out]);
        self.blocks(&d.blocks);
    }

    fn guided(&mut self, head: &Guided, d: &Dims) {
        self.decoder(&head.decoder);
        self.linear(&head.proj);
        for (i, l) in head.convs.iter().enumerate() {
            let channels = if i == 0 { head.hidden + head.guide } else { head.features };
            self.conv(l, (d.height / 2, d.width / 2, channels), 3, 1);
        }
    }

    fn pyramid(&mut self, head: &Dpt, d: &Dims) {
        let (sizes, f) = (dpt::levels(d), head.features);
        let patches = |level: usize| (d.rows, d.cols, head.channels[level]);
        self.linears(&head.projects);
        self.up(&head.up4, patches(0));
        self.up(&head.up2, patches(1));
        self.conv(&head.down2, patches(3), 3, 2);
        for (i, s) in sizes.into_iter().enumerate() {
            self.conv(&head.lateral[i], (s.0, s.1, head.channels[i]), 3, 1);
            let fusion = &head.fusion[i];
            for unit in fusion.lateral.iter().chain([&fusion.unit]) {
                self.conv(&unit.conv1, (s.0, s.1, f), 3, 1);
                self.conv(&unit.conv2, (s.0, s.1, f), 3, 1);
            }
            self.conv(&fusion.out, (s.0, s.1, f), 1, 1);
        }
        self.conv(&head.output1, (8 * d.rows, 8 * d.cols, f), 3, 1);
        self.conv(&head.output2, (d.height, d.width, f / 2), 3, 1);
        self.conv(&head.last, (d.height, d.width, head.hidden), 1, 1);
    }

    fn head(&mut self, head: &DenseHead, d: &Dims) {
        match head {
            DenseHead::Linear(h) => {
                self.decoder(&h.decoder);
                self.linear(&h.proj);
            }
            DenseHead::Guided(h) => self.guided(h, d),
            DenseHead::Dpt(h) => self.pyramid(h, d),
        }
    }
}

/// Values of working memory of each thread: the most that any operation of a run announces.
pub(crate) fn thread_values(model: &Model, d: &Dims) -> usize {
    let w = model.weights();
    let mut most = Most(0);
    // Patches do not overlap; they are floats.
    most.linear(&w.patch);
    most.blocks(&w.encoder);
    most.blocks(&w.aa);
    most.linears(&w.aa_time);
    most.decoder(&w.camera.decoder);
    most.linears(w.camera.units.iter().flatten().chain(&w.camera.mlps));
    most.linears([&w.camera.t, &w.camera.rot].into_iter().chain(&w.camera.fov));
    if let Some(stem) = &w.stem {
        most.conv(stem, (d.height, d.width, 3), 3, 2);
    }
    for head in [Some(&w.depth), w.conf.as_ref(), w.gs.as_ref()].into_iter().flatten() {
        most.head(head, d);
    }
    if model.config().has_motion() && d.frames > 1 {
        most.blocks(&w.causal);
        w.causal_back.iter().for_each(|blocks| most.blocks(blocks));
        w.motion.iter().for_each(|head| most.head(head, d));
    }
    most.0
}

/// Values of the tables of a shape: positions of patches, rotary angles, positions inside pyramids.
pub(crate) fn table_values(model: &Model, d: &Dims) -> usize {
    let (c, w) = (model.config(), model.weights());
    let mut ropes: Vec<(usize, Tokens)> = Vec::new();
    let mut rope = |blocks: &[Block], tokens: Tokens| {
        ropes.extend(blocks.iter().map(|b| (b.dim / b.heads, tokens)));
    };
    rope(&w.aa, Tokens::WithRegisters);
    rope(&w.camera.decoder.blocks, Tokens::WithRegisters);
    for head in [Some(&w.depth), w.conf.as_ref(), w.gs.as_ref()].into_iter().flatten() {
        head.decoder().iter().for_each(|d| rope(&d.blocks, Tokens::WithRegisters));
    }
    rope(&w.causal, causal_tokens(c));
    w.motion.iter().filter_map(DenseHead::decoder).for_each(|d| rope(&d.blocks, Tokens::Patches));
    ropes.sort_unstable_by_key(|&(width, tokens)| (width, tokens as usize));
    ropes.dedup();
    let angles = ropes.into_iter().map(|(width, tokens)| {
        let tokens = if tokens == Tokens::Patches { d.patches } else { d.tokens };
        // Sines and cosines, each with a vector behind them.
        2 * (tokens * width / 2 + 16)
    });
    let pyramid = |head: &DenseHead| match head {
        DenseHead::Dpt(h) => {
            let taps: usize = h.channels.iter().map(|c| (d.rows + d.cols) * (c / 2)).sum();
            taps + (d.height + d.width) * (h.features / 4)
        }
        _ => 0,
    };
    let heads = [Some(&w.depth), w.conf.as_ref(), w.gs.as_ref(), w.motion.as_ref()].into_iter().flatten();
    (1 + d.patches) * c.encoder.dim as usize + angles.sum::<usize>() + heads.map(pyramid).sum::<usize>()
}
