use super::{KalmanGains, ObserverSettings, SentVoltages};
use crate::elementary::Scalar;
use crate::qube::{Encoders, NonidealDynamics, State, runge_kutta_4};

/// Longest integration step, us: the error is 6e-6 rad at the worst speeds of a swing-up, 1/500 of
/// an encoder count.
const MAX_STEP_US: u64 = 5_000;

/// Longest interval between two samples that the observer predicts over, us. A rollout has ended
/// before the link is silent for so long.
const MAX_INTERVAL_US: u64 = 100_000;

/// Bound on every entry of a state, rad and rad/s, far beyond any motion of a Qube. A state with an
/// entry beyond the bound, or with one that is not a number, is discarded.
const DIVERGED: f64 = 1e4;

/// The observer's equations, for one Qube or for the simulated Qubes that vector instructions
/// compute side by side (lanes).
#[derive(Clone, Copy, Debug)]
pub struct ObserverEquations<T = f64> {
    dynamics: NonidealDynamics<T>,
    reset_error_rad: T,
}

impl<T: Scalar> ObserverEquations<T> {
    /// Equations with the model and the limit of these settings.
    #[must_use]
    pub fn new(settings: &ObserverSettings) -> Self {
        Self {
            dynamics: NonidealDynamics::new(&settings.model),
            reset_error_rad: T::from_f64(settings.reset_error_rad),
        }
    }

    /// The state one time step later under a voltage.
    #[inline(always)]
    pub fn predict(&self, state: State<T>, voltage_v: T, step_s: T) -> State<T> {
        runge_kutta_4(&self.dynamics, state, voltage_v, step_s)
    }

    /// Corrects a prediction by the measured angles, which `filtered` holds together with filtered
    /// velocities. Returns the state and whether the observer was reset: `filtered` replaces the
    /// prediction when the prediction error exceeds the limit or the corrected state is
    /// implausible.
    #[inline(always)]
    pub fn correct(
        &self,
        predicted: &State<T>,
        filtered: &State<T>,
        theta_gains: &KalmanGains<T>,
        alpha_gains: &KalmanGains<T>,
    ) -> (State<T>, bool) {
        let theta_off = filtered.theta - predicted.theta;
        let alpha_off = filtered.alpha - predicted.alpha;
        let corrected = State {
            theta: theta_gains.angle.mul_add(theta_off, predicted.theta),
            alpha: alpha_gains.angle.mul_add(alpha_off, predicted.alpha),
            theta_dot: theta_gains.velocity.mul_add(theta_off, predicted.theta_dot),
            alpha_dot: alpha_gains.velocity.mul_add(alpha_off, predicted.alpha_dot),
        };
        // A comparison with NaN is false and therefore resets.
        let near =
            (theta_off.abs() < self.reset_error_rad) & (alpha_off.abs() < self.reset_error_rad);
        let kept = near & is_plausible(&corrected);
        (choose(kept, &corrected, filtered), !kept)
    }

    /// The state that the policy sees: `ahead`, which is predicted for the instant at which the
    /// command acts, or `filtered` where the prediction is implausible.
    #[inline(always)]
    pub fn shown(ahead: &State<T>, filtered: &State<T>) -> State<T> {
        choose(is_plausible(ahead), ahead, filtered)
    }
}

/// Selects one of two states number by number: the compiler turns these selections into vector
/// code, but not a branch between states.
#[inline(always)]
fn choose<T: Scalar>(takes_first: bool, first: &State<T>, second: &State<T>) -> State<T> {
    State {
        theta: if takes_first { first.theta } else { second.theta },
        alpha: if takes_first { first.alpha } else { second.alpha },
        theta_dot: if takes_first { first.theta_dot } else { second.theta_dot },
        alpha_dot: if takes_first { first.alpha_dot } else { second.alpha_dot },
    }
}

#[inline(always)]
fn is_plausible<T: Scalar>(state: &State<T>) -> bool {
    let limit = T::from_f64(DIVERGED);
    (state.theta.abs() < limit)
        & (state.alpha.abs() < limit)
        & (state.theta_dot.abs() < limit)
        & (state.alpha_dot.abs() < limit)
}

/// Number of integration steps for a duration, and the length of each, s.
#[must_use]
pub fn prediction_steps(duration_us: u64) -> (u64, f64) {
    let steps = duration_us.div_ceil(MAX_STEP_US).max(1);
    (steps, duration_us as f64 * 1e-6 / steps as f64)
}

/// The observer of one Qube over the device's clock.
#[derive(Clone, Copy, Debug)]
pub(super) struct Observer {
    settings: ObserverSettings,
    encoders: Encoders,
    equations: ObserverEquations,
    sent: SentVoltages,
    /// State at the instant of the last sample.
    estimate: State,
    observer_resets: u32,
}

impl Observer {
    /// An observer of a Qube in the state `estimate`, whose motor has had 0 V so far.
    pub(super) fn new(settings: &ObserverSettings, encoders: Encoders, estimate: State) -> Self {
        Self {
            settings: *settings,
            encoders,
            equations: ObserverEquations::new(settings),
            sent: SentVoltages::new(settings.model.nonidealities.command_delay_s, 0.0),
            estimate,
            observer_resets: 0,
        }
    }

    /// Takes `filtered`, the guard's state at the sample of `now_us`; the sample before was at
    /// `before_us`. Returns the state at the instant at which the command being computed will act.
    pub(super) fn update(&mut self, before_us: u64, now_us: u64, filtered: &State) -> State {
        let elapsed_us = now_us - before_us;
        let (estimate, is_reset) = if elapsed_us <= MAX_INTERVAL_US {
            let elapsed_s = elapsed_us as f64 * 1e-6;
            let gains =
                |encoder, noise_rad_s2| KalmanGains::steady_state(encoder, noise_rad_s2, elapsed_s);
            self.equations.correct(
                &self.moved(before_us, now_us),
                filtered,
                &gains(self.encoders.theta, self.settings.theta_noise_rad_s2),
                &gains(self.encoders.alpha, self.settings.alpha_noise_rad_s2),
            )
        } else {
            (*filtered, true)
        };
        self.estimate = estimate;
        self.observer_resets = self.observer_resets.saturating_add(u32::from(is_reset));
        let ahead = self.moved(now_us, now_us.saturating_add(self.sent.delay_us()));
        ObserverEquations::shown(&ahead, filtered)
    }

    /// The estimate moved by the model from one instant to another.
    fn moved(&self, from_us: u64, until_us: u64) -> State {
        let mut state = self.estimate;
        for piece in self.sent.between(from_us, until_us) {
            let (steps, step_s) = prediction_steps(piece.duration_us);
            for _ in 0..steps {
                state = self.equations.predict(state, piece.voltage, step_s);
            }
        }
        state
    }

    /// Records the voltage that was sent in answer to the sample of this instant.
    pub(super) fn send(&mut self, sample_us: u64, voltage_v: f64) {
        self.sent.send(sample_us, voltage_v);
    }

    /// Shifts the pendulum's angle by a change of its zero.
    pub(super) fn shift_alpha(&mut self, by_rad: f64) {
        self.estimate.alpha += by_rad;
    }

    /// Number of times that the observer was reset, after a divergence or too long an interval.
    pub(super) fn observer_resets(&self) -> u32 {
        self.observer_resets
    }
}
