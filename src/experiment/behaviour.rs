use std::f64::consts::PI;

use serde::Serialize;

use crate::qube::wrap_angle;
use crate::recording::Recording;
use crate::session::{ABOUT_UPRIGHT_RAD, Quietness, Verdict, judge_recording};
use crate::telemetry::{Phase, TickRecord};

/// Steps at the end of a rollout that say where it came to: 3 s, by when any swing-up has had time.
const LAST_STEPS: usize = 300;

/// In this share of the last steps it must have been about up to be called chattering.
const CHATTERING_SHARE: f64 = 0.5;

/// Steps at the end over which a pendulum must be held, and quietly: the last second.
const HOLDING_STEPS: usize = 100;

/// A voltage from this root mean square on holds a pendulum by force: standing still takes less, V.
const CHATTERING_RMS_V: f64 = 1.0;

/// Changes of sign in a second from which on such a voltage is called chattering: 3 Hz to and fro.
/// The limit cycle that filter and delay make has 5 to 6 Hz.
const CHATTERING_CHANGES_PER_S: f64 = 6.0;

/// What a rollout did, by its recording: each is exactly one of these.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Behaviour {
    /// It succeeded: within 0.2 rad of upright in each of its last 100 steps, and a return of at
    /// least 400.
    Stood,
    /// It stood at its end and calmly, but too late to earn 400.
    StoodLate,
    /// It left the safety box, or its guard ended it.
    LeftBox,
    /// It kept the pendulum about upright (within 0.5 rad in half of its last 300 steps), but did
    /// not hold it still, or held it by a voltage of at least 1 V (root mean square) that changed its
    /// sign at least six times in the last second.
    Chattered,
    /// None of these: it never got the pendulum up, or lost it.
    Fell,
    /// A fault ended every try of it.
    Fault,
}

impl Behaviour {
    /// All of them, in the order of tables.
    pub const ALL: [Self; 6] =
        [Self::Stood, Self::StoodLate, Self::LeftBox, Self::Chattered, Self::Fell, Self::Fault];

    /// What a recording shows; none where it has come to no result.
    #[must_use]
    pub fn of(recording: &Recording) -> Option<Self> {
        let Verdict::Result { success, outcome, .. } = judge_recording(recording) else {
            return None;
        };
        let running: Vec<&TickRecord> =
            recording.ticks.iter().filter(|tick| tick.phase == Phase::Running).collect();
        Some(match outcome.ending {
            crate::telemetry::Ending::LeftBox(_) => Self::LeftBox,
            _ if success => Self::Stood,
            _ => of_a_failure(&running),
        })
    }

    /// Its name in tables and files.
    #[must_use]
    pub fn name(self) -> &'static str {
        ["stood", "stood_late", "left_box", "chattered", "fell", "fault"][self as usize]
    }
}

/// What a rollout did that had all its steps and did not succeed.
fn of_a_failure(running: &[&TickRecord]) -> Behaviour {
    let last = |count: usize| &running[running.len().saturating_sub(count)..];
    let from_upright_rad = |tick: &TickRecord| wrap_angle(tick.state.alpha - PI).abs();
    let up = last(LAST_STEPS).iter().filter(|tick| from_upright_rad(tick) < ABOUT_UPRIGHT_RAD);
    let is_about_up = up.count() as f64 >= CHATTERING_SHARE * LAST_STEPS as f64;
    let holds = running.len() > HOLDING_STEPS
        && last(HOLDING_STEPS).iter().all(|tick| from_upright_rad(tick) < 0.2);
    // One tick more: a change needs the tick before.
    let chatters = chatters(last(HOLDING_STEPS + 1));
    match (holds, is_about_up) {
        (true, _) if !chatters => Behaviour::StoodLate,
        (true, _) | (false, true) => Behaviour::Chattered,
        (false, false) => Behaviour::Fell,
    }
}

/// Whether the voltage of this stretch goes to and fro.
fn chatters(ticks: &[&TickRecord]) -> bool {
    let mut quietness = Quietness::NONE;
    quietness.add_stretch(ticks);
    quietness.figures().is_some_and(|figures| {
        figures.rms_v >= CHATTERING_RMS_V && figures.sign_changes_per_s >= CHATTERING_CHANGES_PER_S
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::State;

    /// 600 steps with this angle of the pendulum and voltage.
    fn behaviour(alpha: impl Fn(u32) -> f64, voltage_v: impl Fn(u32) -> f64) -> Behaviour {
        let ticks: Vec<TickRecord> = (0..600)
            .map(|tick| TickRecord {
                tick,
                phase: Phase::Running,
                state: State { alpha: alpha(tick), ..State::default() },
                voltage_mv: (1000.0 * voltage_v(tick)) as i16,
                ..TickRecord::default()
            })
            .collect();
        of_a_failure(&ticks.iter().collect::<Vec<_>>())
    }

    fn alternating(tick: u32) -> f64 {
        if tick % 4 < 2 { 4.0 } else { -4.0 }
    }

    #[test]
    fn each_way_to_fail_has_its_name() {
        assert_eq!(behaviour(|_| 0.1, |_| 0.0), Behaviour::Fell);
        // Up for three seconds, then lost.
        assert_eq!(behaviour(|tick| if tick < 400 { PI } else { 0.5 }, |_| 1.0), Behaviour::Fell);
        // Around upright, from one side to the other, whichever way it went up.
        for up in [PI, -PI] {
            let swinging = |tick: u32| up + 0.35 * (f64::from(tick) * 0.3).sin();
            assert_eq!(behaviour(swinging, alternating), Behaviour::Chattered);
        }
        // Held, by force.
        assert_eq!(behaviour(|_| PI + 0.1, alternating), Behaviour::Chattered);
        // Held calmly, from the fifth second on.
        let late = |tick: u32| if tick < 450 { 0.0 } else { PI };
        assert_eq!(behaviour(late, |tick| f64::from(tick % 2) * 0.4), Behaviour::StoodLate);
    }
}
