use std::path::Path;

use qube_hil::qube::{DomainParameter, Profile, Quantity, QubeModel};
use qube_hil::safety::Belief;

use super::genes::Genes;

/// Within which share of `lab` an identified Qube is believed.
const IDENTIFIED_WITHIN: f64 = 0.1;

/// Within which share of the delay, and within how much at least, s.
const DELAY_WITHIN: f64 = 0.3;
const DELAY_WITHIN_S: f64 = 0.002;

/// What is known of the Qube that is driven.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Known {
    /// Nothing but that it is a Qube.
    Unknown,
    /// It has been identified: it lies around `lab`.
    Identified,
}

/// A Qube of a belief: its parameters and the shares of a voltage that arrive.
#[derive(Clone, Copy, Debug)]
pub struct DrawnQube {
    pub model: QubeModel,
    pub positive_share: f64,
    pub negative_share: f64,
}

impl Known {
    /// What the guard is told.
    pub fn belief(self) -> Belief {
        match self {
            Self::Unknown => Belief::of_any_qube(0.3),
            Self::Identified => around(&lab()),
        }
    }

    /// A Qube that lies within the belief: each number where a gene says.
    pub fn qube(self, genes: &mut Genes) -> DrawnQube {
        let belief = self.belief();
        let mut model = belief.low;
        let mut between = |low: f64, high: f64| low + genes.unit() * (high - low);
        for quantity in Quantity::all() {
            model.set(quantity, between(belief.low.get(quantity), belief.high.get(quantity)));
        }
        let least = belief.least_share;
        let (weak, side) = (between(least, 1.0), between(-1.0, 1.0));
        // A weak supply on both sides, or an amplifier that is weak on one.
        let positive_share = if side > 0.3 { 1.0 } else { weak };
        let negative_share = if side < -0.3 { 1.0 } else { weak };
        DrawnQube { model, positive_share, negative_share }
    }

    /// A model for an observer, as a session would have it.
    pub fn observed(self) -> QubeModel {
        match self {
            Self::Unknown => QubeModel::NOMINAL,
            Self::Identified => lab(),
        }
    }
}

/// The Qube whose recordings are public.
fn lab() -> QubeModel {
    static LAB: std::sync::OnceLock<QubeModel> = std::sync::OnceLock::new();
    *LAB.get_or_init(|| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("profiles/lab.toml");
        let text = std::fs::read_to_string(path).expect("the shipped profile");
        Profile::parse(&text).expect("the shipped profile").model()
    })
}

/// The belief in a Qube that was found to be this one.
fn around(model: &QubeModel) -> Belief {
    let (mut low, mut high) = (*model, *model);
    for quantity in Quantity::all() {
        if quantity != Quantity::Parameter(DomainParameter::Gravity) {
            let value = model.get(quantity);
            let within = IDENTIFIED_WITHIN * value.abs();
            low.set(quantity, value - within);
            high.set(quantity, value + within);
        }
    }
    let delay_s = model.gap.command_delay_s;
    let within_s = (DELAY_WITHIN * delay_s).max(DELAY_WITHIN_S);
    low.gap.command_delay_s = (delay_s - within_s).max(0.0);
    high.gap.command_delay_s = delay_s + within_s;
    Belief { low, high, least_share: 0.8 }
}
