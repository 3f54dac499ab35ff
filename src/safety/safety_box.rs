use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use super::Guard;
use crate::elementary::Scalar;
use crate::qube::{PlantModel, State};

/// The limits of the state during a rollout, which ends at once when the state leaves them.
///
/// Only the limit of theta is close to a hardware stop; the other three keep the motion moderate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(
    deny_unknown_fields,
    default = "SafetyBox::default_of_files",
    bound(deserialize = "T: Scalar + Deserialize<'de>")
)]
pub struct SafetyBox<T = f64> {
    /// Largest |theta|, rad.
    pub theta: T,
    /// Largest |alpha|, rad.
    pub alpha: T,
    /// Largest |theta_dot|, rad/s.
    pub theta_dot: T,
    /// Largest |alpha_dot|, rad/s.
    pub alpha_dot: T,
    /// Guard that may act before a limit is reached, and that determines the brake.
    pub guard: Guard,
}

/// The limit that ended a rollout.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Limit {
    /// |theta|.
    Theta,
    /// |alpha|.
    Alpha,
    /// |theta_dot|.
    ThetaDot,
    /// |alpha_dot|.
    AlphaDot,
    /// The speed envelope, which only old recordings name.
    Envelope,
    /// Foresight: after the voltage that the policy requested, the brake could not keep the arm of
    /// every possible Qube away from its stop.
    Foresight,
    /// The profile: the Qube has moved out of the range that the profile's errors allow.
    Unpredicted,
    /// The policy has driven the motor to
    /// [`LARGEST_LOAD`](super::motor_heat::LARGEST_LOAD) of its continuous rating.
    MotorLoad,
}

impl Limit {
    /// The end of a rollout at this limit in at most five words, for tables and lists.
    #[must_use]
    pub fn in_brief(self) -> &'static str {
        match self {
            Self::Theta | Self::Alpha | Self::ThetaDot | Self::AlphaDot => "left the box",
            Self::Envelope | Self::Foresight | Self::Unpredicted => "ended by the guard",
            Self::MotorLoad => "ended by the motor's load",
        }
    }
}

/// The end of a rollout at this limit, as a phrase whose subject is the rollout.
impl std::fmt::Display for Limit {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            Self::Theta => "left the box by theta",
            Self::Alpha => "left the box by alpha",
            Self::ThetaDot => "left the box by theta_dot",
            Self::AlphaDot => "left the box by alpha_dot",
            Self::Envelope => "was ended by the speed envelope",
            Self::Foresight => "was ended by the guard before the brake would come too late",
            Self::Unpredicted => "was ended by the guard because the Qube moved unlike its profile",
            Self::MotorLoad => {
                "was ended because it drove the motor to 90 % of its continuous rating"
            }
        })
    }
}

impl SafetyBox {
    /// The limits of the thesis (section 5.1), without a guard.
    pub const THESIS: Self =
        Self { theta: 2.3, alpha: 4.0 * PI, theta_dot: 30.0, alpha_dot: 40.0, guard: Guard::Box };

    /// The limits of the thesis under foresight: the default of every rollout on a Qube.
    pub const GUARDED: Self = Self { guard: Guard::Foresight, ..Self::THESIS };

    /// The box scaled to a plant's travel: its limit of theta shrinks if the plant's stops are
    /// nearer than a Qube's, and never grows.
    #[must_use]
    pub fn within_travel(&self, plant: &PlantModel) -> Self {
        Self { theta: self.theta * plant.travel_fraction(), ..*self }
    }

    /// The box with a limit of theta that is at most the thesis's, scaled to the plant's travel.
    /// The box of a plant with at least a Qube's travel does not change.
    #[must_use]
    pub fn inside_travel(&self, plant: &PlantModel) -> Self {
        if plant.travel_fraction() < 1.0 {
            Self { theta: self.theta.min(Self::THESIS.within_travel(plant).theta), ..*self }
        } else {
            *self
        }
    }

    /// Converts the box to another number type.
    #[must_use]
    pub fn cast<T: Scalar>(&self) -> SafetyBox<T> {
        SafetyBox {
            theta: T::from_f64(self.theta),
            alpha: T::from_f64(self.alpha),
            theta_dot: T::from_f64(self.theta_dot),
            alpha_dot: T::from_f64(self.alpha_dot),
            guard: self.guard,
        }
    }

    /// The first limit that a state violates; a quantity that is NaN violates its limit.
    #[must_use]
    pub fn violation(&self, state: &State) -> Option<Limit> {
        let keeps = |value: f64, limit: f64| value.abs() < limit;
        if !keeps(state.theta, self.theta) {
            Some(Limit::Theta)
        } else if !keeps(state.alpha, self.alpha) {
            Some(Limit::Alpha)
        } else if !keeps(state.theta_dot, self.theta_dot) {
            Some(Limit::ThetaDot)
        } else if !keeps(state.alpha_dot, self.alpha_dot) {
            Some(Limit::AlphaDot)
        } else {
            None
        }
    }
}

impl<T: Scalar> SafetyBox<T> {
    /// Returns whether a state keeps all limits, computed without a branch for loops over many
    /// pendulums.
    #[inline(always)]
    pub fn contains(&self, state: &State<T>) -> bool {
        (state.theta.abs() < self.theta)
            & (state.alpha.abs() < self.alpha)
            & (state.theta_dot.abs() < self.theta_dot)
            & (state.alpha_dot.abs() < self.alpha_dot)
    }
}

impl<T: Scalar> SafetyBox<T> {
    /// The thesis's box, which supplies each limit, and the guard, that a file does not name.
    fn default_of_files() -> Self {
        SafetyBox::THESIS.cast()
    }
}

impl Default for SafetyBox {
    /// The guarded box, so that the default is safe.
    fn default() -> Self {
        Self::GUARDED
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_limit_is_named_on_both_sides_and_for_nan() {
        let inside = State { theta: 2.29, alpha: -12.5, theta_dot: 29.9, alpha_dot: -39.9 };
        assert_eq!(SafetyBox::THESIS.violation(&inside), None);
        assert!(SafetyBox::THESIS.contains(&inside));
        for sign in [1.0, -1.0, f64::NAN] {
            for (state, limit) in [
                (State { theta: 2.3 * sign, ..inside }, Limit::Theta),
                (State { alpha: 12.57 * sign, ..inside }, Limit::Alpha),
                (State { theta_dot: 30.0 * sign, ..inside }, Limit::ThetaDot),
                (State { alpha_dot: 40.0 * sign, ..inside }, Limit::AlphaDot),
            ] {
                assert_eq!(SafetyBox::THESIS.violation(&state), Some(limit));
                assert!(!SafetyBox::THESIS.contains(&state));
            }
        }
    }
}
