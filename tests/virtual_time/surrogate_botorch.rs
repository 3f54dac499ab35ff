//! Compares the numbers of the surrogate with BoTorch's.
//!
//! Reads each `botorch_fixture_*.json` in `tests/fixtures`, which has four small files, and in
//! `$QUBE_HIL_FIXTURES`; if that variable is not set, in `../shared/fixtures`, relative to the
//! repository. Each file describes its numbers.

use std::path::{Path, PathBuf};

use qube_hil::surrogate::{
    Acquisition, Criterion, Dataset, ExpectedImprovement, FitSettings, GaussianProcess,
    Hyperparameters, Kernel, LogExpectedImprovement, MaximiserSettings, MeanFunction, OnProcess,
    PriorSet, SearchBox, fit, log_marginal_likelihood, maximise,
};
use serde::Deserialize;

use crate::shared::say_skipped;

#[derive(Deserialize)]
struct Fixture {
    /// Kernel of the process; a file that names none uses Matérn 5/2.
    #[serde(default)]
    kernel: Kernel,
    bounds_lo: Vec<f64>,
    bounds_hi: Vec<f64>,
    x: Vec<Vec<f64>>,
    y: Vec<f64>,
    y_mean: f64,
    y_std: f64,
    best_f: f64,
    x_test: Vec<Vec<f64>>,
    at_reference: Evaluation,
    best_fit_of_8_starts: Evaluation,
    acquisition_optimum: AcquisitionOptimum,
}

#[derive(Deserialize)]
struct Evaluation {
    hyperparameters: BotorchHyperparameters,
    objective_total: f64,
    log_marginal_likelihood: f64,
    log_prior_total: f64,
    d_lml_d_mean_constant: f64,
    d_lml_d_raw_lengthscale: Vec<f64>,
    posterior_mean: Vec<f64>,
    posterior_var: Vec<f64>,
    ei: Vec<f64>,
    log_ei: Vec<f64>,
}

#[derive(Deserialize)]
struct BotorchHyperparameters {
    mean_constant: f64,
    lengthscale: Vec<f64>,
    outputscale: f64,
    noise: f64,
}

#[derive(Deserialize)]
struct AcquisitionOptimum {
    log_ei: f64,
}

/// The fixtures of one folder, by name; empty if the folder cannot be read.
fn fixtures_in(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else {
        return Vec::new();
    };
    let mut found: Vec<PathBuf> = entries
        .map(|entry| entry.unwrap().path())
        .filter(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with("botorch_fixture_") && name.ends_with(".json")
        })
        .collect();
    found.sort();
    found
}

