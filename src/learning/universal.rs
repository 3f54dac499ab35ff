use std::sync::atomic::AtomicBool;

use super::actor::NetworkActor;
use super::curve::TrainUpdate;
use super::export::exported;
use super::network::{MAX_PHYSICS_INPUTS, Network};
use super::physics_inputs::PhysicsInputs;
use super::state::TrainingState;
use super::train::perform;
use super::{TrainError, TrainSettings, Trained};
use crate::simulation::{DomainDistribution, Evaluation, SimulationSettings, evaluate};

/// A universal policy: its network has the physics of the Qube as inputs beside the observation
/// (Yu, Liu and Turk 2019, "Policy Transfer with Strategy Optimization").
///
/// With fixed physics inputs it becomes an ordinary policy ([`Self::at`]), because a constant input
/// only shifts the biases of the first layer.
#[derive(Clone, Debug)]
pub struct UniversalPolicy {
    best: Box<Network>,
    last: Box<Network>,
    observation_size: usize,
    /// The result of the training, with all physics inputs 0.
    at_zero: Trained,
}

/// Trains a universal policy by PPO like [`super::train()`], in simulations drawn from
/// `distribution`: policy and value network are given the physics inputs of the simulated Qube.
///
/// # Errors
/// A setting, the distribution or the number of physics inputs is out of range; `stop` was set; or
/// the first update diverged.
pub fn train_universal(
    distribution: &DomainDistribution,
    settings: &TrainSettings,
    physics: PhysicsInputs<'_>,
    seed: u64,
    stop: &AtomicBool,
    on_update: impl FnMut(&TrainUpdate),
) -> Result<UniversalPolicy, TrainError> {
    settings.check()?;
    distribution.check()?;
    if !(1..=MAX_PHYSICS_INPUTS).contains(&physics.count) {
        let (name, value) = ("physics inputs", physics.count.to_string());
        return Err(TrainError::Setting { name, value, bound: "1 to 16" });
    }
    let mut training = TrainingState::new(distribution, settings, Some(physics), seed);
    perform(&mut training, None, stop, on_update)?;
    let observation_size = settings.simulation.observation_size();
    let (best, last) = (training.best.clone(), training.policy.network.clone());
    training.best = at_fixed(&best, observation_size, &[]);
    training.policy.network = at_fixed(&last, observation_size, &[]);
    let at_zero = training.trained()?;
    Ok(UniversalPolicy { best: Box::new(best), last: Box::new(last), observation_size, at_zero })
}

impl UniversalPolicy {
    /// Mean return of the best network in its evaluation during training, with the physics inputs
    /// of each simulated Qube.
    #[must_use]
    pub fn best_return(&self) -> f64 {
        self.at_zero.best_return
    }

    /// Evaluates the policy from `starts` starts that its training has not seen, with the physics
    /// inputs of each simulated Qube.
    ///
    /// # Panics
    /// Panics as [`evaluate`] does, and if the number of inputs or the length of the observation
    /// differs from the training's.
    #[must_use]
    pub fn evaluate_on_new_starts(
        &self,
        physics: PhysicsInputs<'_>,
        distribution: &DomainDistribution,
        simulation: &SimulationSettings,
        seed: u64,
        starts: usize,
    ) -> Evaluation {
        let mut actor =
            NetworkActor::on_starts(&self.best, Some(physics), distribution, seed, starts);
        evaluate(&mut actor, distribution, simulation, seed, starts)
    }

    /// The ordinary policy at these physics inputs: `[count]`, in the order of
    /// [`PhysicsInputs::of`]. Missing inputs count as 0, and inputs beyond `count` are ignored. Its
    /// returns and its curve come from the training, in which the network had the inputs of each
    /// simulated Qube.
    ///
    /// # Errors
    /// The inputs make a bias infinite or NaN.
    pub fn at(&self, physics: &[f32]) -> Result<Trained, TrainError> {
        let at = |network: &Network| exported(&at_fixed(network, self.observation_size, physics));
        Ok(Trained {
            network: at(&self.best)?,
            final_network: at(&self.last)?,
            ..self.at_zero.clone()
        })
    }
}

