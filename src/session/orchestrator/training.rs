//! Trains the policies of candidates: one training, or several with different seeds of which the
//! best policy is kept.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::prepared::{PreparedTraining, PreparedTrainings};
use crate::jobs::{
    CHOSEN_OF_STARTS, Competition, Executor, JobError, JobEvent, TrainingJob, TrainingScore,
    tenth_percentile, train_all,
};
use crate::learning::{Origin, Preset, TrainSettings, Trained, curve_csv, evaluate_on_new_starts};
use crate::policy::Network;
use crate::session::seeds::{SeedFor, derived_seed};
use crate::session::training_time::unix_ns;
use crate::session::{
    Candidate, Identification, Purpose, SessionError, SessionEvent, SessionPaths, SessionSettings,
    TrainingTime,
};
use crate::simulation::{DomainDistribution, Evaluation, Model, SimulationSettings};
use crate::storage::{Disk, write_whole};

/// The kind of Qubes that a policy is trained for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TrainedFor {
    /// The distribution of the candidate's psi.
    Psi,
    /// The model `robust`: the distribution of Qubes for an unidentified Qube.
    Unknown,
    /// The nominal Qube.
    Nominal,
}

/// A candidate whose policy is being trained.
struct Contest {
    candidate: Candidate,
    /// The kinds of Qubes of the trainings of a round, in order.
    trainings: Vec<TrainedFor>,
    competition: Competition<(Trained, TrainedFor)>,
    /// Times of the trainings that have ended.
    times: Vec<TrainingTime>,
    /// True once the policy is written.
    is_over: bool,
}

/// Factor on the width of the simulations in which policies around a questionable fit are compared:
/// an effect that the model lacks makes the Qube differ by more than the fit's errors.
const QUESTIONABLE_WIDTH: f64 = 2.0;

/// A training of a round.
#[derive(Clone, Copy)]
struct Entrant {
    /// Index of its contest.
    contest: usize,
    /// Number of the training among the candidate's trainings.
    training: u32,
    trained_for: TrainedFor,
}

/// Trains policies and writes them into the session's folder. It owns neither rig nor ledger, so it
/// can run in another thread.
#[derive(Clone)]
pub(super) struct Trainer {
    pub(super) disk: Arc<dyn Disk>,
    pub(super) paths: SessionPaths,
    pub(super) settings: SessionSettings,
    pub(super) identification: Identification,
    pub(super) executor: Arc<dyn Executor>,
    /// True if the session runs in real time and therefore writes the times of its trainings. In
    /// virtual time they mean nothing, and the same seed would give other bytes each time.
    pub(super) in_real_time: bool,
}

impl Trainer {
    /// Trains the policies of these candidates; a training that is prepared is not done again. A
    /// candidate whose competing policies all fail in simulation is trained again with other seeds
    /// ([`Competition`]).
    pub(super) fn train(
        &self,
        candidates: Vec<Candidate>,
        prepared: &mut PreparedTrainings,
        stop: &AtomicBool,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let contest = |candidate: Candidate| {
            let trainings = self.trainings(&candidate);
            let competition = Competition::new(trainings.len() as u32);
            Contest { candidate, trainings, competition, times: Vec::new(), is_over: false }
        };
        let mut contests: Vec<Contest> = candidates.into_iter().map(contest).collect();
        while !contests.is_empty() {
            self.train_round(&mut contests, prepared, stop, on_event)?;
            contests.retain(|contest| !contest.is_over);
        }
        Ok(())
    }

    /// The trainings of a candidate in each round. Around an identified Qube there are as many as
    /// the settings name, and the best policy is kept. While the identification is questionable, a
    /// policy for an unidentified Qube competes with these policies, so that no policy around a
    /// questionable fit is kept where the policy for an unidentified Qube is better in simulations.
    fn trainings(&self, candidate: &Candidate) -> Vec<TrainedFor> {
        if candidate.purpose == Purpose::Baseline {
            // The baseline is only for comparison, so its training is not repeated for a better
            // result.
            return vec![TrainedFor::Nominal];
        }
        let (Identification::Found { .. }, Some(plan)) =
            (&self.identification, &self.settings.identification)
        else {
            return vec![TrainedFor::Psi];
        };
        let mut trainings = vec![TrainedFor::Psi; plan.trainings as usize];
        if self.identification.is_questionable() {
            trainings.push(TrainedFor::Unknown);
        }
        trainings
    }

