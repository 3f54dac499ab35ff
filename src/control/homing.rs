use super::current_watch::CurrentWatch;
use super::hanging::Hanging;
use super::homing_probe::{HomingProbe, PushResponse, STRONGEST_V};
use super::homing_settings::{HomingMethod, HomingSettings};
use super::led_arm::{ComingOff, Held, Runaway, Stood};
use super::rest::{StillnessDetector, Swing};
use super::sensor_watch::SensorWatch;
use super::settling::{GentleSettler, LEAD_RAD_S};
use super::stop_seek::{Found, StopSeek};
use super::watch::{Alarm, Watch};
use super::witness::{Witness, ZERO_WITHIN_RAD};
use super::{ControlAction, ControlEvent, ControlState, Motion, TickInput, TickOutput};
use crate::estimation::{Calibration, Estimator, MeasuredRig, MeasuredStops};
use crate::qube::{Measurement, RAD_PER_COUNT, State};
use crate::safety::clamp_to_mv;
use crate::telemetry::{Ending, Fault};

/// Most ticks for the whole of homing: 60 s.
const MAX_TICKS: u32 = 6000;

/// A pendulum that moves over no more than four counts hangs still, rad.
const STILL_RAD: f64 = 4.5 * RAD_PER_COUNT;

/// An arm within this of where it should be is there, rad: friction may hold it a little off.
const NEAR_MIDDLE_RAD: f64 = 0.1;

/// The witness is called anew where the hanging count turns out to be another one by so much, rad.
const OTHER_ZERO_RAD: f64 = 1.5 * RAD_PER_COUNT;

/// How fast the arm is led before it is known how far it goes for each of its encoder's counts, rad/s:
/// twice as far, if the encoder counts half.
const FIRST_LEAD_RAD_S: f64 = 0.8;

/// How far the travel between the stops may differ from what it should be, as a fraction.
const TRAVEL_TOLERANCE: f64 = 0.03;

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
    /// The sign that a first push has shown to be wrong: none is named before a second one has.
    suspected: Option<Fault>,
    ticks: u32,
    swing: Swing,
    settler: GentleSettler,
    held: Held,
    stood: Stood,
    runaway: Runaway,
    state: State,
    voltage_mv: i16,
    found: Option<MeasuredRig>,
}

