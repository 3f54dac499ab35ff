//! Time to propose the next candidate: to fit the surrogate, and to maximise the acquisition
//! function.
//!
//! `cargo bench --bench surrogate`; pin it to one core (`taskset -c 1`) to compare ratios. The data
//! are noisy samples of a synthetic return over eight dimensions.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use qube_hil::surrogate::{
    Dataset, FitSettings, GaussianProcess, LogExpectedImprovement, LogKnowledgeGradient,
    LogNoisyExpectedImprovement, MaximiserSettings, MeanFunction, OnProcess, PriorSet, SearchBox,
    maximise, sobol_point,
};

const DIMENSIONS: usize = 8;

/// Samples of a hump over the unit cube, similar to a return, with noise of standard deviation 15.
fn data(count: usize) -> Dataset {
    let search_box = SearchBox::unit(DIMENSIONS).expect("eight dimensions");
    let centre = [0.3, 0.6, 0.5, 0.4, 0.7, 0.2, 0.5, 0.5];
    let weight = [3.0, 2.0, 2.5, 0.5, 1.0, 1.5, 0.1, 0.05];
    let points: Vec<Vec<f64>> = (0..count).map(|i| sobol_point(i, DIMENSIONS, 1)).collect();
    let values: Vec<f64> = points
        .iter()
        .enumerate()
        .map(|(i, x)| {
            let bowl: f64 = (0..DIMENSIONS).map(|d| weight[d] * (x[d] - centre[d]).powi(2)).sum();
            let noise: f64 = sobol_point(i, 12, 7).iter().sum::<f64>() - 6.0;
            540.0 * (-bowl).exp() + 20.0 * (6.0 * x[0]).sin() + 15.0 * noise
        })
        .collect();
    Dataset::new(&search_box, &points, &values, None).expect("finite values inside the box")
}

/// The settings with which BoTorch is timed too: gamma priors and a constant mean.
fn settings() -> FitSettings {
    FitSettings { mean: MeanFunction::Constant, priors: PriorSet::Gamma, ..FitSettings::default() }
}

fn fitted(count: usize) -> GaussianProcess {
    GaussianProcess::fit(data(count), &settings()).expect("noise keeps the covariance definite")
}

fn fit(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("fit");
    for count in [25, 100, 500, 1000, 2000] {
        group.sample_size(if count < 100 { 30 } else { 10 });
        group.bench_with_input(
            BenchmarkId::from_parameter(count),
            &data(count),
            |bencher, data| {
                bencher.iter(|| GaussianProcess::fit(black_box(data.clone()), &settings()));
            },
        );
    }
    group.finish();
}

fn maximise_acquisition(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("maximise");
    let settings = MaximiserSettings::default();
    for count in [25, 100, 500, 1000, 2000] {
        group.sample_size(if count < 100 { 30 } else { 10 });
        let process = fitted(count);
        let search_box = process.data().search_box().clone();
        group.bench_with_input(BenchmarkId::new("log-ei", count), &process, |bencher, process| {
            let incumbent = process.data().largest_value();
            let acquisition =
                OnProcess { process, criterion: LogExpectedImprovement { incumbent } };
            bencher.iter(|| maximise(black_box(&acquisition), &search_box, &[], &settings));
        });
        group.bench_with_input(BenchmarkId::new("log-nei", count), &process, |bencher, process| {
            bencher.iter(|| {
                let acquisition = LogNoisyExpectedImprovement::new(process, &[], 1);
                acquisition.map(|usable| maximise(black_box(&usable), &search_box, &[], &settings))
            });
        });
        group.bench_with_input(BenchmarkId::new("log-kg", count), &process, |bencher, process| {
            let acquisition = LogKnowledgeGradient::new(process, &[]);
            bencher.iter(|| maximise(black_box(&acquisition), &search_box, &[], &settings));
        });
    }
    group.finish();
}

criterion_group!(benches, fit, maximise_acquisition);
criterion_main!(benches);
