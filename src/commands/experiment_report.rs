use std::path::Path;

use serde_json::Value;

use super::exit::Failure;
use super::{experiment_table, failures, strategy_table};
use crate::charts::{DrawingError, StepLine, densities_svg, searches_svg, strategies_svg};
use crate::experiment::{
    Experiment, ExperimentError, Results, SearchReturns, StrategyResult, StrategyResults,
};
use crate::session::FolderError;
use crate::simulation::DomainDistribution;
use crate::storage::{Disk, MachineDisk, write_whole};

/// The finished work of an experiment, read once for its table, JSON, CSV and figures.
pub enum ExperimentReport {
    /// Of recipes.
    Recipes(Results),
    /// Of a comparison of strategies.
    Strategies(StrategyResults),
}

impl ExperimentReport {
    /// Reads all finished work.
    ///
    /// # Errors
    /// A session, policy or recording cannot be read.
    pub fn read(experiment: &Experiment) -> Result<Self, ExperimentError> {
        Ok(match StrategyResults::read(experiment)? {
            Some(results) => Self::Strategies(results),
            None => Self::Recipes(Results::read(experiment)?),
        })
    }

    /// The table for people.
    pub fn text(&self) -> String {
        match self {
            Self::Recipes(results) => experiment_table::table(results),
            Self::Strategies(results) => strategy_table::table(results),
        }
    }

    /// The results for scripts.
    pub fn json(&self) -> Value {
        match self {
            Self::Recipes(results) => experiment_table::value(results),
            Self::Strategies(results) => strategy_table::value(results),
        }
    }

    /// The results as CSV.
    pub fn csv(&self) -> String {
        match self {
            Self::Recipes(results) => experiment_table::csv(results),
            Self::Strategies(results) => strategy_table::csv(results),
        }
    }

    /// The figures; those of recipes need the searches and distributions too.
    ///
    /// # Errors
    /// A search cannot be read.
    pub fn figures(&self, experiment: &Experiment) -> Result<Figures<'_>, ExperimentError> {
        Ok(match self {
            Self::Strategies(results) => Figures::Strategies(results),
            Self::Recipes(_) => Figures::Recipes {
                distributions: experiment.distributions()?,
                searches: experiment.searches()?,
            },
        })
    }
}

/// The figures of an experiment as data.
pub enum Figures<'a> {
    /// Success against real rollouts, of a comparison of strategies.
    Strategies(&'a StrategyResults),
    /// The distributions and searches of recipes.
    Recipes { distributions: Vec<(String, DomainDistribution)>, searches: SearchReturns },
}

impl Figures<'_> {
    /// The figures by the names of their files.
    fn drawn(&self) -> Result<Vec<(&'static str, String)>, DrawingError> {
        let mut drawn = Vec::new();
        match self {
            Self::Strategies(results) => {
                let title = format!(
                    "{} on {}: recommendations that succeed",
                    results.recipe, results.plant
                );
                let line = |it: &StrategyResult| StepLine {
                    name: it.method.name().into(),
                    corners: it.corners(),
                };
                let lines: Vec<StepLine> = results.strategies.iter().map(line).collect();
                let budgets = results.strategies.iter().filter_map(StrategyResult::budget);
                let last = f64::from(budgets.max().unwrap_or(1).max(2));
                drawn.push(("strategies.svg", strategies_svg(&title, &lines, last)?));
            }
            Self::Recipes { distributions, searches } => {
                drawn.push(("figure-5.2.svg", densities_svg(distributions)?));
                if !searches.is_empty() {
                    drawn.push(("figure-5.3.svg", searches_svg(searches)?));
                }
            }
        }
        Ok(drawn)
    }

    /// Draws the figures and writes them into a folder.
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
