use nalgebra::DVector;

use super::space::{Space, distribution_of};
use crate::learning::{TrainSettings, evaluate_on_new_starts};
use crate::policy::Network;
use crate::qube::MAX_STEPS;
use crate::simulation::Trajectory;

/// Points with the returns of a policy in their Qubes, as fractions of the largest possible return.
/// There are as many trajectories as points, and each draws its Qube among the points, so a point
/// may appear several times or not at all.
pub fn scored(
    network: &Network,
    settings: &TrainSettings,
    space: &Space,
    points: &[DVector<f64>],
    seed: u64,
) -> (Vec<DVector<f64>>, Vec<f64>) {
    let Some(distribution) = distribution_of(space, points) else { return Default::default() };
    let models: Vec<_> = points.iter().map(|point| space.model(point)).collect();
    let count = points.len();
    let evaluation =
        evaluate_on_new_starts(network, &distribution, &settings.simulation, seed, count);
    evaluation
        .returns
        .iter()
        .enumerate()
        .filter_map(|(number, policy_return)| {
            let drawn = Trajectory::draw(&distribution, seed, number as u64).model;
            let index = models.iter().position(|model| *model == drawn)?;
            Some((points[index].clone(), policy_return / MAX_STEPS as f64))
        })
        .unzip()
}
