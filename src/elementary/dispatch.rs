//! Compiles one body of code for several instruction sets and picks one at run time.
//!
//! Users install without target flags, so the compiler assumes an x86-64 processor of 2003. A
//! [`VectorKernel`] is therefore compiled again inside functions that enable AVX-512, or AVX2 with
//! FMA, and [`dispatch()`] calls the best one that this processor supports. On 64-bit ARM the plain
//! path suffices: NEON and its fused multiply-add belong to every such processor.
//!
//! All paths compute the same bits as long as a kernel sums in a fixed order: vector instructions
//! round like scalar ones, and `mul_add` is correctly rounded everywhere. Only x86 processors
//! without FMA (before 2013) pay for this, because `mul_add` is a slow library call there. A kernel
//! whose results need not be the same everywhere may avoid `mul_add` depending on
//! [`InstructionSet::LEVEL`].
//!
//! Trap: every function that a kernel calls must be `#[inline(always)]` or small enough to be
//! inlined. A function that is not inlined is compiled without the instruction set, and each
//! `mul_add` in it becomes the slow library call.

use std::sync::atomic::{AtomicU8, Ordering};

/// A computation that is compiled once for each instruction set; the implementing struct holds its
/// arguments.
pub trait VectorKernel {
    /// Result of the computation.
    type Output;

    /// Runs the computation. Implementations must be `#[inline(always)]`, or they run on the plain
    /// path.
    ///
    /// `I` is the instruction set, for kernels whose tiles have a different shape on each.
    fn run<I: InstructionSet>(self) -> Self::Output;
}

/// The instruction set for which a kernel is being compiled.
pub trait InstructionSet {
    /// The level to which the instruction set belongs.
    const LEVEL: Level;
}

/// The instruction sets for which kernels are compiled, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// AVX-512 (F, VL, BW, DQ) with FMA.
    Avx512,
    /// AVX2 with FMA.
    Avx2,
    /// The baseline of the architecture: SSE2 on x86-64, NEON on ARM.
    Plain,
}

/// Index in [`Level::ALL`] of the best level that may be used. It changes the speed, and the
/// results only of kernels that read [`InstructionSet::LEVEL`].
static FIRST_ALLOWED: AtomicU8 = AtomicU8::new(0);

impl Level {
    /// Every level, best first.
    pub const ALL: [Self; 3] = [Self::Avx512, Self::Avx2, Self::Plain];

    /// The best allowed level that this processor supports.
    #[must_use]
    #[inline]
    pub fn best() -> Self {
        let allowed = &Self::ALL[usize::from(FIRST_ALLOWED.load(Ordering::Relaxed))..];
        allowed.iter().copied().find(|level| level.is_available()).unwrap_or(Self::Plain)
    }

    /// Makes this the best allowed level ([`Self::best`]) in this process until the next call, to
    /// reproduce another processor's behaviour.
    pub fn forbid_better(self) {
        FIRST_ALLOWED.store(self as u8, Ordering::Relaxed);
    }

    /// Returns whether this processor supports the level.
    #[must_use]
    #[inline]
    pub fn is_available(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx2")
                    && is_x86_feature_detected!("fma")
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx512 | Self::Avx2 => false,
            Self::Plain => true,
        }
    }
}

/// Runs a kernel with the best allowed instruction set of this processor ([`Level::best`]).
#[inline]
pub fn dispatch<K: VectorKernel>(kernel: K) -> K::Output {
    dispatch_at(Level::best(), kernel)
}

/// Runs a kernel with the given instruction set, even if [`Level::forbid_better`] forbids it; runs
/// the plain path if the processor does not support that set.
#[inline]
pub fn dispatch_at<K: VectorKernel>(level: Level, kernel: K) -> K::Output {
    if !level.is_available() {
        return kernel.run::<Plain>();
    }
    match level {
        // SAFETY: `is_available` has just found every feature that the function enables.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { x86::run_avx512(kernel) },
        // SAFETY: `is_available` has just found every feature that the function enables.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { x86::run_avx2(kernel) },
        _ => kernel.run::<Plain>(),
    }
}

struct Plain;

impl InstructionSet for Plain {
    const LEVEL: Level = Level::Plain;
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{InstructionSet, Level, VectorKernel};

    struct Avx512;

    impl InstructionSet for Avx512 {
        const LEVEL: Level = Level::Avx512;
    }

    struct Avx2;

    impl InstructionSet for Avx2 {
        const LEVEL: Level = Level::Avx2;
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
    pub(super) fn run_avx512<K: VectorKernel>(kernel: K) -> K::Output {
        kernel.run::<Avx512>()
    }

    #[target_feature(enable = "avx2,fma")]
    pub(super) fn run_avx2<K: VectorKernel>(kernel: K) -> K::Output {
        kernel.run::<Avx2>()
    }
}

#[cfg(test)]
mod tests {
    use super::super::{exp, inverse_square_root, sin_cos, tanh};
    use super::*;

    struct AllFunctions<'a> {
        inputs: &'a [f32],
        outputs: &'a mut [[f32; 5]],
    }

    impl VectorKernel for AllFunctions<'_> {
        type Output = Level;

        #[inline(always)]
        fn run<I: InstructionSet>(self) -> Level {
            for (&x, output) in self.inputs.iter().zip(self.outputs) {
                let (sin, cos) = sin_cos(x);
                *output = [sin, cos, tanh(x), exp(x), inverse_square_root(x.abs())];
            }
            I::LEVEL
        }
    }

    #[test]
    fn every_instruction_set_computes_the_bits_of_the_scalar_functions() {
        let inputs: Vec<f32> = (-40_000..40_000).map(|i| i as f32 * 2.3e-3).collect();
        for level in Level::ALL {
            let mut outputs = vec![[0.0; 5]; inputs.len()];
            let ran = dispatch_at(level, AllFunctions { inputs: &inputs, outputs: &mut outputs });
            if ran != level {
                println!("{level:?} is not available here: checked {ran:?} instead");
            }
            for (&x, output) in inputs.iter().zip(&outputs) {
                let (sin, cos) = sin_cos(x);
                let expected = [sin, cos, tanh(x), exp(x), inverse_square_root(x.abs())];
                assert_eq!(
                    output.map(f32::to_bits),
                    expected.map(f32::to_bits),
                    "{level:?} at {x}"
                );
            }
        }
    }

    #[test]
    fn the_best_level_is_available_and_runs() {
        let ran = dispatch(AllFunctions { inputs: &[], outputs: &mut [] });
        assert_eq!(ran, Level::best());
        assert!(ran.is_available());
    }
}
