use super::next_excitation::simulated;
use super::*;
use crate::policy::{Excitation, ExcitationShape};
use crate::qube::{
    DomainParameter, DomainParameters, Nonidealities, Nonideality, PlantModel, Profile, QubeModel,
    RAD_PER_COUNT, State, quantised,
};
use crate::replay::{MotionLog, MotionSample, simulate_stretch};

/// A chirp from 5 Hz down, recorded from `truth` at 250 Hz through encoders.
fn chirp(truth: &QubeModel, sign: f64, seconds: f64) -> MotionLog {
    chirp_of(truth, sign, seconds, &|_| true)
}

/// A chirp recorded only at the indices where `is_taken` is true; voltages are held in between.
fn chirp_of(
    truth: &QubeModel,
    sign: f64,
    seconds: f64,
    is_taken: &dyn Fn(usize) -> bool,
) -> MotionLog {
    let start = State { theta: -0.02, ..State::default() };
    driven(truth, sign, seconds, start, is_taken)
}

/// The motion from a start state under the voltages of a chirp, recorded only at the indices where
/// `is_taken` is true.
fn driven(
    truth: &QubeModel,
    sign: f64,
    seconds: f64,
    start: State,
    is_taken: &dyn Fn(usize) -> bool,
) -> MotionLog {
    let count = (seconds * 250.0) as usize + 1;
    let samples: Vec<MotionSample> = (0..count)
        .filter(|index| is_taken(*index))
        .map(|index| {
            let time_s = index as f64 / 250.0;
            let phase = 2.0 * std::f64::consts::PI * (5.0 * time_s - 0.4 * time_s * time_s);
            let voltage_v = sign * 1.5 * phase.cos();
            MotionSample { time_s, state: State::default(), voltage_v }
        })
        .collect();
    let mut states = Vec::new();
    simulate_stretch(&samples, 0..samples.len(), truth, start, |state| states.push(state));
    let encoded = |state: State| State {
        theta: quantised(state.theta),
        alpha: quantised(state.alpha),
        ..state
    };
    let samples = samples.into_iter().zip(states);
    MotionLog {
        samples: samples
            .map(|(sample, state)| MotionSample { state: encoded(state), ..sample })
            .collect(),
        plant: PlantModel::QUBE,
    }
}

/// A Qube that differs from nominal in five parameters and in every nonideality but the cable's
/// drift.
fn truth() -> QubeModel {
    let mut truth = QubeModel {
        nonidealities: Nonidealities {
            coulomb_torque_n_m: 4e-4,
            positive_dead_zone_v: 0.1,
            negative_dead_zone_v: 0.25,
            cable_stiffness_n_m_rad: 1e-3,
            cable_rest_rad: -0.6,
            command_delay_s: 0.0073,
            ..Nonidealities::default()
        },
        ..QubeModel::NOMINAL
    };
    for (parameter, factor) in [
        (DomainParameter::MotorResistance, 1.1),
        (DomainParameter::RotaryDamping, 5.0),
        (DomainParameter::PendulumDamping, 20.0),
        (DomainParameter::PendulumMass, 0.9),
        (DomainParameter::PendulumLength, 0.97),
    ] {
        truth.parameters.set(parameter, factor * truth.parameters.get(parameter));
    }
    truth
}

fn all() -> Vec<Unknown> {
    Unknown::all().collect()
}

#[test]
fn a_known_qube_is_found_within_four_standard_errors() {
    let logs = [chirp(&truth(), 1.0, 5.0), chirp(&truth(), -1.0, 5.0)];
    let found = identify(&logs, &all(), &QubeModel::NOMINAL).unwrap();
    for estimate in &found.estimates {
        let expected = estimate.unknown.quantity(estimate.unknown.of(&truth()));
        let off = (estimate.value - expected).abs() / estimate.standard_error;
        assert!(off < 4.0, "{} should be {expected}: {estimate:?}", estimate.unknown.name());
    }
    let is_determined = |term: Nonideality| {
        let unknown = Unknown::from(term);
        let estimate = found.estimates.iter().find(|estimate| estimate.unknown == unknown);
        estimate.is_some_and(Estimate::is_determined)
    };
    assert!(is_determined(Nonideality::CommandDelay) && is_determined(Nonideality::CableStiffness));
    // Scaling all forces and all inertias by the same factor leaves the motion unchanged.
    let undetermined: Vec<Unknown> =
        found.undetermined.iter().flatten().map(|(unknown, _)| *unknown).collect();
    assert!(undetermined.contains(&DomainParameter::PendulumMass.into()), "{undetermined:?}");

    let held_out = [chirp(&truth(), -1.0, 6.0)];
    let error = horizon_error(&held_out, &found.model, 5.8).rms;
    assert!(error.theta_rad < 0.01 && error.alpha_rad < 0.01, "{error:?}");
    let nominal = horizon_error(&held_out, &QubeModel::NOMINAL, 5.8).rms;
    assert!(nominal.theta_rad > 0.1, "{nominal:?}");
}

