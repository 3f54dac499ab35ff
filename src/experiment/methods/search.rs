use super::run::{Access, MethodRun, OnDisk, Recommendation, Recommendations, Recommended};
use crate::experiment::folder::make;
use crate::experiment::search::{open_search, searched};
use crate::experiment::{ExperimentError, ExperimentEvent};
use crate::search::{Observation, Strategy, StrategyKind};
use crate::session::{SeedFor, Session, SessionEvent, SessionSettings, derived_seed};

/// The recommendations of a search: after each candidate, the point that the strategy recommends.
/// The session evaluates a candidate only when a caller requests the recommendation after it, so
/// the search ends at a success.
pub(super) struct FromSearch<'a> {
    run: &'a MethodRun<'a>,
    settings: SessionSettings,
    strategy: Box<dyn Strategy>,
    session: Option<Session>,
    /// Candidates whose rollouts are complete, in order.
    evaluated: Vec<Observation>,
}

impl<'a> FromSearch<'a> {
    /// Prepares the search of a method's run, whose folder contains the session of the search.
    ///
    /// # Errors
    /// The settings are invalid for the strategy.
    pub fn new(run: &'a MethodRun<'a>, kind: StrategyKind) -> Result<Self, ExperimentError> {
        let settings = SessionSettings {
            name: format!("{} of {}", run.name, run.experiment.settings().name),
            // A separate seed, because scoring uses the run's own.
            seed: derived_seed(run.seed, SeedFor::ExperimentPart),
            emulated: run.plant.emulated,
            strategy: kind,
            ..run.recipe.settings.clone()
        };
        let strategy = settings.search()?;
        Ok(Self { run, settings, strategy, session: None, evaluated: Vec::new() })
    }

    /// Continues the search until this many candidates are evaluated; a read-only run does nothing.
    fn search_to(&mut self, candidates: u32) -> Result<(), ExperimentError> {
        let Access::Work(on_event) = self.run.access else { return Ok(()) };
        let experiment = self.run.experiment;
        let session = match self.session.take() {
            Some(session) => session,
            None => {
                make(&self.run.folder)?;
                let settings = self.settings.clone();
                open_search(&self.run.search(), settings, experiment.rig(), experiment.stop())?
                    .trained_by(experiment.executor(1))
            }
        };
        let name = &self.run.name;
        let mut on_event = |progress: SessionEvent| {
            on_event(ExperimentEvent::Search { name, progress: &progress })
        };
        let session = self.session.insert(session);
        let pending = self.settings.extent.pending;
        experiment.while_searching(pending, || session.run_to(candidates, &mut on_event)).map_err(
            |source| ExperimentError::Search { name: name.clone(), source: Box::new(source) },
        )
    }

    fn read_evaluated(&mut self) -> Result<(), ExperimentError> {
        let rollouts = self.settings.extent.rollouts as usize;
        let more = searched(&self.run.search(), self.evaluated.len())?;
        self.evaluated.extend(more.into_iter().take_while(|it| it.returns.len() == rollouts));
        Ok(())
    }
}

impl Recommendations for FromSearch<'_> {
    fn count(&self) -> u32 {
        self.settings.extent.initial_candidates + self.settings.extent.iterations
    }

    fn rollouts_each(&self) -> u32 {
        self.settings.extent.rollouts
    }

    fn after(&mut self, steps: u32) -> Result<OnDisk<Recommended>, ExperimentError> {
        let steps = steps as usize;
        if self.evaluated.len() < steps {
            self.search_to(steps as u32)?;
            self.read_evaluated()?;
        }
        let Some(data) = self.evaluated.get(..steps) else { return Ok(OnDisk::Missing) };
        let psi = self.settings.psi.psi(&self.strategy.recommend(data)?.point)?;
        let recommendation = Recommendation::of(self.run.recipe.clone(), Some(psi));
        Ok(OnDisk::Found(Recommended::Found(Box::new(recommendation))))
    }
}
