//! What a set of run times says, and what it does not: a percentile needs at least one sample beyond it.

use std::str::FromStr;

/// A percentile to report, in (0, 100).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Percentile(pub(crate) f64);

impl Percentile {
    /// Samples from which it means something: p90 10, p95 20, p99 100, p99.9 1000; the median 1.
    pub(crate) fn needs(self) -> usize {
        if self.0 <= 50.0 { 1 } else { (100.0 / (100.0 - self.0)).round() as usize }
    }

    /// Its name in JSON: `p50_ms`, `p99_9_ms`.
    pub(crate) fn key(self) -> String {
        format!("p{}_ms", self.0.to_string().replace('.', "_"))
    }
}

impl std::fmt::Display for Percentile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "p{}", self.0)
    }
}

impl FromStr for Percentile {
    type Err = String;

    fn from_str(text: &str) -> Result<Percentile, String> {
        match text.trim().parse::<f64>() {
            Ok(p) if p > 0.0 && p <= 99.999 => Ok(Percentile(p)),
            _ => Err("a percentile is a number above 0, at most 99.999".into()),
        }
    }
}

/// Times of one configuration, milliseconds.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Samples {
    sorted: Vec<f64>,
}

impl Samples {
    /// Of at least one time.
    pub(crate) fn new(mut times: Vec<f64>) -> Samples {
        assert!(!times.is_empty(), "statistics of no sample");
        times.sort_by(f64::total_cmp);
        Samples { sorted: times }
    }

    /// How many.
    pub(crate) fn len(&self) -> usize {
        self.sorted.len()
    }

    /// The fastest.
    pub(crate) fn min(&self) -> f64 {
        self.sorted[0]
    }

    /// The slowest.
    pub(crate) fn max(&self) -> f64 {
        self.sorted[self.sorted.len() - 1]
    }

    /// The middle one, or the mean of the two in the middle.
    pub(crate) fn median(&self) -> f64 {
        self.at(50.0)
    }

    /// Linear between the two nearest ranks.
    fn at(&self, percent: f64) -> f64 {
        let place = percent / 100.0 * (self.sorted.len() - 1) as f64;
        let (low, part) = (place.floor() as usize, place.fract());
        let high = (low + 1).min(self.sorted.len() - 1);
        self.sorted[low] + (self.sorted[high] - self.sorted[low]) * part
    }

    /// A percentile, where there are samples enough for it.
    pub(crate) fn percentile(&self, p: Percentile) -> Option<f64> {
        (self.len() >= p.needs()).then(|| self.at(p.0))
    }

    /// p99 - p50, where there are samples enough.
    pub(crate) fn jitter(&self) -> Option<f64> {
        Some(self.percentile(Percentile(99.0))? - self.median())
    }

    /// The average.
    pub(crate) fn mean(&self) -> f64 {
        self.sorted.iter().sum::<f64>() / self.len() as f64
    }

    /// Standard deviation of the population that the samples are from; none of one sample.
    pub(crate) fn std(&self) -> Option<f64> {
        let (n, mean) = (self.len(), self.mean());
        let squares: f64 = self.sorted.iter().map(|t| (t - mean).powi(2)).sum();
        (n > 1).then(|| (squares / (n - 1) as f64).sqrt())
    }

    /// The interval between two samples that holds the true median with 95 % probability whatever the distribution;
    /// none of fewer than six samples.
    pub(crate) fn median_interval(&self) -> Option<(f64, f64)> {
        let cut = outer_ranks(self.len())?;
        Some((self.sorted[cut], self.sorted[self.len() - 1 - cut]))
    }
}

/// Samples to leave out at either end so that the median lies between the rest with 95 % probability: each sample is
/// below it with probability 1/2, so the number below is binomial.
fn outer_ranks(n: usize) -> Option<usize> {
    if n > 1000 {
        // The normal limit; 2^-n no longer fits a float.
        return Some((n as f64 / 2.0 - 0.98 * (n as f64).sqrt()).floor() as usize);
    }
    let (mut probability, mut below) = (0.5f64.powi(n as i32), 0.0);
    let mut cut = None;
    for k in 0..n {
        below += probability;
        if below > 0.025 {
            break;
        }
        cut = Some(k);
        probability *= (n - k) as f64 / (k + 1) as f64;
    }
    cut
}

#[cfg(test)]
mod tests {
    use super::*;

    fn up_to(n: usize) -> Samples {
        // Shuffled on purpose: 7 is coprime to every size used here.
        Samples::new((0..n).map(|i| (i * 7 % n) as f64).collect())
    }

    #[test]
    fn a_percentile_without_enough_samples_is_not_given() {
        for (p, needs) in [(50.0, 1), (90.0, 10), (95.0, 20), (99.0, 100), (99.9, 1000)] {
            let p = Percentile(p);
            assert_eq!(p.needs(), needs, "{p}");
            assert!(up_to(needs).percentile(p).is_some(), "{p}");
            if needs > 1 {
                assert_eq!(up_to(needs - 1).percentile(p), None, "{p} of {} samples", needs - 1);
            }
        }
        assert_eq!(up_to(99).jitter(), None);
        assert_eq!(Percentile(99.9).key(), "p99_9_ms");
        assert_eq!(Percentile(50.0).key(), "p50_ms");
    }

    #[test]
    fn percentiles_are_those_of_known_samples() {
        // 0, 1, ..., 100: percentile p is p.
        let s = up_to(101);
        for p in [10.0, 50.0, 90.0, 95.0, 99.0] {
            assert_eq!(s.percentile(Percentile(p)), Some(p));
        }
        assert_eq!((s.min(), s.max(), s.mean(), s.median()), (0.0, 100.0, 50.0, 50.0));
        assert_eq!(s.jitter(), Some(49.0));
        assert_eq!(Samples::new(vec![3.0, 1.0]).median(), 2.0);
        assert_eq!(Samples::new(vec![4.0]).std(), None);
        let s = Samples::new(vec![2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0]);
        assert!((s.std().unwrap() - (32.0f64 / 7.0).sqrt()).abs() < 1e-12);
    }

    /// Ranks from tables of the sign test (two-sided, 95 %).
    #[test]
    fn the_interval_of_the_median_is_the_sign_test() {
        for (n, cut) in
            [(5, None), (6, Some(0)), (8, Some(0)), (9, Some(1)), (12, Some(2)), (20, Some(5)), (50, Some(17))]
        {
            assert_eq!(outer_ranks(n), cut, "{n} samples");
        }
        assert_eq!(up_to(20).median_interval(), Some((5.0, 14.0)));
        assert_eq!(up_to(5).median_interval(), None);
        // Exact and normal meet.
        let (exact, normal) = (outer_ranks(1000).unwrap() as f64, outer_ranks(1001).unwrap() as f64);
        assert!((exact - normal).abs() <= 1.0, "{exact} {normal}");
    }

    #[test]
    fn percentiles_are_read_and_refused() {
        assert_eq!("99.9".parse(), Ok(Percentile(99.9)));
        for bad in ["", "0", "100", "-3", "x", "nan"] {
            assert!(bad.parse::<Percentile>().is_err(), "{bad}");
        }
    }
}
