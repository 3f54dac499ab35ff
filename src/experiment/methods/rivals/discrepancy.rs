use super::simulator::SampledMotion;
use crate::qube::State;

/// Weights of the observations: theta (1/rad), cosine and sine of alpha, theta_dot and alpha_dot
/// (s/rad). The velocities are about 10 and 20 times as large as the angles.
const WEIGHTS: [f64; 5] = [1.0, 1.0, 1.0, 0.1, 0.05];

/// Weight of the absolute differences.
const ABSOLUTE_WEIGHT: f64 = 0.5;

/// Weight of the squared differences.
const SQUARED_WEIGHT: f64 = 1.0;

/// Standard deviation of the Gaussian filter over time, steps.
const FILTER_STEPS: f64 = 5.0;

/// Bound on a weighted difference: larger ones count as this much.
const LARGEST: f64 = 10.0;

/// The discrepancy of two motions (SimOpt, Chebotar et al. 2019, equation 4), without unit: the
/// absolute and squared differences of the weighted observations, as a mean over the steps that
/// both motions have. A Gaussian filter over time smooths the differences, so that a small shift in
/// time costs little. A difference that is not a finite number counts as [`LARGEST`].
pub fn discrepancy(real: &SampledMotion, simulated: &SampledMotion) -> f64 {
    let steps = real.states.len().min(simulated.states.len());
    let mut total = 0.0;
    for (index, weight) in WEIGHTS.iter().enumerate() {
        let difference: Vec<f64> = real
            .states
            .iter()
            .zip(&simulated.states)
            .map(|(real, simulated)| {
                let own = weight * (observed(simulated)[index] - observed(real)[index]);
                if own.is_finite() { own.clamp(-LARGEST, LARGEST) } else { LARGEST }
            })
            .collect();
        for smoothed in filtered(&difference) {
            total += ABSOLUTE_WEIGHT * smoothed.abs() + SQUARED_WEIGHT * smoothed * smoothed;
        }
    }
    total / steps.max(1) as f64
}

/// The observations of a state, in the order of [`WEIGHTS`].
fn observed(state: &State) -> [f64; 5] {
    [state.theta, state.alpha.cos(), state.alpha.sin(), state.theta_dot, state.alpha_dot]
}

/// The values after a Gaussian filter, which ends at three standard deviations; near the ends of
/// the values it averages over fewer of them.
fn filtered(values: &[f64]) -> Vec<f64> {
    let reach = (3.0 * FILTER_STEPS) as usize;
    let kernel: Vec<f64> =
        (0..=reach).map(|away| (-0.5 * (away as f64 / FILTER_STEPS).powi(2)).exp()).collect();
    (0..values.len())
        .map(|here| {
            let first = here.saturating_sub(reach);
            let end = (here + reach + 1).min(values.len());
            let (mut sum, mut weights) = (0.0, 0.0);
            for (there, value) in values.iter().enumerate().take(end).skip(first) {
                let weight = kernel[here.abs_diff(there)];
                sum += weight * value;
                weights += weight;
            }
            sum / weights
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn swinging(shift: f64, amplitude: f64) -> SampledMotion {
        let states = (0..300).map(|step| {
            let phase = 0.1 * (f64::from(step) - shift);
            State { theta: amplitude * phase.sin(), ..State::default() }
        });
        SampledMotion { states: states.collect(), voltages_v: vec![0.0; 300] }
    }

    #[test]
    fn the_discrepancy_is_zero_for_equal_motions_and_grows_with_the_difference() {
        let real = swinging(0.0, 1.0);
        assert_eq!(discrepancy(&real, &real), 0.0);
        let costs = [0.9, 0.7, 0.2].map(|amplitude| discrepancy(&real, &swinging(0.0, amplitude)));
        assert!(0.0 < costs[0] && costs[0] < costs[1] && costs[1] < costs[2], "{costs:?}");
        assert!(discrepancy(&real, &swinging(1.0, 1.0)) < discrepancy(&real, &swinging(3.0, 1.0)));
        // A state that is not finite counts with the largest difference, so the sum stays a number.
        let mut lost = swinging(0.0, 1.0);
        lost.states[10].theta = f64::NAN;
        assert!(discrepancy(&real, &lost) > 0.0);
    }
}
