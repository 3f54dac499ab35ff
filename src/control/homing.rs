use serde::{Deserialize, Serialize};

use super::rest::{StillnessDetector, Swing};
use super::sensor_watch::SensorWatch;
use super::settling::{Settler, settling_voltage};
use super::stop_seek::StopSeek;
use super::watch::{Alarm, Watch};
use super::{ControlAction, ControlEvent, ControlState, Motion, TickInput, TickOutput};
use crate::estimation::{Calibration, Estimator, EstimatorSettings};
use crate::qube::{Measurement, RAD_PER_COUNT, State};
use crate::safety::gate;
use crate::telemetry::{Ending, Fault};

/// Most ticks for the whole of homing: 60 s.
const MAX_TICKS: u32 = 6000;

/// A swing wider than this is waited for: while it decays fast, its extremes have no middle, rad.
const LARGEST_SWING_RAD: f64 = 1.5;

/// How gently the arm is held meanwhile, V/rad. An arm that gives way lets the motor's back-EMF take
/// the pendulum's energy, within 8 s of a fall from upright; one that is held firmly keeps it.
const LOOSE_HOLD_V_PER_RAD: f64 = 0.3;

/// A pendulum that moves over no more than four counts hangs still, rad.
const STILL_RAD: f64 = 4.5 * RAD_PER_COUNT;

/// An arm within this of where it should be is there, rad: friction may hold it a little off.
const NEAR_MIDDLE_RAD: f64 = 0.1;

/// Where the middle of the arm comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HomingMethod {
    /// Half-way between the two hard stops, which the arm touches slowly.
    #[default]
    Stops,
    /// Where the arm is when homing starts: somebody put it into the middle by hand.
    #[serde(alias = "here")]
    Hand,
}

/// How homing is done.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HomingSettings {
    /// Where the middle comes from.
    pub method: HomingMethod,
    /// Where the arm's zero lies, seen from that middle, rad: some stops are not where they should be.
    pub theta_offset_rad: f64,
    /// The arm's count where it was put by hand, if it has moved since.
    #[serde(skip)]
    pub hand_counts: Option<i32>,
    /// Signs of the rig; the zeros are what homing finds.
    pub signs: Calibration,
    /// Velocities for the motion itself.
    pub estimator: EstimatorSettings,
}

impl Default for HomingSettings {
    fn default() -> Self {
        Self {
            method: HomingMethod::default(),
            theta_offset_rad: 0.0,
            hand_counts: None,
            signs: Calibration::IDENTITY,
            estimator: EstimatorSettings::default(),
        }
    }
}

/// Finds the arm's middle and the count at which the pendulum hangs: encoders count from wherever
/// they were switched on.
#[derive(Debug)]
pub struct Homing {
    settings: HomingSettings,
    estimator: Option<Estimator>,
    /// Zeros as of the first sample; theta and alpha below are relative to them.
    provisional: Calibration,
    watch: Watch,
    sensors: SensorWatch,
    control: ControlState,
    stillness: StillnessDetector,
    stage: Stage,
    /// The middle between the stops, once it is known.
    middle_rad: Option<f64>,
    /// Where the pendulum hangs, as far as it is known.
    hanging_rad: f64,
    ticks: u32,
    swing: Swing,
    settler: Settler,
    state: State,
    voltage_mv: i16,
    found: Option<Calibration>,
}

#[derive(Clone, Copy, Debug)]
enum Stage {
    /// Wait, the arm loosely held, until the pendulum swings about one point: there it hangs.
    Observe,
    /// Calm the pendulum about that point, with the arm in the middle as far as it is known.
    Calm,
    /// Look for the stops, which tell the middle.
    Seek(StopSeek),
}

impl Homing {
    /// A homing that has not begun.
    #[must_use]
    pub fn new(settings: &HomingSettings) -> Self {
        let middle_rad = match settings.method {
            HomingMethod::Stops => None,
            HomingMethod::Hand => Some(0.0),
        };
        Self {
            settings: *settings,
            estimator: None,
            provisional: settings.signs,
            watch: Watch::default(),
            sensors: SensorWatch::default(),
            control: ControlState::Identified.on(ControlEvent::Home).0,
            stillness: StillnessDetector::default(),
            stage: Stage::Observe,
            middle_rad,
            hanging_rad: 0.0,
            ticks: 0,
            swing: Swing::default(),
            settler: Settler::default(),
            state: State::default(),
            voltage_mv: 0,
            found: None,
        }
    }

