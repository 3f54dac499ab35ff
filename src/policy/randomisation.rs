use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::qube::{Distribution, Quantity, QubeModel};

/// A number of the training record: name, value, whether a training may have it, and the accepted
/// values.
pub(super) type Check = (&'static str, f64, bool, &'static str);

/// The randomisation under which a network was trained: the distribution from which training drew
/// the Qube of each simulated trajectory.
///
/// A draw takes each quantity from its distribution in `distributions`. It then moves the
/// quantities together along each of the `directions`, by a standard normal number for each
/// direction. If there are `specimens`, a draw is instead one of them, each equally often, and
/// `distributions` has their means and standard deviations. `simulation::DomainDistribution` says
/// how draws are kept physical.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Randomisation {
    /// Distribution of each quantity in its SI unit.
    pub distributions: BTreeMap<Quantity, Distribution>,
    /// Joint deviations: the change of each quantity, in its SI unit, for one standard deviation
    /// along the direction.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub directions: Vec<BTreeMap<Quantity, f64>>,
    /// Qubes of which each draw is one; empty where draws follow the distributions.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub specimens: Vec<QubeModel>,
}

/// Number of quantities that a summary names.
const SUMMARISED: usize = 3;

/// Largest magnitude of a number, in its SI unit: far more than any quantity of a Qube.
const LARGEST: f64 = 1e6;

impl Randomisation {
    /// The numbers that a file gives, each with its accepted values.
    pub(super) fn checks(&self) -> impl Iterator<Item = Check> + '_ {
        let means = self.distributions.values().map(|drawn| drawn.mean());
        let joint = self.directions.iter().flat_map(|direction| direction.values().copied());
        let of_specimens = self
            .specimens
            .iter()
            .flat_map(|specimen| Quantity::all().map(|quantity| specimen.get(quantity)));
        let deviations = self.distributions.values().map(Distribution::standard_deviation);
        let within = |name: &'static str| {
            move |value: f64| (name, value, value.abs() <= LARGEST, "from -1000000 to 1000000")
        };
        let not_negative = |value: f64| {
            let is_possible = (0.0..=LARGEST).contains(&value);
            ("a standard_deviation of randomisation", value, is_possible, "from 0 to 1000000")
        };
        means
            .map(within("a mean or value of randomisation"))
            .chain(deviations.map(not_negative))
            .chain(joint.map(within("an entry of randomisation.directions")))
            .chain(of_specimens.map(within("an entry of randomisation.specimens")))
    }

    /// The number of random quantities, and the quantities that vary most in proportion to their
    /// mean, in one line. A deviation includes the joint deviations.
    #[must_use]
    pub fn summary(&self) -> String {
        let mut random: Vec<(Quantity, f64, f64)> = Vec::new();
        for (&quantity, drawn) in &self.distributions {
            let joint = self.directions.iter().filter_map(|direction| direction.get(&quantity));
            let variance = joint.fold(drawn.standard_deviation().powi(2), |sum, it| sum + it * it);
            if variance > 0.0 {
                random.push((quantity, drawn.mean(), variance.sqrt()));
            }
        }
        // A quantity whose mean is 0 has no proportion to it and comes last.
        let share =
            |mean: f64, deviation: f64| if mean == 0.0 { 0.0 } else { deviation / mean.abs() };
        random.sort_by(|a, b| share(b.1, b.2).total_cmp(&share(a.1, a.2)));
        let most: Vec<String> = random
            .iter()
            .take(SUMMARISED)
            .map(|&(quantity, mean, deviation)| {
                let [mean, deviation] = [mean, deviation].map(three_digits);
                format!("{} {mean} ± {deviation} {}", quantity.symbol(), quantity.unit())
            })
            .collect();
        let most = most.join(", ");
        match random.len() {
            0 => "always the same pendulum".to_owned(),
            1 => format!("one random quantity, {most}"),
            count if count <= SUMMARISED => format!("{count} random quantities, {most}"),
            count => format!("{count} random quantities; these vary most: {most}"),
        }
    }
}

/// Writes the random quantities with means, standard deviations and units, and the numbers of
/// directions and specimens, in one line.
impl fmt::Display for Randomisation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let random = self.distributions.iter().filter(|(_, drawn)| is_random(drawn));
        let quantities: Vec<String> =
            random.map(|(quantity, drawn)| in_words(*quantity, drawn)).collect();
        match (quantities.is_empty(), self.directions.len()) {
            (true, 0) => f.write_str("always the same pendulum")?,
            (true, _) => {}
            (false, _) => f.write_str(&quantities.join(", "))?,
        }
        if !quantities.is_empty() && !self.directions.is_empty() {
            f.write_str("; ")?;
        }
        match self.directions.len() {
            0 => {}
            1 => write!(f, "one joint deviation")?,
            many => write!(f, "{many} joint deviations")?,
        }
        match self.specimens.len() {
            0 => Ok(()),
            count => write!(f, "; each draw is one of {count} Qubes with these moments"),
        }
    }
}

