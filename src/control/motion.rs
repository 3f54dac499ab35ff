use super::ControlState;
use crate::qube::{Measurement, State};
use crate::safety::Foreseen;
use crate::telemetry::{Ending, Phase};

/// What one tick knows. All of it is recorded, so that a recording can be decided again.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TickInput {
    /// When the tick was due, by the host's clock, ns.
    pub deadline_ns: u64,
    /// How long after that it woke, ns.
    pub lateness_ns: u64,
    /// Whole periods that were skipped before this tick.
    pub skipped_periods: u32,
    /// Whether somebody asks to stop.
    pub stop_requested: bool,
    /// The sample, or none when no valid one came in time.
    pub measurement: Option<Measurement>,
    /// The port itself is gone; no later sample will come.
    pub link_gone: bool,
    /// The device knows of no hello any more: it has restarted.
    pub board_restarted: bool,
    /// The motor has to cool down, by the samples and voltages before this tick.
    pub motor_overheated: bool,
}

/// What one tick decides.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickOutput {
    /// What the tick was doing.
    pub phase: Phase,
    /// The estimated state that a policy sees.
    pub state: State,
    /// What the controller asked for, V; none while held over or switched off.
    pub wanted_v: Option<f64>,
    /// What to send, mV, by the convention's sign.
    pub voltage_mv: i16,
    /// The motion is over: send nothing more, switch the amplifier off.
    pub ending: Option<Ending>,
}

impl TickOutput {
    /// Of a motion that is no rollout: nothing asked for, nothing ended.
    pub fn settling(state: State, voltage_mv: i16) -> Self {
        Self { phase: Phase::Settling, state, wanted_v: None, voltage_mv, ending: None }
    }
}

/// Something that moves the arm tick by tick: a rollout or a homing. Pure: the same inputs give
/// the same outputs, bit for bit.
pub trait Motion: Send {
    /// Decides one tick. Does not allocate, lock, log or wait.
    fn decide(&mut self, input: &TickInput) -> TickOutput;

    /// Where the motion has come to in the table of states.
    fn control_state(&self) -> ControlState;

    /// How often an observer had lost the Qube and started anew.
    fn observer_resets(&self) -> u32 {
        0
    }

    /// Why foresight ended the motion, if it did.
    fn foreseen(&self) -> Option<Foreseen> {
        None
    }

    /// The voltage as the device's wiring wants it, mV.
    fn device_mv(&self, voltage_mv: i16) -> i16;
}
