//! Time of the parts of a training: a gradient step of both networks, the collection of a batch, an
//! evaluation, and a whole update.
//!
//! `cargo bench --bench learning`; pin it to one core for comparable figures.

use criterion::{Criterion, criterion_group, criterion_main};
use qube_hil::elementary::Level;
use qube_hil::learning::{TrainSettings, Workbench};
use qube_hil::simulation::DomainDistribution;

fn parts(criterion: &mut Criterion) {
    let distribution = DomainDistribution::nominal();
    let settings = TrainSettings::thesis();
    let workbench = || Workbench::new(&distribution, &settings, 0).expect("settings of a preset");

    let mut group = criterion.benchmark_group("gradient_step");
    for level in Level::ALL.into_iter().filter(|level| level.is_available()) {
        let mut workbench = workbench().at_level(level);
        group.bench_function(format!("{level:?}"), |bencher| {
            bencher.iter(|| workbench.gradient_step());
        });
    }
    group.finish();

    let mut workbench = workbench();
    let mut group = criterion.benchmark_group("update");
    group.sample_size(10);
    group.bench_function("collect_48000", |bencher| bencher.iter(|| workbench.collect()));
    group.bench_function("evaluate_100", |bencher| bencher.iter(|| workbench.evaluate()));
    group.bench_function("whole", |bencher| {
        bencher.iter(|| workbench.update().expect("nothing stops the update"));
    });
    group.finish();
}

criterion_group!(benches, parts);
criterion_main!(benches);
