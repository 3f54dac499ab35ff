use super::belief::RivalBelief;
use super::kind::RivalKind;
use super::rival::{Data, Draws, POINTS, Rival, RivalInput, random};
use super::simulator::Demonstration;
use super::space::{Space, distribution_of};
use crate::experiment::methods::MethodSettings;
use crate::experiment::methods::recordings::{MethodRecordings, Recorded, excitation, read};
use crate::experiment::methods::run::{
    MethodRun, OnDisk, Recommendation, Recommendations, Recommended,
};
use crate::experiment::series::FreshSimulations;
use crate::experiment::{ExperimentError, Recipe};
use crate::jobs::{JobError, TrainingScore};
use crate::learning::Trained;
use crate::policy::Policy;
use crate::recording;
use crate::replay::{MotionLog, MotionLogError};
use crate::session::{FolderError, SeedFor, derived_seed};
use crate::storage::{Disk, MachineDisk, write_whole};

/// Numbers of recordings after which a rival that learns from rollouts trains a policy for further
/// recordings. One policy makes all recordings between two of these numbers, so that twenty real
/// rollouts and the recommendation after them need six trainings.
const ROUNDS: [u32; 6] = [0, 1, 2, 5, 10, 20];

/// The recommendations of a rival: after each number of recordings, the distribution of simulations
/// that the rival has learnt from them. A rival that has learnt nothing, as before the first
/// recording, recommends the distribution `robust`.
pub struct FromRival<'a> {
    run: &'a MethodRun<'a>,
    settings: &'a MethodSettings,
    kind: RivalKind,
    rival: Box<dyn Rival>,
    recordings: MethodRecordings<'a>,
    space: Space,
}

impl<'a> FromRival<'a> {
    /// Recommendations in the folder of a method's run.
    pub fn new(run: &'a MethodRun<'a>, settings: &'a MethodSettings, kind: RivalKind) -> Self {
        let recordings = MethodRecordings::of(run);
        let space = Space::of_unknown(run.recipe.settings.plant());
        let rival = kind.rival(&settings.rivals);
        Self { run, settings, kind, rival, recordings, space }
    }

    /// Seed of the belief and the recommendation after `recordings` recordings.
    fn seed(&self, recordings: u32) -> u64 {
        // A separate seed, because scoring uses the run's own.
        let seed = derived_seed(self.run.seed, SeedFor::ExperimentPart);
        derived_seed(seed, SeedFor::Belief { recordings })
    }

    /// The recipe of the trainings.
    fn recipe(&self) -> Recipe {
        let mut recipe = self.run.without_identification().recipe;
        self.kind.name().clone_into(&mut recipe.name);
        self.rival.shape_training(&mut recipe.settings.training);
        recipe
    }

    /// The recommendation of a belief after `recordings` recordings.
    fn recommendation(&self, belief: &RivalBelief, recordings: u32) -> Recommendation {
        let mut random = random(self.seed(recordings), Draws::Points);
        let distribution = match belief {
            RivalBelief::Unknown => None,
            known => distribution_of(&self.space, &known.draws(&self.space, POINTS, &mut random)),
        };
        Recommendation { distribution, ..Recommendation::of(self.recipe(), None) }
    }

    /// Makes the recording with this number if it does not exist.
    fn record(&self, number: u32) -> Result<(), ExperimentError> {
        if self.rival.data() == Data::Excitations {
            let chirp = excitation(number, None, self.run.recipe.settings.plant());
            let kind = Recorded::Excitation(chirp.shape());
            return self.recordings.make(number, kind, &Policy::Excitation(chirp).to_bytes());
        }
        let after = round_within(number);
        let OnDisk::Found(belief) = self.belief(after)? else { return Ok(()) };
        let recommendation = self.recommendation(&belief, after);
        let series = self.run.series(&recommendation, after, self.settings.trainings);
        series.train(0, &mut |_, _| ())?;
        let policy = Policy::load(&series.folders.policy(0).policy())?.to_bytes();
        self.recordings.make(number, Recorded::Policy { after }, &policy)
    }

    /// The first `recordings` recordings. A recording is left out if it is void or has fewer than
    /// two samples from the time in which the policy or excitation drove the motor.
    fn demonstrations(&self, recordings: u32) -> Result<Vec<Demonstration>, ExperimentError> {
        let mut demonstrations = Vec::new();
        for number in 0..recordings {
            let Some(path) = self.recordings.path(number)? else { continue };
            let log = match MotionLog::read(&path) {
                Ok(log) => log,
                Err(MotionLogError::Recording(error)) => return Err(error.into()),
                Err(MotionLogError::Read { path, source }) => {
                    return Err(FolderError::Io { path, source }.into());
                }
                Err(MotionLogError::NeverRan { .. } | MotionLogError::Csv { .. }) => continue,
            };
            // An excitation has no network.
            let policy = match Policy::from_bytes(&recording::read(&path)?.policy) {
                Ok(Policy::Network(policy)) => Some(policy.network),
                _ => None,
            };
            demonstrations.push(Demonstration { log, policy });
        }
        Ok(demonstrations)
    }

