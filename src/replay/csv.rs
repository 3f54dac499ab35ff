use thiserror::Error;

use super::MotionSample;
use super::motion_sample::{MAX_INTERRUPTION_S, device_time_s, with_turns_of};
use crate::qube::{State, applied_voltage_mv, volts};
use crate::recording::column;
use crate::telemetry::Phase;

/// Required columns, in the order of the numbers of a [`MotionSample`].
const COLUMNS: [&str; 6] = [
    column::TIME_S,
    column::THETA_RAD,
    column::ALPHA_RAD,
    column::THETA_DOT_RAD_S,
    column::ALPHA_DOT_RAD_S,
    column::VOLTAGE_V,
];

/// The reason why a text is not a table of a motion. Lines are counted from 1, blank ones too.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum CsvError {
    /// A required column is missing.
    #[error("the column `{column}` is missing; the header has: {found}")]
    MissingColumn {
        /// Name of the column.
        column: &'static str,
        /// Header of the file, at most 200 characters of it.
        found: String,
    },
    /// Two columns have the name of a required column.
    #[error("the header has the column `{column}` twice: keep the one that holds the motion")]
    ColumnTwice {
        /// Name of the column.
        column: &'static str,
    },
    /// A field is not a finite number.
    #[error("line {line}: `{text}` in column `{column}` is not a finite number")]
    BadNumber {
        /// Number of the line.
        line: usize,
        /// Name of the column.
        column: &'static str,
        /// Text of the field.
        text: String,
    },
    /// The field of the column `phase` names no phase.
    #[error(
        "line {line}: `{text}` in column `{}` is no phase: give {}",
        column::PHASE,
        all_phases()
    )]
    BadPhase {
        /// Number of the line.
        line: usize,
        /// Text of the field.
        text: String,
    },
    /// A voltage is larger than any that this program writes into a table.
    #[error(
        "line {line}: `{text}` in column `{column}` is no voltage that this program writes: give at most {largest} \
         {unit} of either sign"
    )]
    NotVolts {
        /// Number of the line.
        line: usize,
        /// Name of the column.
        column: &'static str,
        /// Text of the field.
        text: String,
        /// Largest accepted value.
        largest: f64,
        /// Unit of the column.
        unit: &'static str,
    },
    /// A row ends before a required column.
    #[error("line {line} ends before column `{column}`")]
    ShortRow {
        /// Number of the line.
        line: usize,
        /// Name of a required column that the row lacks.
        column: &'static str,
    },
    /// A row has more fields than the header. Its numbers may have decimal commas, so that each is
    /// read as two.
    #[error(
        "line {line} has {fields} fields, and the header has {columns}: separate columns by commas, and write numbers \
         with decimal points"
    )]
    LongRow {
        /// Number of the line.
        line: usize,
        /// Number of fields in the row.
        fields: usize,
        /// Number of columns in the header.
        columns: usize,
    },
    /// The columns are separated by another character than a comma.
    #[error("the columns of the header are separated by `{separator}`: separate them by commas")]
    OtherSeparator {
        /// Character that separates the columns: `;`, or `tab`.
        separator: &'static str,
    },
    /// The table has fewer than two rows that are used.
    #[error("there are {rows} rows of numbers; a motion needs at least two")]
    TooFewRows {
        /// Number of rows.
        rows: usize,
    },
    /// The time of a row is not later than the time of the row before.
    #[error("line {line}: time goes from {before_s} s to {time_s} s; it has to grow")]
    TimeBackwards {
        /// Number of the line.
        line: usize,
        /// Time of the row before, s.
        before_s: f64,
        /// Time of this row, s.
        time_s: f64,
    },
    /// Two rows are more than 1 s apart, so rows are missing.
    #[error("line {line}: there is no row for {interruption_s} s before it; split the file there")]
    Interrupted {
        /// Number of the line.
        line: usize,
        /// Length of the interruption, s.
        interruption_s: f64,
    },
}

