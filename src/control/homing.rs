use serde::{Deserialize, Serialize};

use super::current_watch::CurrentWatch;
use super::probe::{Answer, Probe, STRONGEST_V};
use super::rest::{StillnessDetector, Swing};
use super::sensor_watch::SensorWatch;
use super::settling::GentleSettler;
use super::stop_seek::{Found, StopSeek};
use super::watch::{Alarm, Watch};
use super::witness::ZERO_WITHIN_RAD;
use super::{ControlAction, ControlEvent, ControlState, Motion, TickInput, TickOutput};
use crate::estimation::{Calibration, Estimator, EstimatorSettings, MeasuredRig, MeasuredStops};
use crate::qube::{HARD_STOP_RAD, Measurement, RAD_PER_COUNT, State};
use crate::safety::gate;
use crate::telemetry::{Ending, Fault};

/// Most ticks for the whole of homing: 60 s.
const MAX_TICKS: u32 = 6000;

/// A swing wider than this is waited for with the motor at 0 V, rad: what such a pendulum does to the
/// arm nobody may add to.
const LARGEST_SWING_RAD: f64 = 0.15;

/// A pendulum that moves over more than this swings, rad.
const SWINGING_RAD: f64 = 0.02;

/// An arm that moves no farther than this, rad, and than so much for each rad of the pendulum's swing, is
/// at rest: nothing but the pendulum moves it.
const RESTING_ARM_RAD: f64 = 0.02;
const RECOIL: f64 = 0.7;

/// An arm that stands within this, rad, while the pendulum swings by up to so much, is held, by friction
/// or by somebody: there the swing does not end by itself.
const STANDING_ARM_RAD: f64 = 3.5 * RAD_PER_COUNT;
const SWING_OF_A_HELD_ARM_RAD: f64 = 1.2;

/// An arm that is led is never faster than this, rad/s ...
const RUNAWAY_RAD_S: f64 = 4.0;

/// ... for so many ticks.
const RUNAWAY_TICKS: u32 = 4;

/// A pendulum that moves over no more than four counts hangs still, rad.
const STILL_RAD: f64 = 4.5 * RAD_PER_COUNT;

/// An arm within this of where it should be is there, rad: friction may hold it a little off.
const NEAR_MIDDLE_RAD: f64 = 0.1;

/// The witness is called anew where the hanging count turns out to be another one by so much, rad.
const OTHER_ZERO_RAD: f64 = 1.5 * RAD_PER_COUNT;

/// How far the travel between the stops may differ from what it should be, as a fraction.
const TRAVEL_TOLERANCE: f64 = 0.03;

/// An arm that is off its place, that has more than this to get there, V ...
const HELD_V: f64 = 1.3;

/// ... and that stays within so many counts ...
const HELD_COUNTS: i32 = 3;

/// ... for so many ticks, is held.
const HELD_TICKS: u32 = 200;

/// An arm that has not moved for so many ticks although its pendulum swings is held too.
const STOOD_TICKS: u32 = 1000;

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
    /// How far apart the operator knows this rig's stops to be, rad; without it, as far as a Qube's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub travel_rad: Option<f64>,
    /// The arm's count where it was put by hand, if it has moved since.
    #[serde(skip)]
    pub hand_counts: Option<i32>,
    /// Signs of the rig; the zeros are what homing finds.
    pub signs: Calibration,
    /// Velocities for the motion itself.
    pub estimator: EstimatorSettings,
}

impl HomingSettings {
    /// How far apart the stops should be, rad.
    #[must_use]
    pub fn expected_travel_rad(&self) -> f64 {
        self.travel_rad.unwrap_or(2.0 * HARD_STOP_RAD)
    }
}

impl Default for HomingSettings {
    fn default() -> Self {
        Self {
            method: HomingMethod::default(),
            theta_offset_rad: 0.0,
            travel_rad: None,
            hand_counts: None,
            signs: Calibration::IDENTITY,
            estimator: EstimatorSettings::default(),
        }
    }
}

/// Finds the arm's middle and the count at which the pendulum hangs: encoders count from wherever
/// they were switched on.
///
/// Nothing is believed before it has been seen. The motor stays at 0 V until the pendulum hardly swings;
/// a push that grows from nothing shows whether the arm follows; from then on arm and pendulum are
/// witnesses of each other, and the arm is led so slowly that a witness who falls silent costs no hit.
#[derive(Debug)]
pub struct Homing {
    settings: HomingSettings,
    estimator: Option<Estimator>,
    /// Zeros as of the first sample; theta and alpha below are relative to them.
    provisional: Calibration,
    watch: Watch,
    sensors: SensorWatch,
    current: CurrentWatch,
    control: ControlState,
    stillness: StillnessDetector,
    stage: Stage,
    /// Where the arm is held while nothing else is known, rad.
    place_rad: f64,
    /// The middle between the stops, once it is known.
    middle_rad: Option<f64>,
    /// The stops that were touched, the lower first, rad.
    stops_rad: Option<(f64, f64)>,
    /// Where the pendulum hangs, as far as it is known.
    hanging_rad: f64,
    ticks: u32,
    swing: Swing,
    arm_swing: Swing,
    settler: GentleSettler,
    held: Held,
    stood: Held,
    runaway_ticks: u32,
    middle_before_rad: Option<f64>,
    state: State,
    voltage_mv: i16,
    found: Option<MeasuredRig>,
}

