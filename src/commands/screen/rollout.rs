//! The state of the current rollout, as the recorder sees it.

use std::sync::{Mutex, PoisonError};

use crate::recording::Viewer;
use crate::safety::SafetyBox;
use crate::scoring::Latencies;
use crate::telemetry::{LatencySummary, Phase, RolloutHeader, RolloutOutcome, TickRecord};

/// The state of a rollout on the screen.
#[derive(Clone, Debug, Default)]
pub struct RolloutState {
    /// Name of the candidate in its session, of the policy in its experiment, or of the excitation;
    /// `None` for another rollout.
    pub name: Option<String>,
    /// Number of the rollout.
    pub rollout: u32,
    /// True if an excitation runs rather than a policy.
    pub is_excitation: bool,
    /// True until the rollout ends.
    pub is_running: bool,
    /// Limits of the box; `None` before the first rollout.
    pub limits: Option<SafetyBox>,
    /// Largest voltage of the plant's limits, V.
    pub largest_voltage_v: f64,
    /// Last tick.
    pub tick: TickRecord,
    /// Ticks under the policy so far.
    pub steps: u32,
    /// Largest fraction of each limit of the box that the state, as the policy sees it, has reached
    /// under the policy: of theta, alpha, theta_dot and alpha_dot.
    pub nearest: [f64; 4],
    /// Lateness of the wake-ups of this rollout, microseconds.
    pub lateness_us: LatencySummary,
    /// Ticks of all rollouts since the program began.
    pub ticks: u64,
    /// Missed deadlines in these ticks.
    pub missed: u64,
}

impl RolloutState {
    /// Returns the limit that the policy came nearest to, and the fraction of it that was reached;
    /// `None` before the policy's first tick.
    pub fn nearest_limit(&self) -> Option<(&'static str, f64)> {
        let names = ["θ", "α", "θ velocity", "α velocity"];
        let nearest =
            names.into_iter().zip(self.nearest).max_by(|one, other| one.1.total_cmp(&other.1))?;
        (self.steps > 0).then_some(nearest)
    }
}

/// Follows rollouts for the screen, on the recorder's thread.
#[derive(Debug, Default)]
pub struct RolloutPanel {
    state: Mutex<(RolloutState, Latencies)>,
}

impl RolloutPanel {
    /// Returns a copy of the current state.
    pub fn state(&self) -> RolloutState {
        let (mut state, latencies) = {
            let locked = self.state.lock().unwrap_or_else(PoisonError::into_inner);
            (locked.0.clone(), locked.1.clone())
        };
        // The percentiles need a sorting, which must not keep the recorder waiting for the lock.
        state.lateness_us = latencies.lateness_us();
        state
    }
}

impl Viewer for RolloutPanel {
    fn begins(&self, header: &RolloutHeader, _: u64) {
        let mut locked = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let (ticks, missed) = (locked.0.ticks, locked.0.missed);
        let state = RolloutState {
            name: header.candidate.map(|_| header.policy.clone()),
            rollout: header.rollout,
            is_excitation: header.policy.starts_with("excitation"),
            is_running: true,
            limits: Some(header.settings.safety_box),
            largest_voltage_v: header.settings.plant.limits.largest_voltage_v,
            ticks,
            missed,
            ..RolloutState::default()
        };
        *locked = (state, Latencies::default());
    }

    fn ticked(&self, tick: &TickRecord) {
        let mut locked = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let (state, latencies) = &mut *locked;
        let missed = latencies.missed_deadlines();
        latencies.add(std::slice::from_ref(tick));
        state.ticks += 1;
        state.missed += latencies.missed_deadlines() - missed;
        state.tick = *tick;
        if tick.phase == Phase::Running
            && let Some(limits) = &state.limits
        {
            state.steps += 1;
            let used = [
                tick.state.theta / limits.theta,
                tick.state.alpha / limits.alpha,
                tick.state.theta_dot / limits.theta_dot,
                tick.state.alpha_dot / limits.alpha_dot,
            ];
            for (nearest, used) in state.nearest.iter_mut().zip(used) {
                // A state that is not a number changes nothing.
                *nearest = nearest.max(used.abs());
            }
        }
    }

    fn ended(&self, _: Option<&RolloutOutcome>) {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).0.is_running = false;
    }
}
