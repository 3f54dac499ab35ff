//! Collects evidence from a series of pushes, and decides when it suffices for a verdict.

use super::rest::Shift;
use super::swing_fit::{Lag, fit};
use crate::control::{AT_REST_COUNTS, ArmResponse, ProbeTrace, WEAK_A_V};
use crate::qube::{Encoder, Encoders};

/// Largest range of the count of a dead encoder, which may flicker, counts.
const DEAD_COUNTS: f64 = 2.0;

/// Deviation of the pendulum from its free swing that proves a motion of the arm, counts of a Qube,
/// or of a coarser encoder. The rounding of counts alone gives 0.3.
const DRIVEN_COUNTS: f64 = 2.0;

/// Least lag of a working pendulum encoder (the factor k of [`swing_fit`](super::swing_fit)). A
/// nominal pendulum lags behind the arm by k = 3 L_r / (2 L_p) = 0.99.
const ALIVE_LAG: f64 = 0.5;

/// Largest standard error of a lag that is evaluated.
const KNOWN_LAG: f64 = 0.15;

/// Least ratio of a working encoder's lag to the lag's standard error.
const SIGMAS: f64 = 5.0;

/// Largest lag of a dead pendulum encoder; two standard errors are added to the lag before it is
/// compared.
const DEAD_LAG: f64 = 0.3;

/// Current below which a Qube's motor counts as drawing no current, A. At 1 V a motor that is held
/// draws 0.1 A.
const NO_CURRENT_A: f64 = 0.02;

/// Push from which a missing current is a defect, V: below it, the amplifier's dead zone may
/// explain it.
const CURRENT_FROM_V: f64 = 1.0;

/// Least fall of the current during a push that proves a turning motor, as a share of the largest
/// current: about 1 rad/s at 0.25 V. The current of a motor that is held stays constant.
const TURNING_DROP: f64 = 0.15;

/// Least shift, from before some pushes to after them, that distinguishes an arm from a pendulum,
/// counts of a Qube, or of a coarser encoder: 0.03 rad. A free pendulum hangs at the same angle
/// before and after the pushes; the middle of its swing, which decays, lies up to five counts from
/// this angle.
const SHIFTED_COUNTS: f64 = 10.0;

/// Largest ratio of the arm's shift to the pendulum's with which the encoders count as exchanged:
/// the count of encoder 0, which should be the arm's, has then come back, as a pendulum's count
/// does. After a push from outside both may have shifted.
const CAME_BACK_SHARE: f64 = 0.5;

/// Number of pushes that must show a defect, because a hand may have disturbed one of them.
const DEFECT_SEEN: u32 = 2;

/// The verdict about the pendulum's encoder.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) enum Pendulum {
    #[default]
    Unknown,
    Alive(Lag),
    Dead,
    /// The pendulum's encoder counts the arm's motion, and the arm's encoder the pendulum's.
    /// `off_rad` is the change of the hanging angle by some pushes, rad.
    Exchanged {
        off_rad: f64,
    },
}

/// The effect of a push on the evidence.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PushEffect {
    /// The evidence suffices for a verdict.
    Enough,
    /// The push shows a defect while the pendulum's encoder is still in question, or the encoders
    /// may be exchanged, so it is repeated.
    SeeAgain,
    /// Something moved, but the evidence does not suffice.
    SomethingMoved,
    /// Nothing moved, so the next push may follow at once.
    NothingMoved,
}

/// The evidence from the pushes so far.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Evidence {
    /// Response of the arm to the motor by the arm's encoder; `None` if the arm has not moved far
    /// enough.
    pub(super) arm: Option<ArmResponse>,
    pub(super) pendulum: Pendulum,
    /// Largest push so far, V.
    pub(super) strongest_v: f64,
    /// Largest current of the largest push, A.
    pub(super) current_a: f64,
    /// Current that a motor with a good contact draws at least in the largest push, A.
    least_a: f64,
    /// True if a push showed more current than its voltage explains.
    pub(super) has_unexplained_current: bool,
    /// Largest share by which the current fell in a push that neither encoder showed; 0 if no such
    /// fall reached [`TURNING_DROP`].
    pub(super) current_drop: f64,
    /// Numbers of pushes that showed each defect.
    dead_arm_seen: u32,
    dead_pendulum_seen: u32,
    no_current_seen: u32,
    unseen_turns: u32,
    exchanged_seen: u32,
    /// True if the count of encoder 0, which should be the arm's, has come to rest where a push
    /// left it, as no pendulum's count does.
    arm_stayed: bool,
    /// True if an encoder has shown a motion.
    moved: bool,
}