#[test]
fn recordings_whose_cables_rest_elsewhere_have_rest_angles_of_their_own() {
    let resting = |rest_rad: f64, sign: f64, zero_rad: f64| {
        let mut truth = truth();
        truth.nonidealities.cable_rest_rad = rest_rad;
        let mut log = chirp(&truth, sign, 5.0);
        log.samples.iter_mut().for_each(|sample| sample.state.alpha += zero_rad);
        log
    };
    let rests_rad = [-0.6, -0.6, 0.2, 0.2];
    let zeros_rad = [0.0, 0.003, 0.0, -0.003];
    let signs = [1.0, -1.0, 1.0, -1.0];
    let logs: Vec<MotionLog> =
        (0..4).map(|index| resting(rests_rad[index], signs[index], zeros_rad[index])).collect();
    let found = identify(&logs, &all(), &QubeModel::NOMINAL).unwrap();
    for (index, rest_rad) in rests_rad.iter().enumerate() {
        let own = found.model_of(&[index]).nonidealities.cable_rest_rad;
        assert!((own - rest_rad).abs() < 0.1, "{index}: {own} instead of {rest_rad}");
        // An encoder rounds downwards, by half a count on average.
        let zero_rad = found.offsets[index].alpha_zero_rad + 0.5 * RAD_PER_COUNT;
        assert!((zero_rad - zeros_rad[index]).abs() < 6e-4, "{index}: {zero_rad}");
    }
    let group = found.model_of(&[2, 3]).nonidealities.cable_rest_rad;
    assert!((group - 0.2).abs() < 0.1, "{group}");
    assert_eq!(found.model_of(&[]), found.model);
    // The scatter of -0.6 and 0.2 about their mean is 0.4.
    assert!((0.2..0.6).contains(&found.scatter.cable_rest_rad), "{:?}", found.scatter);
    let rest = Unknown::from(Nonideality::CableRest);
    let rest = found.estimates.iter().find(|estimate| estimate.unknown == rest).unwrap();
    assert!(rest.standard_error > found.scatter.cable_rest_rad, "{rest:?}");
    assert_eq!(found.assessment.verdict, ModelVerdict::Fits, "{:?}", found.assessment);
}

#[test]
fn recordings_of_one_homing_have_one_rest_angle() {
    let logs = [1.0, -1.0].map(|sign| chirp(&truth(), sign, 5.0));
    let found = identify(&logs, &all(), &QubeModel::NOMINAL).unwrap();
    assert!(found.scatter.cable_rest_rad < 0.05, "{:?}", found.scatter);
}

#[test]
fn fixed_quantities_keep_their_values() {
    let moves = [Nonideality::CommandDelay.into(), Nonideality::CoulombTorque.into()];
    let found = identify(&[chirp(&truth(), 1.0, 2.0)], &moves, &QubeModel::NOMINAL).unwrap();
    assert_eq!(found.model.parameters, QubeModel::NOMINAL.parameters);
    assert!(found.model.nonidealities.command_delay_s > 0.0);
    assert_eq!(found.estimates.len(), 2);
}

/// A busy computer skips ticks now and then, and the device holds the last voltage.
#[test]
fn a_recording_with_a_few_short_interruptions_is_fitted() {
    let is_lost = |index: usize| [133, 410, 620].iter().any(|it| (*it..it + 9).contains(&index));
    let holed = chirp_of(&truth(), 1.0, 5.0, &|index| !is_lost(index));
    assert_eq!(holed.samples.len(), 1251 - 27);
    assert_eq!(check_recording(&holed), Ok(()));
    let moves = [Nonideality::CommandDelay.into(), DomainParameter::RotaryMass.into()];
    let found = identify(
        &[holed],
        &moves,
        &QubeModel {
            nonidealities: Nonidealities { command_delay_s: 0.0, ..truth().nonidealities },
            ..truth()
        },
    )
    .unwrap();
    let delay_s = found.model.nonidealities.command_delay_s;
    assert!((delay_s - truth().nonidealities.command_delay_s).abs() < 5e-4, "{delay_s}");
}