/// Reads the samples of a table with a header line. The voltage of the last row may be empty,
/// because no motion follows it; it is then 0 V. Times count from the first sample.
///
/// A table with the column `phase` is a table of ticks. From such a table, as from a recording,
/// only the ticks under the policy that have a sample are used ([`APPLIED`] lists the columns that
/// show whether a tick has one). Their voltages are converted by [`applied_voltage_mv`] to the
/// voltages that the motor driver applies. If the table also has the board's report, angles come
/// from the encoders and times from the device's clock, as in the motion of a recording.
pub(super) fn parse_csv(text: &str) -> Result<Vec<MotionSample>, CsvError> {
    // Some programs put a byte-order mark before the text.
    let text = text.trim_start_matches('\u{feff}');
    let mut lines = text
        .lines()
        .enumerate()
        .map(|(index, line)| (index + 1, line))
        .filter(|(_, line)| !line.trim().is_empty())
        .peekable();
    let header = Header::of(lines.next().map_or("", |(_, line)| line));
    let columns = header.motion()?;
    let ticks = TickColumns::of(&header);
    let mut start_us = None;
    let mut samples: Vec<MotionSample> = Vec::new();
    while let Some((line, text)) = lines.next() {
        let row = Row::of(line, text);
        row.check_length(header.names.len())?;
        let mut sample = match &ticks {
            Some(ticks) if !ticks.is_of_policy(&row)? => continue,
            _ => row.sample(&columns, lines.peek().is_none())?,
        };
        let [.., voltage] = columns;
        COMMANDED.check(&row, row.text(voltage), sample.voltage_v)?;
        if ticks.is_some() {
            let commanded_mv = (1000.0 * sample.voltage_v).round() as i16;
            sample.voltage_v = volts(applied_voltage_mv(commanded_mv));
        }
        if let Some(reported) = ticks.as_ref().and_then(|ticks| ticks.reported.as_ref()) {
            let time_us = reported.replace(&row, &mut sample)?;
            sample.time_s = device_time_s(time_us, *start_us.get_or_insert(time_us));
            if samples.last().is_some_and(|last| sample.time_s <= last.time_s) {
                continue;
            }
        }
        if let Some(last) = samples.last() {
            let (before_s, time_s) = (last.time_s, sample.time_s);
            if time_s <= before_s {
                return Err(CsvError::TimeBackwards { line, before_s, time_s });
            }
            if time_s - before_s > MAX_INTERRUPTION_S {
                return Err(CsvError::Interrupted { line, interruption_s: time_s - before_s });
            }
        }
        samples.push(sample);
    }
    if samples.len() < 2 {
        return Err(CsvError::TooFewRows { rows: samples.len() });
    }
    // Numbers as large as times since 1970 cannot resolve the microseconds by which a fit changes
    // the delay.
    let start_s = samples[0].time_s;
    for sample in &mut samples {
        sample.time_s -= start_s;
    }
    Ok(samples)
}

/// A column of a table.
#[derive(Clone, Copy)]
struct Column {
    name: &'static str,
    /// Index of its field in each row.
    place: usize,
}

/// The header of a table.
struct Header<'a> {
    names: Vec<&'a str>,
}

impl<'a> Header<'a> {
    fn of(line: &'a str) -> Self {
        Self { names: line.split(',').map(str::trim).collect() }
    }

    /// The column with this name; `None` if there is none.
    fn column(&self, name: &'static str) -> Option<Column> {
        let place = self.names.iter().position(|it| *it == name)?;
        Some(Column { name, place })
    }

    /// The required columns, in the order of [`COLUMNS`].
    fn motion(&self) -> Result<[Column; COLUMNS.len()], CsvError> {
        if let [names] = self.names[..] {
            let other = [(';', ";"), ('\t', "tab")].into_iter().find(|(it, _)| names.contains(*it));
            if let Some((_, separator)) = other {
                return Err(CsvError::OtherSeparator { separator });
            }
        }
        let mut columns = COLUMNS.map(|name| Column { name, place: 0 });
        for column in &mut columns {
            *column = self.column(column.name).ok_or_else(|| CsvError::MissingColumn {
                column: column.name,
                found: self.names.join(", ").chars().take(200).collect(),
            })?;
            if self.names.iter().filter(|it| **it == column.name).count() > 1 {
                return Err(CsvError::ColumnTwice { column: column.name });
            }
        }
        Ok(columns)
    }
}

/// A row of a table.
struct Row<'a> {
    /// Number of its line, from 1.
    line: usize,
    fields: Vec<&'a str>,
}

impl<'a> Row<'a> {
    fn of(line: usize, text: &'a str) -> Self {
        Self { line, fields: text.split(',').map(str::trim).collect() }
    }

    /// Refuses a row with more fields than the header has columns, unless the rest is empty.
    fn check_length(&self, columns: usize) -> Result<(), CsvError> {
        let rest = self.fields.get(columns..).unwrap_or_default();
        if rest.iter().all(|field| field.is_empty()) {
            return Ok(());
        }
        Err(CsvError::LongRow { line: self.line, fields: self.fields.len(), columns })
    }