/// Returns a network without physics inputs that gives the outputs of `network` at these physics
/// inputs; missing inputs count as 0.
fn at_fixed(network: &Network, observation_size: usize, physics: &[f32]) -> Network {
    let mut fixed = network.clone();
    fixed.observation_size = observation_size;
    fixed.first[observation_size..].as_flattened_mut().fill(0.0);
    let physics_weights = &network.first[observation_size..network.constant()];
    let bias = &mut fixed.first[observation_size];
    *bias = network.first[network.constant()];
    for (weights, input) in physics_weights.iter().zip(physics) {
        for (bias, weight) in bias.iter_mut().zip(weights) {
            *bias += weight * input;
        }
    }
    fixed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::actor::outputs;
    use crate::learning::evaluation::EVALUATION_SEED;
    use crate::learning::random::Stream;
    use crate::learning::tests::small;
    use crate::qube::{DomainParameter, QubeModel};

    const OBSERVATION: [f32; 8] = [0.5, -0.3, 0.9, 0.1, -0.7, 0.4, 0.2, -0.9];
    const PHYSICS: [f32; 14] =
        [1.0, -0.6, 0.3, 0.2, -1.1, 0.4, 0.8, -0.2, 0.7, 0.1, -0.5, 1.3, 0.6, -0.9];

    fn output(network: &Network, inputs: &[f32]) -> f32 {
        let lanes: Vec<f32> = inputs.iter().flat_map(|&input| [input; 16]).collect();
        let mut output = [0.0; 16];
        outputs(network, &lanes, &mut output);
        output[3]
    }

    #[test]
    fn fixed_inputs_become_biases_of_an_ordinary_policy() {
        for count in [1, 2, 14] {
            let size = OBSERVATION.len() + count;
            let network = Network::orthogonal(size, &mut Stream::Weights.generator(4), 1.0, -0.5);
            let physics = &PHYSICS[..count];
            let fixed = at_fixed(&network, OBSERVATION.len(), physics);
            let with_physics = output(&network, &[&OBSERVATION[..], physics].concat());
            assert!((output(&fixed, &OBSERVATION) - with_physics).abs() < 1e-5);
            let mut deployed = exported(&fixed).unwrap();
            assert_eq!(deployed.sizes(), [8, 64, 64, 1]);
            let voltage_v = deployed.voltage_of_observation_v(&OBSERVATION);
            assert!((voltage_v - 5.0 * with_physics).abs() < 1e-4);
            let without_physics = at_fixed(&network, OBSERVATION.len(), &[]);
            assert!(
                (output(&without_physics, &OBSERVATION) - with_physics).abs() > 1e-3,
                "the physics inputs do not change the output"
            );
        }
    }

    /// Two Qubes that differ in the mass of the pendulum.
    fn two_qubes() -> DomainDistribution {
        let [mut light, mut heavy] = [QubeModel::NOMINAL; 2];
        let mass = crate::qube::Quantity::Parameter(DomainParameter::PendulumMass);
        light.set(mass, 0.6 * light.get(mass));
        heavy.set(mass, 1.4 * heavy.get(mass));
        DomainDistribution::of_specimens(vec![light, heavy]).unwrap()
    }

    /// The pendulum's mass as a deviation from the nominal one, relative to it.
    fn mass_of(model: &QubeModel) -> f32 {
        let mass = crate::qube::Quantity::Parameter(DomainParameter::PendulumMass);
        (model.get(mass) / QubeModel::NOMINAL.get(mass) - 1.0) as f32
    }

    fn settings(threads: usize) -> TrainSettings {
        TrainSettings { threads, simulation: SimulationSettings::robust(), ..small() }
    }

    fn trained(threads: usize, count: usize) -> Result<UniversalPolicy, TrainError> {
        let settings = settings(threads);
        let physics = PhysicsInputs { count, of: &|model| vec![mass_of(model); count] };
        let never = AtomicBool::new(false);
        train_universal(&two_qubes(), &settings, physics, 5, &never, |_| ())
    }

    #[test]
    fn a_universal_policy_depends_on_the_qube_and_not_on_the_number_of_threads() {
        // One input fits beside the observation of a transition, 14 do not.
        for count in [1, 14] {
            let (one, two) = (trained(1, count).unwrap(), trained(2, count).unwrap());
            let of = |policy: &UniversalPolicy, input: f32| {
                policy.at(&vec![input; count]).unwrap().network
            };
            assert_eq!(of(&one, 0.4), of(&two, 0.4));
            assert_ne!(of(&one, 0.4), of(&one, -0.4));
            assert_eq!(one.at(&[]).unwrap(), one.at_zero);
            assert!(one.best_return().is_finite());
        }
    }

    #[test]
    fn an_evaluation_gives_the_policy_the_inputs_of_each_qube_as_its_training_does() {
        let policy = trained(1, 1).unwrap();
        let TrainSettings { simulation, evaluation_starts, .. } = settings(1);
        let mean_return = |of: &(dyn Fn(&QubeModel) -> Vec<f32> + Sync)| {
            let (physics, starts) = (PhysicsInputs { count: 1, of }, evaluation_starts.into());
            let qubes = two_qubes();
            policy
                .evaluate_on_new_starts(physics, &qubes, &simulation, EVALUATION_SEED, starts)
                .mean_return()
        };
        assert_eq!(mean_return(&|model| vec![mass_of(model)]), policy.best_return());
        assert_ne!(mean_return(&|_| vec![3.0]), policy.best_return());
    }

    #[test]
    fn a_policy_is_told_at_least_one_number_and_at_most_sixteen() {
        for count in [0, MAX_PHYSICS_INPUTS + 1] {
            let message = trained(1, count).unwrap_err().to_string();
            assert!(message.contains("physics inputs") && message.contains("1 to 16"), "{message}");
        }
    }
}