#[test]
fn uninformative_and_defective_recordings_are_named() {
    let good = chirp(&truth(), 1.0, 4.0);
    assert_eq!(check_recording(&good), Ok(()));
    let changed = |change: &dyn Fn(usize, &mut MotionSample)| {
        let mut log = good.clone();
        log.samples.iter_mut().enumerate().for_each(|(index, sample)| change(index, sample));
        check_recording(&log).unwrap_err()
    };
    let short = MotionLog { samples: good.samples[..250].to_vec(), ..good.clone() };
    assert!(matches!(check_recording(&short), Err(Unfit::Short { .. })));
    let mut interrupted = good.clone();
    interrupted.samples.drain(300..320);
    assert!(matches!(check_recording(&interrupted), Err(Unfit::Interrupted { .. })));
    let holes = chirp_of(&truth(), 1.0, 4.0, &|index| index % 30 >= 9);
    assert!(matches!(check_recording(&holes), Err(Unfit::Interrupted { .. })));
    let broken = changed(&|index, sample| {
        sample.voltage_v = if index == 7 { f64::NAN } else { sample.voltage_v };
    });
    assert_eq!(broken, Unfit::NotFinite { sample: 7 });
    let stands = changed(&|index, sample| sample.time_s -= if index > 8 { 0.01 } else { 0.0 });
    assert_eq!(stands, Unfit::TimeDoesNotAdvance { sample: 9 });
    let nothing = identify(std::slice::from_ref(&good), &[], &QubeModel::NOMINAL);
    assert!(matches!(nothing, Err(IdentifyError::NoUnknowns)));
    let known = Unknown(DomainParameter::Gravity.into());
    let known = identify(std::slice::from_ref(&good), &[known], &QubeModel::NOMINAL);
    assert!(matches!(known, Err(IdentifyError::NotUnknown { .. })));
    let slow = changed(&|index, sample| sample.time_s = index as f64 / 40.0);
    assert!(matches!(slow, Unfit::Interrupted { .. }));
    assert_eq!(changed(&|_, sample| sample.voltage_v *= 0.1), Unfit::NoVoltage);
    let in_mv = changed(&|_, sample| sample.voltage_v *= 1000.0);
    assert!(matches!(in_mv, Unfit::NotVolts { .. }), "{in_mv}");
    let still = changed(&|_, sample| {
        (sample.state.theta, sample.state.alpha) = (0.0, 0.0);
        sample.voltage_v = 0.9 * sample.voltage_v.signum();
    });
    assert!(matches!(still, Unfit::NoMotion { angle: "theta", .. }));
    let hit = changed(&|index, sample| sample.state.theta += if index > 500 { 2.5 } else { 0.0 });
    assert!(matches!(hit, Unfit::AtStop { .. }));
    let held = good.samples[500].state;
    let stalled = changed(&|index, sample| {
        if index > 500 {
            (sample.state.theta, sample.voltage_v) = (held.theta, 2.0);
        }
    });
    assert!(matches!(stalled, Unfit::FrozenArm { .. }), "{stalled}");
    let arm_unplugged = changed(&|index, sample| {
        if index > 500 {
            sample.state.theta = held.theta;
        }
    });
    assert!(matches!(arm_unplugged, Unfit::FrozenArmUnderPendulum { .. }), "{arm_unplugged}");
    let unplugged = changed(&|index, sample| {
        if index > 500 {
            sample.state.alpha = held.alpha;
        }
    });
    assert!(matches!(unplugged, Unfit::FrozenPendulum { .. }), "{unplugged}");
    // Single samples that were lost on the wire are no interruption.
    let mut lost = good.clone();
    lost.samples.retain(|sample| (sample.time_s * 250.0).round() as u32 % 7 != 3);
    assert_eq!(check_recording(&lost), Ok(()));
}

