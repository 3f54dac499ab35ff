use serde::{Deserialize, Serialize};

use super::sensor_watch::SensorWatch;
use super::settling::{Settler, settling_voltage};
use super::watch::{Alarm, Watch};
use super::{ControlAction, ControlEvent, ControlState, Motion, TickInput, TickOutput};
use crate::estimation::{Calibration, Estimator, EstimatorSettings};
use crate::qube::{CONTROL_PERIOD_S, HARD_STOP_RAD, Measurement, RAD_PER_COUNT, State};
use crate::safety::gate;
use crate::telemetry::{Ending, Fault};

/// Most ticks for the whole of homing: 60 s.
const MAX_TICKS: u32 = 6000;

/// An arm that moves less than this, rad ...
const REST_RANGE_RAD: f64 = 0.1;

/// ... for so many ticks, which is 1 s, is at rest.
const REST_TICKS: u32 = 100;

/// How fast the arm looks for its stops, rad/s: slow enough to touch them without a hit.
const SEEK_RAD_S: f64 = 1.5;

/// How far ahead of the arm its moving target may run, rad: against a stop that pushes with 1.6 V. A
/// real Qube's cable, friction and dead zone together take 1.2 V; 2 V are taken for a stalled motor.
const SEEK_LEAD_RAD: f64 = 0.95;

/// An arm that gains no more than this against its drive stands at a stop, rad ...
const PROGRESS_RAD: f64 = 0.01;

/// ... when it has not for this many ticks: longer than two swings of the pendulum, whose pull may
/// lift the arm off the stop for a while.
const BLOCKED_TICKS: u32 = 120;

/// How far the travel between the stops may differ from the nominal one, as a fraction.
const TRAVEL_TOLERANCE: f64 = 0.1;

/// Ticks over which the pendulum's swing is judged: more than one period of it (0.53 s).
const SWING_TICKS: u32 = 80;

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
    stillness: Stillness,
    stage: Stage,
    /// The middle between the stops, once it is known.
    middle_rad: Option<f64>,
    /// Where the pendulum hangs, as far as it is known.
    hanging_rad: f64,
    ticks: u32,
    seek: Option<Seek>,
    swing: Swing,
    settler: Settler,
    state: State,
    voltage_mv: i16,
    found: Option<Calibration>,
}

#[derive(Clone, Copy, Debug)]
enum Stop {
    Negative,
    Positive { negative_rad: f64 },
}

impl Stop {
    fn direction(self) -> f64 {
        match self {
            Self::Negative => -1.0,
            Self::Positive { .. } => 1.0,
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Stage {
    /// Wait, the arm loosely held, until the pendulum swings about one point: there it hangs.
    Observe,
    /// Calm the pendulum about that point, with the arm in the middle as far as it is known.
    Calm,
    /// Towards the stop at negative theta, then towards the other.
    Seek { stop: Stop },
}

/// A stop that is being looked for.
#[derive(Clone, Copy, Debug)]
struct Seek {
    /// Where the arm is drawn to; it moves ahead of the arm.
    target_rad: f64,
    furthest_rad: f64,
    /// Ticks since the arm last gained ground.
    blocked_ticks: u32,
}

/// How long the arm has stayed where it is.
#[derive(Clone, Copy, Debug, Default)]
struct Stillness {
    ticks: u32,
    lowest_rad: f64,
    highest_rad: f64,
}

impl Stillness {
    /// Takes the arm's next angle; true once it has been at rest for 1 s.
    fn is_still(&mut self, theta: f64) -> bool {
        let (lowest_rad, highest_rad) = (self.lowest_rad.min(theta), self.highest_rad.max(theta));
        *self = if self.ticks > 0 && highest_rad - lowest_rad < REST_RANGE_RAD {
            Self { ticks: self.ticks + 1, lowest_rad, highest_rad }
        } else {
            Self { ticks: 1, lowest_rad: theta, highest_rad: theta }
        };
        self.ticks > REST_TICKS
    }
}

/// Extremes of the pendulum's angle over windows of more than one of its periods.
#[derive(Clone, Copy, Debug, Default)]
struct Swing {
    ticks: u32,
    lowest_rad: f64,
    highest_rad: f64,
}

/// The pendulum's swing over one whole window.
#[derive(Clone, Copy, Debug)]
struct Window {
    middle_rad: f64,
    width_rad: f64,
}

impl Swing {
    /// Takes one more angle; gives the window that it completes.
    fn update(&mut self, alpha_rad: f64) -> Option<Window> {
        if self.ticks == 0 {
            (self.lowest_rad, self.highest_rad) = (alpha_rad, alpha_rad);
        }
        self.lowest_rad = self.lowest_rad.min(alpha_rad);
        self.highest_rad = self.highest_rad.max(alpha_rad);
        self.ticks += 1;
        if self.ticks < SWING_TICKS {
            return None;
        }
        self.ticks = 0;
        Some(Window {
            middle_rad: 0.5 * (self.lowest_rad + self.highest_rad),
            width_rad: self.highest_rad - self.lowest_rad,
        })
    }
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
            stillness: Stillness::default(),
            stage: Stage::Observe,
            middle_rad,
            hanging_rad: 0.0,
            ticks: 0,
            seek: None,
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
                    self.stage = Stage::Seek { stop: Stop::Negative };
                }
            }
            Stage::Seek { stop } => {
                let at_stop_rad = self.seek(stop)?;
                self.seek = None;
                match stop {
                    Stop::Negative => {
                        let stop = Stop::Positive { negative_rad: at_stop_rad };
                        self.stage = Stage::Seek { stop };
                    }
                    Stop::Positive { negative_rad } => {
                        let travel_rad = at_stop_rad - negative_rad;
                        if (travel_rad / (2.0 * HARD_STOP_RAD) - 1.0).abs() > TRAVEL_TOLERANCE {
                            return Some(Ending::Fault(Fault::TravelBlocked));
                        }
                        self.middle_rad = Some(0.5 * (at_stop_rad + negative_rad));
                        self.swing = Swing::default();
                        self.settler = Settler::default();
                        self.stage = Stage::Calm;
                    }
                }
            }
        }
        None
    }

    /// Moves the target on towards a stop; gives where the stop is once the arm stands at it.
    fn seek(&mut self, stop: Stop) -> Option<f64> {
        let theta = self.state.theta;
        let seek = self.seek.get_or_insert(Seek {
            target_rad: theta,
            furthest_rad: theta,
            blocked_ticks: 0,
        });
        let direction = stop.direction();
        let ahead_rad = direction * (seek.target_rad - theta) + SEEK_RAD_S * CONTROL_PERIOD_S;
        seek.target_rad = theta + direction * ahead_rad.min(SEEK_LEAD_RAD);
        seek.blocked_ticks += 1;
        if direction * (theta - seek.furthest_rad) > PROGRESS_RAD {
            (seek.furthest_rad, seek.blocked_ticks) = (theta, 0);
        }
        (seek.blocked_ticks >= BLOCKED_TICKS).then_some(seek.furthest_rad)
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
            Stage::Seek { .. } => {
                settling_voltage(&seen, self.seek.map_or(seen.theta, |seek| seek.target_rad))
            }
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
        let frozen = TickInput {
            measurement: Some(Measurement {
                status: crate::qube::Status { armed: true, ..Default::default() },
                ..Measurement::default()
            }),
            ..TickInput::default()
        };
        let mut homing = Homing::new(&HomingSettings::default());
        let ending = (0..10_000).find_map(|_| homing.decide(&frozen).ending);
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
