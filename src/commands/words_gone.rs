//! Words of the command line that are no more: each is refused with what is in its place.

use clap::ValueEnum;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

/// A parser of the names of an enum that knows a word of the past beside them, and what to say of it.
pub fn names_but<T>(gone: &'static str, why: &'static str) -> impl TypedValueParser<Value = T>
where
    T: ValueEnum + Clone + Send + Sync + 'static,
{
    let names = T::value_variants().iter().filter_map(ValueEnum::to_possible_value);
    let hidden = PossibleValue::new(gone).hide(true);
    PossibleValuesParser::new(names.chain([hidden])).try_map(move |name| {
        if name == gone { Err(why.to_owned()) } else { T::from_str(&name, false) }
    })
}