#[test]
fn recordings_with_wrong_times_or_cut_off_angles_are_named() {
    let good = chirp(&truth(), 1.0, 4.0);
    let changed = |change: &dyn Fn(usize, &mut MotionSample)| {
        let mut log = good.clone();
        log.samples.iter_mut().enumerate().for_each(|(index, sample)| change(index, sample));
        check_recording(&log)
    };
    // The file was recorded at 250 Hz, and its times correspond to 100 or 500 Hz.
    for rate_hz in [100.0, 500.0] {
        let unfit = changed(&|index, sample| sample.time_s = index as f64 / rate_hz);
        assert!(matches!(unfit, Err(Unfit::OtherRate { .. })), "{rate_hz}: {unfit:?}");
    }
    // A program clamped the angle to bounds that the motion exceeded.
    for limit_rad in [0.3, 0.6] {
        let unfit = changed(&|_, sample| {
            sample.state.alpha = quantised(sample.state.alpha.clamp(-limit_rad, limit_rad));
        });
        let Err(Unfit::Clipped { angle: "alpha", value_rad, .. }) = unfit else {
            panic!("{limit_rad}: {unfit:?}");
        };
        assert!((value_rad.abs() - limit_rad).abs() < 0.01);
    }
    // The pendulum went over the top, and its angle was wrapped to one turn.
    let unfit = changed(&|index, sample| {
        if index >= 600 {
            sample.state.alpha -= 2.0 * std::f64::consts::PI;
        }
    });
    assert!(matches!(unfit, Err(Unfit::Jump { angle: "alpha", .. })), "{unfit:?}");
    // The encoder has a loose contact.
    let unfit = changed(&|index, sample| {
        if index == 600 {
            sample.state.theta += 1.0;
        }
    });
    assert!(matches!(unfit, Err(Unfit::Jump { angle: "theta", .. })), "{unfit:?}");
}

/// A chirp of a motor whose resistance grows by `share` from the first sample to the last.
fn warming_chirp(truth: &QubeModel, sign: f64, share: f64) -> MotionLog {
    let mut log = chirp(truth, sign, 5.0);
    let last = log.samples.len() - 1;
    let mut state = State { theta: -0.02, ..State::default() };
    for index in 0..last {
        let mut warm = *truth;
        warm.parameters.motor_resistance_ohm *= 1.0 + share * index as f64 / last as f64;
        let sample = &mut log.samples[index].state;
        (sample.theta, sample.alpha) = (quantised(state.theta), quantised(state.alpha));
        let start = state;
        simulate_stretch(&log.samples, index..index + 2, &warm, start, |next| state = next);
    }
    log.samples.truncate(last);
    log
}

#[test]
fn only_a_motor_that_warms_raises_a_doubt() {
    for (share, verdict) in [(0.0, ModelVerdict::Fits), (0.3, ModelVerdict::FitsBut)] {
        let logs = [1.0, -1.0].map(|sign| warming_chirp(&truth(), sign, share));
        let found = identify(&logs, &all(), &QubeModel::NOMINAL).unwrap();
        let tests = &found.assessment;
        assert_eq!(tests.verdict, verdict, "{share}: {tests:?}");
        assert_eq!(
            tests.missing_effects.contains(&MissingEffect::Warming),
            share > 0.0,
            "{tests:?}"
        );
        assert_eq!(tests.missing_effects.is_empty(), share == 0.0, "{tests:?}");
        let has_errors = found.estimates.iter().any(|it| it.model_error > 0.0);
        assert_eq!(has_errors, share > 0.0, "{:?}", found.estimates);
    }
}

#[test]
fn an_encoder_off_its_centre_is_doubted_and_named() {
    let logs = [1.0, -1.0].map(|sign| {
        let mut log = chirp(&truth(), sign, 5.0);
        for sample in &mut log.samples {
            sample.state.theta += 0.01 * (sample.state.theta + 0.7).sin();
        }
        log
    });
    let found = identify(&logs, &all(), &QubeModel::NOMINAL).unwrap();
    assert_eq!(found.assessment.verdict, ModelVerdict::FitsBut);
    assert!(
        found.assessment.missing_effects.contains(&MissingEffect::Angle),
        "{:?}",
        found.assessment
    );
    // Such an encoder makes the arm seem longer. The error of its length includes this, and would
    // be much too small without it.
    let length = Unknown::from(DomainParameter::RotaryLength);
    let length = found.estimates.iter().find(|it| it.unknown == length).unwrap();
    let off = (length.value - truth().parameters.rotary_length_m).abs();
    let of_noise = (length.standard_error.powi(2) - length.model_error.powi(2)).sqrt();
    assert!(off < 2.0 * length.standard_error && off > 4.0 * of_noise, "{off}: {length:?}");
}

