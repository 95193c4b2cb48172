//! The integers inside [`super::attention_s8`], for tests: what every kernel must agree on with `==`.

use super::int8::{self, Heads};
use super::{FrameMask, scratch_len_s8};
use crate::cpu::Ctx;
use crate::gemm::NR;
use crate::mat::MatMut;
use crate::simd::LANES;
use std::sync::{Mutex, PoisonError};

/// Everything integer about one query of one head.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct QueryIntegers {
    /// Sum of query times key, for every key seen in order.
    pub scores: Vec<i32>,
    /// Weight of the key in its tile of 64, 0 to 254.
    pub weights: Vec<u8>,
    /// Sum of the weights of each tile.
    pub totals: Vec<i32>,
    /// Sum of weight times value for each channel of each tile.
    pub sums: Vec<i32>,
}

/// First row, head and count of the queries of a task.
#[derive(Clone, Copy)]
pub(crate) struct Place {
    pub row: usize,
    pub head: usize,
    pub queries: usize,
}

/// Collects from all tasks.
pub(crate) struct Watch {
    heads: usize,
    all: Mutex<Vec<QueryIntegers>>,
}

impl Watch {
    fn each(&self, place: Place, f: impl Fn(&mut QueryIntegers, usize, usize)) {
        let mut all = self.all.lock().unwrap_or_else(PoisonError::into_inner);
        for i in 0..place.queries {
            f(&mut all[(place.row + i) * self.heads + place.head], i / NR, i % NR);
        }
    }

    /// `scores` `[panel][rows][16]`, `keys` of the rows in use.
    pub(crate) fn scores(&self, place: Place, scores: &[i32], rows: usize, keys: usize) {
        self.each(place, |q, p, l| q.scores.extend((0..keys).map(|k| scores[(p * rows + k) * NR + l])));
    }

    /// `weights` `[panel][keys/4][16][4]`, `sums` `[panel][rows][16]`, both as the tiles have them: weights less 127.
    pub(crate) fn sums(
        &self,
        place: Place,
        (weights, panel, keys): (&[i8], usize, usize),
        totals: &[[i32; LANES]],
        (sums, rows, offsets): (&[i32], usize, &[f32]),
    ) {
        self.each(place, |q, p, l| {
            let weight = |k: usize| weights[p * panel + (k / 4 * NR + l) * 4 + k % 4];
            q.weights.extend((0..keys).map(|k| (i32::from(weight(k)) + 127) as u8));
            q.totals.push(totals[p][l] + 127 * keys.next_multiple_of(4) as i32);
            q.sums.extend(offsets.iter().enumerate().map(|(c, o)| sums[(p * rows + c) * NR + l] + *o as i32));
        });
    }
}

/// Runs [`super::attention_s8`] and returns its integers, query by query and, inside, head by head; allocates.
pub fn attention_s8_integers(ctx: Ctx, x: Heads, mask: FrameMask) -> Vec<QueryIntegers> {
    let d = x.checked(&mask);
    let rows = x.qkv.rows;
    let watch = Watch { heads: x.heads, all: Mutex::new(vec![QueryIntegers::default(); rows * x.heads]) };
    let mut scratch = vec![0.0; scratch_len_s8(&mask, x.heads, d, ctx.pool.threads())];
    let mut out = vec![0.0; rows * x.heads * d];
    int8::run(ctx, x, mask, &mut scratch, MatMut::new(&mut out, rows, x.heads * d), Some(&watch));
    watch.all.into_inner().unwrap_or_else(PoisonError::into_inner)
}
