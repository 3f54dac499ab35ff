//! Parsers of numbers on the command line.

use clap::builder::TypedValueParser;

/// The parser of seeds that are written to a TOML file. Its integers are signed, so a seed has 63
/// bits.
pub fn seed_in_toml() -> impl TypedValueParser<Value = u64> {
    clap::value_parser!(u64).range(..=i64::MAX as u64)
}

/// Parses a finite number above 0.
pub fn positive(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(value) if f64::is_finite(value) && value > 0.0 => Ok(value),
        _ => Err("give a number above 0".into()),
    }
}

/// Parses a number from `smallest` to `largest`.
pub fn between(text: &str, smallest: f64, largest: f64) -> Result<f64, String> {
    match text.parse() {
        Ok(value) if (smallest..=largest).contains(&value) => Ok(value),
        _ => Err(format!("give a number from {smallest} to {largest}")),
    }
}
