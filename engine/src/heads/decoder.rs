//! Pi3's transformer decoder: projection, frame-local blocks with rotary positions, projection (network
//! specification 1.3, step 8). No layer scale, no q/k norms.

use crate::arena::{carve, carved_len};
use crate::block::{self, BlockShape, Sight};
use crate::dims::Dims;
use crate::features::Features;
use crate::model::Decoder;
use crate::net::Net;
use crate::probe::Probe;
use crate::tables::{Tables, Tokens};
use sf_formats::Result;
use sf_ops::gemm::Act;
use sf_ops::mat::{Mat, MatMut};

/// Tokens, block scratch.
fn lens(decoder: &Decoder, d: &Dims, tokens: usize, threads: usize) -> [usize; 2] {
    let mask = d.frame_mask(tokens);
    [d.frames * tokens * decoder.projects.weight.n, BlockShape::most(&decoder.blocks, &mask, threads)]
}

/// Values of working memory of [`run`].
pub(crate) fn scratch_len(decoder: &Decoder, d: &Dims, tokens: usize, threads: usize) -> usize {
    carved_len(lens(decoder, d, tokens, threads))
}

/// Which tokens of the features take part.
#[derive(Clone, Copy)]
pub(crate) struct Job<'a> {
    pub(crate) name: &'static str,
    pub(crate) x: Features<'a>,
    pub(crate) tokens: Tokens,
}

impl Job<'_> {
    /// Tokens per frame.
    pub(crate) fn per_frame(&self, d: &Dims) -> usize {
        match self.tokens {
            Tokens::WithRegisters => self.x.tokens(),
            Tokens::Patches => d.patches,
        }
    }
}

/// Runs the decoder; `out` receives `[frames, tokens, linear_out]`, registers included where they take
/// part.
pub(crate) fn run(
    net: Net,
    decoder: &Decoder,
    (d, tables): (&Dims, &Tables),
    job: Job,
    (scratch, out): (&mut [f32], &mut [f32]),
    probe: &Probe,
) -> Result<()> {
    let per_frame = job.per_frame(d);
    let dim = decoder.projects.weight.n;
    let rows = d.frames * per_frame;
    let [x, scratch] = carve(scratch, lens(decoder, d, per_frame, net.ctx.pool.threads()));
    match job.tokens {
        Tokens::WithRegisters => net.linear(&decoder.projects, Act::None, job.x.all(), MatMut::new(x, rows, dim)),
        Tokens::Patches => {
            for (f, frame) in x.chunks_exact_mut(per_frame * dim).enumerate() {
                net.linear(&decoder.projects, Act::None, job.x.patches(f), MatMut::new(frame, per_frame, dim));
            }
        }
    }
    let mask = d.frame_mask(per_frame);
    for (j, weights) in decoder.blocks.iter().enumerate() {
        let rope = tables.rope(dim / weights.heads, job.tokens);
        block::forward(net, weights, x, Sight { mask, rope: Some(rope) }, scratch);
        probe.layer(format_args!("{}.{j}", job.name), x)?;
    }
    let width = decoder.linear_out.weight.n;
    net.linear(&decoder.linear_out, Act::None, Mat::new(x, rows, dim), MatMut::new(out, rows, width));
    Ok(())
}