fn is_random(distribution: &Distribution) -> bool {
    distribution.standard_deviation() != 0.0
}

fn in_words(quantity: Quantity, distribution: &Distribution) -> String {
    let family = match distribution {
        Distribution::Constant { .. } => "constant",
        Distribution::Normal { .. } => "normal",
        Distribution::Uniform { .. } => "uniform",
    };
    let (name, unit) = (quantity.symbol(), quantity.unit());
    let [mean, deviation] =
        [distribution.mean(), distribution.standard_deviation()].map(three_digits);
    format!("{name} {mean} ± {deviation} {unit} ({family})")
}

/// A number with at most three significant digits, or without decimals from 1000 to 9999.
fn three_digits(value: f64) -> String {
    let places = if value == 0.0 { 0.0 } else { 2.0 - value.abs().log10().floor() };
    match places {
        // Magnitudes below 0.001 and from 10 000 on.
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
    fn the_text_names_the_random_quantities_with_their_units() {
        let normal = Distribution::Normal { mean: 8.4, standard_deviation: 0.84 };
        let uniform = Distribution::Uniform { mean: 0.0, standard_deviation: 0.00012 };
        let mut randomisation = Randomisation {
            distributions: BTreeMap::from([
                (DomainParameter::Gravity.into(), Distribution::Constant { value: 9.81 }),
                (DomainParameter::MotorResistance.into(), normal),
                (Nonideality::CoulombTorque.into(), uniform),
            ]),
            directions: Vec::new(),
            specimens: Vec::new(),
        };
        let expected = "R_m 8.4 ± 0.84 ohm (normal), coulomb 0 ± 1.20e-4 N m (uniform)";
        assert_eq!(randomisation.to_string(), expected);
        randomisation.directions.push(BTreeMap::from([(DomainParameter::RotaryMass.into(), 0.1)]));
        randomisation.specimens = vec![QubeModel::NOMINAL; 3];
        let more = "; one joint deviation; each draw is one of 3 Qubes with these moments";
        assert_eq!(randomisation.to_string(), format!("{expected}{more}"));
        randomisation.distributions.retain(|_, drawn| !is_random(drawn));
        assert_eq!(randomisation.to_string(), more.strip_prefix("; ").unwrap());
        (randomisation.directions, randomisation.specimens) = Default::default();
        assert_eq!(randomisation.to_string(), "always the same pendulum");
    }

    #[test]
    fn a_summary_names_the_quantities_that_vary_most_with_their_joint_deviations() {
        let of = |standard_deviation| Distribution::Normal { mean: 10.0, standard_deviation };
        let mut randomisation = Randomisation {
            distributions: BTreeMap::from([
                (DomainParameter::Gravity.into(), of(0.0)),
                (DomainParameter::MotorResistance.into(), of(3.0)),
                (DomainParameter::RotaryMass.into(), of(1.0)),
                (DomainParameter::PendulumMass.into(), of(2.0)),
                (DomainParameter::PendulumLength.into(), of(0.5)),
            ]),
            directions: vec![BTreeMap::from([(DomainParameter::MotorResistance.into(), 4.0)])],
            specimens: Vec::new(),
        };
        assert_eq!(
            randomisation.summary(),
            "4 random quantities; these vary most: R_m 10 ± 5 ohm, M_p 10 ± 2 kg, M_r 10 ± 1 kg"
        );
        randomisation.distributions.retain(|quantity, _| quantity.symbol() == "R_m");
        assert_eq!(randomisation.summary(), "one random quantity, R_m 10 ± 5 ohm");
        randomisation.distributions.clear();
        assert_eq!(randomisation.summary(), "always the same pendulum");
    }

    #[test]
    fn a_quantity_that_does_not_exist_is_refused() {
        let read = |name: &str| {
            let text =
                format!(r#"{{"distributions":{{"{name}":{{"type":"constant","value":0.024}}}}}}"#);
            serde_json::from_str::<Randomisation>(&text)
        };
        let constant = Distribution::Constant { value: 0.024 };
        let mass = Quantity::from(DomainParameter::PendulumMass);
        assert_eq!(read("M_p").unwrap().distributions, BTreeMap::from([(mass, constant)]));
        let refused = read("M_x").unwrap_err().to_string();
        assert!(refused.contains("M_x"), "{refused}");
    }
}
