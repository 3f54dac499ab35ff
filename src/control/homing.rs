use super::cross_check::{CrossCheck, SURELY_WRONG_SCALE, WRONG_SCALE, zero_within_rad};
use super::current_watch::CurrentWatch;
use super::hanging::Hanging;
use super::homing_probe::{HomingProbe, PushResponse, STRONGEST_V};
use super::homing_settings::{HomingMethod, HomingSettings};
use super::homing_watch::{Held, Motionless, Runaway};
use super::leave_stop::LeavingStop;
use super::rest::StillnessDetector;
use super::sensor_watch::SensorWatch;
use super::settling::{GentleSettler, LEAD_RAD_S};
use super::stop_seek::{HardStops, StopSeek};
use super::swing::Swing;
use super::voltage_watch::VoltageWatch;
use super::watch::{Alarm, Watch, most_urgent};
use super::{ControlAction, ControlEvent, ControlState, Motion, TickInput, TickOutput};
use crate::estimation::{Calibration, Estimator, MeasuredRig, MeasuredStops};
use crate::qube::{Measurement, State};
use crate::safety::clamp_to_mv;
use crate::telemetry::{Ending, Fault, TickRules};

/// Most ticks for the whole of homing: 60 s.
const MAX_TICKS: u32 = 6000;

/// Largest width of a still pendulum's swing, counts: 4, and half a count for rounding.
const STILL_COUNTS: f64 = 4.5;

/// Distance from its target within which the arm counts as arrived, rad: friction may stop the arm
/// short of the target.
const NEAR_MIDDLE_RAD: f64 = 0.1;

/// Change of the hanging angle that restarts the cross-check of the encoders, counts.
const OTHER_ZERO_COUNTS: f64 = 1.5;

/// Velocity at which homing leads the arm before its encoder's scale is known to be right, rad/s.
/// An encoder that gives half as many counts makes the arm move at twice this velocity.
const FIRST_LEAD_RAD_S: f64 = 0.8;

/// Largest relative difference between the measured and the expected distance of the stops.
const TRAVEL_TOLERANCE: f64 = 0.03;

/// Measures the arm's middle and the count at which the pendulum hangs. Both have to be measured
/// after each start, because an encoder counts from the angle at which it was switched on.
///
/// Homing trusts no sensor before testing it. The motor stays at 0 V until pendulum and arm move
/// little enough for a push (`hanging.rs` has the limits); then a push that grows from zero shows
/// whether the arm follows. From then on the two encoders check each other, and the arm moves so
/// slowly that it does no damage if one of them fails.
#[derive(Debug)]
pub struct Homing {
    settings: HomingSettings,
    estimator: Option<Estimator>,
    /// Signs of the settings, with the zeros at the first sample; `state` is relative to them.
    provisional: Calibration,
    watch: Watch,
    voltage: VoltageWatch,
    sensors: SensorWatch,
    current: CurrentWatch,
    control: ControlState,
    stillness: StillnessDetector,
    stage: Stage,
    /// Angle of the arm at the first push, rad; after some faults the arm is led back there.
    first_push_rad: f64,
    /// Middle of the arm's travel by the stops or by the operator's hand, rad, once known.
    middle_rad: Option<f64>,
    /// The stops, once both have been touched.
    stops: Option<HardStops>,
    /// Best estimate of the angle at which the pendulum hangs, rad.
    hanging_rad: f64,
    /// Wrong sign that a first push has shown; it is reported once a second push confirms it.
    suspected: Option<Fault>,
    ticks: u32,
    swing: Swing,
    settler: GentleSettler,
    held: Held,
    motionless: Motionless,
    runaway: Runaway,
    state: State,
    voltage_mv: i16,
    measured: Option<MeasuredRig>,
}

