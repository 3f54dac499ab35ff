use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::not_finite::{NotFinite, restore, restore_bits};
use crate::qube::{Measurement, State, Status};
use crate::telemetry::{Ending, Phase, RolloutHeader, TickRecord};

// Viewers accept few schemas: Foxglove refuses unions (which schemars writes for an Option or an
// enum with documented variants) and references. Every field therefore has one plain type, and an
// absent value is left out. The doc comments below are part of the schemas, hence of every
// recording's bytes.

/// One sample of the device: raw counts, and what they mean by the rollout's calibration.
#[derive(Serialize, Deserialize, JsonSchema)]
#[schemars(title = "qube.Measurement")]
pub(super) struct MeasurementMessage {
    /// When the encoders were read, by the device's clock since its start, us.
    device_time_us: u64,
    /// Encoder of the arm.
    theta_counts: i32,
    /// Encoder of the pendulum.
    alpha_counts: i32,
    /// Angle of the arm, rad.
    theta_rad: f64,
    /// Angle of the pendulum, rad; 0 hanging, +-pi upright.
    alpha_rad: f64,
    /// The arm's velocity by the device's tachometer, counts/s.
    tachometer_counts_s: i32,
    /// Motor current, A.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "f32")]
    current_a: Option<f32>,
    /// The voltage at the motor when the sample was taken, mV, by the device's sign.
    applied_mv: i16,
    /// Time from the previous sample to the act that followed it, by the device's clock, us.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "u32")]
    sample_to_act_us: Option<u32>,
    /// The amplifier may drive the motor.
    armed: bool,
    /// The device's watchdog switched the amplifier off.
    watchdog_tripped: bool,
    /// The amplifier reports a fault.
    amplifier_fault: bool,
    /// A stall was detected.
    stall_detected: bool,
    /// The stall lasted and the Qube switched its motor off.
    stall_error: bool,
    /// The emergency-stop switch is open, or was since the last hello.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    emergency_stop: bool,
    /// The board knows of an emergency-stop switch.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    stop_switch_fitted: bool,
    /// Bits of the numbers that are not finite, by name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    not_finite: Option<String>,
}

/// The estimated state that the controller saw.
#[derive(Serialize, Deserialize, JsonSchema)]
#[schemars(title = "qube.State")]
pub(super) struct StateMessage {
    /// Angle of the arm, rad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "f64")]
    theta_rad: Option<f64>,
    /// Angle of the pendulum, rad; 0 hanging, +-pi upright.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "f64")]
    alpha_rad: Option<f64>,
    /// Velocity of the arm, rad/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "f64")]
    theta_dot_rad_s: Option<f64>,
    /// Velocity of the pendulum, rad/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "f64")]
    alpha_dot_rad_s: Option<f64>,
    /// Bits of the numbers that are not finite, by name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    not_finite: Option<String>,
}

/// Voltage that the controller requested, and the voltage that was sent.
#[derive(Serialize, Deserialize, JsonSchema)]
#[schemars(title = "qube.Command")]
pub(super) struct CommandMessage {
    /// Voltage that the controller requested, V, before any limit; absent while the last one was held over.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "f64")]
    wanted_v: Option<f64>,
    /// Voltage that was sent, V.
    voltage_v: f64,
    /// Voltage that was sent, mV, exactly.
    voltage_mv: i16,
    /// Bits of the numbers that are not finite, by name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    not_finite: Option<String>,
}

/// Phase of the tick; the last message also has the ending.
#[derive(Serialize, Deserialize, JsonSchema)]
#[schemars(title = "qube.Safety")]
pub(super) struct SafetyMessage {
    /// settling, running or braking.
    #[schemars(with = "String")]
    phase: Phase,
    /// The phase for viewers that plot numbers alone: 0 settling, 1 running, 2 braking.
    #[serde(default)]
    phase_number: u8,
    /// No valid sample came in time and the last voltage was held over.
    held_over: bool,
    /// Somebody had asked to stop.
    stop_requested: bool,
    /// How the rollout ended, in its last message only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "String")]
    ending: Option<String>,
    /// The ending as a number: 1 completed, 2 left the box, 3 stopped, 4 fault.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(with = "u8")]
    ending_number: Option<u8>,
}

/// When things happened, by the host's clock.
#[derive(Serialize, Deserialize, JsonSchema)]
#[schemars(title = "qube.Timing")]
pub(super) struct TimingMessage {
    /// When the tick was due, ns.
    deadline_ns: u64,
    /// How long after that it woke, ns.
    lateness_ns: u64,
    /// Whole periods skipped before this tick.
    skipped_periods: u32,
    /// From sending the sample request to handing over the act, ns.
    turnaround_ns: u64,
}

impl MeasurementMessage {
    pub(super) fn new(measurement: &Measurement, header: &RolloutHeader) -> Self {
        let (theta_rad, alpha_rad) = header.settings.calibration.angles_rad(measurement);
        let mut not_finite = NotFinite::default();
        let current_a = measurement.current_a;
        Self {
            device_time_us: measurement.device_time_us,
            theta_counts: measurement.theta_counts,
            alpha_counts: measurement.alpha_counts,
            theta_rad,
            alpha_rad,
            tachometer_counts_s: measurement.tachometer_counts_s,
            current_a: if current_a.is_finite() {
                Some(current_a)
            } else {
                // The 32 bits of the f32: a cast of NaN to f64 may lose them.
                not_finite.keep_bits("current_a", u64::from(current_a.to_bits()));
                None
            },
            applied_mv: measurement.applied_mv,
            sample_to_act_us: measurement.sample_to_act_us,
            armed: measurement.status.armed,
            watchdog_tripped: measurement.status.watchdog_tripped,
            amplifier_fault: measurement.status.amplifier_fault,
            stall_detected: measurement.status.stall_detected,
            stall_error: measurement.status.stall_error,
            emergency_stop: measurement.status.emergency_stop,
            stop_switch_fitted: measurement.status.stop_switch_fitted,
            not_finite: not_finite.into_text(),
        }
    }