    /// A homing out of a latched fault: first the arm, loosely held, must have been at rest for 1 s.
    #[must_use]
    pub fn after_fault(settings: &HomingSettings) -> Self {
        Self { control: ControlState::Cleared.on(ControlEvent::Home).0, ..Self::new(settings) }
    }

    /// Signs and zeros, once homing has completed.
    #[must_use]
    pub fn calibration(&self) -> Option<Calibration> {
        self.found
    }

    fn estimate(&mut self, measurement: &Measurement) -> State {
        let estimator = self.estimator.get_or_insert_with(|| {
            self.provisional.theta_zero_counts = measurement.theta_counts;
            self.provisional.alpha_zero_counts = measurement.alpha_counts;
            if let (HomingMethod::Hand, Some(theta_counts)) =
                (self.settings.method, self.settings.hand_counts)
            {
                let put = Measurement { theta_counts, ..*measurement };
                self.middle_rad = Some(self.provisional.angles_rad(&put).0);
            }
            Estimator::new(self.settings.estimator, self.provisional)
        });
        estimator.update(measurement).guarded
    }

    /// Moves on to the next stage where one has reached its end.
    fn advance(&mut self, measurement: &Measurement) -> Option<Ending> {
        match self.stage {
            Stage::Observe => {
                if let Some(window) = self.swing.update(self.state.alpha)
                    && window.width_rad < LARGEST_SWING_RAD
                {
                    self.hanging_rad = window.middle_rad;
                    if self.control.take(ControlEvent::AtRest) == ControlAction::Seek {
                        self.stage = Stage::Calm;
                    }
                }
            }
            Stage::Calm => {
                let off_middle_rad = self.state.theta - self.calm_rad();
                if let Some(window) = self.swing.update(self.state.alpha)
                    && window.width_rad <= STILL_RAD
                {
                    // Where it is still it hangs. While it is believed to hang elsewhere, that
                    // error holds the arm off its place for good.
                    self.hanging_rad = window.middle_rad;
                    if off_middle_rad.abs() >= NEAR_MIDDLE_RAD {
                        return None;
                    }
                    if self.middle_rad.is_some() {
                        self.found = Some(self.zeros(measurement, off_middle_rad));
                        return Some(Ending::Completed);
                    }
                    self.stage = Stage::Seek(StopSeek::default());
                }
            }
            Stage::Seek(ref mut seek) => match seek.update(self.state.theta) {
                Ok(None) => {}
                Ok(middle_rad) => {
                    self.middle_rad = middle_rad;
                    self.swing = Swing::default();
                    self.settler = Settler::default();
                    self.stage = Stage::Calm;
                }
                Err(fault) => return Some(Ending::Fault(fault)),
            },
        }
        None
    }

    /// The counts at the arm's zero and at the hanging pendulum.
    fn zeros(&self, measurement: &Measurement, off_middle_rad: f64) -> Calibration {
        let off_zero_rad = off_middle_rad - self.settings.theta_offset_rad;
        let off_hanging_rad = self.state.alpha - self.hanging_rad;
        let back = |counts: i32, off_rad: f64, inverted: bool| {
            let off_counts = (off_rad / RAD_PER_COUNT).round() as i32;
            counts.wrapping_sub(if inverted { -off_counts } else { off_counts })
        };
        let signs = &self.settings.signs;
        Calibration {
            theta_zero_counts: back(measurement.theta_counts, off_zero_rad, signs.theta_inverted),
            alpha_zero_counts: back(
                measurement.alpha_counts,
                off_hanging_rad,
                signs.alpha_inverted,
            ),
            ..*signs
        }
    }

    /// Where the arm is held while the pendulum comes to rest: in the middle, or where it was.
    fn calm_rad(&self) -> f64 {
        self.middle_rad.unwrap_or(0.0)
    }

