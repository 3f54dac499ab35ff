//! Watches the counts while the amplifier is off, to decide whether the zeros of the last motion
//! hold.

use std::time::Duration;

use thiserror::Error;

use super::count_drift::CountDrift;
use super::count_range::CountRange;
use crate::qube::{CONTROL_PERIOD_S, Encoders, Measurement};

/// Number of consecutive samples within the widths below that count as rest: 0.6 s, longer than a
/// swing of the pendulum, so that the samples of a swing show its full width.
const REST_SAMPLES: u32 = 60;

/// Largest range of the arm's samples at rest, counts. All constants in counts in this file are
/// counts of a Qube's encoders. An arm without dry friction that creeps this much moves on by 8
/// counts before it stops. A smaller width would cost 8 s after each rollout on a Qube whose cable
/// pulls the arm slowly.
const ARM_WIDTH_COUNTS: f64 = 5.0;

/// Largest bend of the arm's path over 0.6 s of rest, counts: the sum of its first and last count
/// minus twice the count half-way. An arm without dry friction swings about the angle to which its
/// cable pulls it; a stiff cable gives it a period of 3 s. Where it turns round, it moves by 5
/// counts in 0.6 s before it swings back by 50. A swinging pendulum bends the path, too. An arm
/// whose path is bent is at rest after [`LONG_REST_SAMPLES`].
const LARGEST_BEND_COUNTS: f64 = 2.0;

/// Number of consecutive samples that count as rest if the arm's path is bent or the arm has crept
/// away before: 2.4 s.
const LONG_REST_SAMPLES: u32 = 240;

/// Largest range of the pendulum's samples at rest, counts: 0.3 rad to either side. On an arm held
/// by dry friction the pendulum swings for a minute; the middle of a whole swing is the count at
/// which it hangs.
const PENDULUM_WIDTH_COUNTS: f64 = 200.0;

/// Largest change of a count that leaves its zero valid, counts: 0.05 rad. A cable may pull the arm
/// farther within seconds; then the arm is homed before the next rollout, which is always safe.
const TOLERANCE_COUNTS: f64 = 16.0;

/// Largest change of an undriven arm's velocity within a tick, counts a tick: 5 rad/s. A larger
/// change is a jump of the count, or a blow.
const LARGEST_KICK_COUNTS: f64 = 16.0;

/// Shortest time between two samples that show a velocity, ticks: between two samples that follow
/// closely, a change by one count looks like a fast arm.
const SHORTEST_TICKS: f64 = 0.5;

/// Counts at which arm and pendulum are at rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RestingCounts {
    theta: i32,
    alpha: i32,
}

/// Reason why the zeros of the last motion do not hold.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Moved {
    /// The arm's count has changed since the last motion, by this angle, rad.
    #[error(
        "the arm's count moved by {0:.2} rad while the motor was off (the pull of the pendulum's \
         cable, a hand, or a loose plug of the arm's encoder)"
    )]
    Arm(f64),
    /// The pendulum rests at a count at which it did not hang before, off by this angle, rad.
    #[error(
        "the pendulum rests {0:.2} rad from where it hung (a hand, or a loose plug of its encoder)"
    )]
    Pendulum(f64),
    /// The arm's count jumped, or drifted away from its tachometer, after the last motion.
    #[error("the arm's count jumped or drifted while the motor was off (its encoder's cable?)")]
    Jumped,
    /// Arm and pendulum were not seen at rest, either after the last motion or before this one.
    #[error("arm and pendulum were not seen to come to rest since the last motion")]
    Unseen,
    /// The guard ended the last rollout because the Qube moved unlike its profile; counts that the
    /// arm's encoder lost may be the cause.
    #[error("the Qube moved unlike its profile, as if counts of the arm's encoder were lost")]
    Unpredicted,
}

impl RestingCounts {
    /// Counts by which the arm has moved since it was at `before`.
    pub(super) fn arm_counts_since(self, before: Self) -> i32 {
        self.theta.wrapping_sub(before.theta)
    }

