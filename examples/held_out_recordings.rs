//! Scores `identify` on recordings of a real Qube. Each recording in turn is left out of the fit
//! and predicted by the fitted model.
//!
//! ```text
//! cargo run --release --example held_out_recordings [FOLDER [terms]]
//! ```
//!
//! FOLDER holds chirps and swing-ups as CSV files; without FOLDER, `../shared/data/qube-recordings`
//! is read. First the program fits a model for each chirp to the other chirps; then for each
//! recording to all other recordings. The cable's rest angle comes from the fitted recordings of
//! the same series, whose names differ in the last number only. Each entry of the table has the
//! root mean square errors of theta and alpha in rad for one kind of motion, and the number of
//! predictions in brackets. The name of a row for one recording ends with the duration of the fit.
//!
//! With `terms`, the program measures the worth of each term that `identify` adds to the thesis's
//! equations: it fits again without friction, dead zones, cable or delay, and prints how much less
//! likely the recordings that were left out become, in nats a prediction. The errors of predictions
//! are taken as normally distributed, with the root mean square of the same errors on the fitted
//! recordings as standard deviation.

use std::path::{Path, PathBuf};
use std::time::Instant;

use qube_hil::identification::{
    HorizonError, Identified, IdentifyError, PredictionRegime, Unknown, comes_upright,
    horizon_error, identify, regime_error, series_of,
};
use qube_hil::qube::{Nonideality, Profile, QubeModel};
use qube_hil::replay::MotionLog;

/// Horizon over which a chirp is predicted, s.
const CHIRP_S: f64 = 9.8;

/// Horizon over which a chirp is predicted with `terms`, s: a recording then has many predictions.
const SHORT_CHIRP_S: f64 = 1.0;

/// Sums of the squared errors of theta and alpha, rad^2, and the number of predictions.
#[derive(Clone, Copy, Default)]
struct Pool {
    squares: [f64; 2],
    predictions: usize,
}

impl Pool {
    fn add(&mut self, error: &HorizonError) {
        let count = error.predictions as f64;
        self.squares[0] += count * error.rms.theta_rad.powi(2);
        self.squares[1] += count * error.rms.alpha_rad.powi(2);
        self.predictions += error.predictions;
    }

    /// Root mean square errors of theta and alpha, rad.
    fn rms(&self) -> [f64; 2] {
        self.squares.map(|square| (square / self.predictions.max(1) as f64).sqrt())
    }

    /// The logarithm of the density of these errors, which are normal with the standard deviations
    /// `stds`, rad, up to a constant for each prediction.
    fn log_density(&self, stds: [f64; 2]) -> f64 {
        let of = |(square, std): (f64, f64)| {
            -(self.predictions as f64) * std.ln() - 0.5 * square / std.powi(2)
        };
        self.squares.into_iter().zip(stds).map(of).sum()
    }

    fn text(&self) -> String {
        let [theta, alpha] = self.rms();
        format!("{theta:.3}/{alpha:.3} ({})", self.predictions)
    }
}

/// Pooled errors of the swing-up, of balancing and of chirps.
type Scores = [Pool; 3];

/// Terms of the equations that are left out together, and their name.
const TERMS: [(&str, &[Nonideality]); 4] = [
    ("friction", &[Nonideality::CoulombTorque]),
    ("dead zones", &[Nonideality::PositiveDeadZone, Nonideality::NegativeDeadZone]),
    ("cable", &[Nonideality::CableStiffness, Nonideality::CableRest]),
    ("delay", &[Nonideality::CommandDelay]),
];

fn score(scores: &mut Scores, log: &MotionLog, model: &QubeModel, chirp_s: f64) {
    let log = std::slice::from_ref(log);
    if comes_upright(&log[0]) {
        scores[0].add(&regime_error(log, model, PredictionRegime::Swing));
        scores[1].add(&regime_error(log, model, PredictionRegime::Balance));
    } else {
        scores[2].add(&horizon_error(log, model, chirp_s));
    }
}

fn line(name: &str, scores: &Scores) {
    let [swing, balance, chirp] = scores.map(|pool| pool.text());
    println!("{name:40} {swing:>20} {balance:>20} {chirp:>20}");
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let named = arguments.next().map(PathBuf::from);
    let asks_terms = arguments.next().is_some_and(|argument| argument == "terms");
    let folder = named.unwrap_or_else(|| PathBuf::from("../shared/data/qube-recordings"));
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder)
        .map(|entries| entries.filter_map(|entry| Some(entry.ok()?.path())).collect())
        .unwrap_or_default();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "csv"));
    files.sort();
    if files.is_empty() {
        println!("skipped: no recordings in {}", folder.display());
        return;
    }
    let logs: Vec<MotionLog> = files
        .iter()
        .map(|path| MotionLog::read(path).expect("the recording can be read"))
        .collect();
    if asks_terms {
        return worth_of_terms(&files, &logs);
    }
    println!("{:40} {:>20} {:>20} {:>20}", "model", "swing 0.5 s", "balance 0.1 s", "chirp 9.8 s");
    let lab = Profile::lab().model();
    for (name, model) in [("nominal", QubeModel::NOMINAL), ("lab", lab)] {
        let mut scores = Scores::default();
        logs.iter().for_each(|log| score(&mut scores, log, &model, CHIRP_S));
        line(name, &scores);
    }
    in_turn("chirps, each in turn", &files, &logs, |log| !comes_upright(log));
    in_turn("all, each in turn", &files, &logs, |_| true);
}

