use serde::{Deserialize, Serialize};

use crate::qube::{Measurement, State};

/// What the tick is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// Moving the arm to its starting point and the pendulum to rest.
    #[default]
    Settling,
    /// The policy has the motor; these ticks make the return.
    Running,
    /// The rollout is over and the arm is being stopped.
    Braking,
}

/// One tick, as it leaves the control thread: everything that is needed to run it again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TickRecord {
    /// Number of the tick in its rollout, from 0.
    pub tick: u32,
    /// What the tick was doing.
    pub phase: Phase,
    /// When it was due, by the host's clock, ns.
    pub deadline_ns: u64,
    /// How long after that it woke, ns.
    pub lateness_ns: u64,
    /// Whole periods that were skipped before this tick because the one before ran late.
    pub skipped_periods: u32,
    /// Whether somebody had asked to stop by the time the tick woke.
    pub stop_requested: bool,
    /// The sample, or none when no valid one came in time and the last voltage was held over.
    pub measurement: Option<Measurement>,
    /// The estimated state that the policy sees, in the phases before and after it too. What judges,
    /// settles and brakes goes by a filter of its own, which follows from the samples.
    pub state: State,
    /// What the controller asked for, V, before any limit; none while held over.
    pub wanted_v: Option<f64>,
    /// What was sent, mV, by the convention's sign (positive turns the arm to positive theta).
    pub voltage_mv: i16,
    /// Time from sending the sample request to handing over the act, by the host's clock, ns.
    pub turnaround_ns: u64,
}
