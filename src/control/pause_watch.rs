//! Follows an arm that a cable pulls slowly in the pause after a motion.

use super::{Moved, RestWatch, RestingCounts};
use crate::clock::Nanoseconds;
use crate::qube::{Encoders, Measurement};

/// Time for which the counts are watched in a pause, ns. On `lab` the distance between the arm and
/// the angle to which its cable pulls it is halved every 7 s.
const PAUSE_WATCH_NS: Nanoseconds = 60_000_000_000;

/// Longest time between two samples, ns. A longer gap may hide a jump, so it ends the watch.
const LONGEST_GAP_NS: Nanoseconds = 100_000_000;

/// Largest change of the arm's count between two samples of an arm that creeps, counts of a Qube's
/// encoder: one count by the creep, and two because a count may flicker by one to either side.
const LARGEST_STEP_COUNTS: f64 = 3.0;

/// What a sample shows about an arm that was at rest when a pause began.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum PauseEvent {
    /// Nothing new: the arm has not been at rest for long enough since it moved last.
    GoesOn,
    /// The arm is at rest. If it is not where it was, it has crept here.
    Rests(RestingCounts),
    /// The arm's count has changed in another way.
    Changed(Moved),
    /// The time of the watch is over, or a gap between the samples is too long.
    Over,
}

/// The watch of the counts in the pause after a motion.
#[derive(Debug)]
pub(super) struct PauseWatch {
    watch: RestWatch,
    encoders: Encoders,
    /// Time of the last sample, ns, and the arm's count in it.
    sampled_ns: Nanoseconds,
    theta_counts: Option<i32>,
    /// Time at which the arm was at rest last, ns.
    rest_ns: Nanoseconds,
    /// Time at which the watch ends, ns.
    end_ns: Nanoseconds,
}

impl PauseWatch {
    /// A watch that begins at `now_ns`, when `watch` has found arm and pendulum at rest.
    pub fn new(watch: RestWatch, encoders: Encoders, now_ns: Nanoseconds) -> Self {
        Self {
            watch,
            encoders,
            sampled_ns: now_ns,
            theta_counts: None,
            rest_ns: now_ns,
            end_ns: now_ns + PAUSE_WATCH_NS,
        }
    }

    /// Takes the next sample, which arrived at `now_ns`; `at_rest` is where the arm was at rest last.
    pub fn update(
        &mut self,
        sample: &Measurement,
        now_ns: Nanoseconds,
        at_rest: RestingCounts,
    ) -> PauseEvent {
        if self.is_over(now_ns) {
            return PauseEvent::Over;
        }
        self.sampled_ns = now_ns;
        let before_counts = self.theta_counts.replace(sample.theta_counts);
        let step = sample.theta_counts.wrapping_sub(before_counts.unwrap_or(sample.theta_counts));
        let rest = self.watch.update(sample);
        let largest_step = self.encoders.theta.covering_qube_counts(LARGEST_STEP_COUNTS);
        if step.unsigned_abs() > largest_step.unsigned_abs() || self.watch.has_jumped_or_drifted() {
            return PauseEvent::Changed(Moved::Jumped);
        }
        let Some(rest) = rest else { return PauseEvent::GoesOn };
        let elapsed_s = now_ns.saturating_sub(self.rest_ns) as f64 * 1e-9;
        if !rest.is_creep_from(at_rest, elapsed_s, self.encoders) {
            let counts = rest.arm_counts_since(at_rest);
            return PauseEvent::Changed(Moved::Arm(self.encoders.theta.angle_rad(counts)));
        }
        self.rest_ns = now_ns;
        PauseEvent::Rests(rest)
    }

    /// Returns whether the time of the watch is over, or the last sample is too old.
    pub fn is_over(&self, now_ns: Nanoseconds) -> bool {
        now_ns >= self.end_ns || now_ns.saturating_sub(self.sampled_ns) > LONGEST_GAP_NS
    }

