use super::voltage_watch::VoltageWatch;
use super::watch::{Alarm, Watch, most_urgent};
use super::{ControlState, Motion, TickInput, TickOutput};
use crate::estimation::{Calibration, Estimator, EstimatorSettings};
use crate::qube::{PlantModel, State};
use crate::safety::clamp_to_mv;
use crate::telemetry::Ending;

/// Distance from a nominal stop within which the arm counts as at the stop, rad.
const NEAR_STOP_RAD: f64 = 0.3;

/// Ticks, 0.5 s, after which an arm that has not left its stop is taken to be at rest there, and
/// its angle is stored.
const REST_TICKS: u32 = 50;

/// Distance from the stored angle, or from the first angle while none is stored, that only a push
/// by hand or too small a voltage explains, rad: 4 mm at the arm's end.
const PUSHED_RAD: f64 = 0.05;

/// Distance from the stored angle within which a pushed arm has come back, rad.
const BACK_RAD: f64 = 0.025;

/// Distance from the stored angle beyond which the voltage evidently does not hold the arm, rad.
const AWAY_RAD: f64 = 0.5;

/// Ticks within which a pushed arm must come back: 3 s.
const RETURN_TICKS: u32 = 300;

/// Presses the arm outward against the stop that it touches.
///
/// The arm is at its stop already, so it cannot move far even if the host stops responding while
/// the voltage is on. Any press ends when the arm is at no stop, when the voltage does not hold it,
/// when time is up, or on a stop request or a fault.
#[derive(Debug)]
pub struct StopPress {
    plant: PlantModel,
    calibration: Calibration,
    push_v: f64,
    most_ticks: u32,
    kind: PressKind,
    estimator: Estimator,
    watch: Watch,
    voltage: VoltageWatch,
    ticks: u32,
    /// Direction of the stop, 1 or -1; 0 before the first sample.
    outward: f64,
    /// First angle of the arm, positive outward, rad.
    first_rad: f64,
    /// Angle at which the arm rests against the stop, positive outward, rad; `None` until the arm
    /// is at rest there.
    rest_rad: Option<f64>,
    pushed_ticks: u32,
    state: State,
    voltage_mv: i16,
    seen: PressOutcome,
}

/// The purpose of a press.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PressKind {
    /// Tests the voltage before the operator unplugs the board. It also ends as soon as a hand has
    /// pushed the arm off its stop and the motor has brought the arm back.
    Rehearsal,
    /// Keeps the voltage on while the operator feels whether it lasts.
    Test,
}

/// The result of pressing the arm against its stop.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PressOutcome {
    /// The arm has stayed at its stop so far, or was pushed off it less than 3 s ago.
    #[default]
    Stayed,
    /// The arm was not at a stop.
    NotAtStop,
    /// The arm was pushed off its stop by hand, and the motor brought it back.
    CameBack,
    /// The arm was pushed off its stop by hand and did not come back within 3 s, or went 0.5 rad
    /// away: the voltage is too small.
    StayedAway,
}

impl StopPress {
    /// A press with `push_v` volts, above 0, for at most `most_ticks` ticks.
    #[must_use]
    pub fn new(
        plant: &PlantModel,
        calibration: Calibration,
        push_v: f64,
        most_ticks: u32,
        kind: PressKind,
    ) -> Self {
        Self {
            plant: *plant,
            calibration,
            push_v,
            most_ticks,
            kind,
            estimator: Estimator::new(EstimatorSettings::default(), calibration),
            watch: Watch::default(),
            voltage: VoltageWatch::default(),
            ticks: 0,
            outward: 0.0,
            first_rad: 0.0,
            rest_rad: None,
            pushed_ticks: 0,
            state: State::default(),
            voltage_mv: 0,
            seen: PressOutcome::default(),
        }
    }

    /// The result so far.
    #[must_use]
    pub fn outcome(&self) -> PressOutcome {
        self.seen
    }

