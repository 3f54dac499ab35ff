use std::ops::RangeInclusive;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::{DomainParameter, Nonidealities, QubeModel};

/// Names one entry of the [`Nonidealities`]: any but the cable's drift.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Nonideality {
    /// Coulomb friction of the arm, N m.
    CoulombTorque,
    /// Dead zone for positive voltages, V.
    PositiveDeadZone,
    /// Dead zone for negative voltages, V.
    NegativeDeadZone,
    /// Stiffness of the cable, N m/rad.
    CableStiffness,
    /// The cable's rest angle, rad.
    CableRest,
    /// Time until a command acts at the motor, s ([`Nonidealities::command_delay_s`]).
    CommandDelay,
}

impl Nonideality {
    /// All terms, in order. The cable's drift is not among them: only the emulator has it.
    pub const ALL: [Self; 6] = [
        Self::CoulombTorque,
        Self::PositiveDeadZone,
        Self::NegativeDeadZone,
        Self::CableStiffness,
        Self::CableRest,
        Self::CommandDelay,
    ];

    /// The name in profiles, with its unit.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::CoulombTorque => "coulomb_torque_n_m",
            Self::PositiveDeadZone => "positive_dead_zone_v",
            Self::NegativeDeadZone => "negative_dead_zone_v",
            Self::CableStiffness => "cable_stiffness_n_m_rad",
            Self::CableRest => "cable_rest_rad",
            Self::CommandDelay => "command_delay_s",
        }
    }

    /// The symbol of the term in psi and in the tables of psi.
    #[must_use]
    pub fn symbol(self) -> &'static str {
        match self {
            Self::CoulombTorque => "coulomb",
            Self::PositiveDeadZone => "positive_dead_zone",
            Self::NegativeDeadZone => "negative_dead_zone",
            Self::CableStiffness => "cable_stiffness",
            Self::CableRest => "cable_rest",
            Self::CommandDelay => "delay",
        }
    }

    /// The accepted range, in the unit of the term. Only the rest angle may be negative.
    #[must_use]
    pub fn range(self) -> RangeInclusive<f64> {
        match self {
            Self::CoulombTorque | Self::CableStiffness | Self::CommandDelay => 0.0..=0.1,
            Self::PositiveDeadZone | Self::NegativeDeadZone => 0.0..=5.0,
            Self::CableRest => -10.0..=10.0,
        }
    }
}

impl Nonidealities {
    /// The value of one term, in its unit.
    #[must_use]
    pub fn get(&self, term: Nonideality) -> f64 {
        match term {
            Nonideality::CoulombTorque => self.coulomb_torque_n_m,
            Nonideality::PositiveDeadZone => self.positive_dead_zone_v,
            Nonideality::NegativeDeadZone => self.negative_dead_zone_v,
            Nonideality::CableStiffness => self.cable_stiffness_n_m_rad,
            Nonideality::CableRest => self.cable_rest_rad,
            Nonideality::CommandDelay => self.command_delay_s,
        }
    }

    /// Sets one term, in its unit.
    pub fn set(&mut self, term: Nonideality, value: f64) {
        *match term {
            Nonideality::CoulombTorque => &mut self.coulomb_torque_n_m,
            Nonideality::PositiveDeadZone => &mut self.positive_dead_zone_v,
            Nonideality::NegativeDeadZone => &mut self.negative_dead_zone_v,
            Nonideality::CableStiffness => &mut self.cable_stiffness_n_m_rad,
            Nonideality::CableRest => &mut self.cable_rest_rad,
            Nonideality::CommandDelay => &mut self.command_delay_s,
        } = value;
    }
}

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
