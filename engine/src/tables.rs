//! Tables that depend on the clip shape alone: computed once per session.

use crate::dims::Dims;
use crate::embed::PositionEmbedding;
use crate::model::{DenseHead, Dpt, Model};
use sf_formats::config::{AngleRound, ModelConfig};
use sf_ops::rope::{self, RopeTable};

/// Position embeddings inside a DPT head.
#[derive(Clone, Debug)]
pub(crate) struct DptTables {
    /// On the patch grid, one per tap (the channel counts differ).
    pub(crate) taps: [PositionEmbedding; 4],
    /// At the network's size, before the last two convolutions.
    pub(crate) full: PositionEmbedding,
}

impl DptTables {
    fn new(dpt: &Dpt, d: &Dims) -> DptTables {
        let aspect = d.width as f64 / d.height as f64;
        DptTables {
            taps: dpt.channels.map(|c| PositionEmbedding::new(d.rows, d.cols, c, aspect)),
            full: PositionEmbedding::new(d.height, d.width, dpt.features / 2, aspect),
        }
    }

    fn of(head: Option<&DenseHead>, d: &Dims) -> Option<DptTables> {
        match head {
            Some(DenseHead::Dpt(dpt)) => Some(DptTables::new(dpt, d)),
            _ => None,
        }
    }
}

/// Which tokens a block runs on: their positions differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Tokens {
    /// Registers at (0, 0), then patches.
    WithRegisters,
    /// Patches alone.
    Patches,
}

/// Everything a session looks up.
pub(crate) struct Tables {
    /// `[1 + patches, dim]`: the class token's row, then the resized grid.
    pub(crate) positions: Vec<f32>,
    ropes: Vec<(usize, Tokens, RopeTable)>,
    pub(crate) depth: Option<DptTables>,
    pub(crate) conf: Option<DptTables>,
    pub(crate) gs: Option<DptTables>,
    pub(crate) motion: Option<DptTables>,
}

impl Tables {
    pub(crate) fn new(model: &Model, d: &Dims) -> Tables {
        let (c, w) = (model.config(), model.weights());
        let mut tables = Tables {
            positions: positions(c, model.values(w.positions), d.rows, d.cols),
            ropes: Vec::new(),
            depth: DptTables::of(Some(&w.depth), d),
            conf: DptTables::of(w.conf.as_ref(), d),
            gs: DptTables::of(w.gs.as_ref(), d),
            motion: DptTables::of(w.motion.as_ref(), d),
        };
        for block in w.aa.iter().chain(&w.camera.decoder.blocks) {
            tables.add(c, d, block.dim / block.heads, Tokens::WithRegisters);
        }
        for head in [Some(&w.depth), w.conf.as_ref(), w.gs.as_ref()].into_iter().flatten() {
            if let Some(decoder) = head.decoder() {
                decoder.blocks.iter().for_each(|b| tables.add(c, d, b.dim / b.heads, Tokens::WithRegisters));
            }
        }
        for block in &w.causal {
            tables.add(c, d, block.dim / block.heads, causal_tokens(c));
        }
        if let Some(decoder) = w.motion.as_ref().and_then(DenseHead::decoder) {
            decoder.blocks.iter().for_each(|b| tables.add(c, d, b.dim / b.heads, Tokens::Patches));
        }
        tables
    }

    fn add(&mut self, config: &ModelConfig, d: &Dims, head_dim: usize, tokens: Tokens) {
        if !self.ropes.iter().any(|(h, t, _)| (*h, *t) == (head_dim, tokens)) {
            let registers = match tokens {
                Tokens::WithRegisters => config.aa.registers as usize,
                Tokens::Patches => 0,
            };
            self.ropes.push((head_dim, tokens, rope_table(config, registers, (d.rows, d.cols), head_dim)));
        }
    }

    /// Rotary table of heads this wide.
    pub(crate) fn rope(&self, head_dim: usize, tokens: Tokens) -> &RopeTable {
        let found = self.ropes.iter().find(|(h, t, _)| (*h, *t) == (head_dim, tokens));
        &found.expect("rotary tables of all blocks are made with the session").2
    }
}

/// Tokens of the causal module.
pub(crate) fn causal_tokens(config: &ModelConfig) -> Tokens {
    if config.causal_registers { Tokens::WithRegisters } else { Tokens::Patches }
}

/// The stored table `[1 + grid^2, dim]` resized to a patch grid: `[1 + rows cols, dim]`.
pub(crate) fn positions(config: &ModelConfig, stored: &[f32], rows: usize, cols: usize) -> Vec<f32> {
    let (dim, grid) = (config.encoder.dim as usize, config.pos_grid as usize);
    let mut out = Vec::with_capacity((1 + rows * cols) * dim);
    out.extend_from_slice(&stored[..dim]);
    out.extend(sf_ops::resize::position_table(&stored[dim..], grid, dim, (rows, cols)));
    out
}

/// Registers at (0, 0), patches at (row + 1, column + 1).
pub(crate) fn rope_table(config: &ModelConfig, registers: usize, grid: (usize, usize), head_dim: usize) -> RopeTable {
    let mut places = vec![(0u32, 0u32); registers];
    for y in 0..grid.0 as u32 {
        places.extend((0..grid.1 as u32).map(|x| (y + 1, x + 1)));
    }
    let round = match config.rope_round {
        AngleRound::None => rope::AngleRound::None,
        AngleRound::Bf16 => rope::AngleRound::Bf16,
    };
    RopeTable::new(&places, head_dim, config.rope_base, round)
}
