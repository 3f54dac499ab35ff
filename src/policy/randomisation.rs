use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::qube::{Quantity, QubeModel};

/// The randomisation under which a network was trained: the distribution from which the Qube of each simulated
/// trajectory was drawn.
///
/// Draws follow `distributions` and move together along `directions`, each times a standard normal number of its own.
/// Where there are `specimens`, each draw is one of them, each equally often, and `distributions` has their moments.
/// `simulation::DomainDistribution` says how draws are kept physical.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Randomisation {
    /// Distribution of each quantity.
    pub distributions: BTreeMap<Quantity, RandomQuantity>,
    /// Joint deviations: how far each moves a quantity, in its SI unit.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub directions: Vec<BTreeMap<Quantity, f64>>,
    /// Qubes of which each draw is one.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub specimens: Vec<QubeModel>,
}

/// The distribution of one quantity in its SI unit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum RandomQuantity {
    /// Always the same value.
    Constant {
        /// The value.
        value: f64,
    },
    /// A normal distribution.
    Normal {
        /// Mean.
        mean: f64,
        /// Standard deviation before truncation.
        standard_deviation: f64,
    },
    /// A uniform distribution, sqrt(3) standard deviations to either side of the mean.
    Uniform {
        /// Mean.
        mean: f64,
        /// Standard deviation.
        standard_deviation: f64,
    },
}

impl RandomQuantity {
    /// Whether draws differ.
    #[must_use]
    pub fn is_random(&self) -> bool {
        match *self {
            Self::Constant { .. } => false,
            Self::Normal { standard_deviation, .. } | Self::Uniform { standard_deviation, .. } => {
                standard_deviation != 0.0
            }
        }
    }
}

/// The random quantities with means, standard deviations and units, in one line.
impl fmt::Display for Randomisation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let random = self.distributions.iter().filter(|(_, drawn)| drawn.is_random());
        let told: Vec<String> = random
            .map(|(quantity, drawn)| match *drawn {
                RandomQuantity::Constant { value } => in_words(*quantity, value, 0.0, "constant"),
                RandomQuantity::Normal { mean, standard_deviation } => {
                    in_words(*quantity, mean, standard_deviation, "normal")
                }
                RandomQuantity::Uniform { mean, standard_deviation } => {
                    in_words(*quantity, mean, standard_deviation, "uniform")
                }
            })
            .collect();
        match (told.is_empty(), self.directions.len()) {
            (true, 0) => f.write_str("always the same Qube")?,
            (true, _) => {}
            (false, _) => f.write_str(&told.join(", "))?,
        }
        match self.directions.len() {
            0 => {}
            1 => write!(f, "; one joint deviation")?,
            many => write!(f, "; {many} joint deviations")?,
        }
        match self.specimens.len() {
            0 => Ok(()),
            count => write!(f, "; each draw is one of {count} Qubes with these moments"),
        }
    }
}

fn in_words(quantity: Quantity, mean: f64, standard_deviation: f64, family: &str) -> String {
    let (name, unit) = (quantity.symbol(), quantity.unit());
    let [mean, deviation] = [mean, standard_deviation].map(three_digits);
    format!("{name} {mean} ± {deviation} {unit} ({family})")
}

/// A number with three significant digits.
fn three_digits(value: f64) -> String {
    let places = if value == 0.0 { 0.0 } else { 2.0 - value.abs().log10().floor() };
    match places {
        // Below 0.001 and from 10 000 on.
        places if !(-1.0..=5.0).contains(&places) => format!("{value:.2e}"),
        places => {
            let text = format!("{value:.*}", places.max(0.0) as usize);
            match text.contains('.') {
                true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
                false => text,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{DomainParameter, Nonideality};

    #[test]
    fn the_random_quantities_are_told_with_their_units() {
        let normal = RandomQuantity::Normal { mean: 8.4, standard_deviation: 0.84 };
        let uniform = RandomQuantity::Uniform { mean: 0.0, standard_deviation: 0.00012 };
        let mut randomisation = Randomisation {
            distributions: BTreeMap::from([
                (DomainParameter::Gravity.into(), RandomQuantity::Constant { value: 9.81 }),
                (DomainParameter::MotorResistance.into(), normal),
                (Nonideality::CoulombTorque.into(), uniform),
            ]),
            directions: Vec::new(),
            specimens: Vec::new(),
        };
        let told = "R_m 8.4 ± 0.84 ohm (normal), coulomb 0 ± 1.20e-4 N m (uniform)";
        assert_eq!(randomisation.to_string(), told);
        randomisation.directions.push(BTreeMap::from([(DomainParameter::RotaryMass.into(), 0.1)]));
        randomisation.specimens = vec![QubeModel::NOMINAL; 3];
        let more = "; one joint deviation; each draw is one of 3 Qubes with these moments";
        assert_eq!(randomisation.to_string(), format!("{told}{more}"));
        randomisation.distributions.retain(|_, drawn| !drawn.is_random());
        (randomisation.directions, randomisation.specimens) = Default::default();
        assert_eq!(randomisation.to_string(), "always the same Qube");
    }

    #[test]
    fn a_quantity_that_does_not_exist_is_refused() {
        let read = |name: &str| {
            let text =
                format!(r#"{{"distributions":{{"{name}":{{"type":"constant","value":0.024}}}}}}"#);
            serde_json::from_str::<Randomisation>(&text)
        };
        let constant = RandomQuantity::Constant { value: 0.024 };
        let mass = Quantity::from(DomainParameter::PendulumMass);
        assert_eq!(read("M_p").unwrap().distributions, BTreeMap::from([(mass, constant)]));
        let refused = read("M_x").unwrap_err().to_string();
        assert!(refused.contains("M_x"), "{refused}");
    }
}