#[derive(Clone, Copy, Debug)]
enum Stage {
    /// Wait at 0 V until the pendulum hardly swings: the middle of that is where it hangs.
    Observe(Hanging),
    /// Push until the arm follows.
    Probe(HomingProbe),
    /// Calm the pendulum about that point, with the arm in the middle as far as it is known.
    Calm,
    /// Look for the stops, which tell the middle.
    Seek(StopSeek),
    /// Something is wrong: lead the arm back to where it was pushed first, if something lets it go.
    ComeOff(ComingOff),
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
            stage: Stage::Observe(Hanging::default()),
            place_rad: 0.0,
            middle_rad,
            stops_rad: None,
            hanging_rad: 0.0,
            suspected: None,
            ticks: 0,
            swing: Swing::default(),
            settler: GentleSettler::default(),
            held: Held::default(),
            stood: Stood::default(),
            runaway: Runaway::default(),
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
        let scale_is_known = self.sensors.witness().is_some_and(Witness::scale_is_known);
        match &mut self.stage {
            Stage::Observe(hanging) => {
                if let Some(hung) = hanging.update(self.state.theta, self.state.alpha) {
                    self.hangs_at(hung.middle_rad, hung.within_rad);
                    if self.control.take(ControlEvent::AtRest) == ControlAction::Seek {
                        self.place_rad = self.state.theta;
                        self.stage = Stage::Probe(HomingProbe::new(hung.swing_rad));
                    }
                }
            }
            Stage::Probe(probe) => {
                let answer = probe.update(&seen);
                return self.answered(answer).map(Ending::Fault);
            }
            Stage::Calm => {
                // The middle, or the place where it was put by hand.
                let off_rad = self.state.theta - self.calm_rad();
                let voltage_v = f64::from(self.voltage_mv) * 1e-3;
                let is_off = off_rad.abs() >= NEAR_MIDDLE_RAD;
                self.stood.update(measurement.theta_counts);
                if self.held.lasts(measurement.theta_counts, voltage_v, is_off) {
                    return Some(Ending::Fault(Fault::ArmHeld));
                }
                if let Some(window) = self.swing.update(self.state.alpha)
                    && window.width_rad <= STILL_RAD
                {
                    // Where it is still it hangs. While it is believed to hang elsewhere, that
                    // error holds the arm off its place for good.
                    self.hangs_at(window.middle_rad, ZERO_WITHIN_RAD);
                    if !is_off {
                        self.found = Some(self.zeros(measurement, off_rad));
                        return Some(Ending::Completed);
                    }
                }
            }
            Stage::Seek(seek) => {
                let lead_rad_s = if scale_is_known { LEAD_RAD_S } else { FIRST_LEAD_RAD_S };
                if let Some(Found { lowest_rad, highest_rad }) =
                    seek.update(self.state.theta, lead_rad_s)
                {
                    self.stops_rad = Some((lowest_rad, highest_rad));
                    self.swing = Swing::default();
                    let travel = (highest_rad - lowest_rad) / self.settings.expected_travel_rad();
                    if (travel - 1.0).abs() > TRAVEL_TOLERANCE {
                        self.come_off(Fault::TravelWrong);
                    } else {
                        self.middle_rad = Some(0.5 * (lowest_rad + highest_rad));
                        self.stage = Stage::Calm;
                    }
                }
            }
            Stage::ComeOff(coming_off) => {
                return coming_off.update(&seen).map(Ending::Fault);
            }
        }
        None
    }

    fn come_off(&mut self, fault: Fault) {
        self.stage = Stage::ComeOff(ComingOff::after(fault, self.state.theta, self.place_rad));
    }

    /// Goes on where the arm follows a push; gives what is wrong where it does not.
    fn answered(&mut self, answer: PushResponse) -> Option<Fault> {
        let witness = self.sensors.witness();
        let leads = witness.is_some_and(|own| own.pendulum_seems_to_lead());
        let rather_leads = witness.is_some_and(|own| own.pendulum_rather_leads());
        let wrong_sign = match answer {
            PushResponse::Waits => return None,
            PushResponse::Moves => return Some(Fault::ArmPushed),
            PushResponse::Stays => {
                let is_dead = self.current.is_dead(STRONGEST_V);
                return Some(if is_dead { Fault::MotorDead } else { Fault::ArmHeld });
            }
            PushResponse::Follows if leads => Some(Fault::WrongSignAlpha),
            PushResponse::Follows => None,
            PushResponse::Opposes if rather_leads => Some(Fault::WrongSignTheta),
            PushResponse::Opposes => Some(Fault::WrongSignMotor),
        };
        match (self.suspected, wrong_sign) {
            (None, None) => {
                self.current.motor_works();
                self.swing = Swing::default();
                self.settler = GentleSettler::default();
                self.stage = match self.middle_rad {
                    Some(_) => Stage::Calm,
                    None => Stage::Seek(StopSeek::default()),
                };
                None
            }
            // Whoever pushes the arm once makes a sign look wrong, and whoever is told so changes it.
            (None, Some(sign)) => {
                self.suspected = Some(sign);
                self.sensors.forget_signs();
                if let Stage::Probe(probe) = &mut self.stage {
                    probe.ask_again();
                }
                None
            }
            (Some(first), Some(second)) if first == second => Some(first),
            (Some(_), _) => Some(Fault::ArmPushed),
        }
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
            Stage::Observe(_) => 0.0,
            Stage::Probe(probe) => probe.voltage_v(),
            Stage::Calm => self.settler.voltage(&seen, self.calm_rad()),
            Stage::Seek(seek) => {
                let target_rad = seek.target_rad().unwrap_or(seen.theta);
                self.settler.follow(&seen, target_rad, seek.push_v())
            }
            Stage::ComeOff(coming_off) => self.settler.voltage(&seen, coming_off.place_rad()),
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

    /// What encoders and motor say of each other, if something is wrong.
    fn sensed(&mut self, sample: &Measurement) -> Option<Fault> {
        let alarm = self.sensors.check(sample, None);
        if let Some(Alarm::Zero(fault) | Alarm::Brake(fault)) = alarm {
            return Some(fault);
        }
        // While the first push lasts, it is left to that to say which of the signs is wrong.
        let is_led = matches!(self.stage, Stage::Calm | Stage::Seek(_));
        match self.current.check(sample) {
            // At a stop, a stiff cable throws the arm across as soon as nobody holds it.
            Some(Fault::MotorWeak) if is_led => self.come_off(Fault::MotorWeak),
            Some(Fault::MotorWeak) if matches!(self.stage, Stage::ComeOff(_)) => {}
            Some(fault) => return Some(fault),
            None => {}
        }
        let witness = self.sensors.witness();
        let leads = witness.and_then(|own| own.pendulum_leads()) == Some(true);
        let miscounts = witness.is_some_and(|own| own.scale_is_wrong());
        ((leads || miscounts) && is_led).then_some(Fault::EncodersDisagree)
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
            let is_held = self.stood.is_held();
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
        let is_led = !matches!(self.stage, Stage::Observe(_) | Stage::Probe(_));
        if is_led && self.runaway.lasts(&self.seen(), f64::from(self.voltage_mv)) {
            // What the cable throws runs against the voltage of a dead motor too.
            let is_dead = self.current.takes_nothing_at_speed(measurement, self.voltage_mv);
            let fault = if is_dead { Fault::MotorDead } else { Fault::ArmPushed };
            return self.off(Ending::Fault(fault));
        }
        let wanted_v = self.wanted_voltage();
        self.voltage_mv = clamp_to_mv(wanted_v).unwrap_or(0);
        self.output(Some(wanted_v), None)
    }

    fn control_state(&self) -> ControlState {
        self.control
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.settings.signs.device_mv(voltage_mv)
    }
}
