use std::path::Path;

use qube_hil::qube::{Profile, Quantity, QubeModel};
use qube_hil::safety::{Belief, ForesightSettings, IdentifiedQube};

use super::genes::Genes;

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
    pub fn settings(self) -> ForesightSettings {
        let identified = match self {
            Self::Unknown => None,
            Self::Identified => Some(IdentifiedQube::of(lab())),
        };
        ForesightSettings { identified, ..ForesightSettings::default() }
    }

    /// Between which Qubes the one at hand lies: 10 % of each number to either side of an identified one, 30 % of
    /// its delay or 2 ms.
    fn belief(self) -> Belief {
        let ForesightSettings { belief, identified, .. } = self.settings();
        identified.map_or(belief, |identified| identified.belief)
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
            Self::Identified => lab().model(),
        }
    }
}

/// The Qube whose recordings are public.
fn lab() -> &'static Profile {
    static LAB: std::sync::OnceLock<Profile> = std::sync::OnceLock::new();
    LAB.get_or_init(|| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("profiles/lab.toml");
        let text = std::fs::read_to_string(path).expect("the shipped profile");
        Profile::parse(&text).expect("the shipped profile")
    })
}
