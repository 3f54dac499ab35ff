use nalgebra::DVector;

use crate::search::{CmaEs, Observation, SearchError, Strategy as _};

/// The point of least cost in a box among those that CMA-ES evaluates: `evaluations`, rounded up to
/// whole generations.
///
/// # Errors
/// The box is empty, or a cost is not finite.
pub fn minimise(
    lower: &[f64],
    upper: &[f64],
    evaluations: usize,
    seed: u64,
    cost: impl Fn(&DVector<f64>) -> f64,
) -> Result<DVector<f64>, SearchError> {
    let mut search = CmaEs::between(lower, upper, seed)?;
    let mut data: Vec<Observation> = Vec::with_capacity(evaluations);
    // Each batch of proposals is a whole generation, because the search repeats all its updates for
    // each batch.
    let generation = search.generation();
    while data.len() < evaluations {
        for point in search.propose(&data, &[], generation)? {
            let value = -cost(&DVector::from_column_slice(&point));
            data.push(Observation { point, returns: vec![value] });
        }
    }
    let best = search.best(&data)?;
    Ok(DVector::from_vec(best.point))
}
