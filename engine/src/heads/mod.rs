//! Dense heads and the camera head.
//!
//! | file | what |
//! |---|---|
//! | `decoder.rs` | Pi3's transformer decoder, shared by the camera, the linear and the guided heads |
//! | `linear.rs` | one linear layer and a pixel shuffle |
//! | `guided.rs` | half-resolution convolutions beside the image |
//! | `stem.rs` | the image as guided heads see it |
//! | `dpt.rs` | VGGT's convolutional pyramid over four taps |
//! | `camera.rs` | pose and field of view |
//!
//! A dense head works in two steps: [`prepare`] runs what wants all frames at once (a decoder), [`frame`]
//! gives one frame's raw map. Only one frame's pyramid is ever in memory.

pub(crate) mod camera;
pub(crate) mod decoder;
pub(crate) mod dpt;
pub(crate) mod guided;
pub(crate) mod linear;
pub(crate) mod stem;

use crate::dims::Dims;
use crate::features::Features;
use crate::model::DenseHead;
use crate::net::Net;
use crate::probe::Probe;
use crate::tables::{DptTables, Tables, Tokens};
use sf_formats::Result;

/// What a dense head reads.
#[derive(Clone, Copy)]
pub(crate) enum Source<'a> {
    /// One tensor, for a decoder.
    Tokens(Features<'a>),
    /// Four taps, for a pyramid.
    Taps([Features<'a>; 4]),
}

/// A dense head at work on a clip.
pub(crate) struct Dense<'a> {
    pub(crate) net: Net<'a>,
    pub(crate) dims: &'a Dims,
    pub(crate) tables: &'a Tables,
    pub(crate) dpt: Option<&'a DptTables>,
    /// The image stem of all frames; empty where no head is guided.
    pub(crate) guide: &'a [f32],
    pub(crate) head: &'a DenseHead,
    /// Which tokens a decoder runs on.
    pub(crate) tokens: Tokens,
    pub(crate) name: &'static str,
}

impl Dense<'_> {
    /// What a decoder makes of the tokens.
    fn job<'x>(&self, x: Features<'x>) -> decoder::Job<'x> {
        decoder::Job { name: self.name, x, tokens: self.tokens }
    }

    /// The part over all frames; its result stays at the start of `scratch` for [`Dense::frame`].
    pub(crate) fn prepare(&self, source: Source, scratch: &mut [f32], probe: &mut Probe) -> Result<()> {
        match (self.head, source) {
            (DenseHead::Linear(head), Source::Tokens(x)) => {
                linear::prepare(self.net, head, (self.dims, self.tables), self.job(x), scratch, probe)
            }
            (DenseHead::Guided(head), Source::Tokens(x)) => {
                guided::prepare(self.net, head, (self.dims, self.tables), self.job(x), scratch, probe)
            }
            (DenseHead::Dpt(_), Source::Taps(_)) => Ok(()),
            _ => unreachable!("the source is chosen by the kind of the head"),
        }
    }

    /// The raw map of one frame, `[height, width, channels]`.
    ///
    /// Cancelling and deadlines are looked at inside, too: a map may take many times as long as a block.
    pub(crate) fn frame(
        &self,
        source: Source,
        frame: usize,
        (scratch, out): (&mut [f32], &mut [f32]),
        probe: &Probe,
    ) -> Result<()> {
        match (self.head, source) {
            (DenseHead::Linear(head), Source::Tokens(x)) => {
                linear::frame(self.net, head, self.dims, self.job(x).per_frame(self.dims), (frame, scratch, out));
                Ok(())
            }
            (DenseHead::Guided(head), Source::Tokens(x)) => {
                let per_frame = self.job(x).per_frame(self.dims);
                let job = guided::Paint { frame, per_frame, guide: self.guide, scratch, out };
                guided::frame(self.net, head, self.dims, job, probe)
            }
            (DenseHead::Dpt(head), Source::Taps(taps)) => {
                let tables = self.dpt.expect("a pyramid has its position tables");
                dpt::frame(self.net, head, tables, self.dims, dpt::Pyramid { taps, frame, scratch, out }, probe)
            }
            _ => unreachable!("the source is chosen by the kind of the head"),
        }
    }
}

/// Channels of the raw map.
pub(crate) fn channels(head: &DenseHead) -> usize {
    match head {
        DenseHead::Linear(h) => h.out,
        DenseHead::Guided(h) => h.out,
        DenseHead::Dpt(h) => h.out,
    }
}

/// Values of working memory of a dense head over `tokens` tokens per frame.
pub(crate) fn scratch_len(head: &DenseHead, dims: &Dims, tokens: usize, threads: usize) -> usize {
    match head {
        DenseHead::Linear(h) => linear::scratch_len(h, dims, tokens, threads),
        DenseHead::Guided(h) => guided::scratch_len(h, dims, tokens, threads),
        DenseHead::Dpt(h) => dpt::scratch_len(h, dims),
    }
}
