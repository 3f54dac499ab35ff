use crate::qube::{QubeModel, State};

/// A possible Qube: one sample of a belief.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Particle {
    /// Parameters, nonidealities and delay.
    pub model: QubeModel,
    /// Fraction of a positive voltage that arrives at the motor, 0 to 1; below 1 with a weak
    /// supply, or with an amplifier that differs between the signs.
    pub positive_share: f64,
    /// Fraction of a negative voltage that arrives at the motor, 0 to 1.
    pub negative_share: f64,
    /// True state minus estimated state, from quantisation and the error of homing; foresight
    /// computes the filter's lag itself. The errors of the angles persist, and the errors of the
    /// velocities decay.
    pub error: State,
}

impl Particle {
    /// A particle with a full supply and without estimation errors.
    #[must_use]
    pub fn exact(model: QubeModel) -> Self {
        Self { model, positive_share: 1.0, negative_share: 1.0, error: State::default() }
    }
}