    /// Performs one round of each contest's trainings. A policy is written as soon as it is chosen.
    fn train_round(
        &self,
        contests: &mut [Contest],
        prepared: &mut PreparedTrainings,
        stop: &AtomicBool,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        let (mut jobs, mut of_job, mut of_prepared) = (Vec::new(), Vec::new(), Vec::new());
        for (index, contest) in contests.iter().enumerate() {
            let Contest { candidate, trainings, competition, .. } = contest;
            for (training, &trained_for) in competition.round().zip(trainings) {
                let job = self.job(candidate.number, training, &candidate.point, trained_for)?;
                let entrant = Entrant { contest: index, training, trained_for };
                if prepared.has(&job) {
                    of_prepared.push((job, entrant));
                } else {
                    jobs.push(job);
                    of_job.push(entrant);
                }
            }
        }
        let mut began_unix_ns = vec![unix_ns(); jobs.len()];
        // The first error is the cause; later ones, such as a stop, may only follow from it.
        let mut failed = None;
        train_all(self.executor.as_ref(), &jobs, stop, &mut |event| match event {
            JobEvent::Begun { job } => began_unix_ns[job] = unix_ns(),
            JobEvent::Update { job, update } => {
                let Entrant { contest, training, .. } = of_job[job];
                let candidate = contests[contest].candidate.number;
                on_event(SessionEvent::Training { candidate, training, update: &update });
            }
            JobEvent::Finished { job, result } => {
                let entrant = of_job[job];
                let time = TrainingTime {
                    training: entrant.training,
                    began_unix_ns: began_unix_ns[job],
                    // A clock may be set back.
                    ended_unix_ns: unix_ns().max(began_unix_ns[job]),
                };
                let result = result.map(|trained| *trained);
                let contest = &mut contests[entrant.contest];
                if let Err(error) = self.enter(contest, entrant, time, result, on_event) {
                    failed.get_or_insert(error);
                }
            }
        });
        for (job, entrant) in of_prepared {
            let PreparedTraining { result, time } = prepared.take(&job, entrant.training, stop);
            let contest = &mut contests[entrant.contest];
            if let Err(error) = self.enter(contest, entrant, time, result, on_event) {
                failed.get_or_insert(error);
            }
        }
        failed.map_or(Ok(()), Err)
    }

    /// Enters a training into its contest and, if this decides the contest, writes the winner's
    /// policy.
    fn enter(
        &self,
        contest: &mut Contest,
        Entrant { training, trained_for, .. }: Entrant,
        time: TrainingTime,
        result: Result<Trained, JobError>,
        on_event: &mut dyn FnMut(SessionEvent),
    ) -> Result<(), SessionError> {
        contest.times.push(time);
        let (trained, candidate) = (result?, contest.candidate.number);
        let score = match contest.competition.is_contested() {
            true => self.score(candidate, &trained.network)?,
            false => TrainingScore::UNCONTESTED,
        };
        contest.competition.enter(training, score, (trained, trained_for));
        let Some((winner, trained_for)) = contest.competition.take_winner() else { return Ok(()) };
        contest.is_over = true;
        let best_return = winner.best_return;
        // The times are written before the policy, so that no policy is on disk without its times.
        if self.in_real_time {
            let path = self.paths.candidate(candidate).training_times();
            TrainingTime::write_all(&contest.times, self.disk.as_ref(), &path)?;
        }
        self.save(candidate, winner, self.origin(&contest.candidate, trained_for)?)?;
        on_event(SessionEvent::Trained { candidate, best_return });
        Ok(())
    }

