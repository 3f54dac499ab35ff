//! Checks that a policy was made for the plant that it is to drive.

use thiserror::Error;

use super::Policy;
use crate::qube::{PlantModel, PlantName};

/// The reason why a policy does not run on a plant: it was made for another one.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum OtherPlant {
    /// The plants have different names.
    #[error(
        "the policy was made for the plant {made_for} and this is the plant {plant}: give a policy that was \
         trained for {plant}"
    )]
    Name {
        /// Plant of the policy.
        made_for: PlantName,
        /// Plant that was to be driven.
        plant: PlantName,
    },
    /// The plants have the same name and different numbers.
    #[error(
        "the policy was made for the plant {plant} with another description than the one in use: train a policy \
         for this description, or give the plant's file that the policy was trained with"
    )]
    Description {
        /// Name of both plants.
        plant: PlantName,
    },
}

impl Policy {
    /// Checks that the policy may run on this plant. A network runs on the plant that it was
    /// trained for, and the classical controller on the built-in Qube, for which it is tuned. An
    /// excitation and an external controller run on every plant.
    ///
    /// # Errors
    /// The policy was made for another plant.
    pub fn check_plant(&self, plant: &PlantModel) -> Result<(), OtherPlant> {
        let made_for = match self {
            Self::Network(policy) => &policy.training.plant,
            Self::Classical(_) => &PlantModel::QUBE,
            Self::Excitation(_) | Self::External(_) => return Ok(()),
        };
        if made_for == plant {
            Ok(())
        } else if made_for.name == plant.name {
            Err(OtherPlant::Description { plant: plant.name })
        } else {
            Err(OtherPlant::Name { made_for: made_for.name, plant: plant.name })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::{ClassicalController, ClassicalGains};

    #[test]
    fn a_controller_of_a_qube_runs_on_no_other_plant() {
        let policy = Policy::Classical(ClassicalController::new(ClassicalGains::default()));
        assert_eq!(policy.check_plant(&PlantModel::QUBE), Ok(()));
        let larger = PlantModel::parse(include_str!("../../plants/furuta-130.toml")).unwrap();
        let refused = policy.check_plant(&larger).unwrap_err().to_string();
        assert!(refused.contains("qube") && refused.contains("furuta-130"), "{refused}");
        let mut weaker = PlantModel::QUBE;
        weaker.limits.largest_voltage_v = 4.0;
        let refused = policy.check_plant(&weaker).unwrap_err();
        assert_eq!(refused, OtherPlant::Description { plant: weaker.name });
    }
}
