use std::fmt::Write;
use std::path::PathBuf;

use super::predictions::{PredictionErrors, Predictions};
use crate::identification::{
    Estimate, ExpectedExcitation, Identified, ModelVerdict, PredictionBand,
    UndeterminedCombination, Unknown,
};
use crate::qube::{Nonideality, PlantModel};

/// Returns the whole result for people: estimates with their correlations, the cable's rest angles,
/// predictions, verdict, and the next excitation.
pub fn text(
    identified: &Identified,
    fitted_files: &[PathBuf],
    predictions: &Predictions,
    next: &[ExpectedExcitation],
    plant: &PlantModel,
) -> String {
    let mut text = estimates(identified);
    text += &strong_correlations(identified);
    text += &cable_rests(identified, fitted_files);
    for errors in &predictions.errors {
        text += &rms_errors(errors);
    }
    text += &band_lines(predictions);
    let _ = write!(text, "\n{}", assessment(identified));
    text += &unlikely_values(identified, plant);
    text += &late_voltage(identified);
    text += &next_line(next, plant);
    text
}

fn estimates(identified: &Identified) -> String {
    let mut text = format!(
        "{:24} {:>11} {:>11} {:9} {:>13}\n",
        "quantity", "value", "std. error", "unit", "from data"
    );
    for estimate in &identified.estimates {
        let Estimate { unknown, value, standard_error, variance_removed, .. } = *estimate;
        let mark = if estimate.is_determined() { "" } else { "  from the prior" };
        let percent = 100.0 * variance_removed;
        let (name, unit) = (unknown.name(), unknown.0.unit());
        let _ = writeln!(
            text,
            "{name:24} {value:11.4e} {standard_error:11.1e} {unit:9} {percent:11.0} %{mark}"
        );
    }
    if !identified.undetermined.is_empty() {
        text += "\nThe recordings do not determine these combinations (in units of the prior):\n";
    }
    for combination in &identified.undetermined {
        let _ = writeln!(text, "  {}", combination_text(combination));
    }
    text
}

/// Returns a combination such as `+0.71 R_m -0.70 k_m`.
pub fn combination_text(combination: &UndeterminedCombination) -> String {
    let term = |(unknown, weight): &(Unknown, f64)| format!("{weight:+.2} {}", unknown.name());
    combination.iter().map(term).collect::<Vec<_>>().join(" ")
}

/// Absolute correlation from which two estimates are listed as hard to tell apart.
const STRONG_CORRELATION: f64 = 0.8;

/// Returns the pairs of estimates that the recordings hardly tell apart; empty without any.
fn strong_correlations(identified: &Identified) -> String {
    let mut text = String::new();
    let name = |index: usize| identified.estimates[index].unknown.name();
    for (one, row) in identified.correlations.iter().enumerate() {
        for (other, &correlation) in row[..one].iter().enumerate() {
            if correlation.abs() >= STRONG_CORRELATION {
                let also = if correlation > 0.0 { "more" } else { "less" };
                let _ = writeln!(
                    text,
                    "  more {} looks like {also} {} ({correlation:+.2})",
                    name(other),
                    name(one)
                );
            }
        }
    }
    if text.is_empty() { text } else { format!("\nStrongly correlated estimates:\n{text}") }
}

/// Returns the cable's rest angle in each recording; empty if the angle does not scatter between
/// recordings.
fn cable_rests(identified: &Identified, files: &[PathBuf]) -> String {
    let scatter_rad = identified.scatter.cable_rest_rad;
    if scatter_rad == 0.0 {
        return String::new();
    }
    let mut text = format!(
        "\nThe cable's rest angle by recording (scatter {scatter_rad:.2} rad, part of its standard error):\n"
    );
    for (index, path) in files.iter().enumerate() {
        let rest_rad = identified.model_of(&[index]).nonidealities.cable_rest_rad;
        let _ = writeln!(text, "  {rest_rad:+.2} rad  {}", path.display());
    }
    text
}

fn rms_errors(errors: &PredictionErrors) -> String {
    let horizons = errors.horizons.iter().map(|error| ("", error));
    let regimes = errors.regimes.iter().map(|(regime, error)| (regime.name(), error));
    let rows: Vec<_> = horizons.chain(regimes).filter(|(_, error)| error.predictions > 0).collect();
    if rows.is_empty() {
        return String::new();
    }
    let mut text = format!("\n{:9} RMS error of predictions, rad\n", errors.group);
    for (phase, error) in rows {
        let (theta, alpha) = (error.rms.theta_rad, error.rms.alpha_rad);
        let _ = writeln!(
            text,
            "{phase:8}{:5} s  theta {theta:.4}  alpha {alpha:.4}  ({} predictions)",
            error.horizon_s, error.predictions
        );
    }
    text
}

