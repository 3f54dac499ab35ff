use crate::qube::{QubeModel, State};

/// A possible Qube: one sample of a belief.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Particle {
    /// Parameters, nonidealities and delay.
    pub model: QubeModel,
    /// Fraction of a positive voltage that arrives, 0 to 1: a weak supply, or an amplifier that
    /// differs between the signs.
    pub positive_share: f64,
    /// Fraction of a negative voltage that arrives, 0 to 1.
    pub negative_share: f64,
    /// True state minus estimated state, from quantisation, filter lag and the error of homing. The
    /// errors of the angles persist, those of the velocities decay.
    pub error: State,
}

impl Particle {
    /// A particle with a full supply and without estimation errors.
    #[must_use]
    pub fn exact(model: QubeModel) -> Self {
        let error = State { theta: 0.0, alpha: 0.0, theta_dot: 0.0, alpha_dot: 0.0 };
        Self { model, positive_share: 1.0, negative_share: 1.0, error }
    }
}
