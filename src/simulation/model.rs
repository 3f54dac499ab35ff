use serde::{Deserialize, Serialize};

use super::{Direction, DomainDistribution, Family, Psi, PsiError};
use crate::qube::{PlantModel, Profile, QubeModel};

/// A named distribution over simulations: one of the thesis's five (section 5.2), or one with the
/// nonidealities of real Qubes. In a *searched* model, the quantities that psi names (masses and
/// lengths, if the settings name no others) are left to a search for psi.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Model {
    /// The nominal values in every simulation.
    Nominal,
    /// All nine parameters vary, with a fifth of the nominal value as standard deviation.
    Handcrafted,
    /// Masses and lengths vary as in `handcrafted`; the other five parameters are nominal.
    NominalHandcrafted,
    /// Quantities that psi names follow psi, which a session searches; the others are as in
    /// `handcrafted`.
    OptHandcrafted,
    /// Quantities that psi names follow psi, which a session searches; the others are nominal.
    OptNominal,
    /// Parameters and nonidealities vary as for a Qube that is not identified.
    Robust,
    /// Parameters and nonidealities vary around the values of an identified Qube.
    Profile,
    /// Quantities that psi names follow psi, which a session searches; the others are as in
    /// `robust`.
    OptRobust,
    /// Quantities that psi names follow psi, which a session searches; the others are as in
    /// `profile`.
    OptProfile,
}

/// An identified Qube, and the spread of the simulations around it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProfileSettings {
    /// Parameters and nonidealities of the Qube.
    pub model: QubeModel,
    /// Standard deviation of each quantity as a part of its value, 0 to 1. It stands for errors of
    /// the model, which `directions` do not contain.
    pub spread: f64,
    /// Directions of the identification's errors ([`Direction::of_errors`]), the widest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub directions: Vec<Direction>,
    /// Axes along which psi shifts the means; empty if `directions` are the axes. A search keeps
    /// the axes of its first profile, so that a shift moves the means by the same amounts while the
    /// errors change. Files do not have them, because they follow from the profiles.
    #[serde(skip)]
    pub axes: Vec<Direction>,
}

impl ProfileSettings {
    /// The settings for the specimen of a plant that a profile describes, with the errors of the
    /// profile's identification and an additional `spread`.
    #[must_use]
    pub fn of(profile: &Profile, plant: &PlantModel, spread: f64) -> Self {
        let directions = Direction::of_errors(profile, plant);
        Self { model: profile.model(), spread, directions, axes: Vec::new() }
    }
}

impl Model {
    /// Every model: the thesis's in the order of its table 5.3, then those with nonidealities.
    pub const ALL: [Self; 9] = [
        Self::Nominal,
        Self::Handcrafted,
        Self::NominalHandcrafted,
        Self::OptHandcrafted,
        Self::OptNominal,
        Self::Robust,
        Self::Profile,
        Self::OptRobust,
        Self::OptProfile,
    ];

    /// The thesis's five models.
    pub const THESIS: [Self; 5] = [
        Self::Nominal,
        Self::Handcrafted,
        Self::NominalHandcrafted,
        Self::OptHandcrafted,
        Self::OptNominal,
    ];

