use std::cell::OnceCell;

use super::rival::{Draws, POINTS, random};
use super::space::{Space, distribution_of};
use crate::experiment::folder::make;
use crate::experiment::methods::MethodSettings;
use crate::experiment::methods::recordings::{MethodRecordings, Recorded};
use crate::experiment::methods::run::{
    MethodRun, OnDisk, Recommendation, Recommendations, Recommended,
};
use crate::experiment::series::FreshSimulations;
use crate::experiment::{ExperimentError, Recipe};
use crate::jobs::{JobError, TrainingScore};
use crate::learning::{Origin, PhysicsInputs, TrainSettings, UniversalPolicy, train_universal};
use crate::qube::QubeModel;
use crate::search::{CmaEs, Observation, SearchError, Strategy as _};
use crate::session::{SeedFor, derived_seed};
use crate::storage::{Disk, MachineDisk};

/// Largest magnitude of a physics input in the search, in standard deviations of the prior.
const REACH: f64 = 2.0;

/// The recommendations of strategy optimisation (Yu, Liu and Turk 2019, reference 22 of the
/// thesis). One policy is trained over the prior with the Qube's physics as inputs; on the real
/// Qube, CMA-ES searches for the inputs with the highest return. Each real rollout is one
/// candidate.
pub struct FromUniversalPolicy<'a> {
    run: &'a MethodRun<'a>,
    settings: &'a MethodSettings,
    recordings: MethodRecordings<'a>,
    space: Space,
    /// Candidates of the first recordings, which are known to be complete.
    candidates: Candidates,
    /// Policy, trained when it is first needed. No file stores the policy, because the same seed
    /// trains the same policy again.
    policy: OnceCell<UniversalPolicy>,
}

impl<'a> FromUniversalPolicy<'a> {
    /// Recommendations in the folder of a method's run.
    pub fn new(run: &'a MethodRun<'a>, settings: &'a MethodSettings) -> Self {
        let (recordings, space) =
            (MethodRecordings::of(run), Space::of_unknown(run.recipe.settings.plant()));
        let candidates = Candidates::default();
        Self { run, settings, recordings, space, candidates, policy: OnceCell::new() }
    }

    /// The recommendation without the inputs of its policy; the distribution of its training is the
    /// prior.
    fn recommendation(&self) -> Recommendation {
        let mut recipe = self.run.without_identification().recipe;
        "so-cma".clone_into(&mut recipe.name);
        // A separate seed, because scoring uses the run's own.
        let seed = derived_seed(self.run.seed, SeedFor::ExperimentPart);
        let points = self.space.draws(POINTS, &mut random(seed, Draws::Points));
        let distribution = distribution_of(&self.space, &points);
        Recommendation { distribution, ..Recommendation::of(recipe, None) }
    }

    /// The universal policy. The first call carries out the competing trainings and keeps the best
    /// policy, as for other methods, but scores each with the inputs of each simulated Qube.
    fn policy(&self, recommendation: &Recommendation) -> Result<&UniversalPolicy, ExperimentError> {
        if let Some(policy) = self.policy.get() {
            return Ok(policy);
        }
        let series = self.run.series(recommendation, 0, self.settings.trainings);
        let (distribution, simulation) = (series.distribution()?, series.simulation());
        let training = recommendation.recipe.settings.training.clone();
        let settings = TrainSettings { threads: 1, simulation, ..training };
        let (space, scale) = (&self.space, self.settings.rivals.so_cma_scale);
        let physics_of =
            |model: &QubeModel| -> Vec<f32> { inputs(space.point(model).as_slice(), scale) };
        let physics = PhysicsInputs { count: space.dimensions(), of: &physics_of };
        let train = |training: u32| {
            let seed = derived_seed(self.run.seed, SeedFor::Training { candidate: 0, training });
            let stop = self.run.experiment.stop();
            let trained = train_universal(&distribution, &settings, physics, seed, stop, |_| ());
            Ok(trained.map_err(JobError::from)?)
        };
        let score = |policy: &UniversalPolicy, fresh: &FreshSimulations| {
            let FreshSimulations { distribution, simulation, seed, starts } = fresh;
            let simulated =
                policy.evaluate_on_new_starts(physics, distribution, simulation, *seed, *starts);
            TrainingScore::of(&simulated)
        };
        let best = series.best_of(0, train, score)?;
        Ok(self.policy.get_or_init(|| best))
    }

