//! Compares the simulator and identified models with recordings of a real Qube, and checks that the
//! recordings raise no alarm and leave the motor cool.
//!
//! The recordings are not part of the repository. `$QUBE_HIL_RECORDINGS` names their folder; if the
//! variable is not set, the folder is `../shared/data/qube-recordings`, relative to the repository.
//! Without variable and folder these tests say that they are skipped, and pass; with
//! `QUBE_HIL_REQUIRE_RECORDINGS` they fail.

use std::path::{Path, PathBuf};

use qube_hil::control::{ArmInput, SensorWatch};
use qube_hil::estimation::Calibration;
use qube_hil::identification::{PredictionRegime, Unknown, horizon_error, identify, regime_error};
use qube_hil::qube::{CONTROL_PERIOD_S, Measurement, PlantModel, QubeModel, RAD_PER_COUNT};
use qube_hil::replay::{AngleError, MotionLog, simulate_from_first_state};
use qube_hil::safety::MotorHeat;

use crate::shared::say_skipped;

/// The folder of the recordings; `None` if the tests are to be skipped.
fn recordings() -> Option<PathBuf> {
    if let Some(named) = std::env::var_os("QUBE_HIL_RECORDINGS") {
        let folder = PathBuf::from(named);
        assert!(folder.is_dir(), "QUBE_HIL_RECORDINGS names no folder: {}", folder.display());
        return Some(folder);
    }
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/qube-recordings");
    if folder.is_dir() {
        return Some(folder);
    }
    let reason = format!("no recordings of a real Qube in {}", folder.display());
    say_skipped("a comparison with a real Qube", reason, &["QUBE_HIL_REQUIRE_RECORDINGS"]);
    None
}

/// The paths of all recordings in a folder, of which there must be at least one.
fn all_of(folder: &Path) -> Vec<PathBuf> {
    let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let is_recording = |path: &PathBuf| path.extension().is_some_and(|it| it == "csv");
    let recordings: Vec<PathBuf> = paths.filter(is_recording).collect();
    assert!(!recordings.is_empty(), "there is no recording in {}", folder.display());
    recordings
}

fn rmse_of_chirps(folder: &Path) -> Vec<(String, AngleError)> {
    let mut chirps = Vec::new();
    for direction in ["plus", "minus"] {
        for number in 1..=3 {
            let name = format!("chirp_{direction}1.5V_250Hz_{number}.csv");
            let log = MotionLog::read(&folder.join(&name)).unwrap();
            let rmse = simulate_from_first_state(&log, &QubeModel::NOMINAL).unwrap().rmse;
            chirps.push((name, rmse));
        }
    }
    chirps
}

/// Nominal physics differs from the real machine by a known amount. An independent implementation
/// found 0.55 rad (start at +1.5 V) and 0.49 rad (-1.5 V) for theta, and 0.48 rad for alpha.
#[test]
fn nominal_physics_is_half_a_radian_off_on_real_chirps() {
    let Some(folder) = recordings() else { return };
    for (name, rmse) in rmse_of_chirps(&folder) {
        eprintln!("{name}: theta {:.3} rad, alpha {:.3} rad", rmse.theta_rad, rmse.alpha_rad);
        assert!((0.44..0.60).contains(&rmse.theta_rad), "{name}: {rmse:?}");
        assert!((0.44..0.53).contains(&rmse.alpha_rad), "{name}: {rmse:?}");
    }
}

/// The recordings have no current; it is computed from voltage and speed.
#[test]
fn the_motor_of_a_real_qube_stays_cool() {
    let Some(folder) = recordings() else { return };
    for path in all_of(&folder) {
        let log = MotionLog::read(&path).unwrap();
        let (mut heat, mut largest, mut next_s) = (MotorHeat::default(), 0.0_f64, 0.0);
        for sample in &log.samples {
            if sample.time_s + 1e-9 >= next_s {
                next_s += CONTROL_PERIOD_S;
                let voltage_mv = (1000.0 * sample.voltage_v).round() as i16;
                heat.pass(0, None, voltage_mv, sample.state.theta_dot);
                largest = largest.max(heat.load);
            }
        }
        eprintln!("{}: load at most {:.3}", path.display(), largest);
        assert!((0.005..0.5).contains(&largest), "{}: {largest}", path.display());
    }
}

#[test]
fn every_recording_can_be_read() {
    let Some(folder) = recordings() else { return };
    for path in all_of(&folder) {
        let log = MotionLog::read(&path).unwrap();
        assert!(log.samples.len() > 2000, "{}", path.display());
    }
}

