//! The section about the times at which the Qube was driven and policies were trained.

use crate::qube::CONTROL_PERIOD_NS;
use crate::recording::Recording;
use crate::report::chart::{Axis, Chart, Series, Style};
use crate::report::page::Page;
use crate::session::TrainingTime;

/// Seconds in a nanosecond.
const S_PER_NS: f64 = 1e-9;
/// Seconds in a minute.
const S_PER_MIN: f64 = 60.0;

/// The rollouts and trainings of a session in time, each from its beginning to its end, ns since
/// 1970.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct TimeLine {
    /// Times at which the Qube was driven in real time: all rollouts, also void attempts, from the
    /// first to the last recorded tick.
    rollouts: Vec<(u64, u64)>,
    /// Times at which policies were trained.
    trainings: Vec<(u64, u64)>,
}

/// The total times in a time line.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Busy {
    /// Time from the first beginning to the last end, s.
    all_s: f64,
    /// Time for which a Qube was driven, s. Rollouts at the same time on several Qubes count once.
    driven_s: f64,
    /// Sum of the durations of all trainings, s.
    trained_s: f64,
    /// Time for which the Qube was driven while a policy was trained, s.
    both_s: f64,
}

impl TimeLine {
    /// Adds a recorded rollout, unless it was made in virtual time or has no tick.
    pub(super) fn add_rollout(&mut self, recording: &Recording) {
        let (Some(began_unix_ns), Some(first), Some(last)) =
            (recording.header.started_unix_ns, recording.ticks.first(), recording.ticks.last())
        else {
            return;
        };
        let driven_ns = last.deadline_ns.saturating_sub(first.deadline_ns) + CONTROL_PERIOD_NS;
        self.rollouts.push((began_unix_ns, began_unix_ns.saturating_add(driven_ns)));
    }

    /// Adds trainings.
    pub(super) fn add_trainings(&mut self, times: &[TrainingTime]) {
        self.trainings.extend(times.iter().map(|it| (it.began_unix_ns, it.ended_unix_ns)));
    }

    /// The times at which a rollout or training begins or ends, ns since 1970, each with the number
    /// of rollouts and of trainings that are under way from then on.
    fn changes(&self) -> Vec<(u64, u32, u32)> {
        let mut events: Vec<(u64, i32, i32)> = Vec::new();
        events.extend(self.rollouts.iter().flat_map(|&(from, to)| [(from, 1, 0), (to, -1, 0)]));
        events.extend(self.trainings.iter().flat_map(|&(from, to)| [(from, 0, 1), (to, 0, -1)]));
        events.sort_unstable();
        let (mut rollouts, mut trainings) = (0_i32, 0_i32);
        let mut changes: Vec<(u64, u32, u32)> = Vec::new();
        for (at, rollout, training) in events {
            (rollouts, trainings) = (rollouts + rollout, trainings + training);
            let now = (at, rollouts.max(0) as u32, trainings.max(0) as u32);
            match changes.last_mut() {
                Some(last) if last.0 == at => *last = now,
                _ => changes.push(now),
            }
        }
        changes
    }

    fn busy(changes: &[(u64, u32, u32)]) -> Busy {
        let mut busy = Busy { all_s: 0.0, driven_s: 0.0, trained_s: 0.0, both_s: 0.0 };
        for pair in changes.windows(2) {
            let (from, rollouts, trainings) = pair[0];
            let time_s = (pair[1].0 - from) as f64 * S_PER_NS;
            busy.all_s += time_s;
            busy.trained_s += time_s * f64::from(trainings);
            if rollouts > 0 {
                busy.driven_s += time_s;
                busy.both_s += if trainings > 0 { time_s } else { 0.0 };
            }
        }
        busy
    }
}

/// Adds the time line of a session; adds nothing unless it has both rollouts in real time and times
/// of trainings.
pub(super) fn add_time_line(page: &mut Page, line: &TimeLine) {
    if line.rollouts.is_empty() || line.trainings.is_empty() {
        return;
    }
    let changes = line.changes();
    let busy = TimeLine::busy(&changes);
    let percent = |part: f64, whole: f64| if whole > 0.0 { 100.0 * part / whole } else { 0.0 };
    page.heading("How busy Qube and cores were");
    page.paragraph(&format!(
        "From the beginning of the first training or rollout to the end of the last, {:.1} min passed. The Qube was \
         driven for {:.1} min of these ({:.0} %); during {:.0} % of that time policies were trained. On average \
         {:.2} trainings were under way, each on one core. A rollout counts from its settling to the end of its \
         braking. Pauses between rollouts count as waiting, and so does the time between an end and a resumption.",
        busy.all_s / S_PER_MIN,
        busy.driven_s / S_PER_MIN,
        percent(busy.driven_s, busy.all_s),
        percent(busy.both_s, busy.driven_s),
        if busy.all_s > 0.0 { busy.trained_s / busy.all_s } else { 0.0 },
    ));
    let begin = changes.first().map_or(0, |change| change.0);
    let column = |of: fn(&(u64, u32, u32)) -> u32| {
        changes.iter().map(|change| Some(f64::from(of(change)))).collect::<Vec<_>>()
    };
    let most = changes.iter().map(|change| change.1.max(change.2)).max().unwrap_or(1);
    let chart = Chart {
        x: Axis::new("time since the first training or rollout", "min"),
        y: Axis::new("under way", ""),
        xs: changes.iter().map(|change| (change.0 - begin) as f64 * S_PER_NS / S_PER_MIN).collect(),
        series: vec![
            Series::new("trainings", Style::Steps, 0, column(|change| change.2)),
            Series::new("rollouts on the Qube", Style::Steps, 2, column(|change| change.1)),
        ],
        y_range: Some([0.0, f64::from(most) + 0.5]),
        ..Chart::default()
    };
    page.chart(
        "Trainings and rollouts under way",
        "Where the lines overlap, the Qube ran while the next policies were trained. A training on another computer counts \
         from its request to its result.",
        chart,
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    #[test]
    fn a_time_line_adds_up() {
        let line = TimeLine {
            rollouts: vec![(10 * S, 16 * S), (20 * S, 26 * S)],
            trainings: vec![(0, 10 * S), (0, 8 * S), (12 * S, 22 * S)],
        };
        let changes = line.changes();
        assert_eq!(changes[0], (0, 0, 2));
        // A training ends as a rollout begins.
        assert!(changes.contains(&(10 * S, 1, 0)), "{changes:?}");
        assert_eq!(changes.last(), Some(&(26 * S, 0, 0)));
        let busy = TimeLine::busy(&changes);
        assert_eq!(busy, Busy { all_s: 26.0, driven_s: 12.0, trained_s: 28.0, both_s: 6.0 });
        assert_eq!(TimeLine::busy(&[]).all_s, 0.0);
    }
}