#[test]
fn a_slow_motion_is_not_taken_for_an_encoder_off_its_centre() {
    // Where an arm hardly moves, a test of its encoder by the measured angle would find the
    // encoder's own rounding.
    for cable_rest_rad in [-0.6, -0.2, 0.3, 0.7] {
        let mut truth = truth();
        truth.nonidealities.cable_rest_rad = cable_rest_rad;
        let steps = Excitation::new(ExcitationShape::Steps, 0.8);
        let log = simulated(steps, &truth, &PlantModel::QUBE);
        let found = identify(&[log], &all(), &QubeModel::NOMINAL).unwrap();
        let tests = &found.assessment;
        assert_eq!(tests.verdict, ModelVerdict::Fits, "{cable_rest_rad}: {tests:?}");
    }
}

#[test]
fn a_fit_does_not_end_beside_the_best_model() {
    // In a chirp with an amplitude of 2.2 V the arm is rarely at rest, so friction, dead zones and
    // cable can replace each other in the fit.
    let lab = Profile::lab().model();
    let log = simulated(Excitation::new(ExcitationShape::Chirp, -2.2), &lab, &PlantModel::QUBE);
    let found = identify(&[log], &all(), &QubeModel::NOMINAL).unwrap();
    assert_eq!(found.assessment.verdict, ModelVerdict::Fits, "{:?}", found.assessment);
    let Nonidealities { positive_dead_zone_v, negative_dead_zone_v, .. } =
        found.model.nonidealities;
    let off_v = [
        positive_dead_zone_v - lab.nonidealities.positive_dead_zone_v,
        negative_dead_zone_v - lab.nonidealities.negative_dead_zone_v,
    ];
    assert!(off_v.iter().all(|off_v| off_v.abs() < 0.03), "{off_v:?}");
}

#[test]
fn only_held_out_recordings_of_another_qube_raise_a_doubt() {
    let mut longer = truth();
    longer.parameters.pendulum_length_m *= 1.03;
    let identified = identify(&[chirp(&truth(), 1.0, 4.0)], &all(), &QubeModel::NOMINAL).unwrap();
    assert_eq!(identified.clone().hold_out(&[]), None);
    for (qube, doubted) in [(truth(), false), (longer, true)] {
        let mut found = identified.clone();
        let ratio = found.hold_out(&[chirp(&qube, -1.0, 4.0)]).unwrap();
        let missing_effects = &found.assessment.missing_effects;
        assert_eq!(
            missing_effects.contains(&MissingEffect::HeldOut),
            doubted,
            "{ratio}: {missing_effects:?}"
        );
        let verdict = if doubted { ModelVerdict::FitsBut } else { ModelVerdict::Fits };
        assert_eq!(found.assessment.verdict, verdict);
        // No standard error grows by more than the factor by which the recording contradicts the
        // fit, and none shrinks.
        let wider = found.inflation / identified.inflation;
        assert!(if doubted { wider > 2.0 } else { wider < 1.5 }, "{wider}");
        for (estimate, before) in found.estimates.iter().zip(&identified.estimates) {
            let factor = estimate.standard_error / before.standard_error;
            assert!(factor >= 1.0 - 1e-9 && factor <= wider + 1e-9, "{factor} of {estimate:?}");
            assert_eq!(estimate.value, before.value);
        }
    }
}

/// The factor by which a held-out recording multiplies the inflation of a fit's standard errors.
fn widening(identified: &Identified, held_out: &MotionLog) -> f64 {
    let mut found = identified.clone();
    found.hold_out(std::slice::from_ref(held_out)).unwrap();
    found.inflation / identified.inflation
}

#[test]
fn a_held_out_swing_is_measured_by_the_noise_of_the_chirp_that_was_fitted() {
    let identified = identify(&[chirp(&truth(), 1.0, 4.0)], &all(), &QubeModel::NOMINAL).unwrap();
    let mut longer = truth();
    longer.parameters.pendulum_length_m *= 1.01;
    let falls = |qube: &QubeModel| {
        driven(qube, 1.0, 4.0, State { alpha: 2.9, ..State::default() }, &|_| true)
    };
    let (same, other) =
        (widening(&identified, &falls(&truth())), widening(&identified, &falls(&longer)));
    assert!(same < 1.5 && other > 3.0, "{same} {other}");
    // The residuals of a slightly longer pendulum are small, but contradict the estimated length.
    longer.parameters.pendulum_length_m = truth().parameters.pendulum_length_m * 1.003;
    let mut found = identified.clone();
    let ratio = found.hold_out(&[falls(&longer)]).unwrap();
    assert_eq!(found.assessment.missing_effects, [MissingEffect::Contradicted], "{ratio}");
    let provenance = found.profile("longer", Vec::new(), Vec::new()).provenance.unwrap();
    assert_eq!(provenance.doubts, ["contradicted"]);
}