    /// The training of the policy for an unidentified Qube that competes in the first round of this
    /// candidate if the identification is questionable then.
    ///
    /// # Errors
    /// The distribution is invalid.
    pub(super) fn competitor_for_unknown(
        &self,
        candidate: u32,
    ) -> Result<TrainingJob, SessionError> {
        let plan = self.settings.identification.unwrap_or_default();
        self.job(candidate, plan.trainings, &[], TrainedFor::Unknown)
    }

    /// The training of the baseline, as the candidate with this number.
    ///
    /// # Errors
    /// The distribution is invalid.
    pub(super) fn baseline(&self, candidate: u32) -> Result<TrainingJob, SessionError> {
        self.job(candidate, 0, &[], TrainedFor::Nominal)
    }

    /// The training with this number among the trainings of a candidate at this point.
    fn job(
        &self,
        candidate: u32,
        training: u32,
        point: &[f64],
        trained_for: TrainedFor,
    ) -> Result<TrainingJob, SessionError> {
        let (distribution, settings) = self.training_of(point, trained_for)?;
        let seed_for = SeedFor::Training { candidate, training };
        let seed = derived_seed(self.settings.seed, seed_for);
        Ok(TrainingJob { distribution, settings, seed })
    }

    /// The distribution and settings of the training of a candidate at this point.
    fn training_of(
        &self,
        point: &[f64],
        trained_for: TrainedFor,
    ) -> Result<(DomainDistribution, TrainSettings), SessionError> {
        let settings = &self.settings;
        let base = |model: Model| model.distribution(settings.plant(), settings.family, None, None);
        Ok(match trained_for {
            TrainedFor::Psi => {
                let psi = settings.psi.psi(point)?;
                let simulation = settings.simulation(&psi);
                let training = TrainSettings { simulation, ..settings.training.clone() };
                (settings.distribution(&psi)?, training)
            }
            TrainedFor::Unknown => (base(Model::Robust)?, settings.training.clone()),
            TrainedFor::Nominal => {
                // The baseline ignores the nonidealities: it has the Qube's sensors, but no history
                // of commands.
                let simulation = SimulationSettings { history: 0, ..settings.training.simulation };
                (base(Model::Nominal)?, TrainSettings { simulation, ..TrainSettings::quick() })
            }
        })
    }

    /// The origin that a candidate's policy file records.
    fn origin(
        &self,
        candidate: &Candidate,
        trained_for: TrainedFor,
    ) -> Result<Origin, SessionError> {
        let without_psi = |model: Model, preset: Preset| Origin {
            model: model.name().into(),
            psi: None,
            preset: preset.name().into(),
        };
        Ok(match trained_for {
            TrainedFor::Psi => self.settings.origin(&self.settings.psi.psi(&candidate.point)?),
            TrainedFor::Unknown => without_psi(Model::Robust, self.settings.preset()),
            TrainedFor::Nominal => without_psi(Model::Nominal, Preset::Quick),
        })
    }

    /// The score of a policy of a candidate. Simulations of the identified Qube decide whether the
    /// policy succeeds. Policies are compared in the same simulations or, if the identification is
    /// questionable, in simulations that are [`QUESTIONABLE_WIDTH`] times as wide.
    ///
    /// # Errors
    /// The base distribution cannot be simulated.
    fn score(&self, candidate: u32, network: &Network) -> Result<TrainingScore, SessionError> {
        let seed_for = SeedFor::Evaluation { candidate };
        let base = self.settings.base_distribution()?;
        let as_identified = self.simulated_from(&base, seed_for, network);
        if !self.identification.is_questionable() {
            return Ok(TrainingScore::of(&as_identified));
        }
        let doubted = base.widened(QUESTIONABLE_WIDTH, self.settings.family);
        let compared = tenth_percentile(&self.simulated_from(&doubted, seed_for, network));
        Ok(TrainingScore { scored: tenth_percentile(&as_identified), compared })
    }

