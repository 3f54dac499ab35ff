use crate::qube::RewardWeights;
use crate::telemetry::{Phase, TickRecord};

/// The return of a rollout: the sum of the rewards of the ticks in which the policy drove the
/// motor. Each reward is computed from the estimated state and the voltage that was sent.
///
/// A tick without a sample earns the reward of the last estimated state; a skipped period earns
/// nothing.
#[must_use]
pub fn return_of(ticks: &[TickRecord], weights: &RewardWeights) -> f64 {
    ticks
        .iter()
        .filter(|tick| tick.phase == Phase::Running)
        .map(|tick| weights.reward(&tick.state, tick.voltage_v()))
        .fold(0.0, |sum, reward| sum + reward)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::State;
    use std::f64::consts::PI;

    #[test]
    fn only_running_ticks_earn_and_held_over_ones_do_too() {
        let upright = State { alpha: PI, ..State::default() };
        let tick = |phase, measurement, voltage_mv| TickRecord {
            phase,
            measurement,
            state: upright,
            voltage_mv,
            ..TickRecord::default()
        };
        let sample = Some(crate::qube::Measurement::default());
        let ticks = [
            tick(Phase::Settling, sample, 0),
            tick(Phase::Running, sample, 0),
            tick(Phase::Running, None, 2000),
            tick(Phase::Braking, sample, 0),
        ];
        let expected = 1.0 + libm::exp(-0.003 * 4.0);
        assert!((return_of(&ticks, &RewardWeights::THESIS) - expected).abs() < 1e-12);
    }
}
