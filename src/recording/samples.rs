//! Example rollouts for tests of this room and of rooms that read recordings.

use std::collections::BTreeMap;
use std::path::Path;

use super::{FORMAT_VERSION, RolloutWriter};
use crate::estimation::{Calibration, EstimatorSettings};
use crate::qube::{Measurement, PlantModel, RewardWeights, State, Status};
use crate::safety::{Limit, MotorHeat, SafetyBox};
use crate::telemetry::{
    CheckResult, DeviceFacts, Ending, LatencySummary, Phase, Preflight, RolloutHeader,
    RolloutOutcome, TickRecord, TickSettings,
};

pub(crate) const POLICY: &[u8] = b"not a policy, but these very bytes";

pub(crate) fn header() -> RolloutHeader {
    RolloutHeader {
        format: FORMAT_VERSION,
        session: "test".to_owned(),
        candidate: Some(3),
        rollout: 1,
        attempt: 0,
        psi: BTreeMap::from([("mu_M_p".to_owned(), 0.1 + 0.2), ("sigma_M_p".to_owned(), 5e-5)]),
        seed: u64::MAX,
        started_unix_ns: None,
        program_version: "0.1.0".to_owned(),
        git_revision: "unknown".to_owned(),
        device: DeviceFacts::from_iter([(DeviceFacts::KIND, "emulator")]),
        preflight: Preflight::Done(vec![
            CheckResult::pass("latency", "sample p50 0.92 ms"),
            CheckResult::fail("motor-sign", "-0.1 rad", "turn it round"),
            CheckResult::skipped("homing", "not before all else passes"),
        ]),
        motor_heat: Some(MotorHeat { load: 0.25, ..MotorHeat::default() }),
        hard_stop_accepted: false,
        policy: "nominal".to_owned(),
        settings: TickSettings {
            calibration: Calibration { theta_zero_counts: 12, ..Calibration::IDENTITY },
            estimator: EstimatorSettings::default(),
            safety_box: SafetyBox::THESIS,
            max_steps: 600,
            start_theta_rad: 0.0,
            stops: None,
            foresight: None,
            rules: crate::telemetry::TickRules::NEWEST,
            plant: PlantModel::QUBE,
        },
        reward: RewardWeights::THESIS,
    }
}

pub(crate) fn outcome() -> RolloutOutcome {
    RolloutOutcome {
        last_answer_v: None,
        ending: Ending::LeftBox(Limit::Theta),
        phase: Phase::Braking,
        steps: 15,
        missed_deadlines: 1,
        records_lost: 0,
        observer_resets: 0,
        foreseen: None,
        contradiction: None,
        largest_motor_load: Some(0.375),
        lateness_us: LatencySummary { p50: 1.0, p99: 2.0, p999: 3.0, max: 4.1 },
        sample_to_act_us: LatencySummary::default(),
    }
}

/// Returns the tick with this number. Its optional fields have values, with two exceptions: every
/// seventh tick has no sample and no requested voltage, and tick 0 has no time from sample to act.
pub(crate) fn tick(number: u32) -> TickRecord {
    let time_s = f64::from(number) * 0.01;
    let held_over = number % 7 == 3;
    TickRecord {
        tick: number,
        phase: match number {
            0..5 => Phase::Settling,
            5..25 => Phase::Running,
            _ => Phase::Braking,
        },
        deadline_ns: 1_000_000_000 + u64::from(number) * 10_000_000,
        lateness_ns: u64::from(number) * 1001,
        skipped_periods: u32::from(number % 11 == 10),
        stop_requested: number > 25,
        measurement: (!held_over).then(|| Measurement {
            device_time_us: u64::from(number) * 10_000,
            theta_counts: 3 * number as i32 - 20,
            alpha_counts: -(number as i32),
            tachometer_counts_s: 300,
            current_a: 0.1 * number as f32,
            status: Status { armed: true, ..Status::default() },
            applied_mv: -1234,
            sample_to_act_us: (number > 0).then_some(321),
        }),
        state: State {
            theta: time_s.sin(),
            alpha: time_s.cos() * 3.0,
            theta_dot: 1.0 / 3.0,
            alpha_dot: -0.0,
        },
        wanted_v: (!held_over).then_some(time_s.exp()),
        voltage_mv: number as i16 - 10,
        turnaround_ns: 123_456,
    }
}

pub(super) fn ticks(count: u32) -> Vec<TickRecord> {
    (0..count).map(tick).collect()
}

/// A finished recording in memory.
pub(crate) fn recorded(ticks: &[TickRecord]) -> Vec<u8> {
    let mut writer =
        RolloutWriter::begin(Vec::new(), Path::new("memory"), header(), POLICY).unwrap();
    for tick in ticks {
        writer.write(tick).unwrap();
    }
    writer.finish(&outcome()).unwrap()
}

/// Offsets at which the text begins.
pub(super) fn find_all(bytes: &[u8], text: &[u8]) -> Vec<usize> {
    let positions = 0..=bytes.len() - text.len();
    positions.filter(|&start| bytes[start..].starts_with(text)).collect()
}
