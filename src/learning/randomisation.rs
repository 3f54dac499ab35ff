use crate::policy::Randomisation;
use crate::qube::Quantity;
use crate::simulation::DomainDistribution;

/// Converts a distribution of simulated Qubes to the form in which a policy file records it.
pub(super) fn randomisation_of(distribution: &DomainDistribution) -> Randomisation {
    let directions = distribution.directions().iter().map(|direction| {
        let moved = Quantity::all().map(|quantity| (quantity, direction.of(quantity)));
        moved.filter(|&(_, deviation)| deviation != 0.0).collect()
    });
    let distributions = Quantity::all().map(|quantity| (quantity, distribution.get(quantity)));
    Randomisation {
        distributions: distributions.collect(),
        directions: directions.collect(),
        specimens: distribution.specimens().to_vec(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{DomainParameter, Nonideality, QubeModel};
    use crate::simulation::Direction;

    #[test]
    fn a_randomisation_reads_as_the_distribution_that_it_was_made_of() {
        let mass = DomainParameter::PendulumMass.into();
        let friction = Nonideality::CoulombTorque.into();
        let direction = Direction::new(&[(mass, 0.001), (friction, 1e-5)]);
        let specimens = vec![QubeModel::NOMINAL; 3];
        for distribution in [
            DomainDistribution::nominal(),
            DomainDistribution::robust(),
            DomainDistribution::robust().along(&[direction]),
            DomainDistribution::of_specimens(specimens).unwrap(),
        ] {
            let written = serde_json::to_value(randomisation_of(&distribution)).unwrap();
            // A policy file has the quantities in the field `distributions`; a distribution's file
            // has them at the top level.
            let mut fields = written.as_object().unwrap().clone();
            let quantities = fields.remove("distributions").unwrap();
            fields.extend(quantities.as_object().unwrap().clone());
            let read = serde_json::from_value::<DomainDistribution>(fields.into()).unwrap();
            assert_eq!(read, distribution);
        }
    }
}
