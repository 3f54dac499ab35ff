//! Computes the residuals of a stretch of a recording, and their derivatives with respect to the
//! unknowns.

use nalgebra::{DMatrix, DVector};

use super::Unknown;
use super::dual::Dual;
use super::stretch::Stretch;
use crate::qube::{Dynamics, NonidealDynamics, PlantModel, Quantity, QubeModel, State};
use crate::replay::{longest_step_s, simulate_stretch_in};

/// Number of entries of a start state.
pub(super) const STARTS: usize = 4;

/// Number of unknowns of a Qube: all quantities but gravity.
const UNKNOWNS: usize = Quantity::COUNT - 1;

/// Number of products in the equations, with the delay.
const PRODUCTS: usize = 14;

/// Number of inputs of a simulation that carries derivatives: all unknowns and the start state.
const INPUTS: usize = UNKNOWNS + STARTS;

/// Step of the finite differences of the equations' products (such as M_p L_r^2), as a fraction of
/// the standard deviation of an unknown's prior. Finite differences suffice, because the products
/// are smooth and need no simulation.
const PRODUCT_STEP: f64 = 1e-5;

/// Smallest delay at which the derivative is computed, s. With a delay of 0 a command arrives with
/// its sample. Then no integration step ends at the arrival, and the derivative would be lost.
const SMALLEST_DELAY_S: f64 = 1e-7;

/// The residuals of a stretch and their derivatives. The residuals of theta and alpha at each
/// sample are in units of `scale`. The derivatives have one column for each unknown, then four
/// columns for the start state.
pub(super) fn linearised(
    stretch: &Stretch<'_>,
    unknowns: &[Unknown],
    plant: &PlantModel,
    model: &QubeModel,
    start: State,
    scale: [f64; 2],
) -> (DVector<f64>, DMatrix<f64>) {
    if unknowns.is_empty() {
        run::<STARTS>(stretch, unknowns, plant, model, start, scale)
    } else {
        run::<INPUTS>(stretch, unknowns, plant, model, start, scale)
    }
}

fn run<const N: usize>(
    stretch: &Stretch<'_>,
    unknowns: &[Unknown],
    plant: &PlantModel,
    model: &QubeModel,
    start: State,
    scale: [f64; 2],
) -> (DVector<f64>, DMatrix<f64>) {
    let (dynamics, delay_s) = with_slopes::<N>(unknowns, plant, model);
    let input = |value, index| Dual::<N>::input(value, unknowns.len() + index);
    let start = State {
        theta: input(start.theta, 0),
        alpha: input(start.alpha, 1),
        theta_dot: input(start.theta_dot, 2),
        alpha_dot: input(start.alpha_dot, 3),
    };
    let samples = stretch.samples();
    let mut residuals = DVector::zeros(2 * samples.len());
    let mut slopes = DMatrix::zeros(2 * samples.len(), unknowns.len() + STARTS);
    let mut row = 0;
    let (recording, range, step_s) = (stretch.recording, stretch.range(), longest_step_s(model));
    simulate_stretch_in(recording, range, &dynamics, delay_s, step_s, start, |state| {
        let measured = samples[row / 2].state;
        for (simulated, measured, scale) in
            [(state.theta, measured.theta, scale[0]), (state.alpha, measured.alpha, scale[1])]
        {
            residuals[row] = (simulated.value - measured) / scale;
            for column in 0..slopes.ncols() {
                slopes[(row, column)] = simulated.slopes[column] / scale;
            }
            row += 1;
        }
    });
    (residuals, slopes)
}

/// The products in the equations and the delay, with their derivatives with respect to the
/// unknowns.
fn with_slopes<const N: usize>(
    unknowns: &[Unknown],
    plant: &PlantModel,
    model: &QubeModel,
) -> (NonidealDynamics<Dual<N>>, Dual<N>) {
    // The delay is raised before the step, so that its derivative is 1 at a delay of 0, too.
    let mut model = *model;
    let delay_s = &mut model.nonidealities.command_delay_s;
    *delay_s = delay_s.max(SMALLEST_DELAY_S);
    let here = numbers(&model);
    let mut with_slopes = here.map(Dual::<N>::constant);
    for (index, unknown) in unknowns.iter().enumerate() {
        let step = PRODUCT_STEP * unknown.prior(plant).std;
        let mut moved = model;
        unknown.set(&mut moved, unknown.of(&model) + step);
        for (number, (there, here)) in with_slopes.iter_mut().zip(numbers(&moved).iter().zip(here))
        {
            number.slopes[index] = (there - here) / step;
        }
    }
    let [
        arm_inertia,
        quarter_inertia,
        coupling,
        pendulum_inertia,
        gravity_torque,
        torque_per_volt,
        arm_damping,
        pendulum_damping,
        coulomb_torque,
        positive_dead_zone,
        negative_dead_zone,
        cable_stiffness,
        cable_rest,
        delay_s,
    ] = with_slopes;
    let ideal = Dynamics {
        arm_inertia,
        quarter_inertia,
        coupling,
        pendulum_inertia,
        gravity_torque,
        torque_per_volt,
        arm_damping,
        pendulum_damping,
    };
    let dynamics = NonidealDynamics {
        ideal,
        coulomb_torque,
        positive_dead_zone,
        negative_dead_zone,
        cable_stiffness,
        cable_rest,
    };
    (dynamics, delay_s)
}

/// The products that the equations use, then the delay, s.
fn numbers(model: &QubeModel) -> [f64; PRODUCTS] {
    let dynamics = NonidealDynamics::<f64>::new(model);
    let ideal = &dynamics.ideal;
    [
        ideal.arm_inertia,
        ideal.quarter_inertia,
        ideal.coupling,
        ideal.pendulum_inertia,
        ideal.gravity_torque,
        ideal.torque_per_volt,
        ideal.arm_damping,
        ideal.pendulum_damping,
        dynamics.coulomb_torque,
        dynamics.positive_dead_zone,
        dynamics.negative_dead_zone,
        dynamics.cable_stiffness,
        dynamics.cable_rest,
        model.nonidealities.command_delay_s,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{Nonidealities, Nonideality};
    use crate::replay::MotionSample;

    /// A resting Qube that gets 3 V and -3 V in turns of 0.1 s.
    fn pushes() -> Vec<MotionSample> {
        (0..40)
            .map(|index| MotionSample {
                time_s: 0.01 * f64::from(index),
                state: State::default(),
                voltage_v: if index % 20 < 10 { 3.0 } else { -3.0 },
            })
            .collect()
    }

    #[test]
    fn the_slope_by_the_delay_agrees_with_finite_differences_from_a_delay_of_0_on() {
        let recording = pushes();
        let stretch = Stretch::from(&recording, 0, 0.4);
        let unknowns = [Unknown::from(Nonideality::CommandDelay)];
        let at = |command_delay_s| {
            let nonidealities = Nonidealities { command_delay_s, ..Nonidealities::default() };
            let model = QubeModel { nonidealities, ..QubeModel::NOMINAL };
            linearised(&stretch, &unknowns, &PlantModel::QUBE, &model, State::default(), [1.0; 2])
        };
        for delay_s in [0.0, 0.004] {
            let step_s = 1e-5;
            let (residuals, slopes) = at(delay_s);
            let by_difference = (at(delay_s + step_s).0 - &residuals) / step_s;
            let off = (slopes.column(0) - &by_difference).norm() / by_difference.norm();
            assert!(off < 0.02, "{delay_s} s: {off}");
        }
    }
}
