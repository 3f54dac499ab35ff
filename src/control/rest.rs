//! Detectors of rest: arm and pendulum at rest before a rollout, the arm centred after a rollout,
//! the arm still before homing.

use crate::qube::{Encoder, Encoders, State, wrap_angle};

/// Velocity below which the arm counts as stopped, rad/s.
pub const STOPPED_RAD_S: f64 = 0.5;

/// Ticks at rest that a rollout requires before its policy starts: 0.3 s.
const REST_TICKS: u32 = 30;

/// Velocity below which arm and pendulum of a Qube count as at rest, rad/s: a flicker by one count
/// (0.003 rad) looks like 0.3 rad/s as a difference.
const AT_REST_RAD_S: f64 = 0.4;

/// Detects when arm and pendulum have been at rest for 0.3 s.
#[derive(Clone, Copy, Debug)]
pub struct RestDetector {
    quiet_ticks: u32,
    /// Velocity below which each counts as at rest, rad/s.
    theta_rad_s: f64,
    alpha_rad_s: f64,
}

impl Default for RestDetector {
    /// A detector for a Qube's encoders.
    fn default() -> Self {
        Self::of(Encoders::QUBE)
    }
}

impl RestDetector {
    /// A detector that allows for a flicker by one count of these encoders.
    pub fn of(encoders: Encoders) -> Self {
        let at_rest_rad_s = |encoder: Encoder| {
            let coarser = encoder.rad_per_count() / Encoder::QUBE.rad_per_count();
            AT_REST_RAD_S * coarser.max(1.0)
        };
        let [theta_rad_s, alpha_rad_s] = [encoders.theta, encoders.alpha].map(at_rest_rad_s);
        Self { quiet_ticks: 0, theta_rad_s, alpha_rad_s }
    }

    /// Takes the next state and the arm's target angle, rad; returns true once the last 0.3 s were
    /// quiet. The tolerances allow for friction that holds the arm a little off its target.
    pub fn at_rest(&mut self, state: &State, target_theta_rad: f64) -> bool {
        let quiet = (state.theta - target_theta_rad).abs() < 0.1
            && wrap_angle(state.alpha).abs() < 0.03
            && state.theta_dot.abs() < self.theta_rad_s
            && state.alpha_dot.abs() < self.alpha_rad_s;
        self.quiet_ticks = if quiet { self.quiet_ticks + 1 } else { 0 };
        self.quiet_ticks >= REST_TICKS
    }
}

/// Largest range of a centred arm's motion, rad.
const CENTRED_RANGE_RAD: f64 = 0.05;

/// Largest distance of a centred arm from the middle, rad.
const CENTRED_REACH_RAD: f64 = 0.5;

/// Ticks for which range and distance must hold: 0.6 s, longer than a swing of the pendulum, so
/// that the pendulum's remaining energy cannot throw the arm far once the amplifier is off.
const CENTRED_TICKS: u32 = 60;

/// Distance from the nearer stop beyond which an arm at rest counts as centred, rad: the cable may
/// hold the arm off the middle for as long as the brake is on.
const OFF_STOPS_RAD: f64 = 1.5;

/// Detects when the arm is centred and the pendulum does not move it.
#[derive(Clone, Copy, Debug)]
pub struct CentredDetector {
    stay: Stay,
    reach_rad: f64,
}

impl Default for CentredDetector {
    /// A detector that accepts an arm within 0.5 rad of the middle.
    fn default() -> Self {
        Self { stay: Stay::default(), reach_rad: CENTRED_REACH_RAD }
    }
}

impl CentredDetector {
    /// A detector that accepts an arm at least 1.5 rad from both stops, or within 0.5 rad of the
    /// middle; `nearer_rad` is the distance of the nearer stop from the middle, rad.
    pub fn off_stops(nearer_rad: f64) -> Self {
        let reach_rad = (nearer_rad - OFF_STOPS_RAD).max(CENTRED_REACH_RAD);
        Self { stay: Stay::default(), reach_rad }
    }

    /// Takes the next arm angle, rad; returns true once the arm has stayed for 0.6 s in a range of
    /// 0.05 rad and near enough to the middle.
    pub fn is_centred(&mut self, theta: f64) -> bool {
        let reach_rad = self.reach_rad;
        let quiet = |width_rad| width_rad <= CENTRED_RANGE_RAD && theta.abs() < reach_rad;
        self.stay.update(theta, quiet) > CENTRED_TICKS
    }
}

/// Largest range of a still arm, rad.
const STILL_RANGE_RAD: f64 = 0.1;

/// Ticks for which a still arm must stay: 1 s.
const STILL_TICKS: u32 = 100;

/// Detects when the arm has been still for 1 s, at any angle.
#[derive(Clone, Copy, Debug, Default)]
pub struct StillnessDetector {
    stay: Stay,
}

impl StillnessDetector {
    /// Takes the next arm angle, rad; returns true once the arm has been still for 1 s.
    pub fn is_still(&mut self, theta: f64) -> bool {
        self.stay.update(theta, |width_rad| width_rad < STILL_RANGE_RAD) > STILL_TICKS
    }
}

/// Duration and range of the arm's current stay in one place.
#[derive(Clone, Copy, Debug, Default)]
struct Stay {
    ticks: u32,
    lowest_rad: f64,
    highest_rad: f64,
}

impl Stay {
    /// Takes the next arm angle, rad, and returns the ticks of the stay. A stay ends when `quiet`
    /// rejects its range, rad.
    fn update(&mut self, theta: f64, quiet: impl Fn(f64) -> bool) -> u32 {
        let lowest_rad = self.lowest_rad.min(theta);
        let highest_rad = self.highest_rad.max(theta);
        *self = if self.ticks > 0 && quiet(highest_rad - lowest_rad) {
            Self { ticks: self.ticks + 1, lowest_rad, highest_rad }
        } else {
            Self { ticks: 1, lowest_rad: theta, highest_rad: theta }
        };
        self.ticks
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flicker_by_one_count_is_rest_however_coarse_the_encoder() {
        let ticks_to_rest = |mut detector: RestDetector, counts: i32| {
            let coarse = Encoder::try_from(counts).unwrap();
            // The filter of 200 rad/s shows a step by one count as 82/s times the step.
            let flicker_rad_s = 82.0 * coarse.rad_per_count();
            let state = |tick: u32| State {
                alpha_dot: if tick.is_multiple_of(8) { flicker_rad_s } else { 0.0 },
                ..State::default()
            };
            (0..100).find(|tick| detector.at_rest(&state(*tick), 0.0))
        };
        let of = |counts| {
            let alpha = Encoder::try_from(counts).unwrap();
            RestDetector::of(Encoders { theta: Encoder::QUBE, alpha })
        };
        assert_eq!(ticks_to_rest(RestDetector::default(), 1024), None);
        for counts in [1000, 1024, 2048, 8192] {
            assert_eq!(ticks_to_rest(of(counts), counts), Some(29), "{counts} counts");
        }
        // A pendulum that moves is not at rest.
        let swings = State { alpha_dot: 0.9, ..State::default() };
        let mut detector = of(1024);
        assert!(!(0..100).any(|_| detector.at_rest(&swings, 0.0)));
    }
}
