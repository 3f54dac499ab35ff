//! Tests the tables that `export` writes, against the recordings that the library reads.

use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::record::Field;
use qube_hil::recording::{COLUMNS, csv_table, read};
use qube_hil::scoring::return_of;
use qube_hil::telemetry::Phase;

use crate::program::qube_hil;

#[test]
fn every_tick_is_a_row_that_reads_back_exactly() {
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let run = ["run", "--policy", "classical", "--clock", "virtual", "--out", "run"];
    assert!(qube_hil(directory, &run).status.success());
    let export = ["export", "run/rollout-0.mcap", "--out", "tables"];
    let output = qube_hil(directory, &export);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let path = directory.join("tables/rollout-0.csv");
    let table = std::fs::read_to_string(&path).unwrap();
    let mut recording = read(&directory.join("run/rollout-0.mcap")).unwrap();
    assert_eq!(table, csv_table(&recording));

    let rows: Vec<Vec<&str>> = table.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows[0], COLUMNS);
    assert_eq!(rows.len(), recording.ticks.len() + 1);
    let column = |name: &str| COLUMNS.iter().position(|it| *it == name).unwrap();
    let mut earned = 0.0;
    for (row, tick) in rows[1..].iter().zip(&recording.ticks) {
        assert_eq!(row.len(), COLUMNS.len(), "{row:?}");
        let number = |name: &str| row[column(name)].parse::<f64>().ok();
        assert_eq!(number("theta_rad"), Some(tick.state.theta));
        assert_eq!(number("alpha_dot_rad_s"), Some(tick.state.alpha_dot));
        assert_eq!(number("wanted_v"), tick.wanted_v);
        assert_eq!(number("voltage_v"), Some(f64::from(tick.voltage_mv) / 1000.0));
        assert_eq!(number("theta_counts"), tick.measurement.map(|it| f64::from(it.theta_counts)));
        assert_eq!(number("turnaround_ns"), Some(tick.turnaround_ns as f64));
        assert_eq!(number("reward").is_some(), tick.phase == Phase::Running);
        earned += number("reward").unwrap_or(0.0);
    }
    assert!((earned - return_of(&recording.ticks, &recording.header.reward)).abs() < 1e-9);

    // The cell of a value that is missing or not finite is empty, and the row keeps its columns.
    recording.ticks.truncate(1);
    recording.ticks[0].measurement = None;
    recording.ticks[0].state.theta = f64::NAN;
    let short_table = csv_table(&recording);
    let row: Vec<&str> = short_table.lines().nth(1).unwrap().split(',').collect();
    assert_eq!(row.len(), COLUMNS.len(), "{row:?}");
    assert_eq!((row[column("theta_rad")], row[column("device_time_us")]), ("", ""));
    assert_ne!(row[column("deadline_ns")], "");

    // The program refuses to replace an existing table, and leaves it as it is.
    let output = qube_hil(directory, &export);
    assert_eq!(output.status.code(), Some(2), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(std::fs::read_to_string(&path).unwrap(), table);

    // The same table in Parquet has the same columns, numbers and gaps. python/tests reads such a
    // table with another reader.
    let parquet = ["export", "run/rollout-0.mcap", "--out", "tables", "--format", "parquet"];
    let output = qube_hil(directory, &parquet);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let file = std::fs::File::open(directory.join("tables/rollout-0.parquet")).unwrap();
    let reader = SerializedFileReader::new(file).unwrap();
    assert_eq!(reader.metadata().file_metadata().num_rows(), rows.len() as i64 - 1);
    for (row, written) in reader.get_row_iter(None).unwrap().zip(&rows[1..]) {
        let row = row.unwrap();
        let names: Vec<&String> = row.get_column_iter().map(|(name, _)| name).collect();
        assert_eq!(names, COLUMNS);
        let values = row.get_column_iter().map(|(_, value)| match value {
            Field::Null => String::new(),
            Field::Double(value) => value.to_string(),
            Field::Float(value) => value.to_string(),
            Field::Long(value) => value.to_string(),
            Field::ULong(value) => value.to_string(),
            other => panic!("{other:?}"),
        });
        assert_eq!(&values.collect::<Vec<_>>(), written);
    }
}
