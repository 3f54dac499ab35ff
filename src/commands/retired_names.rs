//! Retired words of the command line: each is refused with a hint at its replacement.

use clap::ValueEnum;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

/// Returns a parser of the names of an enum, which also recognises the word `retired`: it refuses
/// the word with the message `why`, which names a replacement.
pub fn names_and_retired<T>(
    retired: &'static str,
    why: &'static str,
) -> impl TypedValueParser<Value = T>
where
    T: ValueEnum + Clone + Send + Sync + 'static,
{
    let names = T::value_variants().iter().filter_map(ValueEnum::to_possible_value);
    let hidden = PossibleValue::new(retired).hide(true);
    PossibleValuesParser::new(names.chain([hidden])).try_map(move |name| {
        if name == retired { Err(why.to_owned()) } else { T::from_str(&name, false) }
    })
}