    fn search(&self) -> Result<CmaEs, SearchError> {
        let bounds = vec![REACH; self.space.dimensions()];
        let lower: Vec<f64> = bounds.iter().map(|bound| -bound).collect();
        CmaEs::between(&lower, &bounds, derived_seed(self.run.seed, SeedFor::ExperimentPart))
    }

    /// The inputs of the next candidate.
    fn next_point(&self) -> Result<Vec<f64>, SearchError> {
        self.candidates.next(&self.search()?, self.space.dimensions())
    }

    /// Adds the candidates of the first `recordings` recordings, as far as these are complete on
    /// disk. The recordings of candidates that are known already are not read again.
    fn read_candidates(&mut self, recordings: u32) -> Result<(), ExperimentError> {
        for result in self.recordings.results(self.candidates.count()..recordings)? {
            let point = self.next_point()?;
            self.candidates.0.push(Evaluated { point, return_: result.return_ });
        }
        Ok(())
    }

    /// Makes the recording of the next candidate.
    fn record(&self, recommendation: &Recommendation) -> Result<(), ExperimentError> {
        let number = self.candidates.count();
        let inputs = inputs(&self.next_point()?, self.settings.rivals.so_cma_scale);
        let trained = self.policy(recommendation)?.at(&inputs).map_err(JobError::from)?;
        let policy = trained.into_policy(origin_of(&recommendation.recipe)).to_bytes();
        self.recordings.make(number, Recorded::Policy { after: number }, &policy)
    }
}

impl Recommendations for FromUniversalPolicy<'_> {
    fn count(&self) -> u32 {
        self.settings.most_recordings()
    }

    fn rollouts_each(&self) -> u32 {
        1
    }

    fn first(&self) -> u32 {
        0
    }

    fn after(&mut self, steps: u32) -> Result<OnDisk<Recommended>, ExperimentError> {
        let recommendation = self.recommendation();
        self.read_candidates(steps)?;
        if self.run.access.works() {
            make(&self.run.folder)?;
            while self.candidates.count() < steps {
                self.record(&recommendation)?;
                self.read_candidates(steps)?;
            }
        }
        if self.candidates.count() < steps {
            return Ok(OnDisk::Missing);
        }
        let series = self.run.series(&recommendation, steps, self.settings.trainings);
        let path = series.folders.policy(0).policy();
        if self.run.access.works() && !MachineDisk.exists(&path) {
            let best = match self.candidates.evaluated(steps).as_slice() {
                [] => vec![0.0; self.space.dimensions()],
                data => self.search()?.recommend(data)?.point,
            };
            let policy = self.policy(&recommendation)?;
            let inputs = inputs(&best, self.settings.rivals.so_cma_scale);
            series.keep(0, policy.at(&inputs).map_err(JobError::from)?)?;
        }
        Ok(OnDisk::Found(Recommended::Found(Box::new(recommendation))))
    }
}

/// A candidate whose rollout is over.
struct Evaluated {
    /// Physics inputs of its policy.
    point: Vec<f64>,
    /// Return of its rollout; `None` if the rollout is void.
    return_: Option<f64>,
}

/// The candidates whose rollouts are over, in order.
#[derive(Default)]
struct Candidates(Vec<Evaluated>);

impl Candidates {
    /// Number of candidates.
    fn count(&self) -> u32 {
        self.0.len() as u32
    }

    /// The observations of the first `count` candidates, without void rollouts.
    fn evaluated(&self, count: u32) -> Vec<Observation> {
        let observation = |candidate: &Evaluated| {
            let returns = vec![candidate.return_?];
            Some(Observation { point: candidate.point.clone(), returns })
        };
        self.0.iter().take(count as usize).filter_map(observation).collect()
    }

