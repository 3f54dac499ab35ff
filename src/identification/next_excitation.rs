//! Chooses the excitation with the largest expected information.

use nalgebra::DMatrix;

use super::Unknown;
use super::fit::Fit;
use super::fitness::check_recording;
use super::residuals::Noise;
use super::stretch::Stretch;
use super::weighing::by_recording;
use crate::policy::{EXCITATION_STEPS, Excitation, ExcitationShape};
use crate::qube::{CONTROL_PERIOD_S, PlantModel, Profile, QubeModel, State};
use crate::replay::{MotionLog, MotionSample, simulate_stretch};

/// Voltages that are compared, as shares of the largest permitted one. Under small voltages the arm
/// moves slowly through standstill, which tells dead zones from the rest angle of the cable.
const SHARES: [f64; 4] = [0.4, 0.5, 0.7, 1.0];

/// Largest angle of the arm in the simulation of an excitation that is considered, rad; less for a
/// plant with less travel than a Qube. The rest of the travel is for the difference between the
/// Qube and its model.
const WIDEST_RAD: f64 = 1.6;

/// An excitation with its expected information.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExpectedExcitation {
    /// Form of the voltage.
    pub shape: ExcitationShape,
    /// Largest voltage, V.
    pub voltage_v: f64,
    /// Expected decrease of the entropy of all unknowns together, in nats: each nat makes the
    /// volume of the possible errors e (2.7) times smaller. It is computed for small errors and a
    /// model that is right.
    pub information_nats: f64,
}

/// The excitation of a rollout, counted from 0, with the largest expected information about an
/// identified Qube; a chirp of `largest_v` volts without a profile, or if no excitation is
/// possible. Consecutive rollouts start in opposite directions.
#[must_use]
pub fn excitation_after(
    profile: Option<&Profile>,
    plant: &PlantModel,
    largest_v: f64,
    rollout: u32,
) -> Excitation {
    let possible = profile.map(|profile| next_excitations(profile, plant, largest_v));
    let best = possible.unwrap_or_default().into_iter().next();
    let (shape, voltage_v) =
        best.map_or((ExcitationShape::Chirp, largest_v), |best| (best.shape, best.voltage_v));
    Excitation::of_rollout(shape, voltage_v, rollout)
}

/// The excitations that are possible as the next recording of an identified Qube, within
/// `largest_v` volts, in order of falling expected information. Excitations that would move the arm
/// of the identified model too far, and excitations whose recording no fit would accept, are left
/// out.
///
/// For normal errors the expected information is ½ ln det(I + Σ J'J/σ²), where Σ is the covariance
/// of the profile, J holds the derivatives of the recording that the excitation would make, without
/// the part that its own start state and zero explain, and σ is the encoders' rounding (Lindley,
/// *On a Measure of the Information Provided by an Experiment*, 1956).
#[must_use]
pub fn next_excitations(
    profile: &Profile,
    plant: &PlantModel,
    largest_v: f64,
) -> Vec<ExpectedExcitation> {
    let model = profile.model();
    let unknowns: Vec<Unknown> = Unknown::all().collect();
    let covariance = covariance(profile, &unknowns);
    let mut all = Vec::new();
    for shape in ExcitationShape::ALL {
        for share in SHARES {
            let voltage_v = share * largest_v;
            let log = simulated(Excitation::new(shape, voltage_v), &model, plant);
            let widest_rad = WIDEST_RAD * plant.travel_fraction();
            let is_narrow = log.samples.iter().all(|it| it.state.theta.abs() < widest_rad);
            if is_narrow && check_recording(&log).is_ok() {
                let information = information(&log, &model, &unknowns);
                let information_nats = expected_nats(&covariance, &information);
                if information_nats.is_finite() {
                    all.push(ExpectedExcitation { shape, voltage_v, information_nats });
                }
            }
        }
    }
    all.sort_by(|a, b| b.information_nats.total_cmp(&a.information_nats));
    all
}

/// The covariance of a profile's errors in the fit's units.
fn covariance(profile: &Profile, unknowns: &[Unknown]) -> DMatrix<f64> {
    let model = profile.model();
    let per_unit = |unknown: Unknown| unknown.deviation(unknown.of(&model), 1.0);
    DMatrix::from_fn(unknowns.len(), unknowns.len(), |row, column| {
        let (one, other) = (unknowns[row], unknowns[column]);
        profile.covariance(one.0, other.0) / (per_unit(one) * per_unit(other))
    })
}

