//! A Qube with effects that the library's equations leave out: play between motor and arm, and
//! friction that yields like a spring before it slides.

use std::collections::VecDeque;

use qube_hil::qube::{CONTROL_PERIOD_S, MAX_HISTORY, NonidealDynamics, QubeModel, runge_kutta_4};

use crate::mechanics::Mechanics;

/// A Qube to simulate: its model, and an effect that the library's equations leave out.
#[derive(Clone, Copy)]
pub struct Kind {
    pub model: QubeModel,
    pub beyond_the_model: Beyond,
}

/// An effect that the library's equations leave out.
#[derive(Clone, Copy, PartialEq)]
pub enum Beyond {
    Nothing,
    /// Play between motor and arm, rad; the encoder is on the motor's side.
    Play(f64),
    /// Distance over which the friction yields before it slides (Dahl's model), rad.
    Presliding(f64),
}

/// Number of integration steps in a control period.
const STEPS: u32 = 20;

/// Number of integration steps in a control period if contacts or friction are stiff.
const STIFF_STEPS: u32 = 500;

/// A simulated Qube with its command delay and the effect of its kind.
pub struct Plant {
    kind: Kind,
    mechanics: Mechanics,
    /// Last commands, V, newest first.
    commands_v: VecDeque<f64>,
}

impl Plant {
    /// A Qube at rest with the arm at the angle `theta`, rad.
    pub fn at_rest(kind: &Kind, theta: f64) -> Self {
        let mechanics = Mechanics::at_rest(NonidealDynamics::new(&kind.model), theta);
        Self { kind: *kind, mechanics, commands_v: VecDeque::new() }
    }

    /// The angles that the two encoders measure, rad.
    pub fn angles(&self) -> [f64; 2] {
        let state = &self.mechanics.state;
        match self.kind.beyond_the_model {
            Beyond::Play(_) => [self.mechanics.motor_rad(), state.alpha],
            Beyond::Nothing | Beyond::Presliding(_) => [state.theta, state.alpha],
        }
    }

    /// Advances by one control period with this command, V.
    pub fn advance(&mut self, command_v: f64) {
        self.commands_v.push_front(command_v);
        self.commands_v.truncate(MAX_HISTORY + 2);
        let is_stiff = self.kind.beyond_the_model != Beyond::Nothing;
        let steps = if is_stiff { STIFF_STEPS } else { STEPS };
        let step_s = CONTROL_PERIOD_S / f64::from(steps);
        let mechanics = &mut self.mechanics;
        for step in 0..steps {
            // The voltage that acts at this instant was sent `sent_s` after the start of this
            // period, or before the start if `sent_s` is negative.
            let sent_s =
                (f64::from(step) + 0.5) * step_s - self.kind.model.nonidealities.command_delay_s;
            let age = (-sent_s / CONTROL_PERIOD_S).ceil().max(0.0) as usize;
            let voltage_v = self.commands_v.get(age).copied().unwrap_or(0.0);
            match self.kind.beyond_the_model {
                Beyond::Nothing => {
                    let state = mechanics.state;
                    mechanics.state = runge_kutta_4(&mechanics.dynamics, state, voltage_v, step_s);
                }
                Beyond::Play(play_rad) => mechanics.step_with_play(play_rad, voltage_v, step_s),
                Beyond::Presliding(distance_rad) => {
                    mechanics.step_with_presliding(distance_rad, voltage_v, step_s);
                }
            }
        }
    }
}
