//! Draws the thesis's pictures of its toy problem.

use std::path::PathBuf;

use serde_json::json;

use super::destination::OutputFolder;
use super::exit::Failure;
use super::output::Output;
use crate::charts::toy::{SAMPLES, figure_3_1_svg, figure_3_2_svg};
use crate::storage::{MachineDisk, write_whole};

/// Draw the thesis's figures 3.1 and 3.2: how the surrogate and the acquisition functions work
///
/// Figure 3.1: the surrogate fitted to 3, 7 and 15 samples of a curve, and the likelihood of the
/// data over lengthscale and noise. Figure 3.2: four iterations of the search with PI, EI and UCB.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  qube-hil toy --out figures\n  qube-hil toy --seed 7 --out figures"
)]
pub struct Arguments {
    /// Folder for the SVG files; created if it does not exist
    #[arg(long, value_name = "DIR", default_value = "figures")]
    out: PathBuf,

    /// Seed of the samples: of the random positions, and of the noise of all samples
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Draws all figures.
pub fn run(arguments: &Arguments, output: &Output) -> Result<(), Failure> {
    let place = OutputFolder::of_option("--out", &arguments.out)?;
    let mut files = Vec::new();
    let mut keep = |name: String, drawn: anyhow::Result<String>| {
        let path = place.path().join(name);
        let svg = drawn
            .map_err(|error| Failure::failed(format!("cannot draw {}: {error}", path.display())))?;
        write_whole(&MachineDisk, &path, svg.as_bytes()).map_err(Failure::failed)?;
        files.push(path.display().to_string());
        Ok(())
    };
    for samples in SAMPLES {
        keep(format!("figure-3.1-{samples}-samples.svg"), figure_3_1_svg(samples, arguments.seed))?;
    }
    keep("figure-3.2.svg".into(), figure_3_2_svg(arguments.seed))?;
    output.print(&files.join("\n"), &json!({ "files": files }));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_drawn_whole_and_repeat() {
        let surface = figure_3_1_svg(7, 0).unwrap();
        for words in ["sample seed 3", "log marginal likelihood", "noise deviation", "true curve"] {
            assert!(surface.contains(words), "{words}");
        }
        let iterations = figure_3_2_svg(0).unwrap();
        for words in ["PI, iteration 1", "EI, iteration 4", "UCB (β = 2), iteration 4"] {
            assert!(iterations.contains(words), "{words}");
        }
        assert_eq!(iterations, figure_3_2_svg(0).unwrap());
        assert_ne!(iterations, figure_3_2_svg(1).unwrap());
    }
}