    fn wanted_voltage(&mut self) -> f64 {
        let seen = State { alpha: self.state.alpha - self.hanging_rad, ..self.state };
        match self.stage {
            Stage::Observe => -LOOSE_HOLD_V_PER_RAD * (seen.theta - self.calm_rad()),
            Stage::Calm => self.settler.voltage(&seen, self.calm_rad()),
            Stage::Seek(seek) => settling_voltage(&seen, seek.target_rad().unwrap_or(seen.theta)),
        }
    }

    fn output(&self, wanted_v: Option<f64>, ending: Option<Ending>) -> TickOutput {
        TickOutput { wanted_v, ending, ..TickOutput::settling(self.state, self.voltage_mv) }
    }

    fn off(&mut self, ending: Ending) -> TickOutput {
        self.control.take(match ending {
            Ending::Fault(_) => ControlEvent::ZeroFault,
            Ending::Stopped => ControlEvent::Stop,
            Ending::Completed | Ending::LeftBox(_) => ControlEvent::Homed,
        });
        self.voltage_mv = 0;
        self.output(None, Some(ending))
    }
}

impl Motion for Homing {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        self.ticks += 1 + input.skipped_periods;

        // The arm is slow here: a fault that would brake a rollout can switch off at once.
        let seen = input.measurement.as_ref().and_then(|sample| self.sensors.check(sample, None));
        let alarm = self.watch.check(input).or(seen);
        if let Some(Alarm::Zero(fault) | Alarm::Brake(fault)) = alarm {
            return self.off(Ending::Fault(fault));
        }
        if input.stop_requested {
            return self.off(Ending::Stopped);
        }
        if self.ticks > MAX_TICKS {
            return self.off(Ending::Fault(Fault::HomingTimedOut));
        }
        let Some(measurement) = &input.measurement else {
            return self.output(None, None);
        };
        self.state = self.estimate(measurement);
        if self.control == ControlState::Resting {
            if self.stillness.is_still(self.state.theta) {
                self.control.take(ControlEvent::AtRest);
            }
        } else if let Some(ending) = self.advance(measurement) {
            return self.off(ending);
        }
        let wanted_v = self.wanted_voltage();
        self.voltage_mv = gate(wanted_v).unwrap_or(0);
        self.output(Some(wanted_v), None)
    }

    fn control_state(&self) -> ControlState {
        self.control
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.settings.signs.device_mv(voltage_mv)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::super::drive;
    use super::super::plant_device::{Mishap, PlantDevice};
    use super::*;
    use crate::qube::{COUNTS_PER_REVOLUTION, counts};

    fn home(device: &mut PlantDevice, settings: &HomingSettings) -> (Ending, Option<Calibration>) {
        let clock = device.clock.clone();
        let mut homing = Homing::new(settings);
        let report = drive(device, &clock, &mut homing, None, &AtomicBool::new(false)).unwrap();
        assert!(!device.armed);
        (report.outcome.ending, homing.calibration())
    }

    #[test]
    fn the_middle_and_the_hanging_count_are_found_from_anywhere() {
        // At rest, swinging, fallen from upright a moment ago, and still going round.
        for (theta, alpha, alpha_dot) in [
            (-2.0, 0.3, 0.0),
            (0.4, -0.2, 5.0),
            (2.3, 0.0, 0.0),
            (0.5, 3.0, 2.0),
            (-1.0, 1.0, 25.0),
        ] {
            let mut device = PlantDevice::new(State { theta, alpha, theta_dot: 0.0, alpha_dot });
            device.offset_counts = 12_345;
            let (ending, found) = home(&mut device, &HomingSettings::default());
            assert_eq!(ending, Ending::Completed);
            let found = found.unwrap();
            assert!((found.theta_zero_counts - 12_345).abs() <= 3, "{found:?}");
            let off_counts = (found.alpha_zero_counts - 12_345).rem_euclid(COUNTS_PER_REVOLUTION);
            assert!(off_counts <= 3 || off_counts >= COUNTS_PER_REVOLUTION - 3, "{found:?}");
            assert!(device.state.theta.abs() < 0.1);
        }
    }

    #[test]
    fn homing_by_hand_takes_the_place_where_the_arm_is() {
        let mut device = PlantDevice::new(State { theta: 0.5, ..State::default() });
        let settings = HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() };
        let (ending, found) = home(&mut device, &settings);
        assert_eq!(ending, Ending::Completed);
        assert!((found.unwrap().theta_zero_counts - counts(0.5)).abs() <= 3);
        assert!(device.furthest_rad < 0.7, "homing by hand does not look for stops");
    }

    #[test]
    fn an_arm_that_has_moved_since_it_was_put_by_hand_goes_back() {
        for theta_inverted in [false, true] {
            let signs = Calibration {
                theta_inverted,
                alpha_inverted: theta_inverted,
                voltage_inverted: theta_inverted,
                ..Calibration::IDENTITY
            };
            let mut device = PlantDevice::new(State { theta: 0.5, ..State::default() });
            let settings = HomingSettings {
                method: HomingMethod::Hand,
                hand_counts: Some(counts(0.1)),
                signs,
                ..HomingSettings::default()
            };
            let (ending, found) = home(&mut device, &settings);
            assert_eq!(ending, Ending::Completed);
            assert!((found.unwrap().theta_zero_counts - counts(0.1)).abs() <= 1, "{found:?}");
            assert!((device.state.theta - 0.1).abs() < 0.15, "{:?}", device.state);
        }
    }

    #[test]
    fn zero_lies_where_the_offset_says() {
        for theta_inverted in [false, true] {
            let mut device = PlantDevice::new(State::default());
            let signs = Calibration {
                theta_inverted,
                alpha_inverted: theta_inverted,
                voltage_inverted: theta_inverted,
                ..Calibration::IDENTITY
            };
            let settings =
                HomingSettings { theta_offset_rad: 0.2, signs, ..HomingSettings::default() };
            let (_, found) = home(&mut device, &settings);
            let expected = counts(if theta_inverted { -0.2 } else { 0.2 });
            assert!((found.unwrap().theta_zero_counts - expected).abs() <= 4, "{found:?}");
        }
    }

    #[test]
    fn after_a_fault_the_arm_must_have_been_at_rest_for_a_second() {
        let ticks_of = |alpha_dot: f64, mut homing: Homing| {
            let mut device = PlantDevice::new(State { alpha_dot, ..State::default() });
            let clock = device.clock.clone();
            let stop = AtomicBool::new(false);
            let report = drive(&mut device, &clock, &mut homing, None, &stop).unwrap();
            assert_eq!(report.outcome.ending, Ending::Completed);
            device.voltages_mv.len()
        };
        let settings = HomingSettings { method: HomingMethod::Hand, ..HomingSettings::default() };
        let plain = ticks_of(0.0, Homing::new(&settings));
        let rested = ticks_of(0.0, Homing::after_fault(&settings));
        assert!((100..110).contains(&(rested - plain)), "{rested} and {plain} ticks");
        let still_moving = ticks_of(12.0, Homing::after_fault(&settings));
        assert!(still_moving > rested + 50, "{still_moving} ticks");
    }

    #[test]
    fn an_arm_that_does_not_move_has_no_travel() {
        let frozen = |tick: u64| TickInput {
            deadline_ns: tick * 10_000_000,
            measurement: Some(Measurement {
                device_time_us: tick * 10_000,
                status: crate::qube::Status { armed: true, ..Default::default() },
                ..Measurement::default()
            }),
            ..TickInput::default()
        };
        let mut homing = Homing::new(&HomingSettings::default());
        let ending = (0..10_000).find_map(|tick| homing.decide(&frozen(tick)).ending);
        assert_eq!(ending, Some(Ending::Fault(Fault::TravelBlocked)));
        assert_eq!(homing.calibration(), None);
    }

    #[test]
    fn a_lost_link_ends_homing() {
        let mut device = PlantDevice::new(State::default());
        device.mishap = Box::new(|tick| (tick > 50).then_some(Mishap::Lost));
        let (ending, found) = home(&mut device, &HomingSettings::default());
        assert_eq!((ending, found), (Ending::Fault(Fault::NoSample), None));
    }
}
