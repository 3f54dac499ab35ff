//! Applies a step of the fit to the model.

use super::Unknown;
use crate::qube::{DomainParameter, Nonideality, Quantity, QubeModel};

/// The model after a change of the unknowns, in the fit's units and the order of `unknowns`.
///
/// A motion stays the same if masses, dampings, Coulomb friction, the cable's stiffness and the
/// motor's torque per volt grow by a common factor while the back-EMF stays the same; only the
/// priors determine this factor. Masses, dampings and the motor's constants move by their
/// logarithms, so that a step of any size keeps their proportion. Friction and stiffness may be 0
/// and have no logarithm. If their changes were only added, large steps would lose the proportion,
/// and a fit that begins far from the solution would not reach it. They are therefore multiplied by
/// the growth of the torque per volt; then the part of their change that is not this growth is
/// added. For small changes the result equals a plain addition.
pub(super) fn changed(unknowns: &[Unknown], model: &QubeModel, changes: &[f64]) -> QubeModel {
    let change_of = |parameter: DomainParameter| {
        let pairs = || unknowns.iter().zip(changes);
        let own = Quantity::Parameter(parameter);
        pairs().find(|(unknown, _)| unknown.0 == own).map_or(0.0, |(_, change)| *change)
    };
    // Change of the logarithm of the torque per volt, k_m / R_m.
    let growth =
        change_of(DomainParameter::MotorBackEmf) - change_of(DomainParameter::MotorResistance);
    let mut next = *model;
    for (unknown, change) in unknowns.iter().zip(changes) {
        let here = unknown.of(model);
        let there = match unknown.0 {
            Quantity::Nonideality(Nonideality::CoulombTorque | Nonideality::CableStiffness) => {
                growth.exp() * here + (change - growth * here)
            }
            _ => here + change,
        };
        unknown.set(&mut next, there);
    }
    next
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{NonidealDynamics, Profile};

    /// The torques and inertias of the equations divided by the torque per volt: the numbers on
    /// which a motion depends.
    fn in_volts(model: &QubeModel) -> [f64; 9] {
        let NonidealDynamics { ideal, coulomb_torque, cable_stiffness, .. } =
            NonidealDynamics::<f64>::new(model);
        [
            ideal.arm_inertia,
            ideal.quarter_inertia,
            ideal.coupling,
            ideal.pendulum_inertia,
            ideal.gravity_torque,
            ideal.arm_damping,
            ideal.pendulum_damping,
            coulomb_torque,
            cable_stiffness,
        ]
        .map(|number| number / ideal.torque_per_volt)
    }

    #[test]
    fn a_step_along_the_common_factor_of_all_torques_changes_no_motion() {
        let unknowns: Vec<Unknown> = Unknown::all().collect();
        let lab = Profile::lab().model();
        for growth in [-1.5, 0.7, 1.5] {
            let change = |unknown: &Unknown| match unknown.0 {
                Quantity::Parameter(DomainParameter::MotorResistance) => -growth,
                Quantity::Parameter(
                    DomainParameter::RotaryMass
                    | DomainParameter::PendulumMass
                    | DomainParameter::RotaryDamping
                    | DomainParameter::PendulumDamping,
                ) => growth,
                Quantity::Nonideality(Nonideality::CoulombTorque | Nonideality::CableStiffness) => {
                    growth * unknown.of(&lab)
                }
                _ => 0.0,
            };
            let changes: Vec<f64> = unknowns.iter().map(change).collect();
            let next = changed(&unknowns, &lab, &changes);
            for (there, here) in in_volts(&next).iter().zip(in_volts(&lab)) {
                assert!((there / here - 1.0).abs() < 1e-9, "{growth}: {there} {here}");
            }
        }
    }

    #[test]
    fn an_unchanged_friction_does_not_shrink_when_the_motor_gets_stronger() {
        let unknowns: Vec<Unknown> = Unknown::all().collect();
        let lab = Profile::lab().model();
        let resistance = |unknown: &Unknown| {
            let is_resistance = unknown.0 == DomainParameter::MotorResistance.into();
            if is_resistance { -1.5 } else { 0.0 }
        };
        let changes: Vec<f64> = unknowns.iter().map(resistance).collect();
        let next = changed(&unknowns, &lab, &changes).nonidealities;
        assert!(next.coulomb_torque_n_m >= lab.nonidealities.coulomb_torque_n_m);
        assert!(next.cable_stiffness_n_m_rad >= lab.nonidealities.cable_stiffness_n_m_rad);
    }

    #[test]
    fn a_small_change_moves_each_unknown_by_itself() {
        let unknowns: Vec<Unknown> = Unknown::all().collect();
        let lab = Profile::lab().model();
        for (index, unknown) in unknowns.iter().enumerate() {
            let mut changes = vec![0.0; unknowns.len()];
            changes[index] = 1e-6;
            let next = changed(&unknowns, &lab, &changes);
            for (place, other) in unknowns.iter().enumerate() {
                let moved = other.of(&next) - other.of(&lab);
                let expected = if place == index { 1e-6 } else { 0.0 };
                assert!((moved - expected).abs() < 1e-10, "{}: {moved}", unknown.name());
            }
        }
    }
}
