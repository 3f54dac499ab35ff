//! The motions that the study records.

use std::path::Path;

use qube_hil::estimation::{FilterGains, VelocityFilter};
use qube_hil::policy::{Controller as _, EXCITATION_STEPS, Excitation, ExcitationShape, Policy};
use qube_hil::qube::{CONTROL_PERIOD_S, PlantModel, QubeModel, State};
use qube_hil::replay::{MotionLog, MotionSample};

use crate::plant::{Beyond, Plant};

/// Corner of the filter that gives a policy its velocities, rad/s.
const FILTER_RAD_S: f64 = 200.0;

/// Angles beyond which a recording ends: arm and pendulum, rad.
const ENDS_RAD: [f64; 2] = [2.3, 4.0 * std::f64::consts::PI];

/// Distance between the arm's angles at which the rollouts of a policy begin, rad. The plant and
/// its encoders have no noise, so two rollouts from one angle would be the same recording.
const STARTS_APART_RAD: f64 = 0.06;

/// The motion of a plant in a recording.
#[derive(Clone)]
pub enum Motion {
    /// An excitation: its form and its largest voltage, V.
    Excitation(ExcitationShape, f64),
    /// A rollout of a policy.
    Rollout(Box<Policy>),
}

impl Motion {
    /// The motion that a word such as `chirp:1.5`, `steps:0.6` or `policy:FILE` names.
    pub fn named(text: &str) -> Self {
        let (kind, rest) = text
            .split_once(':')
            .expect("a motion is an excitation and its voltage, such as chirp:1.5, or policy:FILE");
        let voltage_v = || rest.parse().expect("the voltage is a number");
        match kind {
            "policy" => Self::Rollout(Box::new(
                Policy::load(Path::new(rest)).expect("the policy can be read"),
            )),
            other => {
                let shape = ExcitationShape::ALL.into_iter().find(|shape| shape.name() == other);
                Self::Excitation(shape.expect("the motion is an excitation or policy"), voltage_v())
            }
        }
    }

    /// Records the motion on a plant; `number` is the recording's number, from 0. The held-out
    /// recording of an excitation has nine tenths of its voltage, and each rollout of a policy has
    /// a start of its own.
    pub fn record(
        &self,
        model: &QubeModel,
        beyond: Beyond,
        number: u32,
        held_out: bool,
    ) -> MotionLog {
        let mut controller = match self {
            Self::Excitation(shape, voltage_v) => {
                let voltage_v = if held_out { 0.9 * voltage_v } else { *voltage_v };
                Policy::Excitation(Excitation::of_rollout(*shape, voltage_v, number))
            }
            Self::Rollout(policy) => (**policy).clone(),
        };
        let is_rollout = matches!(self, Self::Rollout(_));
        let place = 2 * number + u32::from(held_out);
        let start_rad = if is_rollout { STARTS_APART_RAD * f64::from(place) } else { 0.0 };
        let mut plant = Plant::at_rest(model, beyond, start_rad);
        let gains = FilterGains::new(FILTER_RAD_S, CONTROL_PERIOD_S);
        let first = plant.measured();
        let mut filters = [first.theta, first.alpha].map(VelocityFilter::at_rest);
        let mut samples = Vec::new();
        controller.start();
        for tick in 0..EXCITATION_STEPS {
            let state = plant.measured();
            if state.theta.abs() > ENDS_RAD[0] || state.alpha.abs() > ENDS_RAD[1] {
                break;
            }
            let seen = State {
                theta_dot: filters[0].update(state.theta, &gains),
                alpha_dot: filters[1].update(state.alpha, &gains),
                ..state
            };
            let voltage_v = (1000.0 * controller.voltage_v(&seen)).round() / 1000.0;
            controller.applied(voltage_v);
            plant.advance(voltage_v);
            samples.push(MotionSample {
                time_s: f64::from(tick) * CONTROL_PERIOD_S,
                state,
                voltage_v,
            });
        }
        MotionLog { samples, plant: PlantModel::QUBE }
    }
}
