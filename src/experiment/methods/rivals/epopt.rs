use super::belief::RivalBelief;
use super::rival::{Data, Rival, RivalInput};
use super::tempering::{log_student, posterior_particles};
use super::transitions::{NOISE, Transition};
use crate::learning::{TrainError, TrainSettings};
use crate::replay::MotionLog;

/// Number of particles: points of the space of Qubes that together represent the belief.
const PARTICLES: usize = 400;

/// Largest number of transitions in the likelihood.
const TRANSITIONS: usize = 120;

/// Degrees of freedom of Student's t distribution in the likelihood.
const DEGREES: f64 = 4.0;

/// EPOpt (Rajeswaran et al. 2017, reference 18 of the thesis): trains on the worst simulated
/// trajectories, and weights simulated Qubes by the likelihood of the real transitions.
pub struct EpOpt {
    /// Share of an update's trajectories that the policy learns from in the second half of the
    /// updates: those with the lowest returns.
    pub worst_share: f32,
}

impl Rival for EpOpt {
    fn data(&self) -> Data {
        Data::Rollouts
    }

    fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
        let mut random = given.random();
        let logs: Vec<&MotionLog> = given.latest().iter().map(|it| &it.log).collect();
        let transitions = Transition::of_logs(&logs, TRANSITIONS);
        if transitions.is_empty() {
            return Ok(given.before.clone());
        }
        let log_likelihood = |point: &nalgebra::DVector<f64>| {
            let model = given.space.model(point);
            let of = |transition: &Transition| {
                let predicted = transition.predicted(&model);
                let errors = predicted.iter().zip(&transition.end).zip(NOISE);
                errors
                    .map(|((one, other), noise)| log_student((one - other) / noise, DEGREES))
                    .sum::<f64>()
            };
            transitions.iter().map(of).sum()
        };
        let particles = given.before.draws(given.space, PARTICLES, &mut random);
        Ok(RivalBelief::Points(posterior_particles(
            particles,
            log_likelihood,
            |draw| given.space.drawn_within(draw),
            &mut random,
        )))
    }

    fn shape_training(&self, training: &mut TrainSettings) {
        training.worst_share = self.worst_share;
    }
}
