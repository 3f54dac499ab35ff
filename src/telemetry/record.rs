use serde::{Deserialize, Serialize};

use crate::qube::{Measurement, State};

/// The phase of a rollout.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// The tick moves the arm to its start angle and waits for the pendulum to rest.
    #[default]
    Settling,
    /// The policy has the motor; these ticks make up the return.
    Running,
    /// The rollout is over and the tick stops the arm.
    Braking,
}

impl Phase {
    /// The phase for tools that read numbers alone: 0 settling, 1 running, 2 braking.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::Settling => 0,
            Self::Running => 1,
            Self::Braking => 2,
        }
    }
}

/// The record of one tick: its inputs and outputs, from which it can be replayed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TickRecord {
    /// Number of the tick in its rollout, from 0.
    pub tick: u32,
    /// Phase of the rollout.
    pub phase: Phase,
    /// Time at which the tick was due, by the host's clock, ns.
    pub deadline_ns: u64,
    /// Lateness of the wake-up, ns.
    pub lateness_ns: u64,
    /// Whole periods skipped before this tick because the one before ran late.
    pub skipped_periods: u32,
    /// Whether a stop was requested by the time the tick woke.
    pub stop_requested: bool,
    /// Sample; `None` when no valid one came in time and the last voltage was held.
    pub measurement: Option<Measurement>,
    /// Estimated state that the policy sees, also in the other phases. Guard, settling and braking use
    /// their own filter, which follows from the samples.
    pub state: State,
    /// Voltage that the controller asked for before any limit, V; `None` while the last one is held.
    pub wanted_v: Option<f64>,
    /// Voltage sent, mV, in the convention's sign (positive turns the arm to positive theta).
    pub voltage_mv: i16,
    /// Time from sending the request of the sample to writing the act, by the host's clock, ns.
    pub turnaround_ns: u64,
}
