use std::path::PathBuf;

use super::identified::FromRecordings;
use super::judge::{Judgement, judge};
use super::search::FromSearch;
use super::{Contender, StrategySettings};
use crate::experiment::folder::PolicyFolders;
use crate::experiment::series::Series;
use crate::experiment::work::Tell;
use crate::experiment::{Experiment, ExperimentError, News, Plant, Recipe};
use crate::session::{SeedFor, derived_seed};

/// One repetition of a contender, as far as it has come.
#[derive(Clone, Debug, PartialEq)]
pub struct Repetition {
    /// Who.
    pub contender: Contender,
    /// Which, from 0.
    pub number: u32,
    /// The answers that were judged, in order. One that is as it was before is not judged again.
    pub answers: Vec<AnswerResult>,
    /// Whether an answer succeeds, or there are no more.
    pub is_over: bool,
    /// Real rollouts that it may use.
    pub budget: u32,
}

/// One answer of a contender.
#[derive(Clone, Debug, PartialEq)]
pub struct AnswerResult {
    /// Real rollouts that it was given after; a recording counts as one.
    pub real_rollouts: u32,
    /// What its judges found; why there is no answer, where the recordings were refused.
    pub judgement: Result<Judgement, String>,
    /// Whether it succeeds.
    pub succeeds: bool,
}

impl Repetition {
    /// The real rollouts after which its answer succeeds first; none where it has not.
    #[must_use]
    pub fn succeeded_after(&self) -> Option<u32> {
        self.answers.iter().find(|answer| answer.succeeds).map(|answer| answer.real_rollouts)
    }

    /// `bayrn 3`.
    #[must_use]
    pub fn name(&self) -> String {
        name(self.contender, self.number)
    }
}

fn name(contender: Contender, number: u32) -> String {
    format!("{contender} {number}")
}

/// What policies are to be made by.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Answer {
    /// The recipe.
    pub recipe: Recipe,
    /// Its psi; empty where it has none.
    pub psi: Vec<f64>,
}

/// A contender's answers one after another, as often as it is asked.
pub(super) trait Answers {
    /// How many there are at most.
    fn count(&self) -> u32;

    /// Real rollouts before each.
    fn rollouts_each(&self) -> u32;

    /// The answer after so many candidates or recordings, from 1 on, or why there is none. None where
    /// nothing works and something is missing.
    ///
    /// # Errors
    /// Whatever ends the work early; what is there cannot be read.
    fn after(&mut self, steps: u32) -> Result<Option<Result<Answer, String>>, ExperimentError>;
}

/// One repetition of a contender in its folder.
pub(super) struct Course<'a> {
    /// The experiment it is part of.
    pub experiment: &'a Experiment,
    /// What is said of it.
    pub name: String,
    /// What psi is searched for.
    pub recipe: &'a Recipe,
    /// Everything random follows from it.
    pub seed: u64,
    /// The Qube of this repetition.
    pub plant: Plant,
    /// Where everything is.
    pub folder: PathBuf,
    /// Who hears of the work; without it nothing is done that is not on disk.
    pub work: Option<&'a Tell<'a>>,
}

impl Experiment {
    /// Goes through one repetition of a contender until an answer succeeds or there are no more. With
    /// `work` what is missing is done; else it ends where something is.
    ///
    /// # Errors
    /// Whatever ends it early; what is there cannot be read.
    pub(in crate::experiment) fn follow(
        &self,
        strategies: &StrategySettings,
        (contender, number): (Contender, u32),
        work: Option<&Tell>,
    ) -> Result<Repetition, ExperimentError> {
        let plant = &self.settings().plants[0];
        let emulated = plant.for_policy(self.settings().seed, number);
        let course = Course {
            experiment: self,
            name: name(contender, number),
            recipe: &self.settings().recipes[0],
            seed: derived_seed(self.settings().seed, SeedFor::Repetition { repetition: number }),
            plant: Plant { emulated, vary: 0.0, ..plant.clone() },
            folder: self.folder().repetition(contender.name(), number),
            work,
        };
        let mut answers: Box<dyn Answers + '_> = match contender {
            Contender::Search(kind) => Box::new(FromSearch::new(&course, kind)?),
            Contender::Identify => Box::new(FromRecordings::new(&course, strategies)),
        };
        let mut repetition = Repetition {
            contender,
            number,
            answers: Vec::new(),
            is_over: false,
            budget: answers.count() * answers.rollouts_each(),
        };
        course.follow(answers.as_mut(), &mut repetition)?;
        Ok(repetition)
    }
}

impl Course<'_> {
    fn follow(
        &self,
        answers: &mut dyn Answers,
        repetition: &mut Repetition,
    ) -> Result<(), ExperimentError> {
        let mut judged: Vec<Answer> = Vec::new();
        for steps in 1..=answers.count() {
            let real_rollouts = steps * answers.rollouts_each();
            let result = match answers.after(steps)? {
                None => return Ok(()),
                Some(Err(reason)) => {
                    AnswerResult { real_rollouts, judgement: Err(reason), succeeds: false }
                }
                Some(Ok(answer)) if judged.contains(&answer) => continue,
                Some(Ok(answer)) => {
                    let Some((judgement, succeeds)) = self.judge(&answer, steps)? else {
                        return Ok(());
                    };
                    judged.push(answer);
                    AnswerResult { real_rollouts, judgement: Ok(judgement), succeeds }
                }
            };
            repetition.answers.push(result);
            if let (Some(tell), Some(answer)) = (self.work, repetition.answers.last()) {
                tell(News::Judged { repetition, answer });
            }
            if repetition.succeeded_after().is_some() {
                break;
            }
        }
        repetition.is_over = true;
        Ok(())
    }

    fn judge(
        &self,
        answer: &Answer,
        steps: u32,
    ) -> Result<Option<(Judgement, bool)>, ExperimentError> {
        let settings = self.experiment.settings();
        let folder = self.folder.join("judged").join(format!("{steps:03}"));
        let series = Series {
            experiment: &settings.name,
            recipe: &answer.recipe,
            psi: &answer.psi,
            seed: self.seed,
            folders: PolicyFolders::within(folder),
            rig: self.experiment.rig(),
            stop: self.experiment.stop(),
        };
        judge(&series, &self.plant, settings.policies, settings.rollouts, self.work.is_some())
    }
}