    /// The watch of rest, to go on with before a rollout; `None` if this watch is over.
    pub fn unbroken(self, now_ns: Nanoseconds) -> Option<RestWatch> {
        (!self.is_over(now_ns)).then_some(self.watch)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::super::plant_device::{PlantDevice, TestFault};
    use super::super::rest_monitor::RestMonitor;
    use super::*;
    use crate::clock::{Clock, VirtualClock};
    use crate::qube::{CONTROL_PERIOD_NS, State};

    /// The first sight other than [`PauseEvent::GoesOn`] and of rest, for an arm whose count at each
    /// tick is `counts`, and the last count at which the arm was at rest.
    fn watched(gap_ticks: u64, counts: impl Fn(u64) -> i32) -> (PauseEvent, RestingCounts) {
        let sample = |tick: u64| Measurement {
            device_time_us: 1_000 + tick * CONTROL_PERIOD_NS / 1000,
            theta_counts: counts(tick),
            ..Measurement::default()
        };
        let mut watch = RestWatch::new(Encoders::QUBE);
        let found = (0..).find_map(|tick| watch.update(&sample(tick)).map(|rest| (tick, rest)));
        let (first, mut at_rest) = found.unwrap();
        let mut pause = PauseWatch::new(watch, Encoders::QUBE, first * CONTROL_PERIOD_NS);
        let mut tick = first;
        loop {
            tick += if tick == first + 500 { gap_ticks } else { 1 };
            match pause.update(&sample(tick), tick * CONTROL_PERIOD_NS, at_rest) {
                PauseEvent::GoesOn => {}
                PauseEvent::Rests(rest) => at_rest = rest,
                ends => return (ends, at_rest),
            }
        }
    }

    /// The creep of `lab`: fast enough at first to use all that counts as rest.
    fn creep(tick: u64) -> i32 {
        (-90.0 * (1.0 - (-0.001 * tick as f64).exp())) as i32
    }

    #[test]
    fn an_arm_that_creeps_is_followed_for_a_minute_also_if_its_count_flickers() {
        let still = watched(1, |_| 7).1;
        let flicker = |tick: u64| [0, 1, -1, 0, -1, 1, 1][(tick * tick % 7) as usize];
        for flickers in [0, 1] {
            let counts = |tick| 7 + creep(tick) + flickers * flicker(tick);
            let (ends, at_rest) = watched(1, counts);
            assert_eq!(ends, PauseEvent::Over, "flickers {flickers}");
            let crept = at_rest.arm_counts_since(still);
            assert!((-92..=-86).contains(&crept), "flickers {flickers}: {crept}");
        }
    }

    #[test]
    fn small_jumps_are_no_creep_however_often_they_come() {
        for jump in [4, -4, 7, 10, -12, 16] {
            for every_ticks in [40, 190, 370, 500] {
                let steps = |tick: u64| (tick / every_ticks) as i32;
                for creeps in [0, 1] {
                    let (ends, _) = watched(1, |tick| {
                        jump * steps(tick.saturating_sub(100)) + creeps * creep(tick)
                    });
                    assert_eq!(
                        ends,
                        PauseEvent::Changed(Moved::Jumped),
                        "{jump} every {every_ticks} ticks, creeps: {creeps}"
                    );
                }
            }
        }
    }

    #[test]
    fn an_arm_that_moves_faster_than_a_creep_is_not_followed() {
        // A hand turns the arm by 0.3 rad within a second.
        let (ends, at_rest) = watched(1, |tick| tick.saturating_sub(1000).min(100) as i32);
        assert!(matches!(ends, PauseEvent::Changed(Moved::Arm(rad)) if rad > 0.2), "{ends:?}");
        assert!(at_rest.arm_counts_since(watched(1, |_| 0).1) < 6, "{at_rest:?}");
    }

    #[test]
    fn a_gap_that_may_hide_a_jump_ends_the_watch() {
        let counts = |tick| if tick < 570 { 0 } else { 12 };
        assert_eq!(watched(11, counts).0, PauseEvent::Over);
        assert_eq!(watched(10, counts).0, PauseEvent::Changed(Moved::Jumped));
        assert_eq!(watched(10, |_| 0).0, PauseEvent::Over);
    }

    #[test]
    fn a_silent_device_is_not_watched_for_ever() {
        let silent = |tick| (tick > 300).then_some(TestFault::Lost);
        let mut device = PlantDevice::new(State::default());
        device.disturbance = Box::new(silent);
        let clock = RunningClock(device.clock.clone());
        let mut monitor = RestMonitor::default();
        monitor.keep(None, &mut device, &clock, &AtomicBool::new(false)).unwrap();
        let begun_ns = clock.now_ns();
        assert!(monitor.watches_pause());
        while monitor.watches_pause() && clock.now_ns() < begun_ns + 10_000_000_000 {
            monitor.watch_pause(&mut device, &clock);
        }
        let watched_s = (clock.now_ns() - begun_ns) as f64 * 1e-9;
        assert!((2.0..4.0).contains(&watched_s), "{watched_s} s");
    }

    /// A virtual clock that says that time passes by itself.
    struct RunningClock(VirtualClock);

    impl Clock for RunningClock {
        fn now_ns(&self) -> Nanoseconds {
            self.0.now_ns()
        }

        fn sleep_until(&self, deadline_ns: Nanoseconds) {
            self.0.sleep_until(deadline_ns);
        }
    }
}
