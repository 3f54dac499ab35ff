use crate::qube::CONTROL_PERIOD_S;
use crate::recording::Recording;
use crate::replay::{GuardApproach, controller_of, rerun};
use crate::telemetry::Phase;

/// The nearest approach of a rollout to one limit of its safety box under the voltages of its
/// policy.
#[derive(Clone, Debug, PartialEq)]
pub struct Nearest {
    /// Quantity in words.
    pub quantity: &'static str,
    /// Name of the angle in the player's figures; `None` for a velocity.
    pub angle: Option<&'static str>,
    /// Value with the largest magnitude that the policy's voltages led to, rad or rad/s.
    pub value: f64,
    /// Limit of the quantity's magnitude, rad or rad/s.
    pub limit: f64,
    /// Magnitude of the value as a share of the limit; 1 is at the limit.
    pub share: f64,
    /// Unit of value and limit.
    pub unit: &'static str,
    /// Time of the value from the policy's first tick, s.
    pub time_s: f64,
}

/// The nearest approaches of a recording to the four limits of its box, in the order arm's and
/// pendulum's angle, arm's and pendulum's velocity; empty if the policy never drove the motor.
///
/// The tick right after the policy's last one counts, too, if it was recorded: its state follows
/// from the policy's last voltage, and the brake drives the motor in it if this state is beyond a
/// limit.
#[must_use]
pub fn nearest_approaches(recording: &Recording) -> Vec<Nearest> {
    let limits = recording.header.settings.safety_box;
    let ticks = &recording.ticks;
    let running = || ticks.iter().filter(|tick| tick.phase == Phase::Running);
    let Some(first) = running().next() else { return Vec::new() };
    let last = ticks.iter().rposition(|tick| tick.phase == Phase::Running).unwrap_or(0);
    let after = ticks.get(last + 1).filter(|it| it.tick == ticks[last].tick.wrapping_add(1));
    let reached = || running().chain(after);
    type Of = fn(&crate::qube::State) -> f64;
    let quantities: [(&'static str, Option<&'static str>, Of, f64, &'static str); 4] = [
        ("arm's angle θ", Some("theta"), |state| state.theta, limits.theta, "rad"),
        ("pendulum's angle α", Some("alpha"), |state| state.alpha, limits.alpha, "rad"),
        ("arm's velocity", None, |state| state.theta_dot, limits.theta_dot, "rad/s"),
        ("pendulum's velocity", None, |state| state.alpha_dot, limits.alpha_dot, "rad/s"),
    ];
    let mut found = Vec::new();
    for (quantity, angle, of, limit, unit) in quantities {
        let largest =
            reached().max_by(|one, other| of(&one.state).abs().total_cmp(&of(&other.state).abs()));
        let Some(tick) = largest else { continue };
        let value = of(&tick.state);
        let time_s = f64::from(tick.tick.wrapping_sub(first.tick)) * CONTROL_PERIOD_S;
        found.push(Nearest {
            quantity,
            angle,
            value,
            limit,
            share: value.abs() / limit,
            unit,
            time_s,
        });
    }
    found
}

/// The tick at which the guard was nearest to ending the policy, and its time from the policy's
/// first tick, s. A replay of the recording finds it. `None` if the guard was not foresight or
/// predicted nothing, if the recorded policy cannot be read, or if the replay cannot repeat every
/// decision of the recording, so that the guard's prediction cannot be recomputed.
#[must_use]
pub fn guard_approach(recording: &Recording) -> Option<(GuardApproach, f64)> {
    if recording.header.settings.safety_box.guard.is_box() {
        return None;
    }
    let replayed = rerun(recording, controller_of(recording).ok()?);
    let approach = replayed.guard_approach.filter(|_| replayed.agrees())?;
    let first = recording.ticks.iter().find(|tick| tick.phase == Phase::Running);
    // A policy whose first voltage is refused has no running tick; the approach is then at time 0.
    let first = first.map_or(approach.tick, |first| first.tick);
    Some((approach, f64::from(approach.tick.saturating_sub(first)) * CONTROL_PERIOD_S))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::State;
    use crate::recording::{Completeness, samples};
    use crate::telemetry::TickRecord;

    #[test]
    fn the_largest_values_that_the_policy_led_to_count_and_no_others() {
        let tick = |tick, phase, theta, alpha_dot| TickRecord {
            tick,
            phase,
            state: State { theta, alpha_dot, ..State::default() },
            ..TickRecord::default()
        };
        let ticks = vec![
            tick(0, Phase::Settling, 2.2, 0.0),
            tick(5, Phase::Running, 0.1, -20.0),
            tick(6, Phase::Running, -1.15, 3.0),
            tick(7, Phase::Braking, -2.3, 5.0),
            tick(8, Phase::Braking, -2.4, 50.0),
        ];
        let mut recording = Recording {
            header: samples::header(),
            policy: Vec::new(),
            ticks,
            outcome: None,
            completeness: Completeness::Whole,
        };
        let found = nearest_approaches(&recording);
        let theta = &found[0];
        assert_eq!((theta.value, theta.limit, theta.time_s), (-2.3, 2.3, 0.02));
        assert!((theta.share - 1.0).abs() < 1e-12);
        assert_eq!((found[3].value, found[3].share, found[3].time_s), (-20.0, 0.5, 0.0));

        // A tick is missing after the policy's last tick, so the next recorded tick may be any
        // later one.
        recording.ticks.remove(3);
        let theta = &nearest_approaches(&recording)[0];
        assert_eq!((theta.value, theta.time_s), (-1.15, 0.01));
        assert!((theta.share - 0.5).abs() < 1e-12);
    }
}
