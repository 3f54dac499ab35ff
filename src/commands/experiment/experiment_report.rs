use std::path::Path;

use serde_json::Value;

use super::{method_table, recipe_table};
use crate::charts::{
    DrawingError, ShareOfPlant, StepLine, at_budget_svg, densities_svg, methods_svg,
    over_rollouts_svg, searches_svg, training_progress_svg,
};
use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::experiment::{
    ALL_PLANTS, Experiment, ExperimentError, MethodResult, MethodResults, PolicyResult,
    RecipeResult, Results, SearchReturns, TrainingProgress,
};
use crate::qube::PlantModel;
use crate::recording::read;
use crate::replay::SimulatedSpecimen;
use crate::report::{NamedRollouts, RolloutView, methods_page, recipes_page};
use crate::scoring::criterion::SUCCESS_RETURN;
use crate::session::{FolderError, RolloutAttempt, recording_in};
use crate::simulation::DomainDistribution;
use crate::storage::{Disk, MachineDisk, write_whole};

/// The finished work of an experiment, read once for its table, JSON, CSV, figures and page.
pub enum ExperimentReport {
    /// The results of recipes.
    Recipes(Results),
    /// The results of a comparison of methods.
    Methods(MethodResults),
}

impl ExperimentReport {
    /// Reads all finished work.
    ///
    /// # Errors
    /// A session, policy or recording cannot be read.
    pub fn read(experiment: &Experiment) -> Result<Self, ExperimentError> {
        Ok(match MethodResults::read(experiment)? {
            Some(results) => Self::Methods(results),
            None => Self::Recipes(Results::read(experiment)?),
        })
    }

    /// Returns the table for people.
    pub fn text(&self) -> String {
        match self {
            Self::Recipes(results) => recipe_table::table(results),
            Self::Methods(results) => method_table::table(results),
        }
    }

    /// Returns the results for scripts.
    pub fn json(&self) -> Value {
        match self {
            Self::Recipes(results) => recipe_table::value(results),
            Self::Methods(results) => method_table::value(results),
        }
    }

    /// Returns the results as CSV.
    pub fn csv(&self) -> String {
        match self {
            Self::Recipes(results) => recipe_table::csv(results),
            Self::Methods(results) => method_table::csv(results),
        }
    }

    /// Returns whether the path leads to a regular file that begins like the CSV file of an
    /// experiment, this one or another.
    pub fn is_csv(path: &Path) -> bool {
        let known = [recipe_table::CSV_BEGINS, method_table::CSV_BEGINS];
        MachineDisk
            .read_beginning(path, 64)
            .is_ok_and(|bytes| known.iter().any(|columns| bytes.starts_with(columns.as_bytes())))
    }

    /// Returns the page for a browser, with the commands that repeat the experiment.
    ///
    /// # Errors
    /// A search cannot be read, or the data of a figure cannot be written.
    pub fn page(
        &self,
        experiment: &Experiment,
        commands: &[(String, String)],
    ) -> Result<String, String> {
        let settings = experiment.settings();
        match self {
            Self::Methods(results) => methods_page(&settings.name, results, commands),
            Self::Recipes(results) => {
                let distributions =
                    experiment.distributions().map_err(|error| error.to_string())?;
                let searches = experiment.searches().map_err(|error| error.to_string())?;
                let rollouts = examples(results);
                recipes_page(settings, results, &distributions, &searches, rollouts, commands)
            }
        }
        .map_err(|error| error.to_string())
    }

    /// Returns the data of the figures. For recipes they also contain the searches, distributions
    /// and trainings, which are read here.
    ///
    /// # Errors
    /// A search or a learning curve cannot be read.
    pub fn figures(&self, experiment: &Experiment) -> Result<Figures<'_>, ExperimentError> {
        Ok(match self {
            Self::Methods(results) => Figures::Methods(results),
            Self::Recipes(results) if results.recipes.iter().any(|it| it.budget.is_some()) => {
                Figures::Budgets(results.recipes.iter().filter_map(share_of_plant).collect())
            }
            Self::Recipes(_) => Figures::Recipes {
                plant: *experiment.settings().plant(),
                distributions: experiment.distributions()?,
                searches: experiment.searches()?,
                progress: experiment.training_progress()?,
            },
        })
    }
}

/// Largest number of pairs of recipe and plant whose rollouts a page shows.
const SHOWN: usize = 20;