    /// Returns whether an arm that creeps, slowly enough to be at rest, may have moved here from
    /// `before`, where it was at rest `elapsed_s` seconds earlier.
    pub(super) fn is_creep_from(self, before: Self, elapsed_s: f64, encoders: Encoders) -> bool {
        let fastest_counts_s = ARM_WIDTH_COUNTS / (f64::from(REST_SAMPLES) * CONTROL_PERIOD_S);
        let largest = 2.0 * ARM_WIDTH_COUNTS + fastest_counts_s * elapsed_s;
        self.arm_counts_since(before).abs() <= encoders.theta.covering_qube_counts(largest)
    }

    /// Checks whether the zeros of the last motion hold for the next one: the arm has stayed at
    /// `before`, and the pendulum hangs at `alpha_zero_counts` or whole turns from it.
    ///
    /// # Errors
    /// The zeros do not hold, and homing must measure them again.
    pub fn compare(
        self,
        before: Self,
        alpha_zero_counts: i32,
        encoders: Encoders,
    ) -> Result<(), Moved> {
        let arm = self.arm_counts_since(before);
        if arm.unsigned_abs() > encoders.theta.covering_qube_counts(TOLERANCE_COUNTS).unsigned_abs()
        {
            return Err(Moved::Arm(encoders.theta.angle_rad(arm)));
        }
        let whole_turn = encoders.alpha.counts_per_revolution();
        let half_turn = whole_turn / 2;
        // If the counts of a turn are a power of two, they divide the counter's range, and a wrap
        // of the counter does not change the comparison. With any other number a wrap makes the
        // comparison fail, and the arm is homed again.
        let pendulum = self.alpha.wrapping_sub(alpha_zero_counts).wrapping_add(half_turn);
        let pendulum = pendulum.rem_euclid(whole_turn) - half_turn;
        if pendulum.abs() > encoders.alpha.covering_qube_counts(TOLERANCE_COUNTS) {
            return Err(Moved::Pendulum(encoders.alpha.angle_rad(pendulum)));
        }
        Ok(())
    }
}

/// Detects when arm and pendulum are at rest while the amplifier is off, and whether the arm's
/// count has jumped or drifted meanwhile.
#[derive(Clone, Copy, Debug)]
pub struct RestWatch {
    encoders: Encoders,
    last: Option<Last>,
    theta: CountRange,
    /// The arm's count after half of the samples of a rest, relative to the first.
    half_way: i32,
    alpha: CountRange,
    samples: u32,
    /// Number of these samples that make a rest.
    needed_samples: u32,
    drift: CountDrift,
    has_jumped_or_drifted: bool,
}

/// The previous sample, and the arm's velocity, counts a tick.
#[derive(Clone, Copy, Debug)]
struct Last {
    time_us: u64,
    theta_counts: i32,
    velocity: Option<f64>,
}

impl RestWatch {
    /// A watch of a plant with these encoders.
    #[must_use]
    pub fn new(encoders: Encoders) -> Self {
        let (theta, alpha) = (CountRange::default(), CountRange::default());
        Self {
            encoders,
            last: None,
            theta,
            half_way: 0,
            alpha,
            samples: 0,
            needed_samples: REST_SAMPLES,
            drift: CountDrift::coming_to_rest(),
            has_jumped_or_drifted: false,
        }
    }

    /// A watch that continues from the last sample of a motion, so that no jump in between is
    /// missed.
    #[must_use]
    pub fn after(last: Option<&Measurement>, encoders: Encoders) -> Self {
        let last = last.map(|last| Last {
            time_us: last.device_time_us,
            theta_counts: last.theta_counts,
            velocity: Some(f64::from(last.tachometer_counts_s) * CONTROL_PERIOD_S),
        });
        Self { last, ..Self::new(encoders) }
    }