/// Returns the band of the predictions and the share of held-out errors within it.
fn band_lines(predictions: &Predictions) -> String {
    let Some(PredictionBand { half_widths, .. }) = predictions.band else {
        return String::new();
    };
    let (theta, alpha) = (half_widths.theta_rad, half_widths.alpha_rad);
    let mut text = format!(
        "\nAfter 0.5 s, 90 % of the predictions of fitted recordings are off by at most {theta:.4} rad (theta), {alpha:.4} rad (alpha).\n"
    );
    if let Some(within) = predictions.within {
        let [theta, alpha] = within.shares.map(|share| 100.0 * share);
        let _ = writeln!(
            text,
            "Of the {} predictions of held-out recordings, {theta:.0} % (theta) and {alpha:.0} % (alpha) are off by at most that.",
            within.predictions
        );
    }
    text
}

/// Returns the verdict on the model, with a note if the standard errors are larger than noise alone
/// explains.
fn assessment(identified: &Identified) -> String {
    let tests = &identified.assessment;
    let missing: Vec<String> = tests.missing_effects.iter().map(ToString::to_string).collect();
    let missing = missing.join("; ");
    let verdict = match tests.verdict {
        ModelVerdict::Fits => "The model describes this Qube.".to_owned(),
        ModelVerdict::FitsBut => format!("The model describes this Qube except for {missing}."),
        ModelVerdict::DoesNotFit => format!("The model does not describe this Qube: {missing}."),
    };
    let widened = if identified.inflation > 1.05 {
        let factor = identified.inflation;
        format!(
            " Standard errors are {factor:.1} times as large as noise alone explains, because recordings, or parts of them, disagree."
        )
    } else {
        String::new()
    };
    let effect = if identified.estimates.iter().any(|it| it.model_error > 0.0) {
        " The standard errors include the change of each value by the effect that explains the residuals best."
    } else {
        ""
    };
    format!("{verdict}{widened}{effect}\n")
}

/// Distance of a parameter from its prior mean, in standard deviations, from which it is noted. The
/// largest one of the public recordings of a real Qube is 2.5.
const UNLIKELY_STDS: f64 = 3.0;

/// Returns a note on the parameters that lie far from the plant's description; empty without any.
/// Recordings may determine such a value only together with others, so that the standard error of
/// each takes the description for right.
fn unlikely_values(identified: &Identified, plant: &PlantModel) -> String {
    let is_unlikely = |estimate: &&Estimate| {
        let (unknown, prior) = (estimate.unknown, estimate.unknown.prior(plant));
        let distance = (unknown.of(&identified.model) - prior.mean).abs();
        unknown.is_parameter() && distance > UNLIKELY_STDS * prior.std
    };
    let names: Vec<&str> =
        identified.estimates.iter().filter(is_unlikely).map(|it| it.unknown.name()).collect();
    if names.is_empty() {
        return String::new();
    }
    format!(
        "Far from the plant's description: {}. Is the pendulum another one, or is the time of the recordings wrong? The \
         standard errors take the description for right: weigh and measure what you can, and fix it by --fix.\n",
        names.join(", ")
    )
}

/// Delay below which it counts as none, s.
const NO_DELAY_S: f64 = 1e-4;

/// Returns a note if a doubted fit has no delay although one was fitted; empty otherwise.
fn late_voltage(identified: &Identified) -> String {
    let delay = Unknown::from(Nonideality::CommandDelay);
    let has_none =
        identified.estimates.iter().any(|it| it.unknown == delay && it.value < NO_DELAY_S);
    if identified.assessment.verdict == ModelVerdict::Fits || !has_none {
        return String::new();
    }
    "The best delay is none at all: were the voltages recorded a sample after they acted?\n"
        .to_owned()
}

/// Returns the excitations of a plant with the most and with the least expected information; empty
/// without any.
fn next_line(next: &[ExpectedExcitation], plant: &PlantModel) -> String {
    let (Some(most), Some(least)) = (next.first(), next.last()) else { return String::new() };
    let option = if plant.is_qube() { "" } else { " --plant FILE" };
    format!(
        "To learn more about it: run --excite {} --volts {:.2}{option} (expected: {:.1} nats; from a {} of {:.2} V: {:.1}).\n",
        most.shape.name(),
        most.voltage_v,
        most.information_nats,
        least.shape.name(),
        least.voltage_v,
        least.information_nats
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::ExcitationShape;

    #[test]
    fn the_next_excitation_of_another_plant_needs_the_file_of_the_plant() {
        let excitation = |voltage_v, information_nats| ExpectedExcitation {
            shape: ExcitationShape::Chirp,
            voltage_v,
            information_nats,
        };
        let next = [excitation(3.0, 2.0), excitation(1.2, 1.0)];
        let of_qube = next_line(&next, &PlantModel::QUBE);
        assert!(of_qube.contains("run --excite chirp --volts 3.00 (expected: 2.0"), "{of_qube}");
        let mut other = PlantModel::QUBE;
        other.limits.largest_voltage_v = 4.0;
        let of_other = next_line(&next, &other);
        assert!(of_other.contains("--volts 3.00 --plant FILE (expected: 2.0"), "{of_other}");
        assert_eq!(next_line(&[], &other), "");
    }
}
