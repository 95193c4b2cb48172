//! What this CPU can do, and the set of kernels that follows from it.
//!
//! [`Features`] is a set, not a level: AVX-VNNI exists without AVX-512. Detection is `detected()`
//! intersected with a cap; the cap comes from the environment variable `STREETFORWARD_CPU` or from
//! [`Kernels::capped`] and can only lower what was detected. A cap that this CPU does not have is an
//! error, never a silent fallback.

use crate::gemm::s8::table::{GEMM_S8, GemmS8Kernel};
use crate::gemm::table::{GEMM_F, GemmKernel, WeightType};
use crate::simd::table::{VECTOR, VectorKernels};
use std::sync::OnceLock;

/// Environment variable that lowers the kernels in use.
pub const CPU_VARIABLE: &str = "STREETFORWARD_CPU";

/// Instruction set up to which kernels may be used, as named in `STREETFORWARD_CPU` and `--isa`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Isa {
    /// Portable code only.
    Scalar,
    /// AVX2, FMA and F16C.
    Avx2,
    /// AVX2 and the 256-bit byte dot product.
    AvxVnni,
    /// AVX-512 F, BW, VL and DQ.
    Avx512,
    /// AVX-512 and its byte dot product.
    Avx512Vnni,
    /// AArch64 base vectors.
    Neon,
    /// NEON with the byte dot product.
    NeonDot,
}

impl Isa {
    /// Every name, weakest first within an architecture.
    pub const ALL: [Isa; 7] =
        [Isa::Scalar, Isa::Avx2, Isa::AvxVnni, Isa::Avx512, Isa::Avx512Vnni, Isa::Neon, Isa::NeonDot];

    /// As written in `STREETFORWARD_CPU`.
    pub fn name(self) -> &'static str {
        match self {
            Isa::Scalar => "scalar",
            Isa::Avx2 => "avx2",
            Isa::AvxVnni => "avxvnni",
            Isa::Avx512 => "avx512",
            Isa::Avx512Vnni => "avx512vnni",
            Isa::Neon => "neon",
            Isa::NeonDot => "neondot",
        }
    }

    /// From its name; `None` for anything else.
    pub fn parse(name: &str) -> Option<Isa> {
        Isa::ALL.into_iter().find(|i| i.name() == name)
    }

    /// What the name asks of the CPU.
    pub fn features(self) -> Features {
        match self {
            Isa::Scalar => Features::NONE,
            Isa::Avx2 => Features::AVX2,
            Isa::AvxVnni => Features::AVX2.with(Features::AVX_VNNI),
            Isa::Avx512 => Features::AVX2.with(Features::AVX512),
            Isa::Avx512Vnni => Features::AVX2.with(Features::AVX512).with(Features::AVX512_VNNI),
            Isa::Neon => Features::NEON,
            Isa::NeonDot => Features::NEON.with(Features::NEON_DOT),
        }
    }
}

/// A set of CPU features, in the groups that kernels ask for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Features(u32);

impl Features {
    /// The empty set: portable code.
    pub const NONE: Features = Features(0);
    /// avx2, fma, f16c.
    pub const AVX2: Features = Features(1);
    /// avxvnni.
    pub const AVX_VNNI: Features = Features(1 << 1);
    /// avx512f, avx512bw, avx512vl, avx512dq.
    pub const AVX512: Features = Features(1 << 2);
    /// avx512vnni.
    pub const AVX512_VNNI: Features = Features(1 << 3);
    /// neon.
    pub const NEON: Features = Features(1 << 4);
    /// dotprod.
    pub const NEON_DOT: Features = Features(1 << 5);

    /// Both sets together.
    pub const fn with(self, other: Features) -> Features {
        Features(self.0 | other.0)
    }

    /// What both sets have.
    pub const fn and(self, other: Features) -> Features {
        Features(self.0 & other.0)
    }

    /// Whether every feature of `needed` is in this set.
    pub const fn has(self, needed: Features) -> bool {
        self.0 & needed.0 == needed.0
    }

    /// What this CPU and operating system offer.
    pub fn detected() -> Features {
        static DETECTED: OnceLock<Features> = OnceLock::new();
        *DETECTED.get_or_init(detect)
    }
}

#[cfg(target_arch = "x86_64")]
fn detect() -> Features {
    use std::arch::is_x86_feature_detected as has;
    let mut f = Features::NONE;
    if has!("avx2") && has!("fma") && has!("f16c") {
        f = f.with(Features::AVX2);
        if has!("avxvnni") {
            f = f.with(Features::AVX_VNNI);
        }
        if has!("avx512f") && has!("avx512bw") && has!("avx512vl") && has!("avx512dq") {
            f = f.with(Features::AVX512);
            if has!("avx512vnni") {
                f = f.with(Features::AVX512_VNNI);
            }
        }
    }
    f
}

