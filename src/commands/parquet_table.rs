//! A recording's table as a Parquet file.

use std::sync::Arc;

use parquet::basic::{ConvertedType, Repetition, Type as Physical};
use parquet::column::writer::ColumnWriter;
use parquet::errors::{ParquetError, Result};
use parquet::file::properties::WriterProperties;
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::{Type, TypePtr};

use crate::recording::{COLUMNS, Field, Recording, table_rows};

/// Returns a recording as the contents of a Parquet file, with the columns and rows of its CSV
/// table. A field without a value is null.
///
/// # Errors
/// The library that writes Parquet fails.
pub fn parquet_table(recording: &Recording) -> Result<Vec<u8>> {
    let rows: Vec<_> = table_rows(recording).collect();
    let Some(first) = rows.first() else { return whole_file(&[], &rows) };
    whole_file(first, &rows)
}

/// Returns the file with these rows. Each field of `kinds` has the kind of its column.
fn whole_file(kinds: &[Field], rows: &[[Field; COLUMNS.len()]]) -> Result<Vec<u8>> {
    let columns = COLUMNS.iter().enumerate().map(|(index, name)| {
        // A recording without a tick has no row that shows the kinds of its columns; any kind is
        // valid.
        column(name, kinds.get(index).copied().unwrap_or(Field::Number(None)))
    });
    let fields = columns.collect::<Result<Vec<TypePtr>>>()?;
    let schema = Arc::new(Type::group_type_builder("ticks").with_fields(fields).build()?);
    let properties = Arc::new(WriterProperties::builder().build());
    let mut file = Vec::new();
    let mut writer = SerializedFileWriter::new(&mut file, schema, properties)?;
    let mut group = writer.next_row_group()?;
    let mut index = 0;
    while let Some(mut column) = group.next_column()? {
        let fields = || rows.iter().map(|row| row[index]);
        let levels: Vec<i16> = fields().map(|field| i16::from(has_value(field))).collect();
        match column.untyped() {
            ColumnWriter::DoubleColumnWriter(column) => {
                let values: Vec<f64> = fields().filter_map(number).collect();
                column.write_batch(&values, Some(&levels), None)?;
            }
            ColumnWriter::FloatColumnWriter(column) => {
                let values: Vec<f32> = fields().filter_map(single).collect();
                column.write_batch(&values, Some(&levels), None)?;
            }
            ColumnWriter::Int64ColumnWriter(column) => {
                let values: Vec<i64> = fields().filter_map(whole).collect();
                column.write_batch(&values, Some(&levels), None)?;
            }
            _ => {
                return Err(ParquetError::General(
                    "a column has a type that is not written here".into(),
                ));
            }
        }
        column.close()?;
        index += 1;
    }
    group.close()?;
    writer.close()?;
    Ok(file)
}

/// Returns the schema of the column of this name, for fields of the same kind as `field`.
fn column(name: &str, field: Field) -> Result<TypePtr> {
    let (physical, converted) = match field {
        Field::Number(_) => (Physical::DOUBLE, ConvertedType::NONE),
        Field::Single(_) => (Physical::FLOAT, ConvertedType::NONE),
        Field::Whole(_) => (Physical::INT64, ConvertedType::INT_64),
        Field::Count(_) => (Physical::INT64, ConvertedType::UINT_64),
    };
    let column = Type::primitive_type_builder(name, physical)
        .with_repetition(Repetition::OPTIONAL)
        .with_converted_type(converted);
    Ok(Arc::new(column.build()?))
}

fn has_value(field: Field) -> bool {
    number(field).is_some() || single(field).is_some() || whole(field).is_some()
}

fn number(field: Field) -> Option<f64> {
    match field {
        Field::Number(value) => value,
        _ => None,
    }
}

fn single(field: Field) -> Option<f32> {
    match field {
        Field::Single(value) => value,
        _ => None,
    }
}

/// Returns a whole number as the bits that Parquet stores; the bits of an unsigned number stay as
/// they are.
fn whole(field: Field) -> Option<i64> {
    match field {
        Field::Whole(value) => value,
        Field::Count(value) => value.map(u64::cast_signed),
        Field::Number(_) | Field::Single(_) => None,
    }
}
