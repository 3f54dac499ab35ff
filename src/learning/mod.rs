//! PPO: collect, advantage, gradients, optimiser, trainer, curve.
//!
//! May import `simulation`, `policy`, `safety`, `qube`, `elementary`; never `device` or `control`: training
//! cannot move the motor.

mod kernels;
mod network;