    /// Evaluates the policy of a candidate in simulations from the search's base distribution, none
    /// of which helped to choose the policy.
    ///
    /// # Errors
    /// The base distribution cannot be simulated.
    pub(super) fn simulated_afresh(
        &self,
        candidate: u32,
        network: &Network,
    ) -> Result<Evaluation, SessionError> {
        let base = self.settings.base_distribution()?;
        Ok(self.simulated_from(&base, SeedFor::Estimate { candidate }, network))
    }

    fn simulated_from(
        &self,
        distribution: &DomainDistribution,
        seed_for: SeedFor,
        network: &Network,
    ) -> Evaluation {
        let seed = derived_seed(self.settings.seed, seed_for);
        let simulation = &self.settings.training.simulation;
        evaluate_on_new_starts(network, distribution, simulation, seed, CHOSEN_OF_STARTS)
    }

    fn save(&self, candidate: u32, trained: Trained, origin: Origin) -> Result<(), SessionError> {
        let (disk, paths) = (self.disk.as_ref(), self.paths.candidate(candidate));
        write_whole(disk, &paths.curve(), curve_csv(&trained.curve).as_bytes())?;
        write_whole(disk, &paths.policy(), &trained.into_policy(origin).to_bytes())?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::jobs::LocalExecutor;
    use crate::learning::TrainError;
    use crate::policy::Policy;
    use crate::qube::Profile;
    use crate::session::{FailedRefit, IdentificationSettings};
    use crate::storage::MachineDisk;

    fn trainer(settings: SessionSettings, identification: Identification) -> Trainer {
        Trainer {
            disk: Arc::new(MachineDisk),
            paths: SessionPaths::new(Path::new("session")),
            settings,
            identification,
            executor: Arc::new(LocalExecutor::on_cores(1)),
            in_real_time: true,
        }
    }

    /// An identification with these effects missing.
    fn found(missing_effects: Vec<String>) -> Identification {
        let verdict = "fits but for".into();
        let profiles = Vec::new();
        Identification::Found {
            recordings: 1,
            verdict,
            missing_effects,
            profiles,
            failed_refit: None,
        }
    }

    fn shipped_network() -> Network {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/robust.safetensors");
        match Policy::load(&path) {
            Ok(Policy::Network(policy)) => policy.network,
            _ => panic!("the file holds no network"),
        }
    }

    #[test]
    fn the_return_of_a_policy_is_estimated_in_other_simulations_than_those_that_chose_it() {
        let plan = IdentificationSettings::default();
        let settings = SessionSettings { identification: Some(plan), ..SessionSettings::quick() };
        let settings = settings.around(&plan, &Profile::lab(), &Profile::lab());
        let (trainer, network) = (trainer(settings, found(Vec::new())), shipped_network());
        let chosen = trainer.score(1, &network).unwrap();
        let estimated = |candidate| trainer.simulated_afresh(candidate, &network).unwrap();
        assert_ne!(TrainingScore::of(&estimated(1)), chosen);
        assert_ne!(estimated(1).returns, estimated(2).returns);
        assert_eq!(estimated(1).returns, estimated(1).returns);
    }

    #[test]
    fn policies_around_a_doubted_fit_are_compared_in_wider_simulations() {
        let plan = IdentificationSettings::default();
        let settings = SessionSettings { identification: Some(plan), ..SessionSettings::quick() };
        let settings = settings.around(&plan, &Profile::lab(), &Profile::lab());
        let network = shipped_network();
        let score =
            |missing_effects| trainer(settings.clone(), found(missing_effects)).score(1, &network);
        let undoubted = score(Vec::new()).unwrap();
        let doubted = score(vec!["play".into()]).unwrap();
        assert_eq!(undoubted.compared, undoubted.scored);
        assert_eq!(doubted.scored, undoubted.scored);
        assert!(doubted.compared < doubted.scored - 1.0, "{doubted:?}");
    }

    /// An executor whose first training fails and whose others are then stopped.
    struct FailingExecutor;

    impl Executor for FailingExecutor {
        fn concurrency(&self) -> usize {
            1
        }

        fn train(
            &self,
            jobs: &[TrainingJob],
            _stop: &AtomicBool,
            on_event: &mut dyn FnMut(JobEvent),
        ) {
            for job in 0..jobs.len() {
                let (by, reason) = ("a worker".into(), "its disk is full".into());
                let result = Err(match job {
                    0 => JobError::Elsewhere { by, reason },
                    _ => TrainError::Stopped.into(),
                });
                on_event(JobEvent::Finished { job, result });
            }
        }
    }

    #[test]
    fn a_round_fails_with_its_first_error() {
        let executor = Arc::new(FailingExecutor);
        let trainer = trainer(SessionSettings::quick(), Identification::None);
        let trainer = Trainer { executor, ..trainer };
        let lower = trainer.settings.psi.lower();
        let both = [1, 2].map(|number| candidate(number, Purpose::Initial, lower.clone())).to_vec();
        let never = AtomicBool::new(false);
        let mut prepared = PreparedTrainings::default();
        let failed = trainer.train(both, &mut prepared, &never, &mut |_| ()).unwrap_err();
        assert!(failed.to_string().contains("its disk is full"), "{failed}");
    }

    fn candidate(number: u32, purpose: Purpose, point: Vec<f64>) -> Candidate {
        Candidate {
            number,
            purpose,
            point,
            trained: false,
            policy_checksum: None,
            finished: Vec::new(),
            void: 0,
            void_before: 0,
            policy_of: None,
            identified_from: None,
        }
    }

    #[test]
    fn a_policy_for_an_unknown_qube_competes_for_each_candidate_while_the_fit_is_doubted() {
        let plan = IdentificationSettings::default();
        let settings = SessionSettings { identification: Some(plan), ..SessionSettings::quick() };
        let settings = settings.around(&plan, &Profile::lab(), &Profile::lab());
        let first = candidate(1, Purpose::Initial, settings.psi.as_identified());
        let later = candidate(4, Purpose::Search, settings.psi.lower());
        assert_ne!(first.point, later.point);
        let failed = Some(FailedRefit { recordings: 3, reason: "it does not fit".into() });
        let since_failed = match found(Vec::new()) {
            Identification::Found { recordings, verdict, missing_effects, profiles, .. } => {
                Identification::Found {
                    recordings,
                    verdict,
                    missing_effects,
                    profiles,
                    failed_refit: failed,
                }
            }
            other => other,
        };
        for (identification, competitors) in
            [(found(Vec::new()), 0), (found(vec!["play".into()]), 1), (since_failed, 1)]
        {
            let trainer = trainer(settings.clone(), identification);
            for candidate in [&first, &later] {
                let trainings = trainer.trainings(candidate);
                let unknown = trainings.iter().filter(|it| **it == TrainedFor::Unknown).count();
                assert_eq!(unknown, competitors, "{:?}", candidate.point);
                assert_eq!(trainings.len(), plan.trainings as usize + competitors);
            }
        }
    }

    #[test]
    fn the_session_needs_the_trainings_that_begin_early() {
        let plan = IdentificationSettings::default();
        let settings = SessionSettings { identification: Some(plan), ..SessionSettings::quick() };
        let lab = Profile::lab();
        let around = settings.clone().around(&plan, &lab, &lab);
        let doubted = found(vec!["play".into()]);
        let first = candidate(plan.excitations, Purpose::Initial, around.psi.as_identified());
        let baseline = candidate(3, Purpose::Baseline, Vec::new());
        let (before, later) = (trainer(settings, Identification::None), trainer(around, doubted));
        let early = before.competitor_for_unknown(plan.excitations).unwrap();
        for (needed, early) in [(first, early), (baseline, later.baseline(3).unwrap())] {
            let mut jobs = (0..).zip(later.trainings(&needed)).map(|(training, trained_for)| {
                later.job(needed.number, training, &needed.point, trained_for).unwrap()
            });
            assert!(jobs.any(|job| job == early), "{:?}", needed.purpose);
        }
    }
}
