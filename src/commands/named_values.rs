//! Parsers of values whose names and descriptions come from the library.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use crate::learning::Preset;

/// Returns a parser that accepts one of these names and returns its value. Each entry is a name, a
/// description for the help, and the value.
pub fn named<T: Clone + Send + Sync + 'static>(
    values: impl Iterator<Item = (&'static str, &'static str, T)>,
) -> impl TypedValueParser<Value = T> {
    let values: Vec<_> = values.collect();
    let names = values.iter().map(|(name, help, _)| PossibleValue::new(*name).help(*help));
    PossibleValuesParser::new(names.collect::<Vec<_>>()).try_map(move |given| {
        let value = values.iter().find(|(name, ..)| *name == given);
        value.map(|(.., value)| value.clone()).ok_or("there is no such name")
    })
}

/// Returns a parser that accepts the name of a preset of trainings.
pub fn presets() -> impl TypedValueParser<Value = Preset> {
    /// Retired name of a preset. The help does not list it, and the parser refuses it with the
    /// preset to use instead.
    const RETIRED: &str = "machine";
    let named = Preset::NAMED.into_iter();
    let offered = named.map(|it| PossibleValue::new(it.name()).help(it.description()));
    let retired = PossibleValue::new(RETIRED).hide(true);
    PossibleValuesParser::new(offered.chain([retired])).try_map(|given| {
        if given == RETIRED {
            return Err("use robust instead");
        }
        Preset::NAMED.into_iter().find(|it| it.name() == given).ok_or("there is no such preset")
    })
}