    /// The next candidate: first the mean of the prior, then the proposals of CMA-ES. The search
    /// does not learn from the void rollouts, but counts them, so that each proposal is another
    /// point.
    fn next(&self, search: &CmaEs, dimensions: usize) -> Result<Vec<f64>, SearchError> {
        if self.0.is_empty() {
            return Ok(vec![0.0; dimensions]);
        }
        let void = self.0.iter().filter(|it| it.return_.is_none());
        let void: Vec<Vec<f64>> = void.map(|it| it.point.clone()).collect();
        Ok(search.propose(&self.evaluated(self.count()), &void, 1)?.swap_remove(0))
    }
}

/// The physics inputs of a policy for the Qube at a point of the space.
fn inputs(point: &[f64], scale: f64) -> Vec<f32> {
    point.iter().map(|entry| (scale * entry) as f32).collect()
}

fn origin_of(recipe: &Recipe) -> Origin {
    Origin { model: recipe.name.clone(), ..recipe.origin(None) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::methods::samples::{experiment, record, run, swings};
    use crate::experiment::methods::{Access, Method};
    use crate::session::{RolloutAttempt, recording_in};
    use crate::telemetry::Ending;

    /// Candidates of a search whose return falls with the distance from known inputs, in 14
    /// dimensions.
    fn searched(candidates: usize) -> Vec<Observation> {
        let bounds = [REACH; 14];
        let search = CmaEs::between(&bounds.map(|bound| -bound), &bounds, 3).unwrap();
        let mut data = Candidates::default();
        for _ in 0..candidates {
            let point = data.next(&search, 14).unwrap();
            let squares = point.iter().map(|entry| (entry - 0.7) * (entry - 0.7));
            let return_ = 500.0 - 20.0 * squares.sum::<f64>();
            data.0.push(Evaluated { point, return_: Some(return_) });
        }
        data.evaluated(data.count())
    }

    #[test]
    fn inputs_of_a_known_optimum_are_found_and_the_mean_of_the_prior_comes_first() {
        let data = searched(700);
        assert_eq!(data[0].point, [0.0; 14]);
        let best = |count: usize| {
            data[..count].iter().map(Observation::mean_return).fold(f64::MIN, f64::max)
        };
        // Twenty rollouts are too few to find 14 inputs; 700 rollouts find them.
        assert!(best(20) >= best(1) && best(20) < 480.0, "{}", best(20));
        assert!(best(700) > 499.0, "{}", best(700));
    }

    #[test]
    fn the_search_ignores_a_void_rollout_and_proposes_another_point() {
        let search = CmaEs::between(&[-REACH; 14], &[REACH; 14], 3).unwrap();
        let mut data = Candidates::default();
        let mut points = Vec::new();
        for return_ in [None, Some(200.0), None, Some(100.0)] {
            let point = data.next(&search, 14).unwrap();
            assert!(!points.contains(&point));
            data.0.push(Evaluated { point: point.clone(), return_ });
            points.push(point);
        }
        let evaluated = data.evaluated(4);
        let returns: Vec<f64> = evaluated.iter().map(Observation::mean_return).collect();
        assert_eq!(returns, [200.0, 100.0]);
        assert_eq!(search.recommend(&evaluated).unwrap().point, points[1]);
    }

    #[test]
    fn a_recording_that_is_known_is_not_read_again() {
        let root = tempfile::tempdir().unwrap();
        let method = Method::StrategyOptimisation;
        let experiment = experiment(root.path(), vec![method]);
        let run = run(&experiment, method, Access::ReadOnly);
        let settings = experiment.settings().methods.as_ref().unwrap();
        let mut universal = FromUniversalPolicy::new(&run, settings);
        record(&run, RolloutAttempt::FIRST, Ending::Completed, 300, swings);
        universal.read_candidates(2).unwrap();
        assert_eq!(universal.candidates.count(), 1);
        std::fs::remove_file(recording_in(&run.recordings(), RolloutAttempt::FIRST)).unwrap();
        record(&run, RolloutAttempt { rollout: 1, attempt: 0 }, Ending::Completed, 300, swings);
        universal.read_candidates(2).unwrap();
        assert_eq!(universal.candidates.count(), 2);
        assert_eq!(universal.candidates.evaluated(1).len(), 1);
    }
}