impl Evidence {
    /// Adds one push, and returns its effect on the evidence.
    pub(super) fn add(&mut self, trace: &ProbeTrace) -> PushEffect {
        let samples = trace.samples();
        let width_counts = |angle: fn(&crate::control::ProbeSample) -> f64| {
            let (low, high) = samples
                .iter()
                .map(angle)
                .fold((f64::MAX, f64::MIN), |(low, high), rad| (low.min(rad), high.max(rad)));
            ((high - low) / trace.encoders().theta.rad_per_count()).max(0.0)
        };
        let arm_counts = width_counts(|sample| sample.theta_rad);
        let swing = fit(samples, AT_REST_COUNTS, trace.encoders());
        let finer = trace.encoders().alpha.counts_per_qube_count().max(1.0);
        let is_driven = swing.driven_counts >= DRIVEN_COUNTS * finer;
        let push_v = trace.push_v().abs();
        if push_v >= self.strongest_v {
            (self.strongest_v, self.current_a) = (push_v, trace.current_a());
            self.least_a = WEAK_A_V * trace.current_per_qube_current() * push_v;
        }
        self.has_unexplained_current |= trace.draws_unexplained_current();
        let arm_is_still = arm_counts < DEAD_COUNTS + 0.5;
        let anything = arm_counts > AT_REST_COUNTS + 0.5 || is_driven;
        self.moved |= anything;
        self.arm = self.arm.or_else(|| trace.arm_response());

        let mut shows_a_defect = false;
        if let Some(lag) = swing.lag {
            let size = lag.value.abs();
            let known = lag.standard_error <= KNOWN_LAG;
            if known && size >= ALIVE_LAG && size >= SIGMAS * lag.standard_error {
                self.pendulum = Pendulum::Alive(lag);
            } else if known && size + 2.0 * lag.standard_error <= DEAD_LAG {
                self.dead_pendulum_seen += 1;
                shows_a_defect = true;
            }
        }
        if arm_is_still && is_driven {
            self.dead_arm_seen += 1;
            shows_a_defect = true;
        }
        let no_current_a = NO_CURRENT_A * trace.current_per_qube_current();
        if !anything && push_v >= CURRENT_FROM_V && trace.current_a() < no_current_a {
            self.no_current_seen += 1;
        }
        if !anything && trace.current_drop() >= TURNING_DROP {
            self.unseen_turns += 1;
            self.current_drop = self.current_drop.max(trace.current_drop());
            shows_a_defect = true;
        }
        if self.dead_pendulum_seen >= DEFECT_SEEN && self.pendulum == Pendulum::Unknown {
            self.pendulum = Pendulum::Dead;
        }
        let all_known = self.arm.is_some() && self.pendulum != Pendulum::Unknown;
        if all_known || self.arm_is_dead() || !self.has_current() || self.turns_unseen() {
            PushEffect::Enough
        } else if shows_a_defect && self.pendulum == Pendulum::Unknown {
            PushEffect::SeeAgain
        } else if anything {
            PushEffect::SomethingMoved
        } else {
            PushEffect::NothingMoved
        }
    }

    /// Adds the shifts of arm and pendulum from before the last equal pushes to after them. Returns
    /// their effect if the encoders look exchanged.
    pub(super) fn add_shifts(
        &mut self,
        (arm, pendulum): (Shift, Shift),
        encoders: Encoders,
    ) -> Option<PushEffect> {
        let shifted_rad = |encoder: Encoder| {
            SHIFTED_COUNTS * encoder.counts_per_qube_count().max(1.0) * encoder.rad_per_count()
        };
        let (arm_rad, pendulum_rad) = (arm.by_rad.abs(), pendulum.by_rad.abs());
        self.arm_stayed |= arm_rad >= shifted_rad(encoders.theta).max(arm.width_rad);
        let came_back = arm_rad <= CAME_BACK_SHARE * pendulum_rad;
        if pendulum_rad < shifted_rad(encoders.alpha) || !came_back {
            return None;
        }
        self.exchanged_seen += 1;
        if self.exchanged_seen < DEFECT_SEEN {
            return Some(PushEffect::SeeAgain);
        }
        self.pendulum = Pendulum::Exchanged { off_rad: pendulum.by_rad };
        Some(PushEffect::Enough)
    }

    /// Returns whether the arm turned in the direction of the voltage, in the assumed signs; `None`
    /// if it has not turned far enough.
    pub(super) fn arm_follows(&self) -> Option<bool> {
        self.arm.map(|response| response.theta_rad * response.voltage_v > 0.0)
    }

    /// Returns whether the pendulum lagged behind the arm, in the assumed signs; `None` if its
    /// encoder is not known to work.
    pub(super) fn pendulum_lags(&self) -> Option<bool> {
        match self.pendulum {
            Pendulum::Alive(lag) => Some(lag.value > 0.0),
            Pendulum::Dead | Pendulum::Exchanged { .. } | Pendulum::Unknown => None,
        }
    }

    /// Returns whether the count of encoder 0, which should be the arm's, has come to rest where a
    /// push left it. Until then the encoders may be exchanged.
    pub(super) fn arm_stayed(&self) -> bool {
        self.arm_stayed
    }

    /// Returns whether the arm's count stayed the same in [`DEFECT_SEEN`] pushes that swung the
    /// pendulum, and no push showed a response of the arm.
    pub(super) fn arm_is_dead(&self) -> bool {
        self.dead_arm_seen >= DEFECT_SEEN && self.arm.is_none()
    }

    /// Returns whether the motor's current showed in [`DEFECT_SEEN`] pushes that the motor turns,
    /// and no encoder has ever shown a motion.
    pub(super) fn turns_unseen(&self) -> bool {
        self.unseen_turns >= DEFECT_SEEN && !self.moved
    }

    /// Returns whether the motor draws current; false once [`DEFECT_SEEN`] pushes from
    /// [`CURRENT_FROM_V`] on have moved nothing and drawn no current.
    pub(super) fn has_current(&self) -> bool {
        self.no_current_seen < DEFECT_SEEN
    }

    /// Returns whether nothing moves although the strongest push had at least [`CURRENT_FROM_V`],
    /// and the motor drew far less current in it than a motor at rest should draw.
    pub(super) fn is_weak(&self) -> bool {
        !self.something_moved()
            && self.strongest_v >= CURRENT_FROM_V
            && self.current_a < self.least_a
    }

    /// Returns whether an encoder or the motor's current showed a motion.
    pub(super) fn something_moved(&self) -> bool {
        self.moved || self.turns_unseen()
    }
}
