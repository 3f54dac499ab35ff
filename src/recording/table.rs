use std::fmt::Write;

use super::Recording;
use crate::telemetry::{Phase, TickRecord};

/// The columns of [`csv_table`], in order, with their units.
pub const COLUMNS: [&str; 26] = [
    "tick",
    "time_s",
    "phase",
    "theta_rad",
    "alpha_rad",
    "theta_dot_rad_s",
    "alpha_dot_rad_s",
    "voltage_v",
    "wanted_v",
    "reward",
    "measured_theta_rad",
    "measured_alpha_rad",
    "theta_counts",
    "alpha_counts",
    "tachometer_counts_s",
    "current_a",
    "applied_mv",
    "device_time_us",
    "sample_to_act_us",
    "armed",
    "emergency_stop",
    "deadline_ns",
    "lateness_ns",
    "skipped_periods",
    "turnaround_ns",
    "stop_requested",
];

/// A recording as a table: a header with [`COLUMNS`] and a row for each tick, in numbers that read back exactly.
///
/// `theta_rad` to `alpha_dot_rad_s` are the estimated state that the policy saw, `voltage_v` is what was sent. The time
/// counts by the host's clock from the first tick. `phase` is 0 while the arm settles, 1 under the policy, 2 in braking,
/// because many tools read numbers alone. A field without a value is empty: the measurement of a tick whose sample did
/// not come, the reward of a tick that is not the policy's, a number that is not finite.
#[must_use]
pub fn csv_table(recording: &Recording) -> String {
    let mut table = COLUMNS.join(",");
    table.push('\n');
    let first_ns = recording.ticks.first().map_or(0, |tick| tick.deadline_ns);
    for tick in &recording.ticks {
        add_row(&mut table, recording, tick, first_ns);
    }
    table
}

fn add_row(table: &mut String, recording: &Recording, tick: &TickRecord, first_ns: u64) {
    let header = &recording.header;
    let state = &tick.state;
    let time_s = tick.deadline_ns.saturating_sub(first_ns) as f64 * 1e-9;
    let voltage_v = f64::from(tick.voltage_mv) / 1000.0;
    let is_running = tick.phase == Phase::Running;
    let reward = is_running.then(|| header.reward.reward(state, voltage_v));
    let _ = write!(table, "{},", tick.tick);
    number(table, Some(time_s));
    let _ = write!(table, "{},", tick.phase.number());
    for value in [state.theta, state.alpha, state.theta_dot, state.alpha_dot, voltage_v] {
        number(table, Some(value));
    }
    number(table, tick.wanted_v);
    number(table, reward);
    match &tick.measurement {
        None => table.push_str(&",".repeat(11)),
        Some(measurement) => {
            let (theta_rad, alpha_rad) = header.settings.calibration.angles_rad(measurement);
            number(table, Some(theta_rad));
            number(table, Some(alpha_rad));
            let _ = write!(
                table,
                "{},{},{},",
                measurement.theta_counts, measurement.alpha_counts, measurement.tachometer_counts_s
            );
            match measurement.current_a.is_finite() {
                true => drop(write!(table, "{},", measurement.current_a)),
                false => table.push(','),
            }
            let _ = write!(table, "{},{},", measurement.applied_mv, measurement.device_time_us);
            match measurement.sample_to_act_us {
                Some(time_us) => drop(write!(table, "{time_us},")),
                None => table.push(','),
            }
            let status = &measurement.status;
            let _ =
                write!(table, "{},{},", u8::from(status.armed), u8::from(status.emergency_stop));
        }
    }
    let _ = writeln!(
        table,
        "{},{},{},{},{}",
        tick.deadline_ns,
        tick.lateness_ns,
        tick.skipped_periods,
        tick.turnaround_ns,
        u8::from(tick.stop_requested)
    );
}

/// Adds a field; empty for no value and for one that is not finite.
fn number(table: &mut String, value: Option<f64>) {
    match value.filter(|value| value.is_finite()) {
        Some(value) => drop(write!(table, "{value},")),
        None => table.push(','),
    }
}
