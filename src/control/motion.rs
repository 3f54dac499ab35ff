use super::{ControlState, DeviceLoss};
use crate::qube::{Measurement, State};
use crate::safety::{Contradiction, Foreseen};
use crate::telemetry::{Ending, Phase};

/// Input of one tick. A recording determines every field, so that replay can decide the tick again:
/// `device_loss` follows from the rollout's ending, and `motor_overheated` from the motor's heat at
/// the start and the recorded ticks. The other fields are recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TickInput {
    /// Deadline of the tick by the host's clock, ns.
    pub deadline_ns: u64,
    /// Time from the deadline until the thread woke, ns.
    pub lateness_ns: u64,
    /// Number of whole periods skipped before this tick.
    pub skipped_periods: u32,
    /// True if a stop is requested.
    pub stop_requested: bool,
    /// The sample; `None` if no valid one came in time.
    pub measurement: Option<Measurement>,
    /// Reason why this and all later samples are missing; `None` while samples may come.
    pub device_loss: Option<DeviceLoss>,
    /// True if the motor must cool down, by the heat computed from the samples and voltages before
    /// this tick.
    pub motor_overheated: bool,
}

/// Decision of one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickOutput {
    /// Phase of the rollout.
    pub phase: Phase,
    /// The estimated state that a policy sees.
    pub state: State,
    /// Velocity of the arm in the state that the guard sees, rad/s. The motor's heat is computed
    /// from it, because no wrong model of an observer falsifies this velocity.
    pub heating_theta_dot_rad_s: f64,
    /// Voltage that the controller requested, V; `None` while the last voltage is held or the
    /// amplifier is off.
    pub wanted_v: Option<f64>,
    /// Voltage to send, mV, in the convention's sign.
    pub voltage_mv: i16,
    /// Ending of the motion, if it ends in this tick; the drive then sends no further voltage and
    /// switches the amplifier off.
    pub ending: Option<Ending>,
}

impl TickOutput {
    /// The output of a motion other than a rollout, which has no phases: it always counts as
    /// settling, and one state serves all purposes. `voltage_mv` is the voltage to send, mV,
    /// `wanted_v` the requested one, V, if the tick requested one, and `ending` the motion's ending
    /// if it ends.
    pub fn outside_rollout(
        state: State,
        voltage_mv: i16,
        wanted_v: Option<f64>,
        ending: Option<Ending>,
    ) -> Self {
        Self {
            phase: Phase::Settling,
            state,
            heating_theta_dot_rad_s: state.theta_dot,
            wanted_v,
            voltage_mv,
            ending,
        }
    }
}

/// A motion of the arm, decided tick by tick: a rollout, a homing or a test. Deterministic: the
/// same inputs give the same outputs, bit for bit.
pub trait Motion: Send {
    /// Decides one tick without allocating, locking, logging or waiting.
    fn decide(&mut self, input: &TickInput) -> TickOutput;

    /// State of the control thread that the motion has reached in the table of [`ControlState`].
    fn control_state(&self) -> ControlState;

    /// Number of times that the observer diverged from the Qube and was reset.
    fn observer_resets(&self) -> u32 {
        0
    }

    /// Prediction because of which foresight ended the motion; `None` if foresight did not end it.
    fn foreseen(&self) -> Option<Foreseen> {
        None
    }

    /// Contradiction between the Qube and its profile that ended the motion; `None` if none did.
    fn contradiction(&self) -> Option<Contradiction> {
        None
    }

    /// Converts a voltage, mV, from the sign of the equations of motion to the sign of the device's
    /// wiring.
    fn device_mv(&self, voltage_mv: i16) -> i16;
}
