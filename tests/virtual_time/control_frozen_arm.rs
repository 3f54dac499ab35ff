//! Tests that a freeze of the arm's encoder during a motion is found, and that an arm that friction
//! holds is not taken for a frozen encoder.

use qube_hil::control::{Alarm, ArmInput, SensorWatch};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::estimation::Calibration;
use qube_hil::qube::{
    Measurement, NonidealDynamics, Nonidealities, PlantModel, QubeModel, RAD_PER_COUNT, State,
    control_step, counts,
};
use qube_hil::telemetry::{Ending, Fault};

use crate::harmless::freezes::{KINDS, freezes, policies, qubes};

/// The first alarm and its tick while the arm is driven to and fro beside a swinging pendulum;
/// `None` if there is no alarm in 400 ticks. The arm's encoder freezes after the tick `frozen_at`,
/// or not at all.
fn first_alarm(
    nonidealities: Nonidealities,
    alpha: f64,
    amplitude_v: f64,
    frozen_at: Option<u32>,
) -> Option<(u32, Alarm)> {
    let dynamics = NonidealDynamics::new(&QubeModel { nonidealities, ..QubeModel::NOMINAL });
    let mut state = State { alpha, ..State::default() };
    let mut watch = SensorWatch::with_cross_check(&PlantModel::QUBE, Calibration::IDENTITY);
    let (mut theta_counts, mut voltage_v) = (0, 0.0);
    for tick in 0..400_u32 {
        let is_frozen = frozen_at.is_some_and(|at| tick > at);
        theta_counts = if is_frozen { theta_counts } else { counts(state.theta) };
        let theta_dot = if is_frozen { 0.0 } else { state.theta_dot };
        let sample = Measurement {
            device_time_us: u64::from(tick) * 10_000,
            theta_counts,
            alpha_counts: counts(state.alpha),
            tachometer_counts_s: (theta_dot / RAD_PER_COUNT) as i32,
            ..Measurement::default()
        };
        let voltage_mv = (1e3 * voltage_v) as i16;
        let swing_rad_s = state.alpha.cos() * state.alpha_dot;
        let alarm = watch.check(&sample, Some(ArmInput { voltage_mv, swing_rad_s }));
        if let Some(alarm) = alarm {
            return Some((tick, alarm));
        }
        voltage_v = if tick % 60 < 30 { amplitude_v } else { -amplitude_v };
        state = control_step(&dynamics, state, voltage_v);
    }
    None
}

#[test]
fn a_freeze_in_a_swing_is_found_within_300_ms() {
    for at in (60..300).step_by(7) {
        for (alpha, amplitude_v) in [(1.5, 2.0), (2.0, 4.0), (2.5, 3.0)] {
            let found = first_alarm(Nonidealities::default(), alpha, amplitude_v, Some(at));
            let is_found = found.is_some_and(|(tick, alarm)| {
                (at..=at + 30).contains(&tick) && alarm == Alarm::SwitchOff(Fault::EncoderFrozen)
            });
            assert!(is_found, "{at}, {alpha}: {found:?}");
        }
    }
}

#[test]
fn an_arm_that_friction_holds_against_a_swinging_pendulum_is_not_frozen() {
    // Four times the Coulomb torque of `lab`, 4.7e-4 N m.
    let sticky = Nonidealities { coulomb_torque_n_m: 4.0 * 4.7e-4, ..Nonidealities::default() };
    for nonidealities in [Nonidealities::default(), sticky] {
        for alpha in [0.0, 0.2, 0.5, 1.0, 2.0, 3.0, 3.1] {
            for amplitude_v in [0.0, 0.3, 0.6] {
                let alarm = first_alarm(nonidealities, alpha, amplitude_v, None);
                assert_eq!(alarm, None, "{alpha} rad, {amplitude_v} V");
            }
        }
    }
}

/// Runs whole rollouts, with a freeze at the beginning of the policy (seed 0) or after about 60 %
/// of its time (seed 1), when most rollouts balance quietly: only the test push finds such a
/// freeze.
#[test]
fn a_freeze_in_a_rollout_is_found_within_300_ms_and_a_healthy_qube_is_left_alone() {
    for (qube, settings) in qubes() {
        for (name, policy) in policies() {
            for seed in 0..2 {
                let settings = EmulatorSettings { seed, ..settings };
                let (healthy, frozen) = freezes(settings, &policy).expect("a homed Qube");
                let rollout = format!("{qube}, {name}, seed {seed}");
                assert!(
                    !matches!(healthy.ending, Ending::Fault(_)),
                    "{rollout}: {:?}",
                    healthy.ending
                );
                for ((kind, _), freeze) in KINDS.iter().zip(frozen) {
                    let rollout = format!("{rollout}, {kind}");
                    let freeze = freeze.unwrap_or_else(|| panic!("{rollout}: no result"));
                    let found_ms = freeze.found_ms();
                    assert!(found_ms.is_some_and(|ms| ms <= 300.0), "{rollout}: {found_ms:?}");
                    assert!(!freeze.is_named_otherwise(), "{rollout}: {:?}", freeze.outcome.ending);
                }
            }
        }
    }
}