/// Scores each recording of `kind` with a model that is fitted to the other recordings of that
/// kind, and prints the errors of each and of all.
fn in_turn(name: &str, files: &[PathBuf], logs: &[MotionLog], kind: impl Fn(&MotionLog) -> bool) {
    let unknowns: Vec<Unknown> = Unknown::all().collect();
    let kept: Vec<usize> = (0..logs.len()).filter(|&index| kind(&logs[index])).collect();
    let mut scores = Scores::default();
    for &held_out in &kept {
        let others: Vec<usize> = kept.iter().copied().filter(|&it| it != held_out).collect();
        let started = Instant::now();
        match Without::fit(files, logs, held_out, &others, &unknowns) {
            Ok(fit) => {
                let seconds = started.elapsed().as_secs_f64();
                let mut own = Scores::default();
                score(&mut own, &logs[held_out], &fit.model, CHIRP_S);
                score(&mut scores, &logs[held_out], &fit.model, CHIRP_S);
                line(&format!("  without {} {seconds:.0} s", file_name(&files[held_out])), &own);
            }
            Err(why) => println!("  without {}: refused: {why}", file_name(&files[held_out])),
        }
    }
    line(name, &scores);
}

/// A fit without one recording.
struct Without {
    found: Identified,
    /// Model for the recording that was left out.
    model: QubeModel,
}

impl Without {
    fn fit(
        files: &[PathBuf],
        logs: &[MotionLog],
        held_out: usize,
        others: &[usize],
        unknowns: &[Unknown],
    ) -> Result<Self, IdentifyError> {
        let fitted: Vec<MotionLog> = others.iter().map(|&index| logs[index].clone()).collect();
        let found = identify(&fitted, unknowns, &QubeModel::NOMINAL)?;
        let alike: Vec<usize> = (0..others.len())
            .filter(|&place| series_of(&files[others[place]]) == series_of(&files[held_out]))
            .collect();
        let model = found.model_of(&alike);
        Ok(Self { found, model })
    }
}

/// Prints the worth of each of [`TERMS`]: by how many nats a prediction the recordings that a fit
/// leaves out become less likely when the fit also leaves the term out, and how many of them do.
fn worth_of_terms(files: &[PathBuf], logs: &[MotionLog]) {
    let indices: Vec<usize> = (0..logs.len()).collect();
    // For each recording, the logarithm of its density and the number of its predictions.
    let densities = |name: &str, left_out: &[Nonideality]| -> Vec<Option<(f64, usize)>> {
        let without: Vec<Unknown> = left_out.iter().map(|&term| Unknown::from(term)).collect();
        let unknowns: Vec<Unknown> = Unknown::all().filter(|it| !without.contains(it)).collect();
        let mut pooled = Scores::default();
        let mut density_of = |&held_out: &usize| {
            let others: Vec<usize> = indices.iter().copied().filter(|&it| it != held_out).collect();
            let fit = Without::fit(files, logs, held_out, &others, &unknowns).ok()?;
            let mut known = Scores::default();
            for (place, &other) in others.iter().enumerate() {
                score(&mut known, &logs[other], &fit.found.model_of(&[place]), SHORT_CHIRP_S);
            }
            let mut own = Scores::default();
            score(&mut own, &logs[held_out], &fit.model, SHORT_CHIRP_S);
            score(&mut pooled, &logs[held_out], &fit.model, SHORT_CHIRP_S);
            let seen = own.iter().zip(&known).filter(|(own, _)| own.predictions > 0);
            let density = seen.map(|(own, known)| own.log_density(known.rms())).sum();
            Some((density, own.iter().map(|pool| pool.predictions).sum()))
        };
        let densities = indices.iter().map(&mut density_of).collect();
        line(name, &pooled);
        densities
    };
    println!("{:40} {:>20} {:>20} {:>20}", "model", "swing 0.5 s", "balance 0.1 s", "chirp 1 s");
    let full = densities("all terms", &[]);
    for (name, left_out) in TERMS {
        let poorer = densities(&format!("without {name}"), left_out);
        let both: Vec<(f64, usize)> = full
            .iter()
            .zip(&poorer)
            .filter_map(|(full, poorer)| Some((full.as_ref()?, poorer.as_ref()?)))
            .map(|(&(full, predictions), &(poorer, _))| (full - poorer, predictions))
            .collect();
        let nats: f64 = both.iter().map(|(nats, _)| nats).sum();
        let predictions: usize = both.iter().map(|(_, predictions)| predictions).sum();
        let less = both.iter().filter(|(nats, _)| *nats > 0.0).count();
        println!(
            "  {:.2} nats a prediction less likely; {less} of {} recordings less likely",
            nats / predictions.max(1) as f64,
            both.len()
        );
    }
}

fn file_name(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}
