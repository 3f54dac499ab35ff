use serde::Serialize;

use super::criterion::{UPRIGHT_STEPS, balanced_to_the_end, is_about_upright, running};
use super::{Quietness, Verdict, score_recording};
use crate::qube::PlantModel;
use crate::recording::Recording;
use crate::telemetry::{Ending, TickRecord};

/// Number of final steps that show whether the pendulum is kept near upright: 3 s, the second half
/// of a rollout, in which a swing-up is normally over.
const LAST_STEPS: usize = 300;

/// Share of the final steps in which a chattering pendulum is near upright.
const CHATTERING_SHARE: f64 = 0.5;

/// Root mean square voltage, V, from which the pendulum counts as held by force; quiet balancing
/// needs less.
const CHATTERING_RMS_V: f64 = 1.0;

/// Sign changes of the voltage per second from which holding by force counts as chattering: 6,
/// which is 3 Hz. The limit cycle that filter and delay cause has 5 to 6 Hz.
const CHATTERING_CHANGES_PER_S: f64 = 6.0;

/// The class of a rollout's behaviour, computed from its recording. Each rollout has exactly one
/// class: a successful rollout is [`Balanced`](Self::Balanced) at any voltage, and a rollout
/// without a result has [`Fault`](Self::Fault) in tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Behaviour {
    /// Success: all steps taken, within 0.2 rad of upright in each of the last 100 steps, and a
    /// return of at least 400.
    #[serde(rename = "stood")]
    Balanced,
    /// Balanced quietly for the last second, but with a return below 400, as after a late swing-up.
    #[serde(rename = "stood_late")]
    BalancedLate,
    /// Left the safety box, or was ended by the guard or by the motor's load.
    LeftBox,
    /// Kept the pendulum near upright (within 0.5 rad in at least half of the last 300 steps)
    /// without balancing it for the last second. The class also contains rollouts that balanced it
    /// for the last second, with a return below 400, by a voltage of at least 1 V (root mean
    /// square) whose sign changed at least six times.
    Chattered,
    /// Never brought the pendulum up, or lost it.
    Fell,
    /// Every attempt was void: ended by a fault, or recorded with ticks missing. [`Behaviour::of`]
    /// never returns this class, because one recording does not show it.
    Fault,
}

impl Behaviour {
    /// Every behaviour, in the order of tables.
    pub const ALL: [Self; 6] = [
        Self::Balanced,
        Self::BalancedLate,
        Self::LeftBox,
        Self::Chattered,
        Self::Fell,
        Self::Fault,
    ];

    /// The behaviour that a recording shows; `None` if the rollout has no result.
    #[must_use]
    pub fn of(recording: &Recording) -> Option<Self> {
        let Verdict::Result { success, outcome, .. } = score_recording(recording) else {
            return None;
        };
        Some(match outcome.ending {
            Ending::LeftBox(_) => Self::LeftBox,
            _ if success => Self::Balanced,
            _ => of_a_failure(&running(&recording.ticks)),
        })
    }

    /// The name in files and for scripts.
    #[must_use]
    pub fn name(self) -> &'static str {
        ["stood", "stood_late", "left_box", "chattered", "fell", "fault"][self as usize]
    }
}

/// Classifies a rollout that took all steps without success.
fn of_a_failure(running: &[&TickRecord]) -> Behaviour {
    let last = |count: usize| &running[running.len().saturating_sub(count)..];
    let up = last(LAST_STEPS).iter().filter(|tick| is_about_upright(&tick.state));
    let is_about_up = up.count() as f64 >= CHATTERING_SHARE * LAST_STEPS as f64;
    // The 100 changes of the voltage in the last second lie between 101 ticks.
    let chatters = chatters(last(UPRIGHT_STEPS + 1));
    let holds = running.len() > UPRIGHT_STEPS
        && balanced_to_the_end(running.iter().map(|tick| &tick.state));
    match (holds, is_about_up) {
        (true, _) if !chatters => Behaviour::BalancedLate,
        (true, _) | (false, true) => Behaviour::Chattered,
        (false, false) => Behaviour::Fell,
    }
}

/// Returns whether the voltage in these ticks is large and alternates often enough to count as
/// chattering.
fn chatters(ticks: &[&TickRecord]) -> bool {
    let mut quietness = Quietness::NONE;
    // The motor of the plant only affects the losses, which are not used here.
    quietness.add_stretch(ticks, &PlantModel::QUBE);
    quietness.figures().is_some_and(|figures| {
        figures.rms_v >= CHATTERING_RMS_V && figures.sign_changes_per_s >= CHATTERING_CHANGES_PER_S
    })
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::qube::State;
    use crate::telemetry::Phase;

    /// The behaviour of 600 steps with this pendulum angle and voltage.
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
        // The pendulum is up for the first four seconds, then lost.
        assert_eq!(behaviour(|tick| if tick < 400 { PI } else { 0.5 }, |_| 1.0), Behaviour::Fell);
        // The pendulum swings about upright from side to side, for either direction of the
        // swing-up.
        for up in [PI, -PI] {
            let swinging = |tick: u32| up + 0.35 * (f64::from(tick) * 0.3).sin();
            assert_eq!(behaviour(swinging, alternating), Behaviour::Chattered);
        }
        // The pendulum is held by force.
        assert_eq!(behaviour(|_| PI + 0.1, alternating), Behaviour::Chattered);
        // The pendulum is held quietly from 4.5 s on.
        let late = |tick: u32| if tick < 450 { 0.0 } else { PI };
        assert_eq!(behaviour(late, |tick| f64::from(tick % 2) * 0.4), Behaviour::BalancedLate);
    }
}
