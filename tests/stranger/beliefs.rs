use qube_hil::qube::{PlantModel, Profile, Quantity, QubeModel};
use qube_hil::safety::{Belief, ForesightSettings, IdentifiedQube};

use super::genes::Genes;

/// Knowledge about the Qube that is driven.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BeliefKind {
    /// The Qube is not identified.
    Unknown,
    /// The Qube is identified: its parameters lie around the values of `lab`.
    Identified,
    /// The Qube is identified, and its profile has a tenth of the standard errors of `lab`.
    Precise,
}

/// A Qube within a belief: its parameters, and the fractions of positive and negative voltages that
/// reach its motor.
#[derive(Clone, Copy, Debug)]
pub struct DrawnQube {
    pub model: QubeModel,
    pub positive_share: f64,
    pub negative_share: f64,
}

impl BeliefKind {
    /// Settings of the guard.
    pub fn settings(self) -> ForesightSettings {
        let identified = match self {
            Self::Unknown => None,
            Self::Identified => Some(IdentifiedQube::of(&Profile::lab(), &PlantModel::QUBE)),
            Self::Precise => {
                let mut profile = Profile::lab();
                profile.standard_errors.values_mut().for_each(|error| *error /= 10.0);
                Some(IdentifiedQube::of(&profile, &PlantModel::QUBE))
            }
        };
        ForesightSettings { identified, ..ForesightSettings::default() }
    }

    /// The belief within which the Qube is drawn: the belief about the identified Qube, wide enough
    /// for the tolerated error of the model, or the belief about any Qube.
    fn belief(self) -> Belief {
        let ForesightSettings { belief, identified, .. } = self.settings();
        identified.map_or(belief, |identified| identified.tolerated())
    }

    /// A Qube within the belief, each number chosen by a gene.
    pub fn qube(self, genes: &mut Genes) -> DrawnQube {
        let belief = self.belief();
        let mut model = belief.low;
        let mut between = |low: f64, high: f64| low + genes.unit() * (high - low);
        for quantity in Quantity::all() {
            model.set(quantity, between(belief.low.get(quantity), belief.high.get(quantity)));
        }
        let least = belief.least_share;
        let (weak, side) = (between(least, 1.0), between(-1.0, 1.0));
        // Either the supply is weak for both signs, or the amplifier is weak for one.
        let positive_share = if side > 0.3 { 1.0 } else { weak };
        let negative_share = if side < -0.3 { 1.0 } else { weak };
        DrawnQube { model, positive_share, negative_share }
    }

    /// The model that a session would give an observer.
    pub fn observed(self) -> QubeModel {
        match self {
            Self::Unknown => QubeModel::NOMINAL,
            Self::Identified | Self::Precise => Profile::lab().model(),
        }
    }
}