    /// The belief after `recordings` recordings, all of which exist. The belief is stored on disk.
    fn belief(&self, recordings: u32) -> Result<OnDisk<RivalBelief>, ExperimentError> {
        if recordings == 0 && self.rival.data() != Data::None {
            return Ok(OnDisk::Found(RivalBelief::Unknown));
        }
        let path = self.run.folder.join(format!("belief-{recordings}.json"));
        if MachineDisk.exists(&path) {
            return RivalBelief::of_file(&read(&path)?)
                .and_then(|belief| belief.within(&self.space))
                .map(OnDisk::Found)
                .map_err(|reason| ExperimentError::damaged_result(path, &reason));
        }
        if !self.run.access.works() {
            return Ok(OnDisk::Missing);
        }
        let belief = self.learnt(recordings)?;
        let text = belief.to_file().map_err(|error| ExperimentError::Settings {
            path: path.clone(),
            reason: error.to_string(),
        })?;
        write_whole(&MachineDisk, &path, text.as_bytes())?;
        Ok(OnDisk::Found(belief))
    }

    /// Learns from the first `recordings` recordings. The update starts from the belief after the
    /// largest number of [`ROUNDS`] below `recordings`.
    fn learnt(&self, recordings: u32) -> Result<RivalBelief, ExperimentError> {
        let earlier = recordings.checked_sub(1).map_or(0, round_within);
        let before = match recordings {
            0 => RivalBelief::Unknown,
            _ => match self.belief(earlier)? {
                OnDisk::Found(belief) => belief,
                OnDisk::Missing => RivalBelief::Unknown,
            },
        };
        let recorded = self.demonstrations(recordings)?;
        let recipe = self.recipe();
        let given = RivalInput {
            space: &self.space,
            before: &before,
            first_latest: self.demonstrations(earlier)?.len(),
            recorded: &recorded,
            simulation: &recipe.simulation(None),
            training: &recipe.settings.training,
            stop: self.run.experiment.stop(),
            seed: self.seed(recordings),
        };
        let belief = self.rival.update(&given).map_err(JobError::from)?;
        if recordings > 0 && belief == before {
            tracing::warn!(
                "{}: {} learns nothing from the recordings 0 to {}: they are void or too short, and its distribution \
                 stays as it was",
                self.run.name,
                self.kind.name(),
                recordings - 1
            );
        }
        Ok(belief)
    }
}

impl FromRival<'_> {
    /// Seed of the competing training with this number, of a rival whose training is its own.
    fn training_seed(&self, training: u32) -> u64 {
        match training {
            0 => self.seed(0),
            _ => derived_seed(self.seed(0), SeedFor::Training { candidate: 0, training }),
        }
    }

    /// Trains and stores the policy of a rival whose training is its own ([`Rival::trained`]),
    /// unless the policy is on disk.
    fn train_own_policy(
        &self,
        recommendation: &Recommendation,
        steps: u32,
    ) -> Result<(), ExperimentError> {
        let series = self.run.series(recommendation, steps, self.settings.trainings);
        if !self.run.access.works() || MachineDisk.exists(&series.folders.policy(0).policy()) {
            return Ok(());
        }
        let recipe = self.recipe();
        let train = |training: u32| {
            let given = RivalInput {
                space: &self.space,
                before: &RivalBelief::Unknown,
                first_latest: 0,
                recorded: &[],
                simulation: &recipe.simulation(None),
                training: &recipe.settings.training,
                stop: self.run.experiment.stop(),
                seed: self.training_seed(training),
            };
            Ok(self.rival.trained(&given).map_err(JobError::from)?)
        };
        let score = |trained: &Option<Trained>, fresh: &FreshSimulations| match trained {
            Some(trained) => fresh.score(&trained.network),
            None => TrainingScore::UNCONTESTED,
        };
        match series.best_of(0, train, score)? {
            Some(trained) => series.keep(0, trained),
            None => Ok(()),
        }
    }
}