    /// Updates the result from the arm's angle; returns whether the press ends.
    fn update(&mut self) -> bool {
        if self.outward == 0.0 {
            self.outward = self.state.theta.signum();
            self.first_rad = self.state.theta.abs();
        }
        let reach_rad = self.state.theta * self.outward;
        // An arm that leaves its stop before it has rested is compared with its first angle:
        // otherwise the place where it was held would count as the stop.
        let off_rad = self.rest_rad.unwrap_or(self.first_rad) - reach_rad;
        if self.rest_rad.is_none() && self.pushed_ticks == 0 && off_rad <= PUSHED_RAD {
            if reach_rad < self.plant.limits.hard_stop_rad - NEAR_STOP_RAD {
                self.seen = PressOutcome::NotAtStop;
                return true;
            }
            if self.ticks >= REST_TICKS {
                self.rest_rad = Some(reach_rad);
            }
            return false;
        }
        if self.pushed_ticks > 0 {
            self.pushed_ticks += 1;
            if off_rad < BACK_RAD {
                self.pushed_ticks = 0;
                self.seen = PressOutcome::CameBack;
                return self.kind == PressKind::Rehearsal;
            }
        } else if off_rad > PUSHED_RAD {
            self.pushed_ticks = 1;
        }
        if off_rad > AWAY_RAD || self.pushed_ticks > RETURN_TICKS {
            self.seen = PressOutcome::StayedAway;
            return true;
        }
        false
    }

    fn off(&mut self, ending: Ending) -> TickOutput {
        self.voltage_mv = 0;
        TickOutput::outside_rollout(self.state, 0, None, Some(ending))
    }
}

