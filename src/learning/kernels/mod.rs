//! The arithmetic of gradient steps, of which a training with the thesis's budget takes 750 000 for
//! each network.
//!
//! Activations are stored feature by feature, `[feature][64 samples]`, the first layer's weights as
//! `[input][neuron]`, the second layer's as `[neuron][neuron of the first layer]`. With this layout
//! one kernel ([`product`]) computes every product of two matrices without packing, and only the
//! first hidden layer is needed a second time sample by sample ([`transpose`]).
//!
//! Each file is plain loops over arrays of fixed size; `crate::elementary` compiles them for each
//! instruction set. Sums run in one fixed order, so AVX-512 and AVX2 give the same bits. Processors
//! without a fused multiply-add round each product as well, and give other bits.

mod adam;
mod backward;
mod forward;
mod head;
mod product;
mod sum;
#[cfg(test)]
mod tests;
mod transpose;

pub(super) use adam::{AdamSettings, AdamStep, Moments};
pub(super) use backward::{Gradient, Workspace};
pub(super) use forward::Forward;
pub(super) use head::{Head, Minibatch, PolicyHead, ValueHead, gaussian_log_probability};

use crate::elementary::{InstructionSet, Level};

/// Computes `a b + c`, fused wherever the processor has such an instruction. Elsewhere `mul_add`
/// would be a slow library call, so the result is rounded twice.
#[inline(always)]
fn multiply_add<I: InstructionSet>(a: f32, b: f32, c: f32) -> f32 {
    if matches!(I::LEVEL, Level::Plain) && !cfg!(target_arch = "aarch64") {
        a * b + c
    } else {
        a.mul_add(b, c)
    }
}
