//! Random values, kernel sets and canaries.

use sf_ops::Ctx;
use sf_ops::cpu::{Features, Isa, Kernels};
use sf_ops::gemm::{GEMM_F, GEMM_S8};
use sf_ops::par::Pool;
use std::sync::Once;

/// xorshift64*: values in [-1, 1).
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Random(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    pub(crate) fn bits(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    pub(crate) fn below(&mut self, n: usize) -> usize {
        (self.bits() >> 33) as usize % n
    }

    pub(crate) fn value(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u32 << 23) as f32 - 1.0
    }

    pub(crate) fn vec(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.value()).collect()
    }
}

/// Whether this CPU has what a row needs.
#[cfg(target_arch = "x86_64")]
fn must_run() -> Vec<(bool, &'static str)> {
    use std::arch::is_x86_feature_detected as has;
    vec![
        (has!("avx2"), "vector_avx2"),
        (has!("avx2"), "gemm_s8_4x16_avx2"),
        (has!("avx2"), "gemm_s8_6x16_avx2wide"),
        (has!("avxvnni"), "gemm_s8_6x16_avxvnni"),
        (has!("avx512bw"), "vector_avx512"),
        (has!("avx512vnni"), "gemm_s8_12x32_avx512vnni"),
    ]
}

/// Whether this CPU has what a row needs.
#[cfg(target_arch = "aarch64")]
fn must_run() -> Vec<(bool, &'static str)> {
    use std::arch::is_aarch64_feature_detected as has;
    vec![(has!("neon"), "vector_neon"), (has!("neon"), "gemm_s8_4x16_neon"), (has!("dotprod"), "gemm_s8_6x16_neondot")]
}

/// The distinct kernel sets of this CPU, portable code first. Rows that cannot run here are named once, and
/// the minimum that must run is asserted.
pub(crate) fn kernel_sets() -> Vec<&'static Kernels> {
    static REPORT: Once = Once::new();
    let mut sets: Vec<&'static Kernels> = Vec::new();
    for k in Kernels::available() {
        let rows = |k: &Kernels| (k.gemm_f32.name, k.gemm_s8.name, k.vector.name);
        if sets.iter().all(|s| rows(s) != rows(k)) {
            sets.push(k);
        }
    }
    REPORT.call_once(|| {
        for row in GEMM_F.iter().filter(|r| !Features::detected().has(r.needs)) {
            println!("not run on this CPU: {}", row.name);
        }
        for row in GEMM_S8.iter().filter(|r| !Features::detected().has(r.needs)) {
            println!("not run on this CPU: {}", row.name);
        }
    });
    assert_eq!(sets[0].isa, Isa::Scalar);
    // The minimum that must run, by what the CPU says of itself.
    let ran = |name: &str| sets.iter().any(|k| [k.vector.name, k.gemm_s8.name, k.product_s8.name].contains(&name));
    for (has, name) in must_run() {
        assert!(!has || ran(name), "{name} must run on this CPU");
    }
    sets
}

/// Runs `f` with every kernel set on one thread and with every thread count on the last set.
/// The first call is the portable one.
pub(crate) fn everywhere(mut f: impl FnMut(Ctx, &str)) {
    let sets = kernel_sets();
    for kernels in &sets {
        // A new pool, so that its working memory has the size that these kernels ask for.
        let pool = Pool::new(1).unwrap();
        f(Ctx { pool: &pool, kernels }, kernels.isa.name());
    }
    for threads in [2, 3] {
        let pool = Pool::new(threads).unwrap();
        let kernels = sets[sets.len() - 1];
        f(Ctx { pool: &pool, kernels }, &format!("{} on {threads} threads", kernels.isa.name()));
    }
}

/// Written around and between the rows of outputs.
pub(crate) const CANARY: f32 = -7.0e30;

/// Asserts equal bits and names the first difference.
pub(crate) fn same_bits(a: &[f32], b: &[f32], what: &str) {
    assert_eq!(a.len(), b.len(), "{what}");
    for (i, (x, y)) in a.iter().zip(b).enumerate() {
        assert!(x.to_bits() == y.to_bits(), "{what}: value {i} is {x:e}, expected {y:e}");
    }
}

/// Asserts |a - b| <= tolerance everywhere and names the first difference.
pub(crate) fn close(a: &[f32], b: &[f32], tolerance: f32, what: &str) {
    assert_eq!(a.len(), b.len(), "{what}");
    for (i, (x, y)) in a.iter().zip(b).enumerate() {
        assert!((x - y).abs() <= tolerance, "{what}: value {i} is {x:e}, expected {y:e} within {tolerance:e}");
    }
}

/// Keeps the first result and asserts that every later one has the same bits.
#[derive(Default)]
pub(crate) struct Same(Option<Vec<f32>>);

impl Same {
    /// True for the first result.
    pub(crate) fn check(&mut self, value: &[f32], what: &str) -> bool {
        match &self.0 {
            None => {
                self.0 = Some(value.to_vec());
                true
            }
            Some(first) => {
                same_bits(value, first, what);
                false
            }
        }
    }
}