#[test]
fn the_surrogate_agrees_with_the_botorch_fixtures_of_this_repository() {
    let found = fixtures_in(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures"));
    assert!(!found.is_empty());
    found.iter().for_each(|path| compare(path));
}

#[test]
fn the_surrogate_agrees_with_botorch_fixtures_from_outside() {
    let shared = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/fixtures");
    let named = std::env::var_os("QUBE_HIL_FIXTURES").map(PathBuf::from);
    let folder = named.clone().unwrap_or_else(shared);
    let found = fixtures_in(&folder);
    if found.is_empty() {
        // A folder that was named explicitly must not be skipped.
        assert!(named.is_none(), "no botorch_fixture_*.json in {}", folder.display());
        let reason = format!("no botorch_fixture_*.json in {}", folder.display());
        return say_skipped("a comparison with BoTorch from outside", reason, &[]);
    }
    found.iter().for_each(|path| compare(path));
}

fn compare(path: &Path) {
    let name = path.file_name().unwrap().to_string_lossy().into_owned();
    let fixture: Fixture = serde_json::from_slice(&std::fs::read(path).unwrap())
        .unwrap_or_else(|error| panic!("{name}: {error}"));
    let priors = if name.contains("gamma") { PriorSet::Gamma } else { PriorSet::Lognormal };
    let search_box = SearchBox::new(fixture.bounds_lo.clone(), fixture.bounds_hi.clone()).unwrap();
    let data = Dataset::new(&search_box, &fixture.x, &fixture.y, None).unwrap();
    close(&name, "mean of y", data.offset(), fixture.y_mean);
    close(&name, "deviation of y", data.scale(), fixture.y_std);
    close(&name, "largest y", data.largest_value(), fixture.best_f);

    for evaluation in [&fixture.at_reference, &fixture.best_fit_of_8_starts] {
        at_given_hyperparameters(&name, &fixture, priors, &data, evaluation);
    }

    let theirs = &fixture.best_fit_of_8_starts;
    for seed in 0..5 {
        let settings = FitSettings {
            kernel: fixture.kernel,
            mean: MeanFunction::Constant,
            priors,
            seed,
            ..FitSettings::default()
        };
        let ours = fit(&data, &settings).unwrap();
        let advantage = ours.objective - theirs.objective_total;
        assert!(advantage >= -1e-6, "{name}: our fit reaches {advantage} relative to theirs");
        println!("{name}: objective after fitting minus theirs {advantage:+.2e} (seed {seed})");
    }

    // BoTorch's acquisition optimum belongs to its fitted hyperparameters.
    let process = process_at(&data, fixture.kernel, &theirs.hyperparameters);
    let acquisition = OnProcess {
        process: &process,
        criterion: LogExpectedImprovement { incumbent: fixture.best_f },
    };
    for seed in 0..5 {
        let settings = MaximiserSettings { seed, ..MaximiserSettings::default() };
        let found = maximise(&acquisition, &search_box, &[], &settings);
        let advantage = found.value - fixture.acquisition_optimum.log_ei;
        assert!(advantage >= -1e-6, "{name}: our log EI optimum is {advantage} relative to theirs");
        println!("{name}: log EI optimum minus theirs {advantage:+.2e} (seed {seed})");
    }
}

fn process_at(data: &Dataset, kernel: Kernel, theirs: &BotorchHyperparameters) -> GaussianProcess {
    GaussianProcess::new(data.clone(), kernel, translated(theirs)).unwrap()
}

fn translated(theirs: &BotorchHyperparameters) -> Hyperparameters {
    Hyperparameters {
        mean: theirs.mean_constant,
        lengthscales: theirs.lengthscale.clone(),
        signal_variance: theirs.outputscale,
        noise_variance: theirs.noise,
    }
}

fn at_given_hyperparameters(
    name: &str,
    fixture: &Fixture,
    priors: PriorSet,
    data: &Dataset,
    theirs: &Evaluation,
) {
    let hyperparameters = translated(&theirs.hyperparameters);
    let evidence = log_marginal_likelihood(data, fixture.kernel, &hyperparameters).unwrap();
    close(name, "log marginal likelihood", evidence.value, theirs.log_marginal_likelihood);
    close(name, "log prior", hyperparameters.log_prior(priors), theirs.log_prior_total);

    // Their gradients are with respect to raw parameters: l = ln(1 + exp(raw)) for gamma priors,
    // and l = raw otherwise. A gradient near 0 is a difference of larger terms, so the error is
    // relative to the largest component, or to 1 if that is larger.
    let gradients = theirs.d_lml_d_raw_lengthscale.iter();
    let size = gradients.fold(1.0_f64, |most, gradient| most.max(gradient.abs()));
    for ((ours, l), raw) in evidence
        .d_log_lengthscales
        .iter()
        .zip(&hyperparameters.lengthscales)
        .zip(&theirs.d_lml_d_raw_lengthscale)
    {
        let d_raw = if priors == PriorSet::Gamma { 1.0 - (-l).exp() } else { 1.0 };
        assert!((ours / l * d_raw - raw).abs() < 1e-9 * size, "{name}: {} {raw}", ours / l * d_raw);
    }
    let d_mean_error = (evidence.d_mean - theirs.d_lml_d_mean_constant).abs();
    assert!(
        d_mean_error < 1e-9 * (1.0 + theirs.d_lml_d_mean_constant.abs()),
        "{name}: {d_mean_error}"
    );

    let process = GaussianProcess::new(data.clone(), fixture.kernel, hyperparameters).unwrap();
    let improvement = ExpectedImprovement { incumbent: fixture.best_f };
    let log_improvement = LogExpectedImprovement { incumbent: fixture.best_f };
    for (i, point) in fixture.x_test.iter().enumerate() {
        let posterior = process.posterior(point);
        close(name, "posterior mean", posterior.mean, theirs.posterior_mean[i]);
        close(name, "posterior variance", posterior.variance, theirs.posterior_var[i]);
        let score = |criterion: &dyn Criterion| {
            criterion.score(posterior.mean, posterior.deviation()).value
        };
        close_logarithms(name, "log EI", score(&log_improvement), theirs.log_ei[i]);
        // BoTorch's plain expected improvement (EI) is a difference, which rounding dominates far
        // from the incumbent; its own log EI gives the correct value.
        let sound = theirs.log_ei[i] > -30.0;
        let expected = if sound { theirs.ei[i] } else { theirs.log_ei[i].exp() };
        close(name, "EI", score(&improvement), expected);
        let whole = OnProcess { process: &process, criterion: log_improvement };
        close_logarithms(name, "log EI of the process", whole.value(point), theirs.log_ei[i]);
    }
}

/// Checks that two numbers differ by less than a relative 1e-9.
fn close(name: &str, quantity: &str, ours: f64, theirs: f64) {
    let error = (ours - theirs).abs() / theirs.abs();
    assert!(
        ours == theirs || error < 1e-9,
        "{name}: {quantity} is {ours}, BoTorch has {theirs} (relative {error:e})"
    );
}

/// Checks that two logarithms differ by less than 1e-9, or by a relative 1e-9 if they exceed 1 in
/// magnitude.
fn close_logarithms(name: &str, quantity: &str, ours: f64, theirs: f64) {
    let error = (ours - theirs).abs() / theirs.abs().max(1.0);
    assert!(
        error < 1e-9,
        "{name}: {quantity} is {ours}, BoTorch has {theirs} (relative {error:e})"
    );
}