    /// The model's name in files and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Nominal => "nominal",
            Self::Handcrafted => "handcrafted",
            Self::NominalHandcrafted => "nominal-handcrafted",
            Self::OptHandcrafted => "opt-handcrafted",
            Self::OptNominal => "opt-nominal",
            Self::Robust => "robust",
            Self::Profile => "profile",
            Self::OptRobust => "opt-robust",
            Self::OptProfile => "opt-profile",
        }
    }

    /// A description of the model in one sentence, for people.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Self::Nominal => "The name plate's values, always the same",
            Self::Handcrafted => "All nine parameters vary by a fifth",
            Self::NominalHandcrafted => "Masses and lengths vary by a fifth",
            Self::OptHandcrafted => {
                "Masses and lengths by a psi that is searched, the others vary by a fifth"
            }
            Self::OptNominal => "Masses and lengths by a psi that is searched",
            Self::Robust => "Parameters and nonidealities as for a Qube that nobody has identified",
            Self::Profile => "Parameters and nonidealities around an identified Qube",
            Self::OptRobust => "Masses and lengths by a psi that is searched, the rest as robust",
            Self::OptProfile => "Masses and lengths by a psi that is searched, the rest as profile",
        }
    }

    /// Returns whether the model leaves a psi to a search.
    #[must_use]
    pub fn is_searched(self) -> bool {
        self.searched() == self
    }

    /// The names of the models that leave a psi to a search, separated by commas.
    #[must_use]
    pub fn searched_names() -> String {
        let searched = Self::ALL.into_iter().filter(|model| model.is_searched());
        searched.map(Self::name).collect::<Vec<_>>().join(", ")
    }

    /// The searched model that draws the quantities that psi does not name from the same
    /// distribution as this model. In the thesis's space these are all but masses and lengths.
    #[must_use]
    pub fn searched(self) -> Self {
        match self {
            Self::Nominal | Self::NominalHandcrafted | Self::OptNominal => Self::OptNominal,
            Self::Handcrafted | Self::OptHandcrafted => Self::OptHandcrafted,
            Self::Robust | Self::OptRobust => Self::OptRobust,
            Self::Profile | Self::OptProfile => Self::OptProfile,
        }
    }

    /// Returns whether the model is drawn around an identified Qube.
    #[must_use]
    pub fn needs_profile(self) -> bool {
        self.searched() == Self::OptProfile
    }

    /// Returns whether simulations have the nonidealities of real Qubes.
    #[must_use]
    pub fn has_nonidealities(self) -> bool {
        matches!(self.searched(), Self::OptRobust | Self::OptProfile)
    }

    /// The distribution of simulations of a plant before psi is applied.
    ///
    /// # Errors
    /// The model needs a profile and there is none, or a value of the profile or the plant cannot
    /// be simulated.
    pub fn base_distribution(
        self,
        plant: &PlantModel,
        family: Family,
        profile: Option<&ProfileSettings>,
    ) -> Result<DomainDistribution, PsiError> {
        let of_qube = match self {
            Self::Nominal | Self::OptNominal => DomainDistribution::nominal(),
            Self::Handcrafted | Self::OptHandcrafted => DomainDistribution::handcrafted(family),
            Self::NominalHandcrafted => DomainDistribution::nominal_handcrafted(family),
            Self::Robust | Self::OptRobust => DomainDistribution::robust(),
            Self::Profile | Self::OptProfile => {
                let ProfileSettings { model, spread, directions, axes: _ } =
                    profile.ok_or(PsiError::NoProfile)?;
                // A profile describes a specimen of the plant, so its values are not converted.
                let around = DomainDistribution::around(model, *spread, family);
                return Ok(around.map_err(PsiError::Base)?.along(directions));
            }
        };
        of_qube.of_plant(plant).map_err(PsiError::Base)
    }

    /// The distribution of simulations of a plant. A searched model needs a psi; the others ignore
    /// it.
    ///
    /// # Errors
    /// A searched model has no psi, or [`Self::base_distribution`] fails.
    pub fn distribution(
        self,
        plant: &PlantModel,
        family: Family,
        profile: Option<&ProfileSettings>,
        psi: Option<&Psi>,
    ) -> Result<DomainDistribution, PsiError> {
        let base = self.base_distribution(plant, family, profile)?;
        match (self.is_searched(), psi) {
            (false, _) => Ok(base),
            (true, Some(psi)) => {
                let axes = profile.map_or(&[][..], |profile| &profile.axes);
                Ok(match axes {
                    [] => base.shaped_by(psi, family),
                    axes => base.shaped_along(axes, psi, family),
                })
            }
            (true, None) => Err(PsiError::Missing { model: self.name() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::PsiSpace;

    #[test]
    fn files_write_the_name_of_a_model() {
        for model in Model::ALL {
            assert_eq!(toml::Value::try_from(model).unwrap().as_str(), Some(model.name()));
        }
    }

    #[test]
    fn searched_models_need_a_psi_and_models_around_a_qube_need_a_profile() {
        let space = PsiSpace::thesis();
        let psi = space.psi(&space.lower()).unwrap();
        let profile = ProfileSettings::of(
            &Profile::exact("exact", &QubeModel::NOMINAL),
            &PlantModel::QUBE,
            0.1,
        );
        for model in Model::ALL {
            let distribution =
                |psi| model.distribution(&PlantModel::QUBE, Family::Normal, Some(&profile), psi);
            let base =
                model.base_distribution(&PlantModel::QUBE, Family::Normal, Some(&profile)).unwrap();
            if model.is_searched() {
                assert!(matches!(distribution(None), Err(PsiError::Missing { .. })));
                assert_eq!(distribution(Some(&psi)).unwrap(), base.shaped_by(&psi, Family::Normal));
            } else {
                assert_eq!(distribution(None).unwrap(), base);
            }
            let alone = model.base_distribution(&PlantModel::QUBE, Family::Normal, None);
            assert_eq!(matches!(alone, Err(PsiError::NoProfile)), model.needs_profile());
        }
        let names = "opt-handcrafted, opt-nominal, opt-robust, opt-profile";
        assert_eq!(Model::searched_names(), names);
    }
}
