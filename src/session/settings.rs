use serde::{Deserialize, Serialize};

use super::Extent;
use crate::control::HomingSettings;
use crate::device::emulator::EmulatorSettings;
use crate::estimation::EstimatorSettings;
use crate::learning::{Origin, TrainSettings};
use crate::qube::QubeModel;
use crate::safety::{Guard, SafetyBox};
use crate::search::{BayRnSettings, SearchError, Strategy, StrategyKind};
use crate::simulation::{
    DomainDistribution, Family, PsiError, PsiSpace, SensorModel, SimulationSettings, box_file,
};
use crate::surrogate::SearchBox;

/// What the quantities are drawn from that psi does not shape; in the thesis's sessions these are g,
/// R_m, k_m, D_r and D_p.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Model {
    /// Nominal: `opt-nominal` in the thesis's table 5.3.
    #[default]
    OptNominal,
    /// Normal with a fifth of the nominal as standard deviation: `opt-handcrafted`.
    OptHandcrafted,
    /// As for a Qube that nobody has identified, with its gap.
    OptRobust,
    /// Around an identified Qube, with its gap.
    OptProfile,
}

impl Model {
    /// Its name, as a policy's file gives it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::OptNominal => "opt-nominal",
            Self::OptHandcrafted => "opt-handcrafted",
            Self::OptRobust => "opt-robust",
            Self::OptProfile => "opt-profile",
        }
    }
}

/// An identified Qube, and how far simulations are drawn around it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProfileSettings {
    /// The Qube.
    pub model: QubeModel,
    /// Standard deviations, as a part of each of its values.
    pub spread: f64,
}

/// What the emulated Qube is like.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EmulatedQubeSettings {
    /// Its physics.
    pub model: QubeModel,
    /// By how much the delay of a command differs from the model's at most, s.
    pub command_jitter_s: f64,
    /// Play between motor and arm, rad.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub play_rad: f64,
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl EmulatedQubeSettings {
    /// A well one that starts as this seed says.
    #[must_use]
    pub fn emulator(&self, seed: u64) -> EmulatorSettings {
        EmulatorSettings {
            model: self.model,
            command_jitter_s: self.command_jitter_s,
            play_rad: self.play_rad,
            seed,
            ..EmulatorSettings::default()
        }
    }
}

impl Default for EmulatedQubeSettings {
    fn default() -> Self {
        Self { model: QubeModel::NOMINAL, command_jitter_s: 0.0, play_rad: 0.0 }
    }
}

/// Everything that decides a session, as `session.toml` holds it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SessionSettings {
    /// The session's name.
    pub name: String,
    /// Everything random follows from it.
    pub seed: u64,
    /// What psi does not shape.
    pub model: Model,
    /// The Qube of the model `opt-profile`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub profile: Option<ProfileSettings>,
    /// What psi shapes, and the box of the search.
    pub psi: PsiSpace,
    /// Shape of the distributions that psi gives mean and standard deviation of.
    pub family: Family,
    /// How much is done.
    pub extent: Extent,
    /// How velocities are estimated on the Qube.
    pub estimator: EstimatorSettings,
    /// The box that ends a rollout.
    #[serde(with = "box_file")]
    pub safety_box: SafetyBox,
    /// How the arm's middle is found.
    pub homing: HomingSettings,
    /// What the emulated Qube is like, where it is used.
    pub emulated: EmulatedQubeSettings,
    /// How psi is searched.
    pub strategy: StrategyKind,
    /// How BayRn does it.
    pub bayrn: BayRnSettings,
    /// How policies are trained.
    pub training: TrainSettings,
}

impl SessionSettings {
    /// A session of minutes: fewer points, two rollouts each, a training of seconds. What psi does not
    /// shape is drawn as for a Qube that nobody has identified, friction, cable and delay too, and
    /// policies see their last two commands: what crosses over to the machine best (docs/learning.md).
    #[must_use]
    pub fn quick() -> Self {
        Self {
            name: String::new(),
            seed: 0,
            model: Model::OptRobust,
            profile: None,
            psi: PsiSpace::thesis(),
            family: Family::Normal,
            extent: Extent::QUICK,
            estimator: EstimatorSettings::default(),
            safety_box: SafetyBox::GUARDED,
            homing: HomingSettings::default(),
            emulated: EmulatedQubeSettings::default(),
            strategy: StrategyKind::BayRn,
            bayrn: BayRnSettings::default(),
            training: TrainSettings::robust(),
        }
    }

