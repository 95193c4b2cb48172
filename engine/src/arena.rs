//! The one block of working memory of a session.
//!
//! The plan fixes its size; stages carve it into named disjoint slices, and stages that never overlap
//! in time carve the same bytes. Every slice starts on a 64-byte line, so vector loads never straddle.

use sf_formats::{Error, Result};

/// f32 values in a 64-byte line.
const LINE: usize = 16;

/// Working memory of a session, zeroed once, 64-byte aligned.
#[derive(Debug)]
pub(crate) struct Arena {
    block: Vec<f32>,
    start: usize,
    len: usize,
}

impl Arena {
    /// Memory for `len` values; `Resource` when the system has none.
    pub(crate) fn new(len: usize) -> Result<Arena> {
        let block = filled("arena", len + LINE, 0.0f32)?;
        let address = block.as_ptr() as usize;
        let start = (address.next_multiple_of(4 * LINE) - address) / 4;
        Ok(Arena { block, start, len })
    }

    /// All of it.
    pub(crate) fn all(&mut self) -> &mut [f32] {
        &mut self.block[self.start..self.start + self.len]
    }
}

/// `len` copies of `value`; `Resource` when the system has no memory for them.
pub(crate) fn filled<T: Clone>(what: &str, len: usize, value: T) -> Result<Vec<T>> {
    let mut out = Vec::new();
    out.try_reserve_exact(len).map_err(|_| {
        let bytes = len.saturating_mul(size_of::<T>());
        Error::resource(what, format!("{bytes} bytes are not available: use fewer or smaller frames"))
    })?;
    out.resize(len, value);
    Ok(out)
}

/// Values a slice of `len` takes in the arena.
fn padded(len: usize) -> usize {
    len.next_multiple_of(LINE)
}

/// Values that [`carve`] needs for these slices.
pub(crate) fn carved_len<const N: usize>(lens: [usize; N]) -> usize {
    lens.into_iter().map(padded).sum()
}

/// Cuts the start of `block` into slices of exactly `lens` values, each on its own lines.
///
/// The same `lens` function serves the plan and the stage, so that they cannot disagree.
pub(crate) fn carve<const N: usize>(block: &mut [f32], lens: [usize; N]) -> [&mut [f32]; N] {
    let need = carved_len(lens);
    assert!(need <= block.len(), "arena area of {} values is smaller than the {need} carved", block.len());
    let mut rest = block;
    lens.map(|len| {
        let (area, tail) = std::mem::take(&mut rest).split_at_mut(padded(len));
        rest = tail;
        &mut area[..len]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slices_are_aligned_disjoint_and_exact() {
        let lens = [1, 0, 17, 64];
        assert_eq!(carved_len(lens), 16 + 32 + 64);
        let mut arena = Arena::new(carved_len(lens)).unwrap();
        let parts = carve(arena.all(), lens);
        for (i, part) in parts.into_iter().enumerate() {
            assert_eq!(part.len(), lens[i]);
            assert_eq!(part.as_ptr() as usize % 64, 0);
            part.fill(i as f32 + 1.0);
        }
        let all = arena.all();
        assert_eq!((all[0], all[1], all[16], all[33], all[48], all[111]), (1.0, 0.0, 3.0, 0.0, 4.0, 4.0));
    }

    #[test]
    fn impossible_sizes_are_an_error() {
        assert_eq!(Arena::new(usize::MAX / 8).unwrap_err().status() as i32, 5);
    }
}
