use std::io::ErrorKind;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::folder::{PolicyFolders, make};
use super::rollouts::{PolicyOfFolder, Record, Repeated, RolloutFolder};
use super::{ExperimentError, Made, Plant, Recipe, RolloutResult};
use crate::jobs::{CHOSEN_OF_STARTS, Competition, Executor, TrainingJob, TrainingScore};
use crate::learning::{TrainSettings, TrainUpdate, Trained, curve_csv, evaluate_on_new_starts};
use crate::policy::{Network, Policy, PolicyError, PolicyFault};
use crate::rig::{NotBegun, Rig, RigError, RigSettings, RolloutPlan};
use crate::session::{EmulatedQubeSettings, SeedFor, SessionError, derived_seed};
use crate::simulation::{DomainDistribution, Psi, PsiError, SimulationSettings};
use crate::storage::{MachineDisk, write_whole};
use crate::telemetry::Ending;

/// The policies of one recipe and one psi: each is trained with its own seed and run on plants.
/// Work that is complete on disk is not repeated.
pub(super) struct PolicySeries<'a> {
    /// Name of the experiment.
    pub experiment: &'a str,
    /// Recipe of the policies.
    pub recipe: &'a Recipe,
    /// Psi of a searched model; `None` for others.
    pub psi: Option<&'a Psi>,
    /// Distribution of the simulations that replaces the recipe's, if any.
    pub distribution: Option<&'a DomainDistribution>,
    /// Seed from which every random number follows, together with the policy's number.
    pub seed: u64,
    /// Number of competing trainings of a policy in a round; the best in simulation is kept.
    pub trainings: u32,
    /// Folders of the policies and their recordings.
    pub folders: PolicyFolders,
    /// Settings of the rig.
    pub rig: &'a RigSettings,
    /// Flag that requests a stop.
    pub stop: &'a Arc<AtomicBool>,
    /// Executor of the trainings.
    pub executor: Arc<dyn Executor>,
}

/// The simulations, new to all competing trainings of a policy, in which they are scored.
pub(super) struct FreshSimulations {
    /// Distribution of the simulations.
    pub distribution: DomainDistribution,
    /// Settings of the simulations besides the distribution.
    pub simulation: SimulationSettings,
    /// Seed of the simulated Qubes and starts.
    pub seed: u64,
    /// Number of the starts.
    pub starts: usize,
}

impl FreshSimulations {
    /// The score of a policy.
    pub fn score(&self, network: &Network) -> TrainingScore {
        let Self { distribution, simulation, seed, starts } = self;
        let simulated = evaluate_on_new_starts(network, distribution, simulation, *seed, *starts);
        TrainingScore::of(&simulated)
    }
}

/// The rollouts of a policy on a plant.
pub(super) struct Ran {
    /// Results of the rollouts, in order.
    pub results: Vec<RolloutResult>,
    /// Time of the last training or rollout for the results.
    pub made: Made,
}

