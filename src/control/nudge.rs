use super::watch::{Alarm, Watch};
use super::{ControlState, Motion, TickInput, TickOutput};
use crate::estimation::{Calibration, Estimator, EstimatorSettings};
use crate::qube::State;
use crate::safety::{brake_voltage, gate};
use crate::telemetry::Ending;

/// Most ticks of each of the three stages: 0.1 s, 0.3 s for the whole.
const STAGE_TICKS: u32 = 10;

/// A push ends when the arm has gone this far, rad.
const REACH_RAD: f64 = 0.12;

/// An arm that went at least this far has moved, rad: ten counts.
const MOVED_RAD: f64 = 0.03;

/// Below this the arm counts as stopped, rad/s.
const STOPPED_RAD_S: f64 = 0.5;

/// A small push of the arm, to see what follows from it: open loop, because the signs that any
/// feedback needs are what it is to find out.
///
/// It pushes one way and then as long the other way, which leaves a free arm about at rest; an arm
/// that stood at a stop moves on the way back. Once a motion was seen the arm is braked by
/// feedback, with the sign that was seen.
#[derive(Debug)]
pub struct Nudge {
    signs: Calibration,
    push_v: f64,
    estimator: Estimator,
    watch: Watch,
    stage: Stage,
    ticks: u32,
    pushed_ticks: u32,
    start: Option<State>,
    state: State,
    voltage_mv: i16,
    current_a: f64,
    seen: NudgeResponse,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Push,
    PushBack,
    Brake,
}

/// How arm and pendulum answered a push: differences from the start to its end.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct NudgeResponse {
    /// The voltage that was applied, V, by the signs that were assumed.
    pub voltage_v: f64,
    /// How far the arm went, rad.
    pub theta_rad: f64,
    /// How far the pendulum went, rad.
    pub alpha_rad: f64,
    /// Largest motor current meanwhile, A, without its sign.
    pub current_a: f64,
}

impl NudgeResponse {
    /// Whether the arm's count shows a motion.
    #[must_use]
    pub fn arm_moved(&self) -> bool {
        self.theta_rad.abs() >= MOVED_RAD
    }
}

impl Nudge {
    /// A push by `push_v`, with these signs taken as right.
    #[must_use]
    pub fn new(signs: Calibration, push_v: f64) -> Self {
        Self {
            signs,
            push_v,
            estimator: Estimator::new(EstimatorSettings::default(), signs),
            watch: Watch::default(),
            stage: Stage::Push,
            ticks: 0,
            pushed_ticks: 0,
            start: None,
            state: State::default(),
            voltage_mv: 0,
            current_a: 0.0,
            seen: NudgeResponse::default(),
        }
    }

    /// What was seen; zeros before the end.
    #[must_use]
    pub fn response(&self) -> NudgeResponse {
        self.seen
    }

    fn stage_v(&self) -> f64 {
        match self.stage {
            Stage::Push => self.push_v,
            Stage::PushBack => -self.push_v,
            Stage::Brake => {
                let sense = (self.seen.theta_rad * self.seen.voltage_v).signum();
                (sense * brake_voltage(self.state.theta_dot))
                    .clamp(-self.push_v.abs(), self.push_v.abs())
            }
        }
    }

    /// Moves on to the next stage at the end of one; true at the end of the last.
    fn advance(&mut self, start: &State) -> bool {
        let gone = NudgeResponse {
            voltage_v: self.stage_v(),
            theta_rad: self.state.theta - start.theta,
            alpha_rad: self.state.alpha - start.alpha,
            current_a: self.current_a,
        };
        match self.stage {
            Stage::Push if gone.theta_rad.abs() >= REACH_RAD || self.ticks >= STAGE_TICKS => {
                self.seen = gone;
                self.pushed_ticks = self.ticks;
                if !gone.arm_moved() {
                    // The way back is then a push of its own.
                    self.start = Some(self.state);
                }
                self.enter(Stage::PushBack);
            }
            Stage::PushBack if self.seen.arm_moved() && self.ticks >= self.pushed_ticks => {
                self.enter(Stage::Brake);
            }
            Stage::PushBack if !self.seen.arm_moved() => {
                let is_over = self.ticks >= self.pushed_ticks;
                if gone.arm_moved() && (gone.theta_rad.abs() >= REACH_RAD || is_over) {
                    self.seen = gone;
                    self.enter(Stage::Brake);
                } else if is_over {
                    return true;
                }
            }
            Stage::Brake
                if self.state.theta_dot.abs() < STOPPED_RAD_S || self.ticks >= STAGE_TICKS =>
            {
                return true;
            }
            _ => {}
        }
        false
    }