/// The recording that an excitation makes of a Qube that begins at rest in the middle.
pub(super) fn simulated(
    mut excitation: Excitation,
    model: &QubeModel,
    plant: &PlantModel,
) -> MotionLog {
    let encoders = plant.encoders;
    let mut samples: Vec<MotionSample> = Vec::with_capacity(EXCITATION_STEPS as usize);
    let mut state = State::default();
    for tick in 0..EXCITATION_STEPS {
        let measured = State {
            theta: encoders.theta.angle_rad(encoders.theta.counts(state.theta)),
            alpha: encoders.alpha.angle_rad(encoders.alpha.counts(state.alpha)),
            ..state
        };
        let voltage_v = excitation.voltage_v(&measured);
        let time_s = f64::from(tick) * CONTROL_PERIOD_S;
        samples.push(MotionSample { time_s, state: measured, voltage_v });
        // The simulation of the next period needs only the time of the sample at its end.
        let next = MotionSample { time_s: time_s + CONTROL_PERIOD_S, ..samples[tick as usize] };
        samples.push(next);
        let last_two = tick as usize..tick as usize + 2;
        simulate_stretch(&samples, last_two, model, state, |there| state = there);
        samples.pop();
    }
    MotionLog { samples, plant: *plant }
}

/// The information of a recording about the unknowns, J'J/σ², in the fit's units.
fn information(log: &MotionLog, model: &QubeModel, unknowns: &[Unknown]) -> DMatrix<f64> {
    let whole = Stretch::windows(&log.samples, f64::INFINITY);
    let mut fit = Fit::new(unknowns, &log.plant, *model, whole).with_offsets();
    fit.noise = [Noise::of_resolution(log.plant.encoders); 3];
    let count = unknowns.len();
    let mut information = DMatrix::zeros(count, count);
    for (own, _) in by_recording(&fit, &fit.reduced(), 1.0) {
        information += own;
    }
    information
}