#[derive(Clone, Copy, Debug)]
enum Stage {
    /// Wait at 0 V until the pendulum hardly swings: the middle of that is where it hangs.
    Observe,
    /// Push until the arm follows.
    Probe(Probe),
    /// Calm the pendulum about that point, with the arm in the middle as far as it is known.
    Calm,
    /// Look for the stops, which tell the middle.
    Seek(StopSeek),
    /// The stops are not where they should be: come off the last one, if something lets the arm go.
    ComeOff { from_rad: f64, ticks: u32 },
}

/// Whether pushing may begin: with these swings of pendulum and arm, rad.
fn is_calm_enough(pendulum_rad: f64, arm_rad: f64) -> bool {
    let hardly_swings =
        pendulum_rad < LARGEST_SWING_RAD && arm_rad < RECOIL.mul_add(pendulum_rad, RESTING_ARM_RAD);
    hardly_swings || pendulum_rad < SWING_OF_A_HELD_ARM_RAD && arm_rad < STANDING_ARM_RAD
}

/// For how long the arm has stayed where it is although it should go elsewhere.
#[derive(Clone, Copy, Debug, Default)]
struct Held {
    counts: i32,
    ticks: u32,
}

impl Held {
    fn lasts(&mut self, counts: i32, is_pushed: bool) -> bool {
        let stays = counts.wrapping_sub(self.counts).wrapping_abs() <= HELD_COUNTS;
        *self = if stays && is_pushed {
            Self { ticks: self.ticks + 1, ..*self }
        } else {
            Self { counts, ticks: 0 }
        };
        self.ticks >= HELD_TICKS
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
            current: CurrentWatch::default(),
            control: ControlState::Identified.on(ControlEvent::Home).0,
            stillness: StillnessDetector::default(),
            stage: Stage::Observe,
            place_rad: 0.0,
            middle_rad,
            stops_rad: None,
            hanging_rad: 0.0,
            ticks: 0,
            swing: Swing::default(),
            arm_swing: Swing::default(),
            settler: GentleSettler::default(),
            held: Held::default(),
            stood: Held::default(),
            runaway_ticks: 0,
            middle_before_rad: None,
            state: State::default(),
            voltage_mv: 0,
            found: None,
        }
    }

    /// A homing out of a latched fault: first the arm must have been at rest for 1 s.
    #[must_use]
    pub fn after_fault(settings: &HomingSettings) -> Self {
        Self { control: ControlState::Cleared.on(ControlEvent::Home).0, ..Self::new(settings) }
    }

    /// Signs and zeros, once homing has completed.
    #[must_use]
    pub fn calibration(&self) -> Option<Calibration> {
        self.found.map(|rig| rig.calibration)
    }

    /// All that is known of the rig, once homing has completed.
    #[must_use]
    pub fn measured(&self) -> Option<MeasuredRig> {
        self.found
    }

    /// How far apart the stops were that the arm touched, rad, once both were.
    #[must_use]
    pub fn travel_rad(&self) -> Option<f64> {
        self.stops_rad.map(|(lowest_rad, highest_rad)| highest_rad - lowest_rad)
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

    /// The state with alpha as seen from hanging.
    fn seen(&self) -> State {
        State { alpha: self.state.alpha - self.hanging_rad, ..self.state }
    }

    /// From now on the pendulum is known to hang there.
    fn hangs_at(&mut self, hanging_rad: f64, within_rad: f64) {
        let is_other = (hanging_rad - self.hanging_rad).abs() > OTHER_ZERO_RAD;
        self.hanging_rad = hanging_rad;
        if is_other || self.sensors.witness().is_none() {
            let off_counts = (hanging_rad / RAD_PER_COUNT).round() as i32;
            let inverted = self.provisional.alpha_inverted;
            let zero = self.provisional.alpha_zero_counts;
            let off_counts = if inverted { -off_counts } else { off_counts };
            let calibration = Calibration {
                alpha_zero_counts: zero.wrapping_add(off_counts),
                ..self.provisional
            };
            self.sensors.call_witness(calibration, within_rad);
        }
    }

    /// Moves on to the next stage where one has reached its end.
    fn advance(&mut self, measurement: &Measurement) -> Option<Ending> {
        let seen = self.seen();
        match &mut self.stage {
            Stage::Observe => {
                let arm = self.arm_swing.update(self.state.theta);
                if let Some(window) = self.swing.update(self.state.alpha)
                    && let Some(arm) = arm
                    && is_calm_enough(window.width_rad, arm.width_rad)
                {
                    // The middle of a swing that decays is known once two of them agree.
                    let before_rad = self.middle_before_rad.replace(window.middle_rad);
                    let swings = window.width_rad > SWINGING_RAD;
                    if swings && before_rad.is_none() {
                        return None;
                    }
                    let before_rad = before_rad.filter(|_| swings).unwrap_or(window.middle_rad);
                    let apart_rad = (window.middle_rad - before_rad).abs();
                    let within_rad = 0.01f64.mul_add(window.width_rad, RAD_PER_COUNT);
                    self.hangs_at(
                        0.5 * (window.middle_rad + before_rad),
                        within_rad + 0.5 * apart_rad,
                    );
                    if self.control.take(ControlEvent::AtRest) == ControlAction::Seek {
                        self.stage = Stage::Probe(Probe::new(window.width_rad));
                    }
                }
            }
            Stage::Probe(probe) => {
                let witness = self.sensors.witness();
                let leads = witness.is_some_and(|own| own.pendulum_seems_to_lead());
                let rather_leads = witness.is_some_and(|own| own.pendulum_rather_leads());
                match probe.update(&seen) {
                    Answer::Waits => {}
                    Answer::Follows if leads => return Some(Ending::Fault(Fault::WrongSignAlpha)),
                    Answer::Follows => {
                        self.current.motor_works();
                        self.place_rad = self.state.theta;
                        self.swing = Swing::default();
                        self.settler = GentleSettler::default();
                        self.stage = match self.middle_rad {
                            Some(_) => Stage::Calm,
                            None => Stage::Seek(StopSeek::default()),
                        };
                    }
                    Answer::Opposes => {
                        return Some(Ending::Fault(if rather_leads {
                            Fault::WrongSignTheta
                        } else {
                            Fault::WrongSignMotor
                        }));
                    }
                    Answer::Stays => {
                        let is_dead = self.current.is_dead(STRONGEST_V);
                        let fault = if is_dead { Fault::MotorDead } else { Fault::ArmHeld };
                        return Some(Ending::Fault(fault));
                    }
                }
            }
            Stage::Calm => {
                // The middle, or the place where it was put by hand.
                let off_rad = self.state.theta - self.calm_rad();
                let is_pushed = f64::from(self.voltage_mv).abs() >= 1e3 * HELD_V
                    && off_rad.abs() >= NEAR_MIDDLE_RAD;
                self.stood.lasts(measurement.theta_counts, true);
                if self.held.lasts(measurement.theta_counts, is_pushed) {
                    return Some(Ending::Fault(Fault::ArmHeld));
                }
                if let Some(window) = self.swing.update(self.state.alpha)
                    && window.width_rad <= STILL_RAD
                {
                    // Where it is still it hangs. While it is believed to hang elsewhere, that
                    // error holds the arm off its place for good.
                    self.hangs_at(window.middle_rad, ZERO_WITHIN_RAD);
                    if off_rad.abs() < NEAR_MIDDLE_RAD {
                        self.found = Some(self.zeros(measurement, off_rad));
                        return Some(Ending::Completed);
                    }
                }
            }
            Stage::Seek(seek) => {
                if let Some(Found { lowest_rad, highest_rad }) = seek.update(self.state.theta) {
                    self.stops_rad = Some((lowest_rad, highest_rad));
                    self.swing = Swing::default();
                    let travel = (highest_rad - lowest_rad) / self.settings.expected_travel_rad();
                    if (travel - 1.0).abs() > TRAVEL_TOLERANCE {
                        self.place_rad = self.state.theta - 0.3;
                        self.stage = Stage::ComeOff { from_rad: self.state.theta, ticks: 0 };
                    } else {
                        self.middle_rad = Some(0.5 * (lowest_rad + highest_rad));
                        self.stage = Stage::Calm;
                    }
                }
            }
            Stage::ComeOff { from_rad, ticks } => {
                *ticks += 1;
                if *from_rad - self.state.theta > 0.05 {
                    return Some(Ending::Fault(Fault::TravelWrong));
                }
                if *ticks > HELD_TICKS {
                    return Some(Ending::Fault(Fault::ArmHeld));
                }
            }
        }
        None
    }

    /// The counts at the arm's zero and at the hanging pendulum, and the stops as seen from there.
    fn zeros(&self, measurement: &Measurement, off_middle_rad: f64) -> MeasuredRig {
        let offset_rad = self.settings.theta_offset_rad;
        let off_zero_rad = off_middle_rad - offset_rad;
        let off_hanging_rad = self.state.alpha - self.hanging_rad;
        let back = |counts: i32, off_rad: f64, inverted: bool| {
            let off_counts = (off_rad / RAD_PER_COUNT).round() as i32;
            counts.wrapping_sub(if inverted { -off_counts } else { off_counts })
        };
        let signs = &self.settings.signs;
        let calibration = Calibration {
            theta_zero_counts: back(measurement.theta_counts, off_zero_rad, signs.theta_inverted),
            alpha_zero_counts: back(
                measurement.alpha_counts,
                off_hanging_rad,
                signs.alpha_inverted,
            ),
            ..*signs
        };
        let zero_rad = self.calm_rad() + offset_rad;
        let stops = self.stops_rad.map(|(lowest_rad, highest_rad)| MeasuredStops {
            lowest_theta_rad: lowest_rad - zero_rad,
            highest_theta_rad: highest_rad - zero_rad,
        });
        MeasuredRig { calibration, stops }
    }

    /// Where the arm is held while the pendulum comes to rest: in the middle, or where it was.
    fn calm_rad(&self) -> f64 {
        self.middle_rad.unwrap_or(self.place_rad)
    }

    fn wanted_voltage(&mut self) -> f64 {
        let seen = self.seen();
        match self.stage {
            Stage::Observe => 0.0,
            Stage::Probe(probe) => probe.voltage_v(),
            Stage::Calm => self.settler.voltage(&seen, self.calm_rad()),
            Stage::Seek(seek) => {
                let target_rad = seek.target_rad().unwrap_or(seen.theta);
                self.settler.follow(&seen, target_rad, seek.push_v())
            }
            Stage::ComeOff { .. } => self.settler.voltage(&seen, self.place_rad - 1.0),
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

    /// Whether the arm is fast against the voltage, though nothing but the motor moves it.
    fn runs_away(&mut self) -> bool {
        let State { theta_dot, .. } = self.state;
        let seen = self.seen();
        let swings = (seen.alpha.sin().abs() + seen.alpha_dot.abs() / 15.0) > 0.5;
        let against = theta_dot * f64::from(self.voltage_mv) < 0.0;
        let is_led = !matches!(self.stage, Stage::Observe);
        let runs = is_led && against && !swings && theta_dot.abs() > RUNAWAY_RAD_S;
        self.runaway_ticks = if runs { self.runaway_ticks + 1 } else { 0 };
        self.runaway_ticks >= RUNAWAY_TICKS
    }

    /// What encoders and motor say of each other, if something is wrong.
    fn sensed(&mut self, sample: &Measurement) -> Option<Fault> {
        let alarm = self.sensors.check(sample, None);
        let fault = alarm.map(|(Alarm::Zero(fault) | Alarm::Brake(fault))| fault);
        let leads = self.sensors.witness().and_then(|own| own.pendulum_leads()) == Some(true);
        // While the first push lasts, it is left to that to say which of the signs is wrong.
        let is_calm = matches!(self.stage, Stage::Calm | Stage::Seek(_));
        fault
            .or_else(|| self.current.check(sample))
            .or_else(|| (leads && is_calm).then_some(Fault::WrongSignAlpha))
    }
}

impl Motion for Homing {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        self.ticks += 1 + input.skipped_periods;

        // The arm is slow here: a fault that would brake a rollout can switch off at once.
        let watched = self.watch.check(input);
        let watched = watched.map(|(Alarm::Zero(fault) | Alarm::Brake(fault))| fault);
        let fault =
            watched.or_else(|| input.measurement.as_ref().and_then(|sample| self.sensed(sample)));
        if let Some(fault) = fault {
            return self.off(Ending::Fault(fault));
        }
        if input.stop_requested {
            return self.off(Ending::Stopped);
        }
        if self.ticks > MAX_TICKS {
            let is_held = self.stood.ticks >= STOOD_TICKS;
            let fault = if is_held { Fault::ArmHeld } else { Fault::HomingTimedOut };
            return self.off(Ending::Fault(fault));
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
        if self.runs_away() {
            // What the cable throws runs against the voltage of a dead motor too.
            let is_dead = self.current.takes_nothing(measurement, self.voltage_mv);
            let fault = if is_dead { Fault::MotorDead } else { Fault::WrongSignMotor };
            return self.off(Ending::Fault(fault));
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
    fn a_qube_in_which_nothing_answers_is_not_homed() {
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
        assert_eq!(ending, Some(Ending::Fault(Fault::MotorDead)), "no current either");
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