    /// The text in a column; empty if the row ends before it.
    fn text(&self, column: Column) -> &'a str {
        self.fields.get(column.place).copied().unwrap_or_default()
    }

    /// The finite number in a column.
    fn number(&self, Column { name: column, place }: Column) -> Result<f64, CsvError> {
        let line = self.line;
        let text = *self.fields.get(place).ok_or(CsvError::ShortRow { line, column })?;
        text.parse::<f64>()
            .ok()
            .filter(|number| number.is_finite())
            .ok_or_else(|| CsvError::BadNumber { line, column, text: text.to_owned() })
    }

    /// The sample in the required columns. The voltage of the last row may be empty.
    fn sample(
        &self,
        &[time, theta, alpha, theta_dot, alpha_dot, voltage]: &[Column; COLUMNS.len()],
        is_last: bool,
    ) -> Result<MotionSample, CsvError> {
        let is_empty = self.fields.get(voltage.place).is_some_and(|field| field.is_empty());
        Ok(MotionSample {
            time_s: self.number(time)?,
            state: State {
                theta: self.number(theta)?,
                alpha: self.number(alpha)?,
                theta_dot: self.number(theta_dot)?,
                alpha_dot: self.number(alpha_dot)?,
            },
            voltage_v: if is_last && is_empty { 0.0 } else { self.number(voltage)? },
        })
    }

    /// The phase in a column: by its number, as `qube-hil export` writes it, or by its name, as
    /// recordings in Python have it.
    fn phase(&self, column: Column) -> Result<Phase, CsvError> {
        let text = self.text(column);
        // Some programs write whole numbers with decimals.
        let number = text.parse::<f64>().ok();
        let is_named =
            |phase: &Phase| text == phase.name() || number == Some(phase.number().into());
        Phase::ALL
            .into_iter()
            .find(is_named)
            .ok_or_else(|| CsvError::BadPhase { line: self.line, text: text.to_owned() })
    }
}

/// A kind of column that holds a voltage.
#[derive(Clone, Copy)]
struct VoltageColumn {
    name: &'static str,
    /// Largest value that the program writes: the wire has 16 bits for millivolts.
    largest: f64,
    unit: &'static str,
}

/// The columns that show whether a tick has a sample: first the column of `qube-hil export`, then
/// the column of recordings in Python.
const APPLIED: [VoltageColumn; 2] = [
    VoltageColumn { name: column::APPLIED_MV, largest: 32_767.0, unit: "mV" },
    VoltageColumn { name: column::APPLIED_V, ..COMMANDED },
];

const COMMANDED: VoltageColumn =
    VoltageColumn { name: column::VOLTAGE_V, largest: 32.767, unit: "V" };

impl VoltageColumn {
    /// Returns whether a row has a voltage in a column of this kind. Python writes NaN if there is
    /// no voltage.
    fn is_in(self, row: &Row<'_>, column: Column) -> Result<bool, CsvError> {
        let text = row.text(column);
        if text.is_empty() || text.eq_ignore_ascii_case("nan") {
            return Ok(false);
        }
        let value = text.parse().map_err(|_| CsvError::BadNumber {
            line: row.line,
            column: self.name,
            text: text.to_owned(),
        })?;
        self.check(row, text, value).map(|()| true)
    }

    fn check(self, row: &Row<'_>, text: &str, value: f64) -> Result<(), CsvError> {
        let Self { name: column, largest, unit } = self;
        if value.abs() <= largest {
            return Ok(());
        }
        let (line, text) = (row.line, text.to_owned());
        Err(CsvError::NotVolts { line, column, text, largest, unit })
    }
}

/// The further columns of a table of ticks.
struct TickColumns {
    phase: Column,
    /// Column with the applied voltage, which is empty in a tick without a sample.
    applied: Option<(Column, VoltageColumn)>,
    /// Columns with the board's report; `None` if one of them is missing.
    reported: Option<ReportColumns>,
}

impl TickColumns {
    /// The columns in this header; `None` if it is not the header of a table of ticks.
    fn of(header: &Header<'_>) -> Option<Self> {
        let phase = header.column(column::PHASE)?;
        let applied = APPLIED.into_iter().find_map(|it| Some((header.column(it.name)?, it)));
        Some(Self { phase, applied, reported: ReportColumns::of(header) })
    }

    /// Returns whether a row has a sample of a tick in which the policy drives the motor.
    fn is_of_policy(&self, row: &Row<'_>) -> Result<bool, CsvError> {
        let phase = row.phase(self.phase)?;
        let has_sample =
            self.applied.map_or(Ok(true), |(column, voltage)| voltage.is_in(row, column))?;
        Ok(phase == Phase::Running && has_sample)
    }
}

