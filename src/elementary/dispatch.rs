//! One body of code, compiled for several instruction sets and chosen at run time.
//!
//! Users install without target flags, so the compiler assumes a processor of 2003. A [`Kernel`] is
//! compiled again inside a function for which AVX-512, or AVX2 with FMA, is switched on, and the
//! best one that this processor has is called. On ARM the plain path is the right one: NEON and
//! its fused multiply-add are part of every 64-bit ARM.
//!
//! All paths compute the same bits as long as a kernel sums in a fixed order: vector
//! instructions round like scalar ones, and `mul_add` is correctly rounded everywhere. The price is
//! paid by x86 processors without FMA (before 2013) alone, where `mul_add` is a slow library call: a
//! kernel that need not repeat bit for bit there may look at [`InstructionSet::LEVEL`] and do
//! without.
//!
//! Trap: everything that a kernel calls must be `#[inline(always)]` or small enough to be inlined.
//! What is not is compiled without the instruction set, where `mul_add` is that library call.

use std::sync::atomic::{AtomicU8, Ordering};

/// A computation that is worth compiling for each instruction set. The struct holds its arguments.
pub trait Kernel {
    /// What it computes.
    type Output;

    /// The body. Implementations must be `#[inline(always)]`, or they run on the plain path.
    ///
    /// `I` tells what it is compiled for, where that decides a tile's shape.
    fn run<I: InstructionSet>(self) -> Self::Output;
}

/// What a kernel may know about the instruction set that it is being compiled for.
pub trait InstructionSet {
    /// Which one.
    const LEVEL: Level;
}

/// The instruction sets that there is code for, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// AVX-512 (F, VL, BW, DQ) with FMA.
    Avx512,
    /// AVX2 with FMA.
    Avx2,
    /// What every processor of this architecture has: SSE2, or NEON.
    Plain,
}

/// The first of [`Level::ALL`] that may be used. It decides how fast things are computed, never what.
static FIRST_ALLOWED: AtomicU8 = AtomicU8::new(0);

impl Level {
    /// All of them, best first.
    pub const ALL: [Self; 3] = [Self::Avx512, Self::Avx2, Self::Plain];

    /// The best that this processor has, among those that are allowed.
    #[must_use]
    #[inline]
    pub fn best() -> Self {
        let allowed = &Self::ALL[usize::from(FIRST_ALLOWED.load(Ordering::Relaxed))..];
        allowed.iter().copied().find(|level| level.is_available()).unwrap_or(Self::Plain)
    }

    /// From now on nothing better than this is used in this process: to see what another processor
    /// would do.
    pub fn forbid_better(self) {
        FIRST_ALLOWED.store(self as u8, Ordering::Relaxed);
    }

    /// Whether this processor has it.
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

/// Runs a kernel with the best instruction set of this processor.
#[inline]
pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    dispatch_at(Level::best(), kernel)
}

/// Runs a kernel with this instruction set, for comparisons; with the plain one when the processor
/// does not have it.
#[inline]
pub fn dispatch_at<K: Kernel>(level: Level, kernel: K) -> K::Output {
    if !level.is_available() {
        return kernel.run::<Plain>();
    }
    match level {
        // SAFETY: `is_available` has just found every feature that the function switches on.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { x86::run_avx512(kernel) },
        // SAFETY: as above.
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
    use super::{InstructionSet, Kernel, Level};

    struct Avx512;

    impl InstructionSet for Avx512 {
        const LEVEL: Level = Level::Avx512;
    }

    struct Avx2;

    impl InstructionSet for Avx2 {
        const LEVEL: Level = Level::Avx2;
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
    pub(super) fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
        kernel.run::<Avx512>()
    }

    #[target_feature(enable = "avx2,fma")]
    pub(super) fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
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

    impl Kernel for AllFunctions<'_> {
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