impl Recommendations for FromRival<'_> {
    fn count(&self) -> u32 {
        match self.rival.data() {
            Data::None => 1,
            Data::Excitations | Data::Rollouts => self.settings.most_recordings(),
        }
    }

    fn rollouts_each(&self) -> u32 {
        u32::from(self.rival.data() != Data::None)
    }

    fn first(&self) -> u32 {
        0
    }

    fn after(&mut self, steps: u32) -> Result<OnDisk<Recommended>, ExperimentError> {
        let requested_steps = steps;
        let steps = if self.rival.data() == Data::None { 0 } else { requested_steps };
        if !self.recordings.complete_to(steps, |number| self.record(number))? {
            return Ok(OnDisk::Missing);
        }
        let OnDisk::Found(belief) = self.belief(steps)? else { return Ok(OnDisk::Missing) };
        let recommendation = self.recommendation(&belief, steps);
        self.train_own_policy(&recommendation, requested_steps)?;
        Ok(OnDisk::Found(Recommended::Found(Box::new(recommendation))))
    }
}

/// The largest of [`ROUNDS`] that is at most `recordings`.
fn round_within(recordings: u32) -> u32 {
    let within = ROUNDS.into_iter().filter(|&round| round <= recordings);
    within.max().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::experiment::ExperimentEvent;
    use crate::experiment::methods::samples::{experiment, record, run, swings};
    use crate::experiment::methods::{Access, Method};
    use crate::jobs;
    use crate::learning::{TrainError, TrainSettings, train};
    use crate::session::RolloutAttempt;
    use crate::simulation::DomainDistribution;
    use crate::telemetry::{Ending, Fault};

    /// A rival with a training of its own, far too short to learn anything, that notes its seeds.
    struct Short(Arc<Mutex<Vec<u64>>>);

    impl Rival for Short {
        fn data(&self) -> Data {
            Data::None
        }

        fn update(&self, given: &RivalInput) -> Result<RivalBelief, TrainError> {
            Ok(given.before.clone())
        }

        fn trained(&self, given: &RivalInput) -> Result<Option<Trained>, TrainError> {
            self.0.lock().unwrap().push(given.seed);
            let training = given.training_on_one_thread();
            let settings = TrainSettings { updates: 1, num_envs: 16, epochs: 1, ..training };
            let robust = DomainDistribution::robust();
            train(&robust, &settings, given.seed, None, given.stop, |_| ()).map(Some)
        }
    }

    #[test]
    fn the_trainings_of_a_rival_with_a_training_of_its_own_compete() {
        let root = tempfile::tempdir().unwrap();
        let method = Method::Rival(RivalKind::Adr);
        let experiment = experiment(root.path(), vec![method]);
        let of_experiment = experiment.settings().methods.clone().unwrap();
        let on_event = |_: ExperimentEvent| ();
        let seeds_of = |trainings, folder: &str| {
            let mut run = run(&experiment, method, Access::Work(&on_event));
            run.folder = root.path().join(folder);
            let settings = MethodSettings { trainings, ..of_experiment.clone() };
            let seeds = Arc::<Mutex<Vec<u64>>>::default();
            let rival = Box::new(Short(Arc::clone(&seeds)));
            let learned = FromRival { rival, ..FromRival::new(&run, &settings, RivalKind::Adr) };
            let recommendation = learned.recommendation(&RivalBelief::Unknown, 0);
            learned.train_own_policy(&recommendation, 0).unwrap();
            let series = run.series(&recommendation, 0, trainings);
            assert!(series.folders.policy(0).policy().exists());
            let seeds = seeds.lock().unwrap().clone();
            (seeds, learned.seed(0))
        };
        let (alone, seed) = seeds_of(1, "alone");
        assert_eq!(alone, [seed]);
        // No training succeeds, so that all rounds are carried out.
        let (competing, seed) = seeds_of(2, "competing");
        assert_eq!(competing[0], seed);
        let (count, all) = (competing.len(), 2 * jobs::ROUNDS as usize);
        let different = competing.into_iter().collect::<BTreeSet<_>>().len();
        assert_eq!((count, different), (all, all));
    }

    #[test]
    fn a_rival_does_not_learn_from_a_void_recording() {
        let root = tempfile::tempdir().unwrap();
        let method = Method::Rival(RivalKind::SimOpt);
        let experiment = experiment(root.path(), vec![method]);
        let run = run(&experiment, method, Access::ReadOnly);
        let settings = experiment.settings().methods.as_ref().unwrap();
        for attempt in 0..=run.recipe.settings.extent.repetitions {
            record(
                &run,
                RolloutAttempt { rollout: 0, attempt },
                Ending::Fault(Fault::EncoderFrozen),
                300,
                swings,
            );
        }
        record(&run, RolloutAttempt { rollout: 1, attempt: 0 }, Ending::Completed, 250, swings);
        let rival = FromRival::new(&run, settings, RivalKind::SimOpt);
        let demonstrations = rival.demonstrations(2).unwrap();
        let lengths: Vec<usize> = demonstrations.iter().map(|it| it.log.samples.len()).collect();
        assert_eq!(lengths, [250]);
    }
}