    pub(super) fn measurement(&self) -> Option<Measurement> {
        let kept_bits = || restore_bits("current_a", self.not_finite.as_deref());
        Some(Measurement {
            device_time_us: self.device_time_us,
            theta_counts: self.theta_counts,
            alpha_counts: self.alpha_counts,
            tachometer_counts_s: self.tachometer_counts_s,
            current_a: match self.current_a {
                Some(current_a) => current_a,
                None => f32::from_bits(u32::try_from(kept_bits()?).ok()?),
            },
            status: Status {
                armed: self.armed,
                watchdog_tripped: self.watchdog_tripped,
                amplifier_fault: self.amplifier_fault,
                stall_detected: self.stall_detected,
                stall_error: self.stall_error,
                emergency_stop: self.emergency_stop,
                stop_switch_fitted: self.stop_switch_fitted,
            },
            applied_mv: self.applied_mv,
            sample_to_act_us: self.sample_to_act_us,
        })
    }
}

impl StateMessage {
    pub(super) fn new(state: &State) -> Self {
        let mut not_finite = NotFinite::default();
        Self {
            theta_rad: not_finite.keep("theta_rad", state.theta),
            alpha_rad: not_finite.keep("alpha_rad", state.alpha),
            theta_dot_rad_s: not_finite.keep("theta_dot_rad_s", state.theta_dot),
            alpha_dot_rad_s: not_finite.keep("alpha_dot_rad_s", state.alpha_dot),
            not_finite: not_finite.into_text(),
        }
    }

    pub(super) fn state(&self) -> Option<State> {
        let not_finite = self.not_finite.as_deref();
        Some(State {
            theta: restore("theta_rad", self.theta_rad, not_finite)?,
            alpha: restore("alpha_rad", self.alpha_rad, not_finite)?,
            theta_dot: restore("theta_dot_rad_s", self.theta_dot_rad_s, not_finite)?,
            alpha_dot: restore("alpha_dot_rad_s", self.alpha_dot_rad_s, not_finite)?,
        })
    }
}

impl CommandMessage {
    pub(super) fn new(record: &TickRecord) -> Self {
        let mut not_finite = NotFinite::default();
        Self {
            wanted_v: record.wanted_v.and_then(|wanted_v| not_finite.keep("wanted_v", wanted_v)),
            voltage_v: record.voltage_v(),
            voltage_mv: record.voltage_mv,
            not_finite: not_finite.into_text(),
        }
    }
}

impl SafetyMessage {
    pub(super) fn new(record: &TickRecord) -> Self {
        Self {
            phase: record.phase,
            phase_number: record.phase.number(),
            held_over: record.measurement.is_none(),
            stop_requested: record.stop_requested,
            ending: None,
            ending_number: None,
        }
    }

    /// The last message of a rollout, of which `last` is the last tick.
    pub(super) fn of_ending(last: &TickRecord, ending: Ending) -> Self {
        let number = match ending {
            Ending::Completed => 1,
            Ending::LeftBox(_) => 2,
            Ending::Stopped => 3,
            Ending::Fault(_) => 4,
        };
        Self { ending: Some(ending_text(ending)), ending_number: Some(number), ..Self::new(last) }
    }
}

fn ending_text(ending: Ending) -> String {
    match serde_json::to_value(ending) {
        Ok(value) => {
            let part = |name| value.get(name).and_then(|part| part.as_str());
            match (part("kind"), part("detail")) {
                (Some(kind), Some(detail)) => format!("{kind}: {detail}"),
                (Some(kind), None) => kind.to_owned(),
                _ => value.to_string(),
            }
        }
        Err(_) => format!("{ending:?}"),
    }
}

impl TimingMessage {
    pub(super) fn new(record: &TickRecord) -> Self {
        Self {
            deadline_ns: record.deadline_ns,
            lateness_ns: record.lateness_ns,
            skipped_periods: record.skipped_periods,
            turnaround_ns: record.turnaround_ns,
        }
    }
}

/// The messages of one tick as they are read.
#[derive(Default)]
pub(super) struct TickMessages {
    pub(super) measurement: Option<MeasurementMessage>,
    pub(super) state: Option<StateMessage>,
    pub(super) command: Option<CommandMessage>,
    pub(super) safety: Option<SafetyMessage>,
}

impl TickMessages {
    /// The record of the tick, once its last message has arrived; `None` if a message or number is
    /// missing, or if `held_over` contradicts the measurement.
    pub(super) fn into_record(self, tick: u32, timing: &TimingMessage) -> Option<TickRecord> {
        let (state, command, safety) = (self.state?, self.command?, self.safety?);
        let measurement = match &self.measurement {
            Some(message) => Some(message.measurement()?),
            None => None,
        };
        if safety.held_over != measurement.is_none() {
            return None;
        }
        Some(TickRecord {
            tick,
            phase: safety.phase,
            deadline_ns: timing.deadline_ns,
            lateness_ns: timing.lateness_ns,
            skipped_periods: timing.skipped_periods,
            stop_requested: safety.stop_requested,
            measurement,
            state: state.state()?,
            wanted_v: restore("wanted_v", command.wanted_v, command.not_finite.as_deref()),
            voltage_mv: command.voltage_mv,
            turnaround_ns: timing.turnaround_ns,
        })
    }
}