#[cfg(target_arch = "aarch64")]
fn detect() -> Features {
    use std::arch::is_aarch64_feature_detected as has;
    let mut f = Features::NONE;
    if has!("neon") {
        f = f.with(Features::NEON);
        if has!("dotprod") {
            f = f.with(Features::NEON_DOT);
        }
    }
    f
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn detect() -> Features {
    Features::NONE
}

/// The kernels in use: one row of every table. Made only here, where rows are chosen under the detected
/// features, so that a value proves that they may run.
#[derive(Debug)]
#[non_exhaustive]
pub struct Kernels {
    /// The cap these rows were chosen under.
    pub isa: Isa,
    /// Detected features under the cap.
    pub features: Features,
    /// Matrix product with f32 weights.
    pub gemm_f32: &'static GemmKernel,
    /// Matrix product with f16 weights.
    pub gemm_f16: &'static GemmKernel,
    /// Matrix product with int8 activations and weights, activations as bytes: attention, products of few rows.
    pub gemm_s8: &'static GemmS8Kernel,
    /// The same for products of many rows and for convolutions; another row where widened activations are faster.
    pub product_s8: &'static GemmS8Kernel,
    /// Element-wise and row-wise operations.
    pub vector: &'static VectorKernels,
}

impl Kernels {
    fn choose(isa: Isa) -> Kernels {
        let features = Features::detected().and(isa.features());
        let gemm = |w| GEMM_F.iter().find(|k| k.weights == w && features.has(k.needs));
        Kernels {
            isa,
            features,
            gemm_f32: gemm(WeightType::F32).expect("a scalar row ends the table"),
            gemm_f16: gemm(WeightType::F16).expect("a scalar row ends the table"),
            gemm_s8: GEMM_S8
                .iter()
                .find(|k| k.bytes == 1 && features.has(k.needs))
                .expect("a scalar row ends the table"),
            product_s8: GEMM_S8.iter().find(|k| features.has(k.needs)).expect("a scalar row ends the table"),
            vector: VECTOR.iter().find(|k| features.has(k.needs)).expect("a scalar row ends the table"),
        }
    }

    /// Every family with the name of its row: what tools print, so that none is left out.
    pub fn rows(&self) -> [(&'static str, &'static str); 5] {
        [
            ("gemm_f32", self.gemm_f32.name),
            ("gemm_f16", self.gemm_f16.name),
            ("product_s8", self.product_s8.name),
            ("gemm_s8", self.gemm_s8.name),
            ("vector", self.vector.name),
        ]
    }

    fn table() -> &'static [Kernels] {
        static TABLE: OnceLock<Vec<Kernels>> = OnceLock::new();
        TABLE.get_or_init(|| {
            Isa::ALL.into_iter().filter(|i| Features::detected().has(i.features())).map(Kernels::choose).collect()
        })
    }

    /// One set for every name that this CPU has, weakest first. The last is the strongest.
    pub fn available() -> impl Iterator<Item = &'static Kernels> {
        Self::table().iter()
    }

    /// The kernels under a cap.
    ///
    /// # Errors
    /// One line when this CPU lacks what the name asks for.
    pub fn capped(isa: Isa) -> Result<&'static Kernels, String> {
        Self::table().iter().find(|k| k.isa == isa).ok_or_else(|| {
            let have: Vec<&str> = Self::table().iter().map(|k| k.isa.name()).collect();
            format!("this CPU has no {}; it has {}", isa.name(), have.join(", "))
        })
    }

    /// The strongest kernels, or those that `STREETFORWARD_CPU` names.
    ///
    /// # Errors
    /// One line when the variable holds an unknown name or an instruction set that this CPU lacks.
    pub fn from_env() -> Result<&'static Kernels, String> {
        match std::env::var_os(CPU_VARIABLE) {
            None => Ok(Self::table().last().expect("scalar kernels exist on every CPU")),
            Some(value) => {
                let isa = value.to_str().and_then(Isa::parse).ok_or_else(|| {
                    let names: Vec<&str> = Isa::ALL.iter().map(|i| i.name()).collect();
                    format!("{CPU_VARIABLE}={value:?} is unknown; use one of {}", names.join(", "))
                })?;
                Self::capped(isa).map_err(|e| format!("{CPU_VARIABLE}: {e}"))
            }
        }
    }

    /// As [`Kernels::from_env`].
    ///
    /// # Panics
    /// When `STREETFORWARD_CPU` is unusable; callers that can report errors use `from_env`.
    pub fn best() -> &'static Kernels {
        match Self::from_env() {
            Ok(k) => k,
            Err(e) => panic!("{e}"),
        }
    }
}

/// What every parallel op needs: the threads and the kernels.
#[derive(Clone, Copy, Debug)]
pub struct Ctx<'a> {
    /// Threads.
    pub pool: &'a crate::par::Pool,
    /// Kernels.
    pub kernels: &'static Kernels,
}

/// The floating-point control word of this architecture.
#[cfg(target_arch = "x86_64")]
mod control {
    /// Power-on value of MXCSR: every exception masked, round to nearest, subnormals kept.
    pub(super) const DEFAULT: u64 = 0x1f80;
    /// Rounding control, flush to zero, denormals are zero; the sticky exception flags do not matter.
    pub(super) const MATTERS: u64 = 0xe040;

