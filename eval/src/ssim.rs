//! Structural similarity with the defaults of scikit-image's `structural_similarity`.
//!
//! Window 7x7 uniform, range 1, K1 = 0.01, K2 = 0.03, sample covariance (N / (N - 1)):
//!
//! ```text
//! S = (2 ma mb + C1)(2 cov + C2) / ((ma^2 + mb^2 + C1)(va + vb + C2))     C1 = 1e-4, C2 = 9e-4
//! ```
//!
//! Borders are mirrored with the edge repeated (d c b a | a b c d). The score of a picture is the mean of the map without its
//! outer 3 pixels, averaged over channels; the masked score is the mean of the whole map over the mask.

const WINDOW: usize = 7;
const PAD: usize = WINDOW / 2;

/// The map of a picture pair `[height, width, 3]`, one value per channel.
#[derive(Clone, Debug, PartialEq)]
pub struct SsimMap {
    width: usize,
    height: usize,
    values: Vec<f64>,
}

impl SsimMap {
    /// Compares two pictures in 0..1 (clamped). `None` when a side is shorter than the window.
    pub fn new(a: &[f32], b: &[f32], (width, height): (usize, usize)) -> Option<SsimMap> {
        assert!(a.len() == width * height * 3 && b.len() == a.len(), "values of {width}x{height} pictures");
        if width < WINDOW || height < WINDOW {
            return None;
        }
        let n = (WINDOW * WINDOW) as f64;
        let mut values = vec![0.0; a.len()];
        for c in 0..3 {
            let plane =
                |v: &[f32]| v.iter().skip(c).step_by(3).map(|v| f64::from(v.clamp(0.0, 1.0))).collect::<Vec<_>>();
            let (x, y) = (plane(a), plane(b));
            let product = |p: &[f64], q: &[f64]| p.iter().zip(q).map(|(p, q)| p * q).collect::<Vec<_>>();
            let mean = |v: Vec<f64>| box_mean(&v, width, height);
            let (xx, yy, xy) = (mean(product(&x, &x)), mean(product(&y, &y)), mean(product(&x, &y)));
            let (mx, my) = (mean(x), mean(y));
            for i in 0..mx.len() {
                let sample = n / (n - 1.0);
                let vx = sample * (xx[i] - mx[i] * mx[i]);
                let vy = sample * (yy[i] - my[i] * my[i]);
                let cov = sample * (xy[i] - mx[i] * my[i]);
                let (c1, c2) = (0.01f64 * 0.01, 0.03f64 * 0.03);
                values[3 * i + c] = (2.0 * mx[i] * my[i] + c1) * (2.0 * cov + c2)
                    / ((mx[i] * mx[i] + my[i] * my[i] + c1) * (vx + vy + c2));
            }
        }
        Some(SsimMap { width, height, values })
    }

    /// The score of the picture: mean without the outer 3 pixels.
    pub fn mean(&self) -> f64 {
        let (w, h) = (self.width, self.height);
        let mut sum = 0.0;
        for y in PAD..h - PAD {
            sum += self.values[3 * (y * w + PAD)..3 * (y * w + w - PAD)].iter().sum::<f64>();
        }
        sum / (3 * (w - 2 * PAD) * (h - 2 * PAD)) as f64
    }

    /// Mean of the whole map over a mask; `None` when it is empty.
    pub fn mean_masked(&self, mask: &[bool]) -> Option<f64> {
        assert_eq!(mask.len() * 3, self.values.len(), "pixels of map and mask");
        let inside = self.values.chunks_exact(3).zip(mask).filter(|(_, m)| **m);
        let (sum, n) = inside.fold((0.0, 0u64), |(sum, n), (v, _)| (sum + v.iter().sum::<f64>(), n + 3));
        (n > 0).then(|| sum / n as f64)
    }

    /// The map `[height, width, 3]`.
    pub fn values(&self) -> &[f64] {
        &self.values
    }
}

/// Mean over the window around every pixel, rows then columns.
fn box_mean(v: &[f64], width: usize, height: usize) -> Vec<f64> {
    let mirrored = |i: usize, n: usize| {
        // `i` counts from PAD before the first pixel.
        if i < PAD {
            PAD - 1 - i
        } else if i - PAD < n {
            i - PAD
        } else {
            2 * n - 1 - (i - PAD)
        }
    };
    let mut rows = vec![0.0; v.len()];
    for y in 0..height {
        for x in 0..width {
            rows[y * width + x] = (x..x + WINDOW).map(|i| v[y * width + mirrored(i, width)]).sum();
        }
    }
    let mut out = vec![0.0; v.len()];
    for y in 0..height {
        for x in 0..width {
            let sum: f64 = (y..y + WINDOW).map(|i| rows[mirrored(i, height) * width + x]).sum();
            out[y * width + x] = sum / (WINDOW * WINDOW) as f64;
        }
    }
    out
}
