use crate::qube::{QubeModel, State};

/// One Qube that the one at hand may be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Particle {
    /// Its parameters, nonidealities and delay.
    pub model: QubeModel,
    /// The share of a positive voltage that arrives, 0 to 1: a weak supply, an amplifier that is not the
    /// same on both sides.
    pub positive_share: f64,
    /// The share of a negative voltage that arrives, 0 to 1.
    pub negative_share: f64,
    /// True state minus estimated state: quantisation, filter lag, an offset of homing. The angles'
    /// errors stay, the velocities' pass.
    pub error: State,
}

impl Particle {
    /// This Qube, with a full supply and an estimate without errors.
    #[must_use]
    pub fn exact(model: QubeModel) -> Self {
        let error = State { theta: 0.0, alpha: 0.0, theta_dot: 0.0, alpha_dot: 0.0 };
        Self { model, positive_share: 1.0, negative_share: 1.0, error }
    }
}
