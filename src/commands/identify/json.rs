use std::path::PathBuf;

use serde_json::{Value, json};

use super::predictions::Predictions;
use super::text::combination_text;
use crate::identification::{
    Estimate, ExpectedExcitation, HorizonError, Identified, IncompleteRecording, LeftOut,
    PredictionBand, PredictionRegime, Recordings,
};

/// Returns the result as `--json` prints it, without the wall time, the path of the profile and the
/// noise ratio of the held-out recordings.
pub fn result(
    identified: &Identified,
    recordings: &Recordings<2>,
    predictions: &Predictions,
    next: &[ExpectedExcitation],
) -> Value {
    let [fitted_files, _] = &recordings.files;
    let [fitted, held_out] = &predictions.errors;
    let recording = |(index, path): (usize, &PathBuf)| {
        json!({
            "file": path.to_string_lossy(),
            "cable_rest_rad": identified.model_of(&[index]).nonidealities.cable_rest_rad,
            "alpha_zero_rad": identified.offsets[index].alpha_zero_rad,
        })
    };
    let missing_effects = identified.assessment.missing_effects.iter().map(|it| it.name());
    json!({
        "estimates": identified.estimates.iter().map(estimate).collect::<Vec<_>>(),
        "recordings": fitted_files.iter().enumerate().map(recording).collect::<Vec<_>>(),
        "cable_rest_scatter_rad": identified.scatter.cable_rest_rad,
        "blind": identified.undetermined.iter().map(combination_text).collect::<Vec<_>>(),
        "fitted": fitted.horizons.iter().map(horizon).collect::<Vec<_>>(),
        "held_out": held_out.horizons.iter().map(horizon).collect::<Vec<_>>(),
        "fitted_phases": fitted.regimes.iter().map(phase).collect::<Vec<_>>(),
        "held_out_phases": held_out.regimes.iter().map(phase).collect::<Vec<_>>(),
        "verdict": identified.assessment.verdict.name(),
        "doubts": missing_effects.collect::<Vec<_>>(),
        "noise_ratio": identified.assessment.noise_ratio,
        "whiteness": identified.assessment.whiteness,
        "growth": identified.assessment.growth,
        "inflation": identified.inflation,
        "prediction_band": band(predictions),
        "next_excitations": next.iter().map(excitation).collect::<Vec<_>>(),
        "left_out": recordings.left_out.iter().map(left_out).collect::<Vec<_>>(),
        "incomplete": recordings.incomplete.iter().map(incomplete).collect::<Vec<_>>(),
    })
}

fn estimate(estimate: &Estimate) -> Value {
    json!({
        "name": estimate.unknown.name(),
        "value": estimate.value,
        "standard_error": estimate.standard_error,
        "model_error": estimate.model_error,
        "told_by_data": estimate.variance_removed,
    })
}

fn horizon(error: &HorizonError) -> Value {
    json!({
        "horizon_s": error.horizon_s,
        "theta_rad": error.rms.theta_rad,
        "alpha_rad": error.rms.alpha_rad,
        "predictions": error.predictions,
    })
}

fn phase((regime, error): &(PredictionRegime, HorizonError)) -> Value {
    let mut value = horizon(error);
    value["phase"] = json!(regime.name());
    value
}

fn band(predictions: &Predictions) -> Value {
    let Some(PredictionBand { half_widths, predictions: count }) = predictions.band else {
        return Value::Null;
    };
    let held_out = predictions.within.map(|within| {
        let [theta, alpha] = within.shares;
        json!({ "theta": theta, "alpha": alpha, "predictions": within.predictions })
    });
    json!({
        "theta_rad": half_widths.theta_rad,
        "alpha_rad": half_widths.alpha_rad,
        "predictions": count,
        "held_out": held_out,
    })
}

fn excitation(excitation: &ExpectedExcitation) -> Value {
    let ExpectedExcitation { shape, voltage_v, information_nats } = excitation;
    json!({ "shape": shape.name(), "voltage_v": voltage_v, "information_nats": information_nats })
}

fn left_out(LeftOut { path, why }: &LeftOut) -> Value {
    json!({ "file": path.to_string_lossy(), "reason": why.to_string() })
}

fn incomplete(IncompleteRecording { path, why, used_s }: &IncompleteRecording) -> Value {
    json!({ "file": path.to_string_lossy(), "reason": why.to_string(), "used_s": used_s })
}