#[derive(Clone, Copy, Debug)]
enum Stage {
    /// Wait at 0 V until pendulum and arm move little; the pendulum hangs in the middle of its
    /// swing.
    Observe(Hanging),
    /// Push until the arm responds.
    Probe(HomingProbe),
    /// Calm the pendulum, with the arm at the middle that the stops or the operator's hand gave.
    Calm,
    /// Seek the stops, which define the middle.
    Seek(StopSeek),
    /// Lead the arm back, after a fault, to where homing first pushed it, if the arm can move.
    LeaveStop(LeavingStop),
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
            voltage: VoltageWatch::default(),
            // A contact with a stop may leave a tachometer at its last velocity for 0.21 s.
            sensors: SensorWatch::of(&settings.plant).without_drift_test(),
            current: CurrentWatch::of(&settings.plant),
            control: ControlState::Identified.on(ControlEvent::Home).0,
            stillness: StillnessDetector::default(),
            stage: Stage::Observe(Hanging::of(&settings.plant)),
            first_push_rad: 0.0,
            middle_rad,
            stops: None,
            hanging_rad: 0.0,
            suspected: None,
            ticks: 0,
            swing: Swing::default(),
            settler: GentleSettler::of(&settings.plant, TickRules::NEWEST),
            held: Held::default(),
            motionless: Motionless::default(),
            runaway: Runaway::default(),
            state: State::default(),
            voltage_mv: 0,
            measured: None,
        }
    }

    /// A homing after a latched fault: it first waits until the arm has been at rest for 1 s.
    #[must_use]
    pub fn after_fault(settings: &HomingSettings) -> Self {
        Self { control: ControlState::Cleared.on(ControlEvent::Home).0, ..Self::new(settings) }
    }

    /// Everything that homing has measured, once it has completed.
    #[must_use]
    pub fn measured(&self) -> Option<MeasuredRig> {
        self.measured
    }

    /// Distance between the stops, rad, once both have been touched.
    #[must_use]
    pub fn travel_rad(&self) -> Option<f64> {
        self.stops.map(|stops| stops.travel_rad())
    }

    /// Count of the arm in the first sample; `None` before it.
    #[must_use]
    pub fn first_theta_counts(&self) -> Option<i32> {
        self.estimator.as_ref().map(|_| self.provisional.theta_zero_counts)
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

    /// The state, with alpha relative to hanging.
    fn state_from_hanging(&self) -> State {
        State { alpha: self.state.alpha - self.hanging_rad, ..self.state }
    }

    /// Sets the angle at which the pendulum hangs, rad, known to within `within_rad`. Starts the
    /// cross-check of the encoders, and restarts it if the angle has changed by more than
    /// `OTHER_ZERO_COUNTS`.
    fn set_hanging_angle(&mut self, hanging_rad: f64, within_rad: f64) {
        let rad_per_count = self.settings.plant.encoders.alpha.rad_per_count();
        let off_rad = (hanging_rad - self.hanging_rad).abs();
        let is_other = off_rad > OTHER_ZERO_COUNTS * rad_per_count;
        self.hanging_rad = hanging_rad;
        if is_other || self.sensors.cross_check().is_none() {
            let calibration = Calibration {
                alpha_zero_counts: self.provisional.alpha_counts_at(hanging_rad),
                ..self.provisional
            };
            self.sensors.start_cross_check(calibration, within_rad);
        }
    }

    /// Updates the current stage and enters the next stage at its end; returns the ending once
    /// homing is over.
    fn advance(&mut self, measurement: &Measurement) -> Option<Ending> {
        let seen = self.state_from_hanging();
        let encoders = self.settings.plant.encoders;
        let scale_is_right = self.sensors.cross_check().is_some_and(CrossCheck::scale_is_right);
        match &mut self.stage {
            Stage::Observe(hanging) => {
                if let Some(hanging_angle) = hanging.update(self.state.theta, self.state.alpha) {
                    self.set_hanging_angle(hanging_angle.hanging_rad, hanging_angle.within_rad);
                    if self.control.take(ControlEvent::AtRest) == ControlAction::Seek {
                        self.first_push_rad = self.state.theta;
                        self.stage = Stage::Probe(HomingProbe::new(
                            &self.settings.plant,
                            hanging_angle.swing_rad,
                        ));
                    }
                }
            }
            Stage::Probe(probe) => {
                let response = probe.update(&seen);
                return self.apply_response(response).map(Ending::Fault);
            }
            Stage::Calm => {
                // Target: the middle, or where the operator put the arm by hand.
                let off_rad = self.state.theta - self.calm_rad();
                let voltage_v = f64::from(self.voltage_mv) * 1e-3;
                let is_off = off_rad.abs() >= NEAR_MIDDLE_RAD;
                self.motionless.update(measurement.theta_counts);
                if self.held.lasts(measurement.theta_counts, voltage_v, is_off) {
                    return Some(Ending::Fault(Fault::ArmHeld));
                }
                if let Some(window) = self.swing.update(self.state.alpha)
                    && window.width_rad <= STILL_COUNTS * encoders.alpha.rad_per_count()
                {
                    // A still pendulum hangs. A wrong hanging angle would hold the arm off its
                    // target permanently.
                    self.set_hanging_angle(
                        window.middle_rad,
                        zero_within_rad(&self.settings.plant),
                    );
                    if !is_off {
                        self.measured = Some(self.zeros(measurement, off_rad));
                        return Some(Ending::Completed);
                    }
                }
            }
            Stage::Seek(seek) => {
                let lead_rad_s = if scale_is_right { LEAD_RAD_S } else { FIRST_LEAD_RAD_S };
                if let Some(stops) = seek.update(self.state.theta, lead_rad_s) {
                    self.stops = Some(stops);
                    self.swing = Swing::default();
                    let travel = stops.travel_rad() / self.settings.expected_travel_rad();
                    if (travel - 1.0).abs() > TRAVEL_TOLERANCE {
                        self.leave_stop(Fault::TravelWrong);
                    } else {
                        self.middle_rad = Some(stops.middle_rad());
                        self.stage = Stage::Calm;
                    }
                }
            }
            Stage::LeaveStop(leaving_stop) => {
                return leaving_stop.update(&seen).map(Ending::Fault);
            }
        }
        None
    }

    fn leave_stop(&mut self, fault: Fault) {
        self.stage =
            Stage::LeaveStop(LeavingStop::after(fault, self.state.theta, self.first_push_rad));
    }

    /// Acts on the response to a push: enters the next stage, waits, or requests a second push.
    /// Returns the fault that the response proves, if any.
    fn apply_response(&mut self, response: PushResponse) -> Option<Fault> {
        let cross_check = self.sensors.cross_check();
        let leads = cross_check.is_some_and(|check| check.lead_is_evident());
        let rather_leads = cross_check.is_some_and(|check| check.lead_is_likelier());
        let wrong_sign = match response {
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
                self.settler = GentleSettler::of(&self.settings.plant, TickRules::NEWEST);
                self.stage = match self.middle_rad {
                    Some(_) => Stage::Calm,
                    None => Stage::Seek(StopSeek::default()),
                };
                None
            }
            // A single touch of the arm makes a sign look wrong, and an operator who is told that a
            // correct sign is wrong would change it. So a second push must confirm the result.
            (None, Some(sign)) => {
                self.suspected = Some(sign);
                self.sensors.forget_signs();
                if let Stage::Probe(probe) = &mut self.stage {
                    probe.push_again();
                }
                None
            }
            (Some(first), Some(second)) if first == second => Some(first),
            (Some(_), _) => Some(Fault::ArmPushed),
        }
    }

    /// Counts at the arm's zero and at the hanging pendulum, and the stops, touched or implied,
    /// relative to the arm's zero.
    fn zeros(&self, measurement: &Measurement, off_middle_rad: f64) -> MeasuredRig {
        let offset_rad = self.settings.theta_offset_rad;
        let off_zero_rad = off_middle_rad - offset_rad;
        let off_hanging_rad = self.state.alpha - self.hanging_rad;
        let signs = &self.settings.signs;
        let calibration = signs.with_zeros_behind(measurement, off_zero_rad, off_hanging_rad);
        let zero_rad = self.calm_rad() + offset_rad;
        let stops = self.stops.or_else(|| self.stops_by_hand()).map(|stops| MeasuredStops {
            lowest_theta_rad: stops.lowest_rad - zero_rad,
            highest_theta_rad: stops.highest_rad - zero_rad,
        });
        MeasuredRig { calibration, stops }
    }

    /// The stops after homing by hand: the operator's middle and the expected travel imply them.
    /// `None` where they are the plant's own around the zero, which guard and brake assume without
    /// measured stops.
    fn stops_by_hand(&self) -> Option<HardStops> {
        let HomingSettings { method, theta_offset_rad, travel_rad, .. } = self.settings;
        let are_the_plants = theta_offset_rad == 0.0 && travel_rad.is_none();
        let (middle_rad, half_rad) = (self.calm_rad(), 0.5 * self.settings.expected_travel_rad());
        (method == HomingMethod::Hand && !are_the_plants).then_some(HardStops {
            lowest_rad: middle_rad - half_rad,
            highest_rad: middle_rad + half_rad,
        })
    }

    /// Target of the arm while the pendulum comes to rest, rad: the middle, or the angle at the
    /// first push if no middle is known.
    fn calm_rad(&self) -> f64 {
        self.middle_rad.unwrap_or(self.first_push_rad)
    }

    fn wanted_voltage(&mut self) -> f64 {
        let seen = self.state_from_hanging();
        match self.stage {
            Stage::Observe(_) => 0.0,
            Stage::Probe(probe) => probe.voltage_v(),
            Stage::Calm => self.settler.voltage(&seen, self.calm_rad()),
            Stage::Seek(seek) => {
                let target_rad = seek.target_rad().unwrap_or(seen.theta);
                self.settler.follow(&seen, target_rad, seek.push_v())
            }
            Stage::LeaveStop(leaving_stop) => {
                self.settler.voltage(&seen, leaving_stop.target_rad())
            }
        }
    }

    /// Switches the amplifier off. A fault that was found before the arm was led off a stop stays
    /// the ending, unless another fault that leaves a doubt follows.
    fn off(&mut self, ending: Ending) -> TickOutput {
        let ending = match (self.stage, ending) {
            (Stage::LeaveStop(_), Ending::Fault(fault)) if fault.leaves_doubt() => ending,
            (Stage::LeaveStop(leaving_stop), _) => Ending::Fault(leaving_stop.fault()),
            _ => ending,
        };
        self.control.take(match ending {
            Ending::Fault(_) => ControlEvent::SwitchOffFault,
            Ending::Stopped => ControlEvent::Stop,
            Ending::Completed | Ending::LeftBox(_) => ControlEvent::Homed,
        });
        self.voltage_mv = 0;
        TickOutput::outside_rollout(self.state, 0, None, Some(ending))
    }

    /// The fault that encoders and motor show together, if any.
    fn sensor_fault(&mut self, sample: &Measurement) -> Option<Fault> {
        let alarm = self.sensors.check(sample, None);
        if let Some(Alarm::SwitchOff(fault) | Alarm::Brake(fault)) = alarm {
            return Some(fault);
        }
        // During the first pushes the probe decides which sign is wrong.
        let is_led = matches!(self.stage, Stage::Calm | Stage::Seek(_));
        match self.current.check(sample) {
            // A stiff cable would throw an arm that is released at one stop across to the other
            // stop.
            Some(Fault::MotorWeak) if is_led => self.leave_stop(Fault::MotorWeak),
            Some(Fault::MotorWeak) if matches!(self.stage, Stage::LeaveStop(_)) => {}
            Some(fault) => return Some(fault),
            None => {}
        }
        let cross_check = self.sensors.cross_check();
        let leads = cross_check.and_then(|check| check.pendulum_leads()) == Some(true);
        // An operator who accepted another distance of the stops may have accepted one that a
        // wrong encoder measured.
        let stops_show_it =
            self.settings.method == HomingMethod::Stops && self.settings.travel_rad.is_none();
        let wrong_scale = if stops_show_it { SURELY_WRONG_SCALE } else { WRONG_SCALE };
        let miscounts = cross_check.is_some_and(|check| check.scale_is_wrong(wrong_scale));
        ((leads || miscounts) && is_led).then_some(Fault::EncodersDisagree)
    }
}

