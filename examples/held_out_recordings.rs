//! Scores `identify` on recordings of a real Qube. Each recording in turn is left out of the fit
//! and predicted by the fitted model.
//!
//! ```text
//! cargo run --release --example held_out_recordings [FOLDER]
//! ```
//!
//! FOLDER holds chirps and swing-ups as CSV files; without FOLDER, `../shared/data/qube-recordings`
//! is read. For each chirp a model is fitted to the other chirps, and then for each recording to
//! all other recordings. The cable's rest angle comes from the fitted recordings of the same
//! series, whose names differ in the last number only. Each entry of the table has the root mean
//! square errors of theta and alpha in rad for one kind of motion, and the number of predictions
//! in brackets. The name of a row for one recording ends with the duration of the fit.

use std::path::{Path, PathBuf};
use std::time::Instant;

use qube_hil::identification::{
    HorizonError, PredictionRegime, Unknown, comes_upright, horizon_error, identify, regime_error,
    series_of,
};
use qube_hil::qube::{Profile, QubeModel};
use qube_hil::replay::MotionLog;

/// Horizon over which a chirp is predicted, s.
const CHIRP_S: f64 = 9.8;

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

    fn text(&self) -> String {
        let [theta, alpha] =
            self.squares.map(|square| (square / self.predictions.max(1) as f64).sqrt());
        format!("{theta:.3}/{alpha:.3} ({})", self.predictions)
    }
}

/// Pooled errors of the swing-up, of balancing and of chirps.
type Scores = [Pool; 3];

fn score(scores: &mut Scores, log: &MotionLog, model: &QubeModel) {
    let log = std::slice::from_ref(log);
    if comes_upright(&log[0]) {
        scores[0].add(&regime_error(log, model, PredictionRegime::Swing));
        scores[1].add(&regime_error(log, model, PredictionRegime::Balance));
    } else {
        scores[2].add(&horizon_error(log, model, CHIRP_S));
    }
}

fn line(name: &str, scores: &Scores) {
    let [swing, balance, chirp] = scores.map(|pool| pool.text());
    println!("{name:40} {swing:>20} {balance:>20} {chirp:>20}");
}

fn main() {
    let named = std::env::args().nth(1).map(PathBuf::from);
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
    let logs: Vec<MotionLog> =
        files.iter().map(|path| MotionLog::read(path).expect("a recording")).collect();
    println!("{:40} {:>20} {:>20} {:>20}", "model", "swing 0.5 s", "balance 0.1 s", "chirp 9.8 s");
    let lab = Profile::lab().model();
    for (name, model) in [("nominal", QubeModel::NOMINAL), ("lab", lab)] {
        let mut scores = Scores::default();
        logs.iter().for_each(|log| score(&mut scores, log, &model));
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
        let others = kept.iter().filter(|&&index| index != held_out);
        let fitted: Vec<MotionLog> = others.map(|&index| logs[index].clone()).collect();
        let started = Instant::now();
        match identify(&fitted, &unknowns, &QubeModel::NOMINAL) {
            Ok(found) => {
                let seconds = started.elapsed().as_secs_f64();
                let fitted = kept.iter().filter(|&&index| index != held_out).enumerate();
                let alike: Vec<usize> = fitted
                    .filter(|(_, index)| series_of(&files[**index]) == series_of(&files[held_out]))
                    .map(|(place, _)| place)
                    .collect();
                let model = found.model_of(&alike);
                let mut own = Scores::default();
                score(&mut own, &logs[held_out], &model);
                score(&mut scores, &logs[held_out], &model);
                line(&format!("  without {} {seconds:.0} s", file_name(&files[held_out])), &own);
            }
            Err(why) => println!("  without {}: refused: {why}", file_name(&files[held_out])),
        }
    }
    line(name, &scores);
}

fn file_name(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}