/// The columns with the board's report in a table of ticks.
struct ReportColumns {
    theta: Column,
    alpha: Column,
    time: Column,
    /// Microseconds in a unit of the column with the time.
    time_unit_us: f64,
}

/// The columns with the device's time, each with the microseconds in its unit: first the column of
/// `qube-hil export`, then the column of recordings in Python.
const DEVICE_TIMES: [(&str, f64); 2] =
    [(column::DEVICE_TIME_US, 1.0), (column::DEVICE_TIME_S, 1e6)];

impl ReportColumns {
    /// The columns in this header; `None` if one of them is missing.
    fn of(header: &Header<'_>) -> Option<Self> {
        let mut times = DEVICE_TIMES.into_iter();
        let (time, time_unit_us) =
            times.find_map(|(name, unit_us)| Some((header.column(name)?, unit_us)))?;
        Some(Self {
            theta: header.column(column::MEASURED_THETA_RAD)?,
            alpha: header.column(column::MEASURED_ALPHA_RAD)?,
            time,
            time_unit_us,
        })
    }

    /// Replaces the angles of a sample by the encoders' angles, and returns the device's time, us.
    fn replace(&self, row: &Row<'_>, sample: &mut MotionSample) -> Result<u64, CsvError> {
        sample.state.theta = row.number(self.theta)?;
        let counted = row.number(self.alpha)?;
        sample.state.alpha = with_turns_of(sample.state.alpha, counted);
        Ok((self.time_unit_us * row.number(self.time)?).round() as u64)
    }
}