    /// Takes the next sample; returns the resting counts once arm and pendulum are at rest.
    pub fn update(&mut self, sample: &Measurement) -> Option<RestingCounts> {
        self.follow(sample);
        let theta = self.theta.with(sample.theta_counts);
        let alpha = self.alpha.with(sample.alpha_counts);
        let arm_width = self.encoders.theta.covering_qube_counts(ARM_WIDTH_COUNTS);
        let pendulum_width = self.encoders.alpha.covering_qube_counts(PENDULUM_WIDTH_COUNTS);
        let is_within = theta.width() <= arm_width && alpha.width() <= pendulum_width;
        if self.samples > 0 && is_within {
            (self.theta, self.alpha) = (theta, alpha);
            self.samples += 1;
            let gone = sample.theta_counts.wrapping_sub(theta.origin);
            if self.samples == REST_SAMPLES / 2 {
                self.half_way = gone;
            }
            if self.samples == REST_SAMPLES {
                let bend = (gone - 2 * self.half_way).abs();
                if bend > self.encoders.theta.covering_qube_counts(LARGEST_BEND_COUNTS) {
                    self.needed_samples = LONG_REST_SAMPLES;
                }
            }
        } else {
            self.theta = CountRange::at(sample.theta_counts);
            self.alpha = CountRange::at(sample.alpha_counts);
            (self.samples, self.needed_samples) = (1, REST_SAMPLES);
        }
        let is_at_rest = self.samples >= self.needed_samples;
        self.has_jumped_or_drifted |= is_at_rest && self.drift.is_large();
        is_at_rest.then(|| RestingCounts { theta: self.theta.middle(), alpha: self.alpha.middle() })
    }

    /// Returns whether arm and pendulum have been at rest for so long that the arm neither creeps
    /// on nor turns round: 2.4 s.
    #[must_use]
    pub fn is_still(&self) -> bool {
        self.samples >= LONG_REST_SAMPLES
    }

    /// Returns whether the arm's count has jumped by more than an arm can move, or has departed from
    /// its tachometer by as much as a rollout would not tolerate.
    #[must_use]
    pub fn has_jumped_or_drifted(&self) -> bool {
        self.has_jumped_or_drifted
    }