impl PolicySeries<'_> {
    /// Trains a policy and returns its best return in training, or `None` if the policy is on disk.
    /// `watch` gets the number of the training and each of its updates.
    ///
    /// # Errors
    /// The training fails, the policy cannot be stored, or its existing file cannot be read or is
    /// of another version.
    pub fn train(
        &self,
        policy: u32,
        watch: &mut dyn FnMut(u32, &TrainUpdate),
    ) -> Result<Option<f64>, ExperimentError> {
        let paths = self.folders.policy(policy);
        let path = paths.policy();
        // A policy that is missing or damaged is trained again, with the same seed. A file that
        // another version wrote, or that the disk fails to read, is not replaced.
        match Policy::load(&path) {
            Ok(_) => return Ok(None),
            Err(PolicyError::Unreadable { source, .. }) if source.kind() == ErrorKind::NotFound => {
            }
            Err(PolicyError::Bad { fault: PolicyFault::NotSafetensors { .. }, .. }) => {
                tracing::warn!("{}: the policy is damaged and is trained again", path.display());
            }
            Err(error) => return Err(SessionError::from(error).into()),
        }
        // The folder is made before the training: if it cannot be made, no training is lost.
        make(paths.folder())?;
        let trained = self.best_of_trainings(policy, watch)?;
        let best_return = trained.best_return;
        self.keep(policy, trained)?;
        Ok(Some(best_return))
    }

    /// Stores a policy that was trained for this series.
    ///
    /// # Errors
    /// The policy cannot be stored.
    pub fn keep(&self, policy: u32, trained: Trained) -> Result<(), ExperimentError> {
        let paths = self.folders.policy(policy);
        make(paths.folder())?;
        let curve = curve_csv(&trained.curve);
        write_whole(&MachineDisk, &paths.curve(), curve.as_bytes())?;
        let mut origin = self.recipe.origin(self.psi);
        // The recipe's model did not draw these simulations, so the origin names the recipe.
        if self.distribution.is_some() {
            origin.model.clone_from(&self.recipe.name);
        }
        let file = trained.into_policy(origin).to_bytes();
        write_whole(&MachineDisk, &paths.policy(), &file)?;
        Ok(())
    }

    /// The distribution in which policies are trained and evaluated.
    ///
    /// # Errors
    /// The errors of [`Recipe::distribution`].
    pub fn distribution(&self) -> Result<DomainDistribution, PsiError> {
        match self.distribution {
            Some(distribution) => Ok(distribution.clone()),
            None => self.recipe.distribution(self.psi),
        }
    }

    /// The simulation settings besides the distribution ([`Recipe::simulation`]).
    pub fn simulation(&self) -> SimulationSettings {
        self.recipe.simulation(self.psi)
    }

    /// The best of a policy's competing trainings by the executor.
    fn best_of_trainings(
        &self,
        policy: u32,
        watch: &mut dyn FnMut(u32, &TrainUpdate),
    ) -> Result<Trained, ExperimentError> {
        let (distribution, simulation) = (self.distribution()?, self.simulation());
        let settings =
            TrainSettings { threads: 1, simulation, ..self.recipe.settings.training.clone() };
        let train = |training| {
            let seed = derived_seed(self.seed, SeedFor::Training { candidate: policy, training });
            let (distribution, settings) = (distribution.clone(), settings.clone());
            let job = TrainingJob { distribution, settings, seed };
            let mut watch = |update: &TrainUpdate| watch(training, update);
            Ok(self.executor.train_one(&job, self.stop, &mut watch)?)
        };
        self.best_of(policy, train, |trained, fresh| fresh.score(&trained.network))
    }

    /// The best of a policy's competing trainings ([`Competition`]), one after the other. `train`
    /// carries out the training with a number, from 0; `score` scores its result in fresh
    /// simulations.
    ///
    /// # Errors
    /// A training fails, or the errors of [`Recipe::distribution`].
    pub fn best_of<T>(
        &self,
        policy: u32,
        mut train: impl FnMut(u32) -> Result<T, ExperimentError>,
        score: impl Fn(&T, &FreshSimulations) -> TrainingScore,
    ) -> Result<T, ExperimentError> {
        let fresh = FreshSimulations {
            distribution: self.distribution()?,
            simulation: self.simulation(),
            seed: derived_seed(self.seed, SeedFor::Evaluation { candidate: policy }),
            starts: CHOSEN_OF_STARTS,
        };
        let mut competition = Competition::new(self.trainings);
        loop {
            for training in competition.round() {
                let trained = train(training)?;
                let score = if competition.is_contested() {
                    score(&trained, &fresh)
                } else {
                    TrainingScore::UNCONTESTED
                };
                competition.enter(training, score, trained);
            }
            if let Some(best) = competition.take_winner() {
                return Ok(best);
            }
        }
    }

    /// Runs a policy on an emulated plant. The emulated Qube of each attempt at a rollout follows
    /// from the plant, the seed and the numbers of policy, rollout and attempt alone, so that a
    /// resumed experiment repeats byte for byte, whichever thread continues it.
    ///
    /// # Errors
    /// The work ends early.
    pub fn run_in_virtual_time(
        &self,
        policy: u32,
        plant: &Plant,
        rollouts: u32,
    ) -> Result<Ran, ExperimentError> {
        let emulated = plant.for_policy(self.seed, policy, 0);
        let rig = RigSettings { homing: self.recipe.settings.homing, ..self.rig.clone() };
        self.run(policy, plant, rollouts, |rollout, attempt, record| {
            let purpose = SeedFor::Emulator { candidate: policy, rollout, attempt };
            let seed = derived_seed(self.seed, purpose);
            record(&virtual_rig(&rig, &emulated, seed, self.stop)?).map(drop)
        })
    }

    /// Runs a policy on one Qube, one rollout after the other; the rig is opened on its first use.
    ///
    /// # Errors
    /// The work ends early.
    pub fn run_on_device(
        &self,
        rig: &mut Option<Rig>,
        policy: u32,
        plant: &Plant,
        rollouts: u32,
    ) -> Result<Ran, ExperimentError> {
        let settings = RigSettings { homing: self.recipe.settings.homing, ..self.rig.clone() };
        let mut not_begun = NotBegun::default();
        self.run(policy, plant, rollouts, |_, _, record| {
            let opened = match rig.take() {
                Some(opened) => opened,
                None => Rig::open(&settings, self.stop)?,
            };
            let opened = rig.insert(opened);
            match record(opened) {
                // A rollout that could not begin is due again.
                Err(ExperimentError::Session(SessionError::Rig(ref error)))
                    if not_begun.may_repeat(error) =>
                {
                    opened.start_again()?;
                }
                Ok(Ending::Fault(_)) => {
                    not_begun.reset();
                    opened.start_again()?;
                }
                Ok(_) => {
                    not_begun.reset();
                    opened.check_off()?;
                }
                Err(error) => {
                    // A stop must not hide a motor that nobody has confirmed to be off.
                    if error.is_stop() {
                        opened.check_off()?;
                    }
                    return Err(error);
                }
            }
            Ok(())
        })
    }

    fn run(
        &self,
        policy: u32,
        plant: &Plant,
        rollouts: u32,
        mut with_rig: impl FnMut(u32, u32, &mut Record<'_>) -> Result<(), ExperimentError>,
    ) -> Result<Ran, ExperimentError> {
        let file = Policy::load(&self.folders.policy(policy).policy())?.to_bytes();
        let folder = self.rollouts(policy, plant);
        let mut made = Made::Earlier;
        let results: Result<_, ExperimentError> = (0..rollouts)
            .map(|rollout| {
                let repeated = Repeated {
                    folder: &folder,
                    plan: self.plan(policy, rollout),
                    policy: &file,
                    repetitions: self.recipe.settings.extent.repetitions,
                    stop: self.stop,
                };
                repeated.perform(|attempt, record| {
                    made = Made::Now;
                    with_rig(rollout, attempt, record)
                })
            })
            .collect();
        Ok(Ran { results: results?, made })
    }

    /// The folder of a policy's rollouts on a plant.
    pub fn rollouts(&self, policy: u32, plant: &Plant) -> RolloutFolder {
        let folder = rollouts_of(self.recipe, &self.folders, policy, plant);
        RolloutFolder { seed: Some(self.seed), ..folder }
    }

    fn plan(&self, policy: u32, rollout: u32) -> RolloutPlan {
        let settings = &self.recipe.settings;
        RolloutPlan {
            session: self.experiment.to_owned(),
            candidate: Some(policy),
            rollout,
            attempt: 0,
            psi: self.psi.map(Psi::named_values).unwrap_or_default(),
            seed: self.seed,
            policy: policy_name(self.recipe, policy),
            estimator: settings.estimator,
            safety_box: settings.safety_box,
            steps: settings.extent.steps,
        }
    }
}