#[test]
fn a_held_out_chirp_is_measured_by_the_noise_of_windows_as_short_as_its_own() {
    // A motor that warms leaves large residuals over whole chirps, and small residuals over windows
    // of half a second.
    let logs = [1.0, -1.0].map(|sign| warming_chirp(&truth(), sign, 0.3));
    let identified = identify(&logs, &all(), &QubeModel::NOMINAL).unwrap();
    let mut longer = truth();
    longer.parameters.pendulum_length_m *= 1.03;
    let other = widening(&identified, &warming_chirp(&longer, -1.0, 0.3));
    assert!(other > 1.5, "{other}");
}

#[test]
fn a_reversed_sign_is_named() {
    let good = chirp(&truth(), 1.0, 4.0);
    for sign in Sign::ALL {
        let refused = identify(&[turned(&good, sign)], &all(), &QubeModel::NOMINAL).unwrap_err();
        assert_eq!(refused.cause(), Some(Cause::Reversed(sign)), "{refused}");
    }
}

/// A recording without velocities, and with one sign reversed.
fn turned(log: &MotionLog, sign: Sign) -> MotionLog {
    let mut log = log.clone();
    for sample in &mut log.samples {
        match sign {
            Sign::Voltage => sample.voltage_v = -sample.voltage_v,
            Sign::Arm => sample.state.theta = -sample.state.theta,
            Sign::Pendulum => sample.state.alpha = -sample.state.alpha,
        }
        (sample.state.theta_dot, sample.state.alpha_dot) = (0.0, 0.0);
    }
    log
}

#[test]
fn no_sign_is_named_for_all_recordings_if_one_recording_alone_has_another() {
    let others = [chirp(&truth(), -1.0, 4.0), chirp(&truth(), 1.5, 4.0)];
    let mut named = 0;
    for sign in Sign::ALL {
        let odd = turned(&chirp(&truth(), 1.0, 4.0), sign);
        let logs = [others[0].clone(), odd, others[1].clone()];
        match identify(&logs, &all(), &QubeModel::NOMINAL) {
            Ok(found) => assert_ne!(found.assessment.verdict, ModelVerdict::Fits, "{sign}"),
            Err(refused) => {
                let cause = refused.cause().unwrap();
                assert!(!matches!(cause, Cause::Reversed(_)), "{sign}: {refused}");
                named += u32::from(cause == Cause::ReversedIn { index: 1, sign });
            }
        }
    }
    assert!(named > 0, "the recording with another sign was never named");
}

#[test]
fn a_pendulum_that_is_shorter_than_its_name_plate_says_is_found() {
    let mut short = truth();
    short.parameters.pendulum_length_m = 0.86 * DomainParameters::NOMINAL.pendulum_length_m;
    let logs = [chirp(&short, 1.0, 4.0), chirp(&short, -1.0, 4.0)];
    let found = identify(&logs, &all(), &QubeModel::NOMINAL).unwrap();
    let ratio = found.model.parameters.pendulum_length_m / short.parameters.pendulum_length_m;
    assert!((ratio - 1.0).abs() < 0.03, "{ratio}");
}

#[test]
fn a_recording_that_no_qube_makes_is_refused() {
    // The voltage has the wrong sign.
    for (sign, seconds) in [(-1.0, 4.0), (1.0, 5.0)] {
        let mut log = chirp(&truth(), sign, seconds);
        for sample in &mut log.samples {
            sample.voltage_v = -sample.voltage_v;
        }
        assert_eq!(check_recording(&log), Ok(()));
        let refused = identify(&[log], &all(), &QubeModel::NOMINAL);
        assert!(
            matches!(
                refused,
                Err(IdentifyError::Implausible { .. } | IdentifyError::NothingExplained { .. })
            ),
            "{sign}, {seconds} s: {refused:?}"
        );
    }
    // The angles do not belong together.
    let mut log = chirp(&truth(), 1.0, 4.0);
    let turned: Vec<f64> = log.samples.iter().rev().map(|sample| sample.state.alpha).collect();
    for (sample, alpha) in log.samples.iter_mut().zip(turned) {
        (sample.state.alpha, sample.state.alpha_dot) = (alpha, 0.0);
    }
    assert_eq!(check_recording(&log), Ok(()));
    let refused = identify(&[log], &all(), &QubeModel::NOMINAL);
    let Err(IdentifyError::Unexplained { cause, .. }) = refused else { panic!("{refused:?}") };
    assert_eq!(cause, Cause::Unknown);
}
