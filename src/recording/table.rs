use std::fmt::Write;

use super::Recording;
use crate::telemetry::{Phase, TickRecord};

/// The names of the columns from which a table of ticks is read as a motion. All but the last two
/// are among [`COLUMNS`].
pub mod column {
    /// Time, counted from the first tick, s.
    pub const TIME_S: &str = "time_s";
    /// Phase, as its number; in Python as its name.
    pub const PHASE: &str = "phase";
    /// Estimated angle of the arm, rad.
    pub const THETA_RAD: &str = "theta_rad";
    /// Estimated angle of the pendulum, rad.
    pub const ALPHA_RAD: &str = "alpha_rad";
    /// Estimated velocity of the arm, rad/s.
    pub const THETA_DOT_RAD_S: &str = "theta_dot_rad_s";
    /// Estimated velocity of the pendulum, rad/s.
    pub const ALPHA_DOT_RAD_S: &str = "alpha_dot_rad_s";
    /// Voltage that was sent, V.
    pub const VOLTAGE_V: &str = "voltage_v";
    /// Angle of the arm by its encoder, rad.
    pub const MEASURED_THETA_RAD: &str = "measured_theta_rad";
    /// Angle of the pendulum by its encoder, rad.
    pub const MEASURED_ALPHA_RAD: &str = "measured_alpha_rad";
    /// Voltage at the motor when the sample was taken, mV.
    pub const APPLIED_MV: &str = "applied_mv";
    /// Time of the sample by the device's clock, us.
    pub const DEVICE_TIME_US: &str = "device_time_us";
    /// [`APPLIED_MV`] in V, as the Python package names it.
    pub const APPLIED_V: &str = "applied_v";
    /// [`DEVICE_TIME_US`] in s, as the Python package names it.
    pub const DEVICE_TIME_S: &str = "device_time_s";
}

/// The columns of a recording's table, in order. A name ends with its unit where the quantity has
/// one.
pub const COLUMNS: [&str; 26] = [
    "tick",
    column::TIME_S,
    column::PHASE,
    column::THETA_RAD,
    column::ALPHA_RAD,
    column::THETA_DOT_RAD_S,
    column::ALPHA_DOT_RAD_S,
    column::VOLTAGE_V,
    "wanted_v",
    "reward",
    column::MEASURED_THETA_RAD,
    column::MEASURED_ALPHA_RAD,
    "theta_counts",
    "alpha_counts",
    "tachometer_counts_s",
    "current_a",
    column::APPLIED_MV,
    column::DEVICE_TIME_US,
    "sample_to_act_us",
    "armed",
    "emergency_stop",
    "deadline_ns",
    "lateness_ns",
    "skipped_periods",
    "turnaround_ns",
    "stop_requested",
];

/// One field of a table; `None` inside is a field without a value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Field {
    /// A finite number.
    Number(Option<f64>),
    /// A finite number of single precision.
    Single(Option<f32>),
    /// A whole number that may be negative.
    Whole(Option<i64>),
    /// A count, a time or a flag.
    Count(Option<u64>),
}

/// The rows of a recording's table: a row for each tick, a field for each of [`COLUMNS`]. All
/// fields of a column are of one variant of [`Field`].
///
/// `theta_rad` to `alpha_dot_rad_s` are the estimated state that the policy saw, and `voltage_v` is
/// the voltage that was sent. `time_s` is the tick's deadline by the host's clock, counted from the
/// deadline of the first tick. `phase` is 0 while the arm settles, 1 under the policy and 2 while
/// braking: a number, because many tools read nothing else.
///
/// A field has no value in these cases: `wanted_v` in a tick whose sample did not come, and in the
/// tick that switches the amplifier off; the fields of the measurement in a tick whose sample did
/// not come; `sample_to_act_us` also where no command answered the previous sample; the reward in a
/// tick outside the policy's phase; and any number that is not finite.
pub fn table_rows(recording: &Recording) -> impl Iterator<Item = [Field; COLUMNS.len()]> + '_ {
    let first_ns = recording.ticks.first().map_or(0, |tick| tick.deadline_ns);
    recording.ticks.iter().map(move |tick| row(recording, tick, first_ns))
}

/// A recording as a table in CSV: a header line with [`COLUMNS`], then [`table_rows`]. The numbers
/// have as many digits as they need to read back exactly. A field without a value is empty.
#[must_use]
pub fn csv_table(recording: &Recording) -> String {
    let mut table = COLUMNS.join(",");
    table.push('\n');
    for row in table_rows(recording) {
        for (index, field) in row.into_iter().enumerate() {
            if index > 0 {
                table.push(',');
            }
            let _ = match field {
                Field::Number(Some(value)) => write!(table, "{value}"),
                Field::Single(Some(value)) => write!(table, "{value}"),
                Field::Whole(Some(value)) => write!(table, "{value}"),
                Field::Count(Some(value)) => write!(table, "{value}"),
                _ => Ok(()),
            };
        }
        table.push('\n');
    }
    table
}

fn row(recording: &Recording, tick: &TickRecord, first_ns: u64) -> [Field; COLUMNS.len()] {
    let header = &recording.header;
    let state = &tick.state;
    let voltage_v = tick.voltage_v();
    let is_running = tick.phase == Phase::Running;
    let measurement = tick.measurement.as_ref();
    let angles_rad = measurement.map(|it| header.settings.calibration.angles_rad(it));
    let number = |value: Option<f64>| Field::Number(value.filter(|value| value.is_finite()));
    let whole = |value: Option<i32>| Field::Whole(value.map(i64::from));
    let flag = |value: bool| Field::Count(Some(value.into()));
    [
        Field::Count(Some(tick.tick.into())),
        number(Some(tick.deadline_ns.saturating_sub(first_ns) as f64 * 1e-9)),
        Field::Count(Some(tick.phase.number().into())),
        number(Some(state.theta)),
        number(Some(state.alpha)),
        number(Some(state.theta_dot)),
        number(Some(state.alpha_dot)),
        number(Some(voltage_v)),
        number(tick.wanted_v),
        number(is_running.then(|| header.reward.reward(state, voltage_v))),
        number(angles_rad.map(|(theta_rad, _)| theta_rad)),
        number(angles_rad.map(|(_, alpha_rad)| alpha_rad)),
        whole(measurement.map(|it| it.theta_counts)),
        whole(measurement.map(|it| it.alpha_counts)),
        whole(measurement.map(|it| it.tachometer_counts_s)),
        Field::Single(measurement.map(|it| it.current_a).filter(|it| it.is_finite())),
        whole(measurement.map(|it| it.applied_mv.into())),
        Field::Count(measurement.map(|it| it.device_time_us)),
        Field::Count(measurement.and_then(|it| it.sample_to_act_us).map(Into::into)),
        measurement.map_or(Field::Count(None), |it| flag(it.status.armed)),
        measurement.map_or(Field::Count(None), |it| flag(it.status.emergency_stop)),
        Field::Count(Some(tick.deadline_ns)),
        Field::Count(Some(tick.lateness_ns)),
        Field::Count(Some(tick.skipped_periods.into())),
        Field::Count(Some(tick.turnaround_ns)),
        flag(tick.stop_requested),
    ]
}