impl Motion for StopPress {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        self.ticks += 1 + input.skipped_periods;
        let differs = self.voltage.watch(self.device_mv(self.voltage_mv), input);
        let alarm = most_urgent([self.watch.check(input), differs]);
        if let Some(Alarm::SwitchOff(fault) | Alarm::Brake(fault)) = alarm {
            return self.off(Ending::Fault(fault));
        }
        if input.stop_requested {
            return self.off(Ending::Stopped);
        }
        let Some(measurement) = &input.measurement else {
            return TickOutput::outside_rollout(self.state, self.voltage_mv, None, None);
        };
        self.state = self.estimator.update(measurement).guarded;
        if self.update() || self.ticks > self.most_ticks {
            return self.off(Ending::Completed);
        }
        let wanted_v = self.outward * self.push_v;
        let largest_v = self.plant.limits.largest_voltage_v;
        self.voltage_mv = clamp_to_mv(wanted_v, largest_v).unwrap_or(0);
        TickOutput::outside_rollout(self.state, self.voltage_mv, Some(wanted_v), None)
    }

    /// Always [`ControlState::Checking`], because a press is part of a check.
    fn control_state(&self) -> ControlState {
        ControlState::Checking
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.calibration.device_mv(voltage_mv)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::super::drive;
    use super::super::plant_device::PlantDevice;
    use super::*;
    use crate::qube::HARD_STOP_RAD;
    use crate::safety::MotorHeat;
    use crate::telemetry::Fault;

    fn pressed(theta: f64, push_v: f64) -> (PressOutcome, PlantDevice) {
        let mut device = PlantDevice::new(State { theta, ..State::default() });
        let clock = device.clock.clone();
        let mut press = StopPress::new(
            &PlantModel::QUBE,
            Calibration::IDENTITY,
            push_v,
            200,
            PressKind::Rehearsal,
        );
        let report = drive(
            &mut device,
            &clock,
            &mut press,
            &mut MotorHeat::default(),
            None,
            &AtomicBool::new(false),
        )
        .unwrap();
        assert_eq!(report.outcome.ending, Ending::Completed);
        assert!(!device.armed);
        (press.outcome(), device)
    }

    #[test]
    fn an_arm_at_either_stop_is_pressed_outward_and_stays() {
        for side in [1.0, -1.0] {
            let (outcome, device) = pressed(side * HARD_STOP_RAD, 0.5);
            assert_eq!(outcome, PressOutcome::Stayed);
            let pressing = side * f64::from(device.voltages_mv[100]);
            assert!((pressing - 500.0).abs() < 1.0, "{pressing}");
            assert!((device.state.theta - side * HARD_STOP_RAD).abs() < 0.01);
        }
    }

    #[test]
    fn a_motor_with_a_voltage_of_its_own_is_switched_off() {
        let mut device = PlantDevice::new(State { theta: HARD_STOP_RAD, ..State::default() });
        device.stuck_mv = Some(3000);
        let clock = device.clock.clone();
        let signs = Calibration::IDENTITY;
        let mut press = StopPress::new(&PlantModel::QUBE, signs, 0.5, 200, PressKind::Test);
        let report = drive(
            &mut device,
            &clock,
            &mut press,
            &mut MotorHeat::default(),
            None,
            &AtomicBool::new(false),
        )
        .unwrap();
        assert_eq!(report.outcome.ending, Ending::Fault(Fault::VoltageDiffers));
        assert!(!device.armed && device.voltages_mv.len() < 10, "{:?}", device.voltages_mv);
    }

    #[test]
    fn an_arm_in_the_middle_is_left_alone() {
        let (outcome, device) = pressed(0.4, 0.5);
        assert_eq!(outcome, PressOutcome::NotAtStop);
        assert!(device.voltages_mv.iter().all(|voltage_mv| *voltage_mv == 0));
    }

    /// Runs a rehearsal whose arm is off its stop by `off_rad` of the tick, rad; returns the last
    /// tick and the result.
    fn after_a_push(off_rad: impl Fn(u32) -> f64) -> Option<(u32, PressOutcome)> {
        press_of(PressKind::Rehearsal, off_rad)
    }

    /// Runs a press whose arm is off its stop by `off_rad` of the tick, rad; returns the last tick
    /// and the result.
    fn press_of(kind: PressKind, off_rad: impl Fn(u32) -> f64) -> Option<(u32, PressOutcome)> {
        let mut press = StopPress::new(&PlantModel::QUBE, Calibration::IDENTITY, 0.5, 6000, kind);
        (0..6000).find_map(|tick| {
            let theta = HARD_STOP_RAD - off_rad(tick);
            let measurement = crate::qube::Measurement {
                device_time_us: u64::from(tick) * 10_000,
                theta_counts: crate::qube::counts(theta),
                applied_mv: press.voltage_mv,
                status: crate::qube::Status { armed: true, ..Default::default() },
                ..Default::default()
            };
            let deadline_ns = u64::from(tick) * 10_000_000;
            let input =
                TickInput { deadline_ns, measurement: Some(measurement), ..TickInput::default() };
            press.decide(&input).ending.map(|_| (tick, press.outcome()))
        })
    }

    #[test]
    fn a_press_distinguishes_a_pushed_arm_that_comes_back_from_one_that_stays_away() {
        let back = after_a_push(|tick| if (200..300).contains(&tick) { 0.12 } else { 0.0 });
        assert_eq!(back, Some((300, PressOutcome::CameBack)));
        let away = after_a_push(|tick| if tick >= 200 { 0.12 } else { 0.0 });
        assert!(matches!(away, Some((tick, PressOutcome::StayedAway)) if tick < 520), "{away:?}");
        let running = after_a_push(|tick| f64::from(tick.saturating_sub(200)) * 0.02);
        assert!(matches!(running, Some((_, PressOutcome::StayedAway))), "{running:?}");
    }

    #[test]
    fn an_arm_that_leaves_its_stop_before_it_has_rested_is_not_taken_to_rest_elsewhere() {
        for kind in [PressKind::Rehearsal, PressKind::Test] {
            // A finger holds the arm off its stop from 0.2 s on.
            let held = press_of(kind, |tick| if tick >= 20 { 0.12 } else { 0.0 });
            assert!(
                matches!(held, Some((tick, PressOutcome::StayedAway)) if tick < 400),
                "{kind:?}: {held:?}"
            );
            // The arm is carried off slowly, and is off by more than `PUSHED_RAD` when its resting
            // angle would be stored.
            let carried = press_of(kind, |tick| f64::from(tick) * 0.005);
            assert!(
                matches!(carried, Some((tick, PressOutcome::StayedAway)) if tick < 400),
                "{kind:?}: {carried:?}"
            );
            // The arm is beside the stop at first, and farther away than `NEAR_STOP_RAD` before it
            // rests.
            let beside = press_of(kind, |tick| 0.28 + f64::from(tick.min(30)) * 0.001);
            assert!(
                matches!(beside, Some((tick, PressOutcome::NotAtStop)) if tick < 50),
                "{kind:?}: {beside:?}"
            );
        }
        // An early push gives the same result as a late one.
        let early = after_a_push(|tick| if (10..40).contains(&tick) { 0.12 } else { 0.0 });
        assert_eq!(early, Some((40, PressOutcome::CameBack)));
        // The arm moves the last 0.2 rad to its stop before it rests there.
        let arrived = after_a_push(|tick| match tick {
            0..40 => 0.2,
            300..400 => 0.12,
            _ => 0.0,
        });
        assert_eq!(arrived, Some((400, PressOutcome::CameBack)));
    }
}