    fn enter(&mut self, stage: Stage) {
        self.stage = stage;
        self.ticks = 0;
    }

    fn output(&self, wanted_v: Option<f64>, ending: Option<Ending>) -> TickOutput {
        TickOutput { wanted_v, ending, ..TickOutput::settling(self.state, self.voltage_mv) }
    }

    fn off(&mut self, ending: Ending) -> TickOutput {
        self.voltage_mv = 0;
        self.output(None, Some(ending))
    }
}

impl Motion for Nudge {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        if let Some(Alarm::Zero(fault) | Alarm::Brake(fault)) = self.watch.check(input) {
            return self.off(Ending::Fault(fault));
        }
        self.ticks += input.skipped_periods;
        let Some(measurement) = &input.measurement else {
            self.ticks += 1;
            return self.output(None, None);
        };
        self.state = self.estimator.update(measurement).guarded;
        self.current_a = self.current_a.max(f64::from(measurement.current_a).abs());
        let start = *self.start.get_or_insert(self.state);
        if self.advance(&start) {
            // A stop is obeyed here: what is left of 0.3 s brings the arm to rest.
            return self.off(if input.stop_requested {
                Ending::Stopped
            } else {
                Ending::Completed
            });
        }
        let wanted_v = self.stage_v();
        self.voltage_mv = gate(wanted_v).unwrap_or(0);
        self.ticks += 1;
        self.output(Some(wanted_v), None)
    }

    /// A part of an examination, which judges what came of it.
    fn control_state(&self) -> ControlState {
        ControlState::Checking
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.signs.device_mv(voltage_mv)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::super::drive;
    use super::super::plant_device::PlantDevice;
    use super::*;
    use crate::qube::HARD_STOP_RAD;

    fn nudged(device: &mut PlantDevice, signs: Calibration) -> NudgeResponse {
        let clock = device.clock.clone();
        let mut nudge = Nudge::new(signs, 0.5);
        let report = drive(device, &clock, &mut nudge, None, &AtomicBool::new(false)).unwrap();
        assert_eq!(report.outcome.ending, Ending::Completed);
        assert!(!device.armed);
        assert!(device.voltages_mv.iter().all(|voltage_mv| voltage_mv.abs() <= 500));
        assert!(device.voltages_mv.len() <= 31, "{} ticks", device.voltages_mv.len());
        nudge.response()
    }

    #[test]
    fn the_arm_follows_the_voltage_and_the_pendulum_lags() {
        let mut device = PlantDevice::new(State::default());
        let seen = nudged(&mut device, Calibration::IDENTITY);
        assert!(
            seen.voltage_v > 0.0 && seen.theta_rad > 0.05 && seen.alpha_rad < -0.05,
            "{seen:?}"
        );
        assert!(device.state.theta.abs() < 0.5 && device.state.theta_dot.abs() < 1.0);
    }

    #[test]
    fn at_a_stop_it_moves_on_the_way_back() {
        for theta in [HARD_STOP_RAD, -HARD_STOP_RAD] {
            let mut device = PlantDevice::new(State { theta, ..State::default() });
            let seen = nudged(&mut device, Calibration::IDENTITY);
            assert!(seen.theta_rad * seen.voltage_v > 0.0 && seen.arm_moved(), "{seen:?}");
            // What the pendulum does there is for the emulator to show: this plant's stop takes the
            // arm's momentum without giving the pendulum its share.
            assert!((device.state.theta - theta).abs() < 0.6, "{:?}", device.state);
            assert!(device.state.theta_dot.abs() < 1.5, "{:?}", device.state);
        }
    }

    #[test]
    fn wrong_signs_show_and_the_arm_is_stopped_all_the_same() {
        for (theta_inverted, alpha_inverted, voltage_inverted) in
            [(true, false, false), (false, true, false), (false, false, true)]
        {
            let mut device = PlantDevice::new(State::default());
            let signs = Calibration {
                theta_inverted,
                alpha_inverted,
                voltage_inverted,
                ..Calibration::IDENTITY
            };
            let seen = nudged(&mut device, signs);
            let follows = seen.theta_rad * seen.voltage_v > 0.0;
            let lags = seen.alpha_rad * seen.theta_rad < 0.0;
            assert_eq!(follows, theta_inverted == voltage_inverted, "{seen:?}");
            assert_eq!(lags, theta_inverted == alpha_inverted, "{seen:?}");
            assert!(device.state.theta_dot.abs() < 1.5, "{:?}", device.state);
        }
    }
}
