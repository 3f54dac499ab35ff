use nalgebra::DVector;

use super::simulator::SampledMotion;
use crate::qube::{Encoder, Encoders, State};

/// Number of steps of a part of a motion: one second.
const PART: usize = 100;

/// Summary statistics of a motion (after BayesSim, section IV), 12 numbers for each of `parts`
/// seconds. The statistics are of the changes, from step to step, of theta, its rate, alpha and its
/// rate: mean, variance, and mean product with the voltage. Angles are in rad. Simulated angles are
/// rounded to the plant's encoders, because recorded angles are. Rates are differences of angles
/// over two steps, in rad a step, so that a filter of recorded velocities has no effect. A part
/// that the motion did not reach has zeros.
pub fn statistics(motion: &SampledMotion, encoders: Encoders, parts: usize) -> Vec<f64> {
    let rounded = |angle_rad: f64, encoder: Encoder| {
        let resolution_rad = encoder.rad_per_count();
        (angle_rad / resolution_rad).round() * resolution_rad
    };
    let both = |state: &State| {
        [rounded(state.theta, encoders.theta), rounded(state.alpha, encoders.alpha)]
    };
    let angles: Vec<[f64; 2]> = motion.states.iter().map(both).collect();
    let mut statistics = Vec::with_capacity(parts * 12);
    for part in 0..parts {
        let (first, end) =
            (part * PART + 1, ((part + 1) * PART).min(angles.len().saturating_sub(2)));
        let mut sums = [[0.0; 3]; 4];
        for step in first..end {
            let voltage_v = motion.voltages_v[step];
            for angle in 0..2 {
                let [before, here, after] = [step - 1, step, step + 1].map(|it| angles[it][angle]);
                let next = angles[step + 2][angle];
                let change = after - here;
                let rate_change = 0.5 * ((next - here) - (after - before));
                add(&mut sums[2 * angle], change, voltage_v);
                add(&mut sums[2 * angle + 1], rate_change, voltage_v);
            }
        }
        let count = end.saturating_sub(first).max(1) as f64;
        for [sum, squares, products] in sums {
            let mean = sum / count;
            statistics.extend([mean, (squares / count - mean * mean).max(0.0), products / count]);
        }
    }
    statistics
}

fn add(sums: &mut [f64; 3], value: f64, voltage_v: f64) {
    // A simulation that diverges must not make the statistics of all simulations infinite.
    let value = if value.is_finite() { value.clamp(-10.0, 10.0) } else { 10.0 };
    sums[0] += value;
    sums[1] += value * value;
    sums[2] += value * voltage_v;
}

/// The first `length` features of several motions: the means of the motions' statistics. A feature
/// that is a variance is given by the square root of its mean.
pub fn features(statistics: &[Vec<f64>], length: usize) -> DVector<f64> {
    let count = statistics.len().max(1) as f64;
    DVector::from_fn(length, |entry, _| {
        let mean = statistics.iter().map(|it| it[entry]).sum::<f64>() / count;
        if entry % 3 == 1 { mean.sqrt() } else { mean }
    })
}

/// Number of parts that cover a motion of `steps` steps.
pub fn parts_of(steps: usize) -> usize {
    steps.div_ceil(PART)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::PlantModel;

    #[test]
    fn a_steady_turn_has_its_rate_and_no_change_of_it() {
        let step_rad = 4.0 * Encoder::QUBE.rad_per_count();
        let states =
            (0..200).map(|step| State { theta: step_rad * f64::from(step), ..State::default() });
        let motion = SampledMotion { states: states.collect(), voltages_v: vec![2.0; 200] };
        let statistics = statistics(&motion, PlantModel::QUBE.encoders, 2);
        assert_eq!(statistics.len(), 24);
        for part in statistics.chunks(12) {
            assert!((part[0] - step_rad).abs() < 1e-12 && part[1] < 1e-12);
            assert!((part[2] - 2.0 * step_rad).abs() < 1e-12);
            assert!(part[3..].iter().all(|it| it.abs() < 1e-12), "{part:?}");
        }
    }
}