    pub(super) fn get() -> u64 {
        let mut mode: u32 = 0;
        // SAFETY: stores MXCSR into a local; SSE is part of x86-64.
        #[allow(unsafe_code)]
        unsafe {
            std::arch::asm!("stmxcsr [{}]", in(reg) &mut mode, options(nostack, preserves_flags));
        }
        u64::from(mode)
    }

    /// `mode` must be `DEFAULT` or come from [`get`].
    pub(super) fn set(mode: u64) {
        let mode = mode as u32;
        // SAFETY: loads a value that MXCSR had or has at power-on; SSE is part of x86-64.
        #[allow(unsafe_code)]
        unsafe {
            std::arch::asm!("ldmxcsr [{}]", in(reg) &mode, options(nostack, readonly, preserves_flags));
        }
    }
}

/// The floating-point control word of this architecture.
#[cfg(target_arch = "aarch64")]
mod control {
    /// Reset value of FPCR.
    pub(super) const DEFAULT: u64 = 0;
    /// RMode, FZ, FZ16, DN.
    pub(super) const MATTERS: u64 = 0x03c8_0000;

    pub(super) fn get() -> u64 {
        let mode: u64;
        // SAFETY: reads the floating-point control register of this thread.
        #[allow(unsafe_code)]
        unsafe {
            std::arch::asm!("mrs {}, fpcr", out(reg) mode, options(nomem, nostack, preserves_flags));
        }
        mode
    }

    /// `mode` must be `DEFAULT` or come from [`get`].
    pub(super) fn set(mode: u64) {
        // SAFETY: writes the floating-point control register of this thread.
        #[allow(unsafe_code)]
        unsafe {
            std::arch::asm!("msr fpcr, {}", in(reg) mode, options(nomem, nostack, preserves_flags));
        }
    }
}

/// The control word is not known on this architecture; it is taken as default.
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
mod control {
    pub(super) const DEFAULT: u64 = 0;
    pub(super) const MATTERS: u64 = 0;

    pub(super) fn get() -> u64 {
        DEFAULT
    }

    pub(super) fn set(_mode: u64) {}
}

/// Puts the calling thread's floating-point unit in the default mode: round to nearest, subnormals kept.
/// New threads inherit their creator's mode, and both settings change results.
pub fn set_default_float_mode() {
    control::set(control::DEFAULT);
}

/// Whether the calling thread rounds to nearest and keeps subnormals.
pub fn float_mode_is_default() -> bool {
    control::get() & control::MATTERS == control::DEFAULT & control::MATTERS
}

/// The default floating-point mode on this thread while alive; the mode before comes back on drop.
#[derive(Debug)]
pub struct DefaultFloatMode {
    before: u64,
    /// A control word belongs to its thread: not `Send`.
    thread: std::marker::PhantomData<*const ()>,
}

impl DefaultFloatMode {
    /// Switches this thread to the default mode.
    pub fn enter() -> DefaultFloatMode {
        let before = control::get();
        control::set(control::DEFAULT);
        DefaultFloatMode { before, thread: std::marker::PhantomData }
    }
}

impl Drop for DefaultFloatMode {
    fn drop(&mut self) {
        control::set(self.before);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip() {
        for isa in Isa::ALL {
            assert_eq!(Isa::parse(isa.name()), Some(isa));
        }
        assert_eq!(Isa::parse("AVX2"), None);
        assert_eq!(Isa::parse(""), None);
    }

    #[test]
    fn a_cap_only_lowers() {
        for k in Kernels::available() {
            assert!(Features::detected().has(k.features));
            assert!(k.isa.features().has(k.features));
            assert!(k.features.has(k.gemm_f32.needs) && k.features.has(k.vector.needs));
            assert!(
                k.features.has(k.gemm_f16.needs)
                    && k.features.has(k.gemm_s8.needs)
                    && k.features.has(k.product_s8.needs)
            );
        }
        let foreign = if cfg!(target_arch = "x86_64") { Isa::Neon } else { Isa::Avx2 };
        let e = Kernels::capped(foreign).unwrap_err();
        assert!(e.contains(foreign.name()) && e.contains("scalar"), "{e}");
        assert_eq!(Kernels::capped(Isa::Scalar).unwrap().features, Features::NONE);
    }

    #[test]
    fn float_mode_is_seen_and_restored() {
        assert!(float_mode_is_default());
        #[cfg(target_arch = "x86_64")]
        {
            // Flush to zero, as a host program may have set it.
            control::set(0x1f80 | 0x8000);
            assert!(!float_mode_is_default());
            {
                let _mode = DefaultFloatMode::enter();
                assert!(float_mode_is_default());
            }
            assert!(!float_mode_is_default());
            set_default_float_mode();
            assert!(float_mode_is_default());
        }
    }
}
