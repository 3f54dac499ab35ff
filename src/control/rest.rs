//! Whether arm and pendulum move, told from the last samples: at rest before a rollout, back in the
//! middle after one, still before homing, and about which point the pendulum swings.

use crate::qube::{State, wrap_angle};

/// Ticks that everything must stay at rest before a rollout: 0.3 s.
const REST_TICKS: u32 = 30;

/// Whether arm and pendulum have been at rest for long enough.
#[derive(Clone, Copy, Debug, Default)]
pub struct RestDetector {
    quiet_ticks: u32,
}

impl RestDetector {
    /// Takes one more state; true once the last 0.3 s were quiet.
    ///
    /// The tolerances leave room for one encoder count (0.003 rad, and 0.3 rad/s as a difference)
    /// and for friction that holds the arm a little off its target.
    pub fn at_rest(&mut self, state: &State, target_theta_rad: f64) -> bool {
        let quiet = (state.theta - target_theta_rad).abs() < 0.1
            && wrap_angle(state.alpha).abs() < 0.03
            && state.theta_dot.abs() < 0.4
            && state.alpha_dot.abs() < 0.4;
        self.quiet_ticks = if quiet { self.quiet_ticks + 1 } else { 0 };
        self.quiet_ticks >= REST_TICKS
    }
}

/// An arm that moves over no more than this is brought back, rad.
const CENTRED_RANGE_RAD: f64 = 0.05;

/// An arm within this of the middle is brought back, rad.
const CENTRED_REACH_RAD: f64 = 0.5;

/// How long both must hold, in ticks: longer than a swing of the pendulum, so that what the pendulum
/// still holds cannot throw the arm far once the amplifier is off.
const CENTRED_TICKS: u32 = 60;

/// An arm that rests this far from its nearer stop, rad, need not be any nearer to the middle: a cable may
/// hold it off for as long as the brake works.
const OFF_STOPS_RAD: f64 = 1.5;

/// Whether the arm has been brought back and the pendulum no longer moves it.
#[derive(Clone, Copy, Debug)]
pub struct CentredDetector {
    stay: Stay,
    reach_rad: f64,
}

impl Default for CentredDetector {
    /// Back is near the middle.
    fn default() -> Self {
        Self { stay: Stay::default(), reach_rad: CENTRED_REACH_RAD }
    }
}

impl CentredDetector {
    /// Back is wherever it is far from a stop; the nearer one is this far from the middle, rad.
    pub fn off_stops(nearer_rad: f64) -> Self {
        let reach_rad = (nearer_rad - OFF_STOPS_RAD).max(CENTRED_REACH_RAD);
        Self { stay: Stay::default(), reach_rad }
    }

    /// Takes the arm's next angle; true once the last 0.6 s stayed within the range.
    pub fn is_centred(&mut self, theta: f64) -> bool {
        let reach_rad = self.reach_rad;
        let quiet = |width_rad| width_rad <= CENTRED_RANGE_RAD && theta.abs() < reach_rad;
        self.stay.update(theta, quiet) > CENTRED_TICKS
    }
}

/// An arm that moves less than this is still, rad.
const STILL_RANGE_RAD: f64 = 0.1;

/// How long an arm must be still, in ticks: 1 s.
const STILL_TICKS: u32 = 100;

/// Whether the arm stays where it is, wherever that may be.
#[derive(Clone, Copy, Debug, Default)]
pub struct StillnessDetector {
    stay: Stay,
}

impl StillnessDetector {
    /// Takes the arm's next angle; true once it has been still for 1 s.
    pub fn is_still(&mut self, theta: f64) -> bool {
        self.stay.update(theta, |width_rad| width_rad < STILL_RANGE_RAD) > STILL_TICKS
    }
}

/// For how many ticks, and over what range, the arm has stayed in one place.
#[derive(Clone, Copy, Debug, Default)]
struct Stay {
    ticks: u32,
    lowest_rad: f64,
    highest_rad: f64,
}

impl Stay {
    /// Takes the arm's next angle and gives the ticks of its stay, which begins anew with an angle that
    /// makes its range, rad, one that is not `quiet`.
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

/// Ticks over which the pendulum's swing is judged: more than one period of it (0.53 s).
const SWING_TICKS: u32 = 80;

/// Extremes of the pendulum's angle over windows of more than one of its periods.
#[derive(Clone, Copy, Debug, Default)]
pub struct Swing {
    ticks: u32,
    lowest_rad: f64,
    highest_rad: f64,
}

/// The pendulum's swing over one whole window.
#[derive(Clone, Copy, Debug)]
pub struct SwingWindow {
    /// The point about which it swings, rad.
    pub middle_rad: f64,
    /// From one extreme to the other, rad.
    pub width_rad: f64,
}

impl Swing {
    /// Takes the pendulum's next angle; gives the window that it completes.
    pub fn update(&mut self, alpha_rad: f64) -> Option<SwingWindow> {
        if self.ticks == 0 {
            (self.lowest_rad, self.highest_rad) = (alpha_rad, alpha_rad);
        }
        self.lowest_rad = self.lowest_rad.min(alpha_rad);
        self.highest_rad = self.highest_rad.max(alpha_rad);
        self.ticks += 1;
        if self.ticks < SWING_TICKS {
            return None;
        }
        self.ticks = 0;
        Some(SwingWindow {
            middle_rad: 0.5 * (self.lowest_rad + self.highest_rad),
            width_rad: self.highest_rad - self.lowest_rad,
        })
    }
}