/// The numbers and names of all phases, for a message.
fn all_phases() -> String {
    Phase::ALL.map(|phase| format!("{} or {}", phase.number(), phase.name())).join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "time_s,theta_rad,alpha_rad,theta_dot_rad_s,alpha_dot_rad_s,voltage_v\n";

    fn parse(rows: &str) -> Result<Vec<MotionSample>, CsvError> {
        parse_csv(&format!("{HEADER}{rows}"))
    }

    #[test]
    fn columns_may_have_any_order_and_other_columns_are_ignored() {
        let text = "\u{feff}voltage_v, note, alpha_dot_rad_s,theta_dot_rad_s,alpha_rad,theta_rad,time_s\r\n\
                    5,x,4,3,2,1,0\r\n\r\n,y,8,7,6,5,0.5\r\n";
        let samples = parse_csv(text).unwrap();
        let state = State { theta: 1.0, alpha: 2.0, theta_dot: 3.0, alpha_dot: 4.0 };
        assert_eq!(samples[0], MotionSample { time_s: 0.0, state, voltage_v: 5.0 });
        assert_eq!(samples[1].time_s, 0.5);
        assert_eq!(samples.len(), 2);
    }

    #[test]
    fn of_an_exported_table_the_rows_under_the_policy_are_used_with_applied_voltages() {
        let text = "phase,time_s,theta_rad,alpha_rad,theta_dot_rad_s,alpha_dot_rad_s,voltage_v,applied_mv\n\
                    0,0.00,1,0,0,0,0.100,0\n\
                    1,0.01,2,0,0,0,0.100,94\n\
                    1,0.02,,,,,0.100,\n\
                    1,0.03,3,0,0,0,0.100,94\n\
                    2,0.04,4,0,0,0,0.100,94\n";
        let samples = parse_csv(text).unwrap();
        let found: Vec<_> =
            samples.iter().map(|it| (it.time_s, it.state.theta, it.voltage_v)).collect();
        let applied_v = volts(applied_voltage_mv(100));
        assert_eq!(found, [(0.0, 2.0, applied_v), (0.03 - 0.01, 3.0, applied_v)]);
        assert!(applied_v != 0.1 && (applied_v - 0.1).abs() < 0.013, "{applied_v}");
    }

    #[test]
    fn a_table_of_ticks_names_phases_by_numbers_or_names_and_refuses_others() {
        let exported = |applied: &str, [first, second]: [&str; 2]| {
            parse_csv(&format!(
                "phase,time_s,theta_rad,alpha_rad,theta_dot_rad_s,alpha_dot_rad_s,voltage_v,{applied}\n\
                 settling,0.00,1,0,0,0,0.1,0\n\
                 {first}\n\
                 1.0,0.02,3,0,0,0,0.1,0.094\n\
                 {second}\n"
            ))
        };
        let without_sample = "running,0.03,0,0,0,0,0.1,NaN";
        for applied in ["applied_mv", "applied_v"] {
            let rows = ["running,0.01,2,0,0,0,0.1,0.094", without_sample];
            let samples = exported(applied, rows).unwrap();
            let thetas: Vec<f64> = samples.iter().map(|sample| sample.state.theta).collect();
            assert_eq!(thetas, [2.0, 3.0]);
        }
        for (row, expected) in [
            (
                "abc,0.01,2,0,0,0,0.1,0.094",
                "line 3: `abc` in column `phase` is no phase: give 0 or",
            ),
            ("7,0.01,2,0,0,0,0.1,0.094", "line 3: `7` in column `phase`"),
            (",0.01,2,0,0,0,0.1,0.094", "line 3: `` in column `phase`"),
            ("1,0.01,2,0,0,0,0.1,abc", "line 3: `abc` in column `applied_v` is not a finite"),
            ("1,0.01,2,0,0,0,0.1,inf", "line 3: `inf` in column `applied_v` is no voltage"),
            (
                "1,0.01,2,0,0,0,1e30,0.094",
                "line 3: `1e30` in column `voltage_v` is no voltage that this program writes: give at most 32.767 V",
            ),
        ] {
            let message = exported("applied_v", [row, without_sample]).unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn phases_count_without_applied_voltages_and_impossible_voltages_are_refused() {
        let ticks = |first: &str| {
            parse_csv(&format!(
                "phase,{HEADER}settling,0.00,1,0,0,0,0.1\n{first}\n1,0.02,3,0,0,0,0.1\n"
            ))
        };
        let thetas = |samples: &[MotionSample]| -> Vec<f64> {
            samples.iter().map(|sample| sample.state.theta).collect()
        };
        assert_eq!(thetas(&ticks("1,0.01,2,0,0,0,0.1").unwrap()), [2.0, 3.0]);
        let message = ticks("x,0.01,2,0,0,0,0.1").unwrap_err().to_string();
        assert!(message.starts_with("line 3: `x` in column `phase` is no phase"), "{message}");
        let message = parse("0,0,0,0,0,1\n0.1,0,0,0,0,40\n").unwrap_err().to_string();
        assert!(
            message.starts_with("line 3: `40` in column `voltage_v` is no voltage"),
            "{message}"
        );
    }

    #[test]
    fn times_since_1970_count_from_the_first_row() {
        let at = |start_s: f64| {
            let row = |time_s: f64| format!("{},0.5,0,0,0,1\n", start_s + time_s);
            parse(&(row(0.0) + &row(0.25) + &row(0.5))).unwrap()
        };
        assert_eq!(at(1_700_000_000.0), at(0.0));
    }

    #[test]
    fn every_fault_is_named_with_its_line() {
        let cases = [
            (
                "0,0,0,0,0,1\n0.1,0,x,0,0,\n",
                "line 3: `x` in column `alpha_rad` is not a finite number",
            ),
            ("0,0,0,0,0,1\n0.1,0,0,nan,0,\n", "line 3: `nan` in column `theta_dot_rad_s`"),
            (
                "0,0,0,0,0,\n0.1,0,0,0,0,\n",
                "line 2: `` in column `voltage_v` is not a finite number",
            ),
            ("0,0,0\n", "line 2 ends before column `theta_dot_rad_s`"),
            ("0,0,0,0,0,1,5\n", "line 2 has 7 fields, and the header has 6"),
            ("", "there are 0 rows"),
            ("0,0,0,0,0,1\n", "there are 1 rows"),
            ("0.1,0,0,0,0,1\n0.1,0,0,0,0,1\n", "line 3: time goes from 0.1 s to 0.1 s"),
            ("0,0,0,0,0,1\n9,0,0,0,0,1\n", "line 3: there is no row for 9 s"),
        ];
        for (rows, expected) in cases {
            let message = parse(rows).unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
        let message = parse_csv("time_s,theta_rad\n0,0\n").unwrap_err().to_string();
        assert_eq!(message, "the column `alpha_rad` is missing; the header has: time_s, theta_rad");
        assert!(matches!(parse_csv(""), Err(CsvError::MissingColumn { .. })));
        for (separator, name) in [(";", ";"), ("\t", "tab")] {
            let message = parse_csv(&HEADER.replace(',', separator)).unwrap_err().to_string();
            assert!(message.contains(&format!("separated by `{name}`")), "{message}");
        }
        assert!(parse("0,0,0,0,0,1,\n0.1,0,0,0,0,1,\n").is_ok(), "an empty field at the end");
        let twice =
            "time_s,theta_rad,alpha_rad,theta_dot_rad_s,alpha_dot_rad_s,voltage_v,voltage_v\n";
        let message = parse_csv(twice).unwrap_err().to_string();
        assert!(message.starts_with("the header has the column `voltage_v` twice"), "{message}");
    }
}
