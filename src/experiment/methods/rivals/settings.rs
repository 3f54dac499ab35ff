use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::RivalKind;
use crate::experiment::{ExperimentSettingError, Method};
use crate::session::SettingError;

/// One number of each method from the literature that a comparison can choose. The other numbers of
/// a method are constants of its file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RivalSettings {
    /// Largest divergence of a step of `simopt` from the distribution before it, nats, 0.01 to 10.
    pub simopt_divergence: f64,
    /// Number of components of the mixture of `bayessim`, 1 to 16.
    pub bayessim_components: u32,
    /// Factor on the noise of the next state in the likelihood of `dropo`, 0.1 to 10.
    pub dropo_noise: f64,
    /// Share of the trajectories that a policy of `epopt` learns from in the second half of its
    /// training: those with the lowest returns; 0.01 to 1.
    pub epopt_worst_share: f64,
    /// Factor on the covariance of the belief from which `npdr` proposes Qubes, 1 to 10.
    pub npdr_widening: f64,
    /// Weight of the divergence from a wide distribution in `lsdr`, beside the return as a fraction
    /// of the largest possible one; 0.001 to 1.
    pub lsdr_weight: f64,
    /// Weight of the standard deviation in the upper confidence bound of `fpo`, 0 to 10.
    pub fpo_beta: f64,
    /// Temperature of the reward of `adr`, 0.01 to 10: the lower, the more the particles follow the
    /// reward rather than the prior.
    pub adr_temperature: f64,
    /// Factor on the physics inputs of the policy of `so-cma`, 0.01 to 1; with 1 the inputs are in
    /// standard deviations of the prior.
    pub so_cma_scale: f64,
}

/// The numbers that were best on the Qubes of scripts/comparison/tuning.toml (docs/rivals.md).
impl Default for RivalSettings {
    fn default() -> Self {
        Self {
            simopt_divergence: 0.3,
            bayessim_components: 1,
            dropo_noise: 1.0,
            epopt_worst_share: 0.6,
            npdr_widening: 2.0,
            lsdr_weight: 0.15,
            so_cma_scale: 0.3,
            ..Self::constants_of_earlier_versions()
        }
    }
}

impl RivalSettings {
    /// The numbers of an experiment whose file has none, because a version began it in which they
    /// were constants.
    pub fn constants_of_earlier_versions() -> Self {
        Self {
            simopt_divergence: 1.0,
            bayessim_components: 4,
            dropo_noise: 1.0,
            epopt_worst_share: 0.1,
            npdr_widening: 2.0,
            lsdr_weight: 0.02,
            fpo_beta: 2.0,
            adr_temperature: 0.3,
            so_cma_scale: 1.0,
        }
    }

    /// The method that uses the number of this name; `None` if there is no such number.
    #[must_use]
    pub fn method_of(name: &str) -> Option<Method> {
        Some(match name {
            "simopt_divergence" => Method::Rival(RivalKind::SimOpt),
            "bayessim_components" => Method::Rival(RivalKind::BayesSim),
            "dropo_noise" => Method::Rival(RivalKind::Dropo),
            "epopt_worst_share" => Method::Rival(RivalKind::EpOpt),
            "npdr_widening" => Method::Rival(RivalKind::Npdr),
            "lsdr_weight" => Method::Rival(RivalKind::Lsdr),
            "fpo_beta" => Method::Rival(RivalKind::Fpo),
            "adr_temperature" => Method::Rival(RivalKind::Adr),
            "so_cma_scale" => Method::StrategyOptimisation,
            _ => return None,
        })
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// The first number that is out of its range.
    pub fn check(&self) -> Result<(), ExperimentSettingError> {
        for (name, value, range) in [
            ("rivals.simopt_divergence", self.simopt_divergence, [0.01, 10.0]),
            ("rivals.bayessim_components", self.bayessim_components.into(), [1.0, 16.0]),
            ("rivals.dropo_noise", self.dropo_noise, [0.1, 10.0]),
            ("rivals.epopt_worst_share", self.epopt_worst_share, [0.01, 1.0]),
            ("rivals.npdr_widening", self.npdr_widening, [1.0, 10.0]),
            ("rivals.lsdr_weight", self.lsdr_weight, [0.001, 1.0]),
            ("rivals.fpo_beta", self.fpo_beta, [0.0, 10.0]),
            ("rivals.adr_temperature", self.adr_temperature, [0.01, 10.0]),
            ("rivals.so_cma_scale", self.so_cma_scale, [0.01, 1.0]),
        ] {
            SettingError::in_range(name, value, range)?;
        }
        Ok(())
    }
}

/// Parses `name=value`, separated by commas; a number that is not named is the default one.
impl FromStr for RivalSettings {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let lines: String = text.split(',').flat_map(|pair| [pair, "\n"]).collect();
        toml::from_str(&lines).map_err(|error| error.message().to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::MethodSettings;

    #[test]
    fn named_numbers_are_read_and_the_others_stay() {
        let read: RivalSettings = "fpo_beta=1.5,bayessim_components=8".parse().unwrap();
        let expected =
            RivalSettings { fpo_beta: 1.5, bayessim_components: 8, ..RivalSettings::default() };
        assert_eq!(read, expected);
        for (text, words) in [
            ("fpo=1", "unknown field `fpo`"),
            ("fpo_beta", "expected"),
            ("fpo_beta=1,fpo_beta=2", "duplicate"),
            ("bayessim_components=1.5", "invalid type"),
        ] {
            let refused = text.parse::<RivalSettings>().unwrap_err();
            assert!(refused.contains(words), "{refused}");
        }
    }

    #[test]
    fn an_experiment_of_an_earlier_version_keeps_its_numbers() {
        let file =
            "methods = [\"simopt\"]\nrepetitions = 1\nrecordings = 6\nspread = 0.1\nbudgets = [2]";
        let settings: MethodSettings = toml::from_str(file).unwrap();
        assert_eq!(settings.rivals.simopt_divergence, 1.0);
        assert_eq!(settings.rivals, RivalSettings::constants_of_earlier_versions());
        assert_ne!(settings.rivals, RivalSettings::default());
    }

    #[test]
    fn each_number_belongs_to_the_method_in_its_name() {
        let numbers = toml::Table::try_from(RivalSettings::default()).unwrap();
        assert_eq!(numbers.len(), 9);
        for name in numbers.keys() {
            let method = RivalSettings::method_of(name).unwrap();
            assert!(name.starts_with(&method.name().replace('-', "_")), "{name}: {method}");
        }
    }

    #[test]
    fn each_number_has_a_range() {
        assert!(RivalSettings::default().check().is_ok());
        for text in [
            "simopt_divergence=0.0",
            "bayessim_components=0",
            "dropo_noise=11.0",
            "epopt_worst_share=0.0",
            "npdr_widening=0.9",
            "lsdr_weight=nan",
            "fpo_beta=-1.0",
            "adr_temperature=0.0",
            "so_cma_scale=2.0",
        ] {
            let settings: RivalSettings = text.parse().unwrap();
            let refused = settings.check().unwrap_err().to_string();
            let name = text.split('=').next().unwrap();
            assert!(refused.contains(name), "{refused}");
        }
    }
}
