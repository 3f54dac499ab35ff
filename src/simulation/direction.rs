use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::qube::Quantity;

/// A joint deviation of several quantities: a standard normal number `z` moves each quantity by `z`
/// times its entry here, which is in the quantity's unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "BTreeMap<String, f64>", into = "BTreeMap<String, f64>")]
pub struct Direction {
    deviations: [f64; Quantity::COUNT],
}

impl Direction {
    /// A direction that moves each of these quantities by this deviation, in its unit, and no other
    /// quantity.
    #[must_use]
    pub fn new(deviations: &[(Quantity, f64)]) -> Self {
        let mut direction = Self { deviations: [0.0; Quantity::COUNT] };
        for &(quantity, deviation) in deviations {
            direction.deviations[quantity.index()] = deviation;
        }
        direction
    }

    /// The deviation by which the direction moves a quantity, in the quantity's unit; 0 for a
    /// quantity that it does not move.
    #[must_use]
    pub fn of(&self, quantity: Quantity) -> f64 {
        self.deviations[quantity.index()]
    }

    /// The direction with every deviation multiplied by a factor.
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Self {
        Self { deviations: self.deviations.map(|deviation| factor * deviation) }
    }
}

impl From<Direction> for BTreeMap<String, f64> {
    fn from(direction: Direction) -> Self {
        let moved = Quantity::all().filter(|&quantity| direction.of(quantity) != 0.0);
        moved.map(|quantity| (quantity.name().to_owned(), direction.of(quantity))).collect()
    }
}

impl TryFrom<BTreeMap<String, f64>> for Direction {
    type Error = String;

    fn try_from(named: BTreeMap<String, f64>) -> Result<Self, String> {
        let entry = |(name, deviation): (String, f64)| match Quantity::from_name(&name) {
            _ if !deviation.is_finite() => {
                Err(format!("{name} = {deviation}: give a finite number"))
            }
            Some(quantity) => Ok((quantity, deviation)),
            None => Err(format!("there is no quantity {name}")),
        };
        let deviations: Vec<_> = named.into_iter().map(entry).collect::<Result<_, _>>()?;
        Ok(Self::new(&deviations))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{DomainParameter, Nonideality};

    #[test]
    fn a_direction_reads_back_and_an_unknown_name_is_refused() {
        let deviations = [
            (DomainParameter::MotorResistance.into(), 0.5),
            (Nonideality::CommandDelay.into(), -0.001),
        ];
        let direction = Direction::new(&deviations);
        let written = serde_json::to_string(&direction).unwrap();
        assert_eq!(serde_json::from_str::<Direction>(&written).unwrap(), direction);
        assert!(serde_json::from_str::<Direction>("{\"R_x\": 1.0}").is_err());
    }
}
