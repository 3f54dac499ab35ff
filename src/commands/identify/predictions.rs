use std::path::PathBuf;

use crate::identification::{
    HorizonError, Identified, PredictionBand, PredictionRegime, comes_upright, horizon_error,
    prediction_errors, regime_error, series_of,
};
use crate::qube::QubeModel;
use crate::replay::{AngleError, MotionLog};

/// Horizons at which the table shows the predictions of recordings whose pendulum stays down, such
/// as chirps and steps, s. The longest is the rest of an excitation of 10 s after the 0.2 s from
/// which the start state is estimated.
const HORIZONS_S: [f64; 3] = [0.01, 0.5, 9.8];

/// The predictions of the fitted model for all recordings, fitted and held out.
#[derive(Debug)]
pub struct Predictions {
    /// Model of each fitted recording: with the cable's rest angle of that recording.
    pub fitted_models: Vec<QubeModel>,
    /// Model of each held-out recording: with the cable's rest angle of the fitted recordings of
    /// the same series.
    pub held_out_models: Vec<QubeModel>,
    /// Errors in the fitted and in the held-out recordings.
    pub errors: [PredictionErrors; 2],
    /// The band that contains 90 % of the errors in the fitted recordings; `None` if these are too
    /// short for a prediction.
    pub band: Option<PredictionBand>,
    /// The shares of the errors in the held-out recordings that are within the band; `None` without
    /// a band or without such errors.
    pub within: Option<WithinBand>,
}

/// The shares of the errors in held-out recordings that are within the band of the fitted ones.
#[derive(Clone, Copy, Debug)]
pub struct WithinBand {
    /// Share of the errors of theta and of alpha.
    pub shares: [f64; 2],
    /// Number of predictions.
    pub predictions: usize,
}

impl Predictions {
    /// Predicts the fitted and the held-out recordings; `files` are their paths in the same order.
    pub fn of(
        identified: &Identified,
        [fitted, held_out]: [&[MotionLog]; 2],
        files: &[Vec<PathBuf>; 2],
    ) -> Self {
        let [fitted_files, held_out_files] = files;
        let fitted_models: Vec<QubeModel> =
            (0..fitted_files.len()).map(|place| identified.model_of(&[place])).collect();
        let of_the_same_series = |path: &PathBuf| -> Vec<usize> {
            let series = series_of(path);
            let places = fitted_files.iter().enumerate();
            places
                .filter(|(_, fitted)| series_of(fitted) == series)
                .map(|(place, _)| place)
                .collect()
        };
        let held_out_models: Vec<QubeModel> = held_out_files
            .iter()
            .map(|path| identified.model_of(&of_the_same_series(path)))
            .collect();
        let band = PredictionBand::of(&pooled(fitted, &fitted_models));
        let held_out_errors = pooled(held_out, &held_out_models);
        let within = band.filter(|_| !held_out_errors.is_empty()).map(|band| WithinBand {
            shares: band.shares_within(&held_out_errors),
            predictions: held_out_errors.len(),
        });
        let errors = [
            PredictionErrors::of("fitted", fitted, &fitted_models),
            PredictionErrors::of("held out", held_out, &held_out_models),
        ];
        Self { fitted_models, held_out_models, errors, band, within }
    }
}

/// Returns the errors of the predictions of half a second in all these recordings.
fn pooled(logs: &[MotionLog], models: &[QubeModel]) -> Vec<AngleError> {
    let pairs = logs.iter().zip(models);
    pairs.flat_map(|(log, model)| prediction_errors(log, model)).collect()
}

/// The errors of the predictions of a group of recordings.
#[derive(Debug)]
pub struct PredictionErrors {
    /// Name of the group in the table.
    pub group: &'static str,
    /// Errors of the recordings whose pendulum never comes upright, in the order of
    /// [`HORIZONS_S`].
    pub horizons: [HorizonError; 3],
    /// Errors of the other recordings, in the order of [`PredictionRegime::ALL`].
    pub regimes: [(PredictionRegime, HorizonError); 2],
}

impl PredictionErrors {
    /// Predicts each recording with its own model.
    fn of(group: &'static str, logs: &[MotionLog], models: &[QubeModel]) -> Self {
        let pairs = || logs.iter().zip(models);
        let horizon = |horizon_s: f64| {
            let hanging = pairs().filter(|(log, _)| !comes_upright(log));
            let parts: Vec<HorizonError> = hanging
                .map(|(log, model)| horizon_error(std::slice::from_ref(log), model, horizon_s))
                .collect();
            HorizonError::pooled(horizon_s, &parts)
        };
        let regime = |regime: PredictionRegime| {
            let parts: Vec<HorizonError> = pairs()
                .map(|(log, model)| regime_error(std::slice::from_ref(log), model, regime))
                .collect();
            (regime, HorizonError::pooled(regime.times().horizon_s, &parts))
        };
        Self {
            group,
            horizons: HORIZONS_S.map(horizon),
            regimes: PredictionRegime::ALL.map(regime),
        }
    }

    /// Returns the errors over the longest horizon, `None` if no recording is that long.
    pub fn longest(&self) -> Option<&HorizonError> {
        self.horizons.last().filter(|error| error.predictions > 0)
    }
}
