use crate::elementary::exp;
use crate::qube::limited_voltage;

/// What a step's reward is multiplied by for its change of the voltage dV: exp(-weight dV^2).
///
/// A factor and no cost: where nothing is earned, as in a swing-up, nothing is lost by a voltage that
/// jumps, and no step is worth less than leaving the box.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Calm {
    /// The voltage of the step before; 0 before a trajectory, as the motor then has none.
    last_v: f32,
}

impl Calm {
    /// The factor of the next step of a trajectory, above 0 to 1.
    pub fn factor(&mut self, voltage_v: f32, weight: f32) -> f32 {
        let voltage_v = limited_voltage(voltage_v);
        let change_v = voltage_v - self.last_v;
        self.last_v = voltage_v;
        exp(-weight * change_v * change_v)
    }
}