/// Returns the first rollout of the best and of the worst policy, by mean return, of each of the
/// first `SHOWN` pairs of recipe and plant. Rollouts that cannot be read are left out.
fn examples(results: &Results) -> NamedRollouts {
    let mut rollouts = NamedRollouts::new();
    // The rows for all plants together repeat the policies of the other rows.
    let rows = results.recipes.iter().filter(|row| row.plant != ALL_PLANTS);
    for result in rows.take(SHOWN) {
        let earned = |policy: &PolicyResult| policy.mean_return().unwrap_or(f64::NEG_INFINITY);
        let order =
            |one: &&PolicyResult, other: &&PolicyResult| earned(one).total_cmp(&earned(other));
        let best = result.policies.iter().max_by(order);
        let worst = result.policies.iter().min_by(order);
        let others = worst.filter(|worst| best.is_some_and(|best| best.number != worst.number));
        for policy in best.into_iter().chain(others) {
            let attempts = (0..).map(|attempt| {
                recording_in(&policy.recordings, RolloutAttempt { rollout: 0, attempt })
            });
            let Some(path) = attempts.take_while(|path| path.exists()).last() else { continue };
            let Ok(recording) = read(&path) else { continue };
            let name = format!("{} on {}, policy {}", result.recipe, result.plant, policy.number);
            let nominal = SimulatedSpecimen::nominal(&recording.header.settings.plant);
            rollouts.push((name, RolloutView::of(&recording, &nominal)));
        }
    }
    rollouts
}

/// Returns the fraction of successful repetitions of a method at a budget; `None` without a budget,
/// or before a repetition is finished.
fn share_of_plant(result: &RecipeResult) -> Option<ShareOfPlant> {
    let budget = result.budget.filter(|_| !result.policies.is_empty())?;
    let method = result.recipe.strip_suffix(&format!(" {budget}")).unwrap_or(&result.recipe);
    let interval = result.success_interval();
    Some(ShareOfPlant {
        plant: result.plant.clone(),
        method: method.to_owned(),
        budget,
        share: result.success_rate(),
        interval: [interval.lower, interval.upper],
    })
}

/// The figures of an experiment as data.
pub enum Figures<'a> {
    /// Success against the number of real rollouts, for methods that are scored until their first
    /// success.
    Methods(&'a MethodResults),
    /// Success after fixed numbers of real rollouts, for methods that are scored at budgets.
    Budgets(Vec<ShareOfPlant>),
    /// The distributions, searches and trainings of recipes.
    Recipes {
        plant: PlantModel,
        distributions: Vec<(String, DomainDistribution)>,
        searches: SearchReturns,
        progress: TrainingProgress,
    },
}

impl Figures<'_> {
    /// Draws the figures as SVG, each with the name of its file.
    fn drawn(&self) -> Result<Vec<(&'static str, String)>, DrawingError> {
        let mut drawn = Vec::new();
        match self {
            Self::Methods(results) => {
                let title = format!(
                    "{} on {}: recommendations that succeed",
                    results.recipe, results.plant
                );
                let line = |it: &MethodResult| StepLine {
                    name: it.method.name().into(),
                    corners: it.corners(),
                };
                let lines: Vec<StepLine> = results.methods.iter().map(line).collect();
                let budgets = results.methods.iter().filter_map(MethodResult::budget);
                let last = f64::from(budgets.max().unwrap_or(1).max(2));
                drawn.push(("strategies.svg", methods_svg(&title, &lines, last)?));
            }
            Self::Budgets(shares) => {
                let title = "policies that succeed, by plant";
                let first = shares.first().map(|it| it.budget);
                let is_one = shares.iter().all(|it| Some(it.budget) == first);
                let draw = if is_one { at_budget_svg } else { over_rollouts_svg };
                drawn.push(("budgets.svg", draw(title, shares)?));
            }
            Self::Recipes { plant, distributions, searches, progress } => {
                drawn.push(("figure-5.2.svg", densities_svg(distributions, plant)?));
                if !progress.is_empty() {
                    drawn.push(("figure-5.3.svg", training_progress_svg(progress)?));
                }
                if !searches.is_empty() {
                    drawn.push(("searches.svg", searches_svg(searches, SUCCESS_RETURN)?));
                }
            }
        }
        Ok(drawn)
    }

    /// Draws the figures and writes them into a folder, which is created if it is missing.
    pub fn write(&self, folder: &Path) -> Result<(), Failure> {
        let drawn = self.drawn().map_err(Failure::failed)?;
        MachineDisk
            .create_folder(folder)
            .map_err(|source| FolderError::Io { path: folder.to_owned(), source })
            .and_then(|()| {
                drawn.iter().try_for_each(|(name, svg)| {
                    write_whole(&MachineDisk, &folder.join(name), svg.as_bytes())
                        .map_err(FolderError::from)
                })
            })
            .map_err(|error| failures::folder(&error))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_csv_file_is_recognised_by_its_columns_and_a_pipe_is_not_one() {
        let folder = tempfile::tempdir().unwrap();
        let table = folder.path().join("table.csv");
        std::fs::write(&table, format!("{}\n1,2\n", recipe_table::CSV_BEGINS)).unwrap();
        assert!(ExperimentReport::is_csv(&table));
        std::fs::write(&table, "time_s,theta_rad\n").unwrap();
        assert!(!ExperimentReport::is_csv(&table));
        let pipe = folder.path().join("pipe.csv");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().unwrap();
        assert!(made.success());
        assert!(!ExperimentReport::is_csv(&pipe));
    }
}