/// An independent fit of the same terms gave 0.061 rad (theta) and 0.025 rad (alpha).
#[test]
fn a_model_with_friction_cable_and_delay_predicts_chirps_that_it_was_not_fitted_to() {
    let Some(folder) = recordings() else { return };
    let chirp = |direction: &str, number: u32| {
        let name = format!("chirp_{direction}1.5V_250Hz_{number}.csv");
        MotionLog::read(&folder.join(name)).unwrap()
    };
    let fitted = [chirp("plus", 1), chirp("minus", 1)];
    let held_out = [chirp("plus", 2), chirp("plus", 3), chirp("minus", 2), chirp("minus", 3)];
    let all: Vec<Unknown> = Unknown::all().collect();
    let found = identify(&fitted, &all, &QubeModel::NOMINAL).unwrap();
    let error = horizon_error(&held_out, &found.model, 9.8);
    eprintln!("held out, 9.8 s: {:?}", error.rms);
    assert_eq!(error.predictions, 4);
    assert!(error.rms.theta_rad <= 0.07 && error.rms.alpha_rad <= 0.03, "{error:?}");
}

/// The model is fitted to two chirps and two swing-ups; `examples/held_out_recordings.rs` holds out
/// each recording in turn.
#[test]
fn a_model_fitted_to_chirps_and_swing_ups_predicts_swing_ups_that_it_was_not_fitted_to() {
    let Some(folder) = recordings() else { return };
    let log = |name: &str| MotionLog::read(&folder.join(format!("{name}.csv"))).unwrap();
    let fitted = [
        log("chirp_plus1.5V_250Hz_1"),
        log("chirp_minus1.5V_250Hz_1"),
        log("swingup_energy_250Hz_10s_1"),
        log("swingup_energy_500Hz_5s_1"),
    ];
    let held_out = [
        log("swingup_energy_250Hz_10s_2"),
        log("swingup_energy_250Hz_10s_3"),
        log("swingup_energy_500Hz_5s_2"),
        log("swingup_energy_500Hz_5s_3"),
    ];
    let all: Vec<Unknown> = Unknown::all().collect();
    let found = identify(&fitted, &all, &QubeModel::NOMINAL).unwrap();
    let error = |regime| regime_error(&held_out, &found.model, regime);
    let (swing, balance) = (error(PredictionRegime::Swing), error(PredictionRegime::Balance));
    eprintln!("held out: swing {swing:?}, balance {balance:?}");
    assert!(swing.rms.theta_rad <= 0.09 && swing.rms.alpha_rad <= 0.14, "{swing:?}");
    assert!(balance.rms.theta_rad <= 0.025 && balance.rms.alpha_rad <= 0.03, "{balance:?}");
    let nominal = regime_error(&held_out, &QubeModel::NOMINAL, PredictionRegime::Swing);
    assert!(nominal.rms.theta_rad > 0.3, "{nominal:?}");
}

/// Samples of a real Qube's swing-ups and chirps, at least 10 ms apart, raise no alarm. The
/// recordings have no current; the current of the nominal motor at their voltage and velocity takes
/// its place.
#[test]
fn a_real_qube_raises_no_alarm_of_encoders_or_motor() {
    let Some(folder) = recordings() else { return };
    let motor = PlantModel::QUBE.parameters;
    for path in all_of(&folder) {
        let log = MotionLog::read(&path).unwrap();
        let mut watch = SensorWatch::with_cross_check(&PlantModel::QUBE, Calibration::IDENTITY);
        let mut next_s = 0.0;
        for sample in &log.samples {
            if sample.time_s + 1e-9 < next_s {
                continue;
            }
            next_s = sample.time_s + 0.01;
            let back_emf_v = motor.motor_back_emf_v_s * sample.state.theta_dot;
            let current_a = (sample.voltage_v - back_emf_v) / motor.motor_resistance_ohm;
            let voltage_mv = (1000.0 * sample.voltage_v) as i16;
            let alarm = watch.check(
                &Measurement {
                    device_time_us: (1e6 * sample.time_s).round() as u64,
                    theta_counts: (sample.state.theta / RAD_PER_COUNT).round() as i32,
                    alpha_counts: (sample.state.alpha / RAD_PER_COUNT).round() as i32,
                    // The recordings have no tachometer; their filtered velocity takes its place.
                    tachometer_counts_s: (sample.state.theta_dot / RAD_PER_COUNT) as i32,
                    current_a: current_a as f32,
                    applied_mv: voltage_mv,
                    ..Measurement::default()
                },
                Some(ArmInput {
                    voltage_mv,
                    swing_rad_s: sample.state.alpha.cos() * sample.state.alpha_dot,
                }),
            );
            assert_eq!(alarm, None, "{} at {} s", path.display(), sample.time_s);
        }
    }
}
