use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{DomainParameter, Nonideality, QubeModel};

/// One number of a [`QubeModel`]: any but the cable's drift.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum Quantity {
    /// One of the nine domain parameters.
    Parameter(DomainParameter),
    /// One of the nonidealities.
    Nonideality(Nonideality),
}

impl Quantity {
    /// Number of quantities.
    pub const COUNT: usize = DomainParameter::ALL.len() + Nonideality::ALL.len();

    /// All quantities: the nine parameters, then the nonidealities.
    pub fn all() -> impl Iterator<Item = Self> {
        let parameters = DomainParameter::ALL.into_iter().map(Self::Parameter);
        parameters.chain(Nonideality::ALL.into_iter().map(Self::Nonideality))
    }

    /// Index among [`Self::all`].
    #[must_use]
    pub fn index(self) -> usize {
        match self {
            Self::Parameter(parameter) => parameter as usize,
            Self::Nonideality(term) => DomainParameter::ALL.len() + term as usize,
        }
    }

    /// The symbol in psi and its tables, such as `M_p` or `delay`.
    #[must_use]
    pub fn symbol(self) -> &'static str {
        match self {
            Self::Parameter(parameter) => parameter.symbol(),
            Self::Nonideality(term) => term.symbol(),
        }
    }

    /// The name in profiles, such as `M_p` or `command_delay_s`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Parameter(parameter) => parameter.symbol(),
            Self::Nonideality(term) => term.name(),
        }
    }

    /// The SI unit.
    #[must_use]
    pub fn unit(self) -> &'static str {
        match self {
            Self::Parameter(parameter) => parameter.unit(),
            Self::Nonideality(Nonideality::CoulombTorque) => "N m",
            Self::Nonideality(Nonideality::PositiveDeadZone | Nonideality::NegativeDeadZone) => "V",
            Self::Nonideality(Nonideality::CableStiffness) => "N m/rad",
            Self::Nonideality(Nonideality::CableRest) => "rad",
            Self::Nonideality(Nonideality::CommandDelay) => "s",
        }
    }

    /// The quantity with this name in profiles.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::all().find(|quantity| quantity.name() == name)
    }

    /// The quantity with this symbol.
    #[must_use]
    pub fn from_symbol(symbol: &str) -> Option<Self> {
        Self::all().find(|quantity| quantity.symbol() == symbol)
    }
}

impl From<Quantity> for String {
    fn from(quantity: Quantity) -> Self {
        quantity.name().to_owned()
    }
}

/// The error for a name that no quantity has.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("there is no quantity {name}")]
pub struct UnknownQuantity {
    /// Name given.
    pub name: String,
}

impl TryFrom<String> for Quantity {
    type Error = UnknownQuantity;

    fn try_from(name: String) -> Result<Self, UnknownQuantity> {
        Self::from_name(&name).ok_or(UnknownQuantity { name })
    }
}

impl From<DomainParameter> for Quantity {
    fn from(parameter: DomainParameter) -> Self {
        Self::Parameter(parameter)
    }
}

impl From<Nonideality> for Quantity {
    fn from(term: Nonideality) -> Self {
        Self::Nonideality(term)
    }
}

impl QubeModel {
    /// The value of one quantity, in its SI unit.
    #[must_use]
    pub fn get(&self, quantity: Quantity) -> f64 {
        match quantity {
            Quantity::Parameter(parameter) => self.parameters.get(parameter),
            Quantity::Nonideality(term) => self.nonidealities.get(term),
        }
    }

    /// Sets one quantity, in its SI unit.
    pub fn set(&mut self, quantity: Quantity, value: f64) {
        match quantity {
            Quantity::Parameter(parameter) => self.parameters.set(parameter, value),
            Quantity::Nonideality(term) => self.nonidealities.set(term, value),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_quantity_is_set_and_read_under_its_own_name() {
        let mut model = QubeModel::NOMINAL;
        for (index, quantity) in Quantity::all().enumerate() {
            assert_eq!(quantity.index(), index);
            model.set(quantity, 1.0 + index as f64);
            assert_eq!(Quantity::from_symbol(quantity.symbol()), Some(quantity));
        }
        for (index, quantity) in Quantity::all().enumerate() {
            assert_eq!(model.get(quantity), 1.0 + index as f64);
        }
        assert_eq!(Quantity::all().count(), Quantity::COUNT);
        let nonidealities = serde_json::to_value(model.nonidealities).unwrap();
        for term in Nonideality::ALL {
            assert_eq!(nonidealities[term.name()], model.nonidealities.get(term));
        }
    }
}