    /// The thesis's own model, extent and training budget. Simulations have the machine's sensors: what
    /// is trained on true states fails on the machine (docs/learning.md).
    #[must_use]
    pub fn thesis() -> Self {
        let training =
            TrainSettings { simulation: SimulationSettings::machine(), ..TrainSettings::thesis() };
        Self { model: Model::OptNominal, extent: Extent::THESIS, training, ..Self::quick() }
    }

    /// Puts rollouts under this guard.
    #[must_use]
    pub fn under(mut self, guard: Guard) -> Self {
        self.safety_box.guard = guard;
        self
    }

    /// Lets machine and simulations alike be seen through this estimator; simulations that show true
    /// states go on to.
    #[must_use]
    pub fn seen_through(mut self, estimator: EstimatorSettings) -> Self {
        self.estimator = estimator;
        if let SensorModel::Encoders { estimator: simulated } =
            &mut self.training.simulation.sensors
        {
            *simulated = estimator;
        }
        self
    }

    /// The strategy that chooses psi.
    ///
    /// # Errors
    /// The settings make no strategy.
    pub fn search(&self) -> Result<Box<dyn Strategy>, SearchError> {
        let search_box = SearchBox::new(self.psi.lower(), self.psi.upper())?;
        let initial_points = self.extent.initial_candidates as usize;
        let bayrn = BayRnSettings { initial_points, ..self.bayrn.clone() };
        self.strategy.build(&search_box, &bayrn, self.seed)
    }

    /// The simulations of one psi.
    ///
    /// # Errors
    /// The psi is outside its box.
    pub fn distribution(&self, psi: &[f64]) -> Result<DomainDistribution, PsiError> {
        let base = self.base_distribution()?;
        Ok(base.shaped_by(&self.psi.psi(psi)?, self.family))
    }

    /// What one psi's simulations surround the physics with.
    ///
    /// # Errors
    /// The psi is outside its box.
    pub fn simulation(&self, psi: &[f64]) -> Result<SimulationSettings, PsiError> {
        Ok(self.training.simulation.shaped_by(&self.psi.psi(psi)?))
    }

    /// What is drawn where psi says nothing.
    ///
    /// # Errors
    /// There is no profile where one is needed, or it has what cannot be simulated.
    pub fn base_distribution(&self) -> Result<DomainDistribution, PsiError> {
        match (self.model, &self.profile) {
            (Model::OptHandcrafted, _) => Ok(DomainDistribution::handcrafted(self.family)),
            (Model::OptRobust, _) => Ok(DomainDistribution::robust()),
            (Model::OptProfile, Some(ProfileSettings { model, spread })) => {
                DomainDistribution::around(model, *spread, self.family).map_err(PsiError::Base)
            }
            (Model::OptProfile, None) => Err(PsiError::NoProfile),
            (Model::OptNominal, _) => Ok(DomainDistribution::nominal()),
        }
    }

    /// What a policy's file says of where it comes from.
    #[must_use]
    pub fn origin(&self, psi: &[f64]) -> Origin {
        // Sensors are named in the policy's record beside the preset.
        let same_budget = |preset: TrainSettings| {
            let simulation = self.training.simulation;
            self.training == TrainSettings { simulation, ..preset }
        };
        let preset = if same_budget(TrainSettings::robust()) {
            "robust"
        } else if same_budget(TrainSettings::quick()) {
            "quick"
        } else if same_budget(TrainSettings::thesis()) {
            "thesis"
        } else {
            "custom"
        };
        Origin {
            model: self.model.name().into(),
            psi: Some(self.psi.with_names(psi)),
            preset: preset.into(),
        }
    }
}

impl Default for SessionSettings {
    fn default() -> Self {
        Self::quick()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::Observation;

    #[test]
    fn the_surrogate_takes_over_when_the_initial_candidates_are_known() {
        let settings = SessionSettings::quick();
        let random = SessionSettings { strategy: StrategyKind::Random, ..settings.clone() };
        let next = |settings: &SessionSettings, data: &[Observation]| {
            settings.search().unwrap().propose(data, 1).unwrap().remove(0)
        };
        let mut data = Vec::new();
        for i in 0..settings.extent.initial_candidates {
            let point = next(&settings, &data);
            assert_eq!(point, next(&random, &data));
            data.push(Observation { point, returns: vec![f64::from(i), f64::from(2 * i)] });
        }
        assert_ne!(next(&settings, &data), next(&random, &data));
    }
}
