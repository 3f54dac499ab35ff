use crate::elementary::exp;
use crate::qube::limited_to;

/// The factor exp(-weight dV^2) on a step's reward for the change of voltage dV since the step
/// before.
///
/// The penalty is a factor rather than a cost: a swing-up, which earns nearly nothing, loses nearly
/// nothing by a voltage that jumps, and no step becomes worse than leaving the box.
#[derive(Clone, Copy, Debug)]
pub(super) struct SmoothnessFactor {
    /// Voltage of the previous step, V; 0 at the start of a trajectory, where the motor is off.
    last_v: f32,
    /// Largest voltage of the plant, V.
    largest_v: f32,
}

impl SmoothnessFactor {
    /// The state at the beginning of a trajectory of a plant with this largest voltage, V.
    pub fn limited_to(largest_v: f32) -> Self {
        Self { last_v: 0.0, largest_v }
    }

    /// Returns the factor of the next step of a trajectory, 0 to 1. `voltage_v` is the step's
    /// voltage, V, and `weight` is in 1/V^2.
    pub fn factor(&mut self, voltage_v: f32, weight: f32) -> f32 {
        let voltage_v = limited_to(voltage_v, self.largest_v);
        let change_v = voltage_v - self.last_v;
        self.last_v = voltage_v;
        exp(-weight * change_v * change_v)
    }
}