    fn follow(&mut self, sample: &Measurement) {
        let encoder = self.encoders.theta;
        let mut velocity = None;
        if let Some(last) = self.last {
            let elapsed_us = sample.device_time_us.saturating_sub(last.time_us);
            let ticks = elapsed_us as f64 * 1e-6 / CONTROL_PERIOD_S;
            if ticks < SHORTEST_TICKS {
                return;
            }
            let moved = sample.theta_counts.wrapping_sub(last.theta_counts);
            let counts = f64::from(moved);
            if let Some(before) = last.velocity {
                let kick = (counts - before * ticks).abs();
                let largest_kick = LARGEST_KICK_COUNTS * encoder.counts_per_qube_count();
                self.has_jumped_or_drifted |= kick > largest_kick * ticks.max(1.0);
            }
            self.has_jumped_or_drifted |= self.drift.has_drifted(
                encoder.angle_rad(moved),
                Duration::from_micros(elapsed_us),
                encoder.angle_rad(sample.tachometer_counts_s),
            );
            velocity = Some(counts / ticks);
        }
        self.last = Some(Last {
            time_us: sample.device_time_us,
            theta_counts: sample.theta_counts,
            velocity,
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::Encoder;

    fn sample(tick: u64, theta_counts: i32, alpha_counts: i32) -> Measurement {
        let device_time_us = 5_000 + tick * 10_000;
        Measurement { device_time_us, theta_counts, alpha_counts, ..Measurement::default() }
    }

    #[test]
    fn counts_that_stay_are_compared_and_those_that_moved_mean_homing_again() {
        let zero = 700;
        let left = RestingCounts { theta: -40, alpha: zero };
        let qube = Encoders::QUBE;
        let now = |theta, alpha| RestingCounts { theta, alpha }.compare(left, zero, qube);
        assert_eq!(now(-40, zero), Ok(()));
        assert_eq!(now(-56, zero + 16), Ok(()));
        // A pendulum that went over the top hangs whole turns away.
        for turns in [-3, -1, 1, 2] {
            assert_eq!(now(-40, zero + 2048 * turns), Ok(()));
            assert!(matches!(now(-40, zero + 2048 * turns + 300), Err(Moved::Pendulum(_))));
        }
        assert!(matches!(now(260, zero), Err(Moved::Arm(rad)) if (rad - 0.92).abs() < 0.01));
        assert!(matches!(now(-57, zero), Err(Moved::Arm(_))));
        assert!(matches!(now(-40, zero - 17), Err(Moved::Pendulum(_))));
        // Counters that wrap give the same result.
        let edge = RestingCounts { theta: i32::MAX, alpha: i32::MIN + 2 };
        let over = RestingCounts { theta: i32::MIN + 3, alpha: i32::MAX };
        assert_eq!(over.compare(edge, i32::MIN + 2, qube), Ok(()));
    }

    #[test]
    fn the_counts_of_other_encoders_cover_the_same_angles() {
        let encoder = |counts: i32| Encoder::try_from(counts).unwrap();
        let fine = Encoders { theta: encoder(4096), alpha: encoder(5000) };
        let left = RestingCounts { theta: 0, alpha: 0 };
        let now = |theta, alpha| RestingCounts { theta, alpha }.compare(left, 0, fine);
        assert_eq!(now(32, 5000 + 39), Ok(()));
        assert_eq!(now(-32, -10_000), Ok(()));
        assert!(matches!(now(33, 0), Err(Moved::Arm(rad)) if (rad - 0.0506).abs() < 1e-3));
        assert!(
            matches!(now(0, 2500), Err(Moved::Pendulum(rad)) if (rad.abs() - std::f64::consts::PI).abs() < 0.01)
        );
        // A change of 40 counts is a jump on a Qube, but not on an encoder that is four times as
        // fine.
        let jumps = |counts: i32| {
            let encoders = Encoders { theta: encoder(counts), ..fine };
            let mut watch = RestWatch::after(Some(&sample(0, 0, 0)), encoders);
            watch.update(&sample(1, 40, 0));
            watch.has_jumped_or_drifted()
        };
        assert!(jumps(2048) && !jumps(8192));
        let mut coarse = RestWatch::new(Encoders { theta: encoder(1000), alpha: encoder(1000) });
        let rested = (0..100).find_map(|tick| coarse.update(&sample(tick, (tick % 2) as i32, 0)));
        assert!(rested.is_some());
    }

    #[test]
    fn a_wide_swing_or_a_creeping_arm_is_not_at_rest() {
        // Swings of 0.4 rad and of 0.2 rad to either side, at twice a second.
        let swing = |counts: f64, tick: u64| 700 + (counts * (0.126 * tick as f64).sin()) as i32;
        let mut watch = RestWatch::new(Encoders::QUBE);
        for tick in 0..200 {
            assert_eq!(watch.update(&sample(tick, 0, swing(130.0, tick))), None);
        }
        let mut watch = RestWatch::new(Encoders::QUBE);
        let rested = (0..100).find_map(|tick| watch.update(&sample(tick, 0, swing(65.0, tick))));
        assert!(matches!(rested, Some(RestingCounts { theta: 0, alpha: 695..=705 })), "{rested:?}");
        let mut watch = RestWatch::new(Encoders::QUBE);
        for tick in 0..200 {
            let moves = sample(tick, 2 * tick as i32, 0);
            let moves = Measurement { tachometer_counts_s: 200, ..moves };
            assert_eq!(watch.update(&moves), None);
        }
        assert!(!watch.has_jumped_or_drifted());
        let rested = (200..).find_map(|tick| watch.update(&sample(tick, 398, 0)));
        assert!(matches!(rested, Some(RestingCounts { theta: 390..=398, alpha: 0 })), "{rested:?}");
    }

    #[test]
    fn an_arm_that_turns_round_is_not_at_rest() {
        // Swings about the angle of the cable's rest twice in 6 s, by 0.08 rad to either side. The
        // first sample is one second before a turning point.
        let swing = |tick: u64| (26.0 * (2.1 * 0.01 * (tick as f64 - 100.0)).cos()) as i32;
        let mut watch = RestWatch::new(Encoders::QUBE);
        for tick in 0..600 {
            assert_eq!(watch.update(&sample(tick, swing(tick), 0)), None, "tick {tick}");
        }
        // A creep at an even pace is slow enough, but it does not stand still.
        let mut watch = RestWatch::new(Encoders::QUBE);
        let creep = |tick: u64| (0.06 * tick as f64) as i32;
        let rested = (0..100).find(|&tick| watch.update(&sample(tick, creep(tick), 0)).is_some());
        assert!(rested.is_some() && !watch.is_still(), "{watch:?}");
        let still = (100..400).find(|&tick| {
            watch.update(&sample(tick, creep(100), 0));
            watch.is_still()
        });
        assert!(still.is_some(), "{watch:?}");
    }

    #[test]
    fn a_jump_while_the_arm_comes_to_rest_is_seen() {
        let last = sample(0, 1000, 0);
        let coming = |jump_at: u64, jump: i32| {
            let mut watch = RestWatch::after(Some(&last), Encoders::QUBE);
            for tick in 1..80 {
                // The arm slows down from 2 rad/s.
                let velocity = (-0.045 * tick as f64).exp();
                let coasted = (150.0 * (1.0 - velocity)) as i32;
                let jumped = if tick >= jump_at { jump } else { 0 };
                let tachometer_counts_s = (675.0 * velocity) as i32;
                watch.update(&Measurement {
                    tachometer_counts_s,
                    ..sample(tick, 1000 + coasted + jumped, 0)
                });
            }
            watch.has_jumped_or_drifted()
        };
        assert!(!coming(500, 0));
        for jump_at in [1, 2, 20, 60] {
            assert!(coming(jump_at, 40) && coming(jump_at, -300), "at {jump_at}");
        }
    }

    #[test]
    fn a_count_that_departs_from_its_tachometer_has_jumped() {
        let departs = |counts_s: u64, ticks: u64| {
            let mut watch = RestWatch::after(Some(&sample(0, 0, 0)), Encoders::QUBE);
            for tick in 1..ticks + 100 {
                watch.update(&sample(tick, (tick.min(ticks) * counts_s / 100) as i32, 0));
            }
            watch.has_jumped_or_drifted()
        };
        for counts_s in [100, 200, 300, 600, 1000, 1500] {
            assert!(departs(counts_s, 200), "{counts_s} counts/s");
        }
        assert!(departs(40, 500));
        // A count that freezes while the arm slides by 0.5 rad.
        let mut frozen = RestWatch::after(Some(&sample(0, 0, 0)), Encoders::QUBE);
        for tick in 1..200 {
            let tachometer_counts_s = if tick < 100 { 163 } else { 0 };
            frozen.update(&Measurement { tachometer_counts_s, ..sample(tick, 0, 0) });
        }
        assert!(frozen.has_jumped_or_drifted());
        assert!(!departs(50, 200));
        assert!(!departs(300, 40));
    }

    #[test]
    fn a_count_that_changes_between_two_close_samples_has_not_jumped() {
        let after_close_samples = |changed: i32, jumped: i32| {
            let mut watch = RestWatch::new(Encoders::QUBE);
            let times_us = [0, 10_000, 20_000, 20_200, 30_200, 40_200];
            let counts = [0, 0, 0, changed, changed + jumped, changed + jumped];
            for (device_time_us, theta_counts) in times_us.into_iter().zip(counts) {
                watch.update(&Measurement { device_time_us, theta_counts, ..sample(0, 0, 0) });
            }
            watch.has_jumped_or_drifted()
        };
        assert!(!after_close_samples(1, 0));
        assert!(!after_close_samples(-3, 0));
        assert!(after_close_samples(0, 17));
        assert!(after_close_samples(-40, 0));
    }
}