/// The expected information ½ ln det(I + Σ I') in nats, for a covariance Σ and an information I'.
fn expected_nats(covariance: &DMatrix<f64>, information: &DMatrix<f64>) -> f64 {
    let eigen = covariance.clone().symmetric_eigen();
    let roots = DMatrix::from_fn(covariance.nrows(), covariance.ncols(), |row, column| {
        eigen.eigenvectors[(row, column)] * eigen.eigenvalues[column].max(0.0).sqrt()
    });
    let seen = roots.tr_mul(information) * &roots;
    let eigenvalues = seen.symmetric_eigenvalues();
    0.5 * eigenvalues.iter().map(|value| value.max(0.0).ln_1p()).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identification::{Identified, identify};

    fn found_in(logs: &[MotionLog]) -> Identified {
        let unknowns: Vec<Unknown> = Unknown::all().collect();
        identify(logs, &unknowns, &QubeModel::NOMINAL).unwrap()
    }

    /// Half the logarithm of the determinant of the estimates' covariance, in SI units: their
    /// entropy up to a constant.
    fn entropy_nats(found: &Identified) -> f64 {
        let count = found.estimates.len();
        let correlation = |row: usize, column: usize| found.correlations[row][column];
        let covariance = DMatrix::from_fn(count, count, correlation);
        let errors: f64 = found.estimates.iter().map(|it| it.standard_error.ln()).sum();
        errors + 0.5 * covariance.symmetric_eigenvalues().iter().map(|it| it.ln()).sum::<f64>()
    }

    /// Information i about a parameter with variance v leaves the variance v / (1 + v i), and the
    /// entropy falls by half the logarithm of the quotient.
    #[test]
    fn the_expected_nats_are_the_fall_of_the_entropy() {
        let matrix = |rows: &[f64]| {
            let count = rows.len().isqrt();
            DMatrix::from_row_slice(count, count, rows)
        };
        for (covariance, information, nats) in [
            (&[4.0][..], &[2.0][..], 3.0_f64.ln()),
            (&[1e-6], &[1e6], 0.5 * 2.0_f64.ln()),
            (&[4.0], &[0.0], 0.0),
            // One of two parameters with correlated errors is seen.
            (&[2.0, 1.0, 1.0, 2.0], &[4.0, 0.0, 0.0, 0.0], 3.0_f64.ln()),
            (&[3.0, 0.0, 0.0, 8.0], &[1.0, 0.0, 0.0, 1.0], 6.0_f64.ln()),
        ] {
            let expected = expected_nats(&matrix(covariance), &matrix(information));
            assert!((expected - nats).abs() < 1e-9, "{expected} instead of {nats}");
        }
    }

    #[test]
    fn a_recording_tells_what_was_expected_of_it() {
        let (lab, plant) = (Profile::lab().model(), PlantModel::QUBE);
        let first = simulated(Excitation::new(ExcitationShape::Chirp, 1.5), &lab, &plant);
        let before = found_in(std::slice::from_ref(&first));
        let profile = before.profile("found", Vec::new(), Vec::new());
        let all = next_excitations(&profile, &plant, 1.5);
        let (most, least) = (all[0], all[all.len() - 1]);
        for expected in [most, least] {
            let ExpectedExcitation { shape, voltage_v, information_nats } = expected;
            let second = simulated(Excitation::new(shape, voltage_v), &lab, &plant);
            let after = found_in(&[first.clone(), second]);
            let gained = entropy_nats(&before) - entropy_nats(&after);
            println!(
                "{shape:?} of {voltage_v} V: {information_nats} nats expected, {gained} gained"
            );
            // The second recording changes the estimate of the noise too, and with it the errors in
            // all fourteen directions. For the best excitation neither a logarithm to the base 2
            // nor a missing factor of one half is within these limits.
            let off = (gained - information_nats).abs();
            assert!(off < 4.0, "{expected:?}, but the gain is {gained} nats");
        }
        let is_chirp_again =
            |it: &ExpectedExcitation| it.shape == ExcitationShape::Chirp && it.voltage_v == 1.5;
        assert!(is_chirp_again(&least) && most.information_nats > 4.0 * least.information_nats);
    }

    #[test]
    fn pushes_raise_the_pendulum_of_lab_and_calm_it_again() {
        let lab = Profile::lab().model();
        let pushes = Excitation::new(ExcitationShape::Pushes, 1.5);
        let samples = simulated(pushes, &lab, &PlantModel::QUBE).samples;
        let widest_rad = |angle: fn(&State) -> f64| {
            let in_a_second = |second: &[MotionSample]| {
                second.iter().map(|it| angle(&it.state).abs()).fold(0.0, f64::max)
            };
            samples.chunks(100).map(in_a_second).collect::<Vec<f64>>()
        };
        let (arm, pendulum) = (widest_rad(|it| it.theta), widest_rad(|it| it.alpha));
        let words = format!("widest angles, rad: arm {arm:.2?}, pendulum {pendulum:.2?}");
        // It is raised, calmed, and raised again.
        let is_raised = |from: usize| pendulum[from..].iter().position(|it| *it > 1.2);
        let is_calm = |from: usize| pendulum[from..].iter().position(|it| *it < 0.6);
        let calm = is_calm(is_raised(0).expect(&words)).expect(&words);
        assert!(is_raised(calm).is_some(), "{words}");
        assert!(pendulum.iter().all(|it| *it < 2.0) && arm.iter().all(|it| *it < 1.6), "{words}");
    }

    #[test]
    fn an_excitation_that_moves_the_arm_too_far_or_not_at_all_is_left_out() {
        let lab = Profile::lab();
        let all = next_excitations(&lab, &PlantModel::QUBE, 1.5);
        assert!(all.windows(2).all(|two| two[0].information_nats >= two[1].information_nats));
        assert!(all.iter().all(|it| it.information_nats > 0.0 && it.voltage_v <= 1.5));
        let mut stuck = lab.model();
        stuck.nonidealities.positive_dead_zone_v = 2.0;
        stuck.nonidealities.negative_dead_zone_v = 2.0;
        let stuck = Profile::exact("stuck", &stuck);
        assert_eq!(next_excitations(&stuck, &PlantModel::QUBE, 1.5), []);
        // Under voltages of up to 5 V, more excitations move the arm too far.
        assert!(next_excitations(&lab, &PlantModel::QUBE, 5.0).len() < all.len());
    }
}