/// The name of a recipe's policy in its recordings.
fn policy_name(recipe: &Recipe, policy: u32) -> String {
    format!("{} {policy}", recipe.name)
}

/// The folder of a policy's rollouts on a plant.
pub(super) fn rollouts_of(
    recipe: &Recipe,
    folders: &PolicyFolders,
    policy: u32,
    plant: &Plant,
) -> RolloutFolder {
    RolloutFolder {
        path: folders.rollouts(policy, &plant.name),
        policy: Some(PolicyOfFolder { number: policy, name: policy_name(recipe, policy) }),
        seed: None,
    }
}

/// Opens a rig with an emulated Qube of this seed and homes it.
pub(super) fn virtual_rig(
    rig: &RigSettings,
    emulated: &EmulatedQubeSettings,
    seed: u64,
    stop: &Arc<AtomicBool>,
) -> Result<Rig, RigError> {
    let emulator = emulated.emulator(seed).of_plant(&rig.plant);
    Rig::open(&RigSettings { emulator, ..rig.clone() }, stop)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::LocalExecutor;
    use crate::rig::DeviceChoice;
    use crate::session::SessionSettings;
    use crate::simulation::Model;

    #[test]
    fn the_best_of_a_policys_trainings_in_fresh_simulations_is_kept() {
        let recipe = Recipe::of(Model::Nominal, &SessionSettings::thesis());
        let best_of = |trainings: u32, scores: &[f64]| {
            let series = PolicySeries {
                experiment: "table",
                recipe: &recipe,
                psi: None,
                distribution: None,
                seed: 7,
                trainings,
                folders: PolicyFolders::of_recommendation("none".as_ref(), 0),
                rig: &RigSettings::in_virtual_time(DeviceChoice::Emulated),
                stop: &Arc::default(),
                executor: Arc::new(LocalExecutor::on_cores(1)),
            };
            let mut carried_out = 0;
            let train = |training| {
                assert_eq!(training, carried_out);
                carried_out += 1;
                Ok(training)
            };
            let score = |training: &u32, _: &FreshSimulations| {
                let score = scores[*training as usize];
                TrainingScore { scored: score, compared: score }
            };
            let best = series.best_of(0, train, score).unwrap();
            (best, carried_out)
        };
        // A single training is kept without a score.
        assert_eq!(best_of(1, &[]), (0, 1));
        assert_eq!(best_of(2, &[400.0, 500.0]), (1, 2));
        assert_eq!(best_of(2, &[10.0, 20.0, 450.0, 30.0]), (2, 4));
    }
}
