//! Sinusoidal embeddings: of time, and of positions inside DPT heads.
//!
//! Computed in f64 with the project's own sine, exponential and logarithm, stored as f32: the same
//! bits everywhere.

use sf_ops::trig;

/// `base^(-i/n)`.
fn frequency(base: f64, i: usize, n: usize) -> f64 {
    trig::exp(-(i as f64) / (n as f64) * trig::ln(base))
}

/// Time embedding of one frame: `[sin(p w_i).., cos(p w_i)..]`, `w_i = base^(-i/(dim/2))` (network
/// specification, item 6). `phase` is (t_f - t_0) / unit; `out` holds `dim` values.
pub(crate) fn time(phase: f64, base: f64, out: &mut [f32]) {
    let half = out.len() / 2;
    for i in 0..half {
        let (s, c) = trig::sin_cos(phase * frequency(base, i, half));
        out[i] = s as f32;
        out[half + i] = c as f32;
    }
}

/// Position embedding of a DPT head, separated into rows and columns (network specification 2.2).
///
/// Channel c of pixel (x, y) is `columns[x][c]` for c below `half`, `rows[y][c - half]` above, with
/// `half` = channels / 2; values already times 0.1.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PositionEmbedding {
    /// `[w, half]`: sines then cosines of the horizontal coordinate.
    pub columns: Vec<f32>,
    /// `[h, half]`: sines then cosines of the vertical coordinate.
    pub rows: Vec<f32>,
    /// Half of the channels.
    pub half: usize,
}

impl PositionEmbedding {
    /// For a map of `h` x `w` with `channels` (a multiple of 4) of an image of aspect width/height.
    pub(crate) fn new(h: usize, w: usize, channels: usize, aspect: f64) -> PositionEmbedding {
        let diagonal = (1.0 + aspect * aspect).sqrt();
        PositionEmbedding {
            columns: axis(w, channels / 4, aspect / diagonal),
            rows: axis(h, channels / 4, 1.0 / diagonal),
            half: channels / 2,
        }
    }

    /// Adds the embedding to row `y` of a map, `[w, channels]`.
    pub(crate) fn add_row(&self, y: usize, row: &mut [f32]) {
        let vertical = &self.rows[y * self.half..][..self.half];
        for (pixel, horizontal) in row.chunks_exact_mut(2 * self.half).zip(self.columns.chunks_exact(self.half)) {
            let (a, b) = pixel.split_at_mut(self.half);
            a.iter_mut().zip(horizontal).for_each(|(p, e)| *p += e);
            b.iter_mut().zip(vertical).for_each(|(p, e)| *p += e);
        }
    }
}

/// `[n, 2 * quarter]` for coordinates spread evenly over `-span (n-1)/n .. span (n-1)/n`.
fn axis(n: usize, quarter: usize, span: f64) -> Vec<f32> {
    let mut out = Vec::with_capacity(n * 2 * quarter);
    for i in 0..n {
        // n values from -e to e, e = span (n-1)/n: step 2 e / (n-1) = 2 span / n.
        let u = span * (2 * i + 1) as f64 / n as f64 - span;
        let angles = (0..quarter).map(|j| trig::sin_cos(u * frequency(100.0, j, quarter)));
        out.extend(angles.clone().map(|(s, _)| s as f32 * 0.1));
        out.extend(angles.map(|(_, c)| c as f32 * 0.1));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_zero_is_sine_zero_cosine_one() {
        let mut e = [9.0; 8];
        time(0.0, 10_000.0, &mut e);
        assert_eq!(e, [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
        time(2.0, 10_000.0, &mut e);
        for i in 0..4 {
            let angle = 2.0 * 10_000f64.powf(-(i as f64) / 4.0);
            assert!((f64::from(e[i]) - angle.sin()).abs() < 1e-7);
            assert!((f64::from(e[4 + i]) - angle.cos()).abs() < 1e-7);
        }
    }

    #[test]
    fn positions_follow_the_definition() {
        let (h, w, c) = (2usize, 3usize, 8usize);
        let e = PositionEmbedding::new(h, w, c, 1.5);
        let diagonal = (1.0f64 + 1.5 * 1.5).sqrt();
        for y in 0..h {
            let mut row = vec![0.0; w * c];
            e.add_row(y, &mut row);
            for x in 0..w {
                let line = |n: usize, i: usize, span: f64| {
                    let end = span * (n - 1) as f64 / n as f64;
                    if n == 1 { -end } else { -end + 2.0 * end * i as f64 / (n - 1) as f64 }
                };
                let (u, v) = (line(w, x, 1.5 / diagonal), line(h, y, 1.0 / diagonal));
                let want: Vec<f64> = [
                    u.sin(),
                    (u * 0.1).sin(),
                    u.cos(),
                    (u * 0.1).cos(),
                    v.sin(),
                    (v * 0.1).sin(),
                    v.cos(),
                    (v * 0.1).cos(),
                ]
                .iter()
                .map(|s| s * 0.1)
                .collect();
                for k in 0..c {
                    assert!((f64::from(row[x * c + k]) - want[k]).abs() < 1e-8, "{y} {x} {k}");
                }
            }
        }
    }
}
