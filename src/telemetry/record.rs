use serde::{Deserialize, Serialize};

use crate::qube::{CONTROL_PERIOD_NS, Measurement, State, volts};

/// The phase of a rollout.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// The program moves the arm to its start angle and brings the pendulum to rest. Homing and
    /// every other motion outside of a rollout have this phase, too.
    #[default]
    Settling,
    /// The policy controls the motor; the return is the sum of the rewards of these ticks.
    Running,
    /// The rollout is over, and the brake stops the arm.
    Braking,
}

impl Phase {
    /// All phases in the order of their numbers.
    pub const ALL: [Self; 3] = [Self::Settling, Self::Running, Self::Braking];

    /// The number of the phase, for tools that read only numbers: 0 settling, 1 running, 2 braking.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::Settling => 0,
            Self::Running => 1,
            Self::Braking => 2,
        }
    }

    /// The name of the phase in recordings and JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Settling => "settling",
            Self::Running => "running",
            Self::Braking => "braking",
        }
    }

    /// The phase in one word, as pages show it.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Settling => "settling",
            Self::Running => "policy",
            Self::Braking => "braking",
        }
    }
}

/// The record of one tick: its inputs and outputs, from which the tick can be replayed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TickRecord {
    /// Number of the tick in its rollout, from 0.
    pub tick: u32,
    /// Phase of the rollout.
    pub phase: Phase,
    /// Time at which the tick was due, by the host's clock, ns.
    pub deadline_ns: u64,
    /// Time from the deadline to the wake-up of the tick, ns.
    pub lateness_ns: u64,
    /// Number of whole periods that were skipped before this tick because the previous tick ran
    /// late.
    pub skipped_periods: u32,
    /// True if a stop had been requested by the time at which the tick had read its sample.
    pub stop_requested: bool,
    /// Sample of the encoders; `None` if no valid sample came in time, so that the last voltage was
    /// held.
    pub measurement: Option<Measurement>,
    /// Estimated state that the policy sees, recorded in all phases, rad and rad/s. Guard, settling
    /// and braking use a filter of their own, whose states can be computed from the samples.
    pub state: State,
    /// Voltage that policy, settling or brake requested in this tick, before any limit, V. If the
    /// guard lets the brake take over, it is the brake's voltage. `None` if the last voltage was
    /// held or the amplifier goes off.
    pub wanted_v: Option<f64>,
    /// Voltage that was sent, or held if there was no sample, mV; 0 if the amplifier goes off. It
    /// has the sign of the convention: positive turns the arm towards positive theta.
    pub voltage_mv: i16,
    /// Time from the wake-up, at which the tick requests its sample, until the voltage (the act) is
    /// written, by the host's clock, ns. Without a sample, and in the last tick of a motion,
    /// nothing is written, and the time ends with the decision.
    pub turnaround_ns: u64,
}

impl TickRecord {
    /// Voltage that was sent or held, V (see [`Self::voltage_mv`]).
    #[must_use]
    pub fn voltage_v(&self) -> f64 {
        volts(self.voltage_mv)
    }

    /// Number of deadlines that this tick missed: each skipped period, and the tick itself if it
    /// was late by more than a period or had no valid sample.
    #[must_use]
    pub fn missed_deadlines(&self) -> u32 {
        let is_missed = self.measurement.is_none() || self.lateness_ns > CONTROL_PERIOD_NS;
        self.skipped_periods.saturating_add(is_missed.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_and_skipped_ticks_and_ticks_without_a_sample_are_missed_deadlines() {
        let sampled = TickRecord { measurement: Some(Default::default()), ..TickRecord::default() };
        assert_eq!(sampled.missed_deadlines(), 0);
        let late = TickRecord { lateness_ns: CONTROL_PERIOD_NS + 1, ..sampled };
        assert_eq!(late.missed_deadlines(), 1);
        let late_without_sample = TickRecord { measurement: None, ..late };
        assert_eq!(late_without_sample.missed_deadlines(), 1);
        let after_skipped = TickRecord { skipped_periods: 2, ..late };
        assert_eq!(after_skipped.missed_deadlines(), 3);
    }

    #[test]
    fn each_phase_has_the_name_that_is_written() {
        for (number, phase) in (0..).zip(Phase::ALL) {
            assert_eq!(phase.number(), number);
            assert_eq!(serde_json::to_value(phase).unwrap(), phase.name());
        }
    }
}
