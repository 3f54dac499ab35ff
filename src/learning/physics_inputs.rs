use crate::qube::QubeModel;

/// The numbers that tell a policy which Qube it drives: inputs of its network beside the
/// observation.
#[derive(Clone, Copy)]
pub struct PhysicsInputs<'a> {
    /// Number of inputs, 1 to 16.
    pub count: usize,
    /// Computes the inputs of a Qube, `[count]`, each scaled to a magnitude of about 1.
    pub of: &'a (dyn Fn(&QubeModel) -> Vec<f32> + Sync),
}

impl PhysicsInputs<'_> {
    /// Writes the inputs of a lane's Qube to their rows, `[input][lanes]`.
    pub(super) fn write(&self, model: &QubeModel, lane: usize, lanes: usize, rows: &mut [f32]) {
        for (row, input) in rows.chunks_exact_mut(lanes).zip((self.of)(model)) {
            row[lane] = input;
        }
    }
}