impl Motion for Homing {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        self.ticks += 1 + input.skipped_periods;

        // The arm is slow here, so the amplifier can go off at once, even after a fault that would
        // brake a rollout.
        let differs = self.voltage.watch(self.device_mv(self.voltage_mv), input);
        let sensors = input.measurement.as_ref().and_then(|sample| self.sensor_fault(sample));
        let alarms = [self.watch.check(input), differs, sensors.map(Alarm::SwitchOff)];
        if let Some(Alarm::SwitchOff(fault) | Alarm::Brake(fault)) = most_urgent(alarms) {
            return self.off(Ending::Fault(fault));
        }
        if input.stop_requested {
            return self.off(Ending::Stopped);
        }
        if self.ticks > MAX_TICKS {
            let is_held = self.motionless.is_held();
            let fault = if is_held { Fault::ArmHeld } else { Fault::HomingTimedOut };
            return self.off(Ending::Fault(fault));
        }
        let Some(measurement) = &input.measurement else {
            return TickOutput::outside_rollout(self.state, self.voltage_mv, None, None);
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
        if is_led
            && self.runaway.lasts(&self.state_from_hanging(), f64::from(self.voltage_mv) * 1e-3)
        {
            // A stiff cable moves an arm against the voltage even if the motor is dead, so the
            // current decides which of the two faults it is.
            let is_dead = self.current.draws_no_current_at_speed(measurement, self.voltage_mv);
            let fault = if is_dead { Fault::MotorDead } else { Fault::ArmPushed };
            return self.off(Ending::Fault(fault));
        }
        let wanted_v = self.wanted_voltage();
        let largest_v = self.settings.plant.limits.largest_voltage_v;
        self.voltage_mv = clamp_to_mv(wanted_v, largest_v).unwrap_or(0);
        TickOutput::outside_rollout(self.state, self.voltage_mv, Some(wanted_v), None)
    }

    fn control_state(&self) -> ControlState {
        self.control
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.settings.signs.device_mv(voltage_mv)
    }
}
