use nalgebra::DVector;

use crate::search::{CmaEs, Observation, SearchError, Strategy as _};

/// Minimises a cost over a box by CMA-ES and returns the evaluated point of least cost. The number
/// of evaluations is rounded up to whole generations.
///
/// # Errors
/// The bounds form no box, a cost is not finite, or `evaluations` is 0.
pub fn minimise(
    lower: &[f64],
    upper: &[f64],
    evaluations: usize,
    seed: u64,
    cost: impl Fn(&DVector<f64>) -> f64,
) -> Result<DVector<f64>, SearchError> {
    let search = CmaEs::between(lower, upper, seed)?;
    let mut data: Vec<Observation> = Vec::with_capacity(evaluations);
    // Each call of `propose` recomputes the updates of all earlier generations from `data`, so the
    // loop requests a whole generation at a time.
    let generation = search.generation();
    while data.len() < evaluations {
        for point in search.propose(&data, &[], generation)? {
            let value = -cost(&DVector::from_column_slice(&point));
            data.push(Observation { point, returns: vec![value] });
        }
    }
    let best = search.recommend(&data)?;
    Ok(DVector::from_vec(best.point))
}
