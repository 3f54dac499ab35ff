use serde::{Deserialize, Serialize};

use crate::session::{EmulatedQubeSettings, SeedFor, derived_seed};

/// A plant on which policies run: an emulated Qube, or an entry that only names the real one. With
/// `vary` above 0, each policy has an emulated Qube of its own, drawn around this one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plant {
    /// Name of the plant in tables and of its folder.
    pub name: String,
    /// Settings of the emulated Qube; without effect where the Qube is real.
    pub emulated: EmulatedQubeSettings,
    /// Relative half width of the draw of each policy's Qube, 0 to 0.2, in experiments of earlier
    /// versions up to 0.5: every parameter, the friction, both dead zones, the cable's stiffness
    /// and the delay are uniform between `1 - vary` and `1 + vary` times their values. With 0 all
    /// policies have the same Qube.
    #[serde(default)]
    pub vary: f64,
}

impl Plant {
    /// The Qube of the policy with this number; policies of different recipes with the same number
    /// share it. In a comparison of methods the number is the repetition's. Plants with the same
    /// `stream` are scaled by the same factors.
    #[must_use]
    pub fn for_policy(&self, seed: u64, policy: u32, stream: u32) -> EmulatedQubeSettings {
        if self.vary == 0.0 {
            return self.emulated;
        }
        self.emulated.varied(self.vary, derived_seed(seed, SeedFor::Qube { policy, plant: stream }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::{DomainParameter, Nonidealities, QubeModel};

    #[test]
    fn each_policy_has_its_own_qube_within_the_range_and_always_the_same() {
        let nonidealities = Nonidealities {
            command_delay_s: 0.01,
            cable_rest_rad: -1.0,
            ..Nonidealities::default()
        };
        let model = QubeModel { nonidealities, ..QubeModel::NOMINAL };
        let emulated =
            EmulatedQubeSettings { model, command_jitter_s: 0.001, ..Default::default() };
        let same = Plant { name: "lab".into(), emulated, vary: 0.0 };
        assert_eq!(same.for_policy(1, 7, 0), emulated);
        let plant = Plant { vary: 0.1, ..same };
        let (mut lowest, mut highest) = (f64::INFINITY, 0.0_f64);
        for policy in 0..100 {
            let drawn = plant.for_policy(3, policy, 0);
            assert_eq!(drawn, plant.for_policy(3, policy, 0));
            assert_ne!(drawn, plant.for_policy(3, policy, 1));
            assert_eq!(drawn.model.nonidealities.cable_rest_rad, -1.0);
            assert_eq!(drawn.command_jitter_s, 0.001);
            assert_eq!(drawn.model.parameters.check(), Ok(()));
            let factors = DomainParameter::ALL.map(|parameter| {
                drawn.model.parameters.get(parameter) / model.parameters.get(parameter)
            });
            for factor in
                factors.into_iter().chain([drawn.model.nonidealities.command_delay_s / 0.01])
            {
                lowest = lowest.min(factor);
                highest = highest.max(factor);
            }
        }
        assert!((0.9..0.901).contains(&lowest) && (1.099..=1.1).contains(&highest));
    }
}
