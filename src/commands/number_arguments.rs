//! Parsers of numbers on the command line.

use clap::builder::TypedValueParser;

/// Returns the parser of seeds that are written to a TOML file: whole numbers of 63 bits, because
/// integers in TOML are signed.
pub fn seed_in_toml() -> impl TypedValueParser<Value = u64> {
    clap::value_parser!(u64).range(..=i64::MAX as u64)
}

/// Parses a number above 0, at most `largest`.
pub fn positive(text: &str, largest: f64) -> Result<f64, String> {
    match text.parse() {
        Ok(value) if value > 0.0 && value <= largest => Ok(value),
        _ => Err(format!("give a number above 0, at most {largest}")),
    }
}

/// Parses a number from `smallest` to `largest`.
pub fn between(text: &str, smallest: f64, largest: f64) -> Result<f64, String> {
    match text.parse() {
        Ok(value) if (smallest..=largest).contains(&value) => Ok(value),
        _ => Err(format!("give a number from {smallest} to {largest}")),
    }
}

/// Parses a spread from 0 to 1, as a fraction of each value.
pub fn spread(text: &str) -> Result<f64, String> {
    between(text, 0.0, 1.0)
}
