use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use super::{EmulatedQubeSettings, Extent, IdentificationSettings};
use crate::control::{HomingMethod, HomingSettings};
use crate::estimation::EstimatorSettings;
use crate::learning::{Origin, Preset, TrainSettings};
use crate::qube::{PlantModel, Profile};
use crate::safety::{Guard, SafetyBox};
use crate::search::{BayRn, BayRnSettings, Observation, SearchError, Strategy, StrategyKind};
use crate::simulation::{
    Direction, DomainDistribution, Family, Model, ProfileSettings, Psi, PsiError, PsiSpace,
    SensorModel, SimulationSettings, box_file,
};
use crate::surrogate::{GaussianProcess, SearchBox};

/// A rig of a session that several rigs share.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SharedRig {
    /// Device as it was named when the session began.
    pub device: String,
    /// Settings of the emulated Qube, used if the device is one.
    pub emulated: EmulatedQubeSettings,
    /// Method by which the rig was homed when the session began; `None` for the method of the
    /// session's settings.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub homing_method: Option<HomingMethod>,
}

/// Number of initial candidates of a search around an identified Qube. The first is trained on
/// simulations exactly as identified; the other two show the surrogate how the return depends on
/// psi.
pub(super) const INITIAL_AROUND: u32 = 3;

/// The settings of a session, as `session.toml` contains them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SessionSettings {
    /// Name of the session.
    pub name: String,
    /// Seed from which every random number follows.
    pub seed: u64,
    /// Model whose psi the search varies; it must be a searched one ([`Model::is_searched`]).
    #[serde(deserialize_with = "searched_model")]
    pub model: Model,
    /// Identified Qube around which the model `opt-profile` is drawn.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub profile: Option<ProfileSettings>,
    /// Search space: the entries of psi and their ranges.
    pub psi: PsiSpace,
    /// Family of the distributions to which psi gives mean and standard deviation.
    pub family: Family,
    /// Numbers of candidates, rollouts and steps.
    pub extent: Extent,
    /// Settings of the identification that comes before the search, which is then around the
    /// identified Qube; `None` if the Qube is not identified. `model` and `psi` are used only
    /// without an identification, or if it fails.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub identification: Option<IdentificationSettings>,
    /// Estimator of the state on the Qube.
    pub estimator: EstimatorSettings,
    /// Safety box; a rollout ends when the state leaves it.
    #[serde(with = "box_file")]
    pub safety_box: SafetyBox,
    /// Homing of the arm.
    pub homing: HomingSettings,
    /// Settings of the emulated Qube, used if the session runs on one.
    pub emulated: EmulatedQubeSettings,
    /// Rigs that share the session and its policies, as the command line named them; empty if there
    /// is one rig.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rigs: Vec<SharedRig>,
    /// Strategy of the search for psi.
    pub strategy: StrategyKind,
    /// Settings of BayRn.
    pub bayrn: BayRnSettings,
    /// Preset that the training's settings come from; `None` in files of versions that did not
    /// record it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub preset: Option<Preset>,
    /// Settings of the training.
    pub training: TrainSettings,
}

impl SessionSettings {
    /// The settings of a session of some minutes: few candidates with two rollouts each, and
    /// the training of the preset `robust`. The base distribution covers the Qubes that an
    /// unidentified Qube may be, with friction, cable and delay, and policies observe their last
    /// two commands, because policies trained in this way transfer best to a real Qube
    /// (docs/learning.md).
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
            identification: None,
            estimator: EstimatorSettings::default(),
            safety_box: SafetyBox::GUARDED,
            homing: HomingSettings::default(),
            emulated: EmulatedQubeSettings::default(),
            rigs: Vec::new(),
            strategy: StrategyKind::BayRn,
            bayrn: BayRnSettings::default(),
            preset: Some(Preset::Robust),
            training: TrainSettings::robust(),
        }
    }

    /// The settings of the thesis: its model, extent and training budget. In contrast to the
    /// thesis, simulations have encoders and their velocity filter, because a policy trained on
    /// true states fails on a real Qube (docs/learning.md).
    #[must_use]
    pub fn thesis() -> Self {
        let training =
            TrainSettings { simulation: SimulationSettings::machine(), ..TrainSettings::thesis() };
        Self {
            model: Model::OptNominal,
            extent: Extent::THESIS,
            preset: Some(Preset::Thesis),
            training,
            ..Self::quick()
        }
    }

    /// The plant that is simulated in training and driven in rollouts.
    #[must_use]
    pub fn plant(&self) -> &PlantModel {
        &self.training.simulation.plant
    }

    /// Converts these settings, which describe Qubes, to another plant: the ranges of psi scale
    /// with the plant's parameters and the limits of theta with its travel, and the emulated plant
    /// has the plant's nominal parameters.
    #[must_use]
    pub fn of_plant(mut self, plant: &PlantModel) -> Self {
        self.psi = self.psi.of_plant(plant);
        self.safety_box = self.safety_box.within_travel(plant);
        self.training.simulation = self.training.simulation.of_plant(plant);
        self.emulated.model = plant.nominal();
        self
    }

    /// Selects the guard of rollouts.
    #[must_use]
    pub fn with_guard(mut self, guard: Guard) -> Self {
        self.safety_box.guard = guard;
        self
    }

    /// Selects the estimator of the rollouts and of the simulations. Simulations that show policies
    /// the true state continue to do so.
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

    /// The settings of the search around an identified Qube. Simulations are drawn from the
    /// `latest` profile and its errors; psi shifts their means along the directions of the errors
    /// of the `first` one, so that a shift moves them by the same amounts around each profile. A
    /// psi still stands for other simulations around another profile; the surrogate ignores this
    /// and treats each return as if its policy had been trained around the latest profile.
    #[must_use]
    pub fn around(self, plan: &IdentificationSettings, first: &Profile, latest: &Profile) -> Self {
        let axes = Direction::of_errors(first, self.plant());
        let psi = PsiSpace::of_posterior(axes.len());
        let profile =
            ProfileSettings { axes, ..ProfileSettings::of(latest, self.plant(), plan.spread) };
        let extent = Extent {
            initial_candidates: INITIAL_AROUND.min(plan.candidates),
            rollouts: plan.rollouts,
            ..self.extent
        };
        Self { model: Model::OptProfile, profile: Some(profile), psi, extent, ..self }
    }

    /// The strategy that chooses psi.
    ///
    /// # Errors
    /// The settings are invalid for the strategy.
    pub fn search(&self) -> Result<Box<dyn Strategy>, SearchError> {
        self.strategy.build(&self.search_box()?, &self.bayrn(), self.seed)
    }

    /// The surrogate that the strategy fits to data; `None` for a strategy without one.
    ///
    /// # Errors
    /// The settings are invalid for the strategy, or the data cannot be fitted.
    pub fn surrogate(&self, data: &[Observation]) -> Result<Option<GaussianProcess>, SearchError> {
        if self.strategy != StrategyKind::BayRn {
            return Ok(None);
        }
        self.bayesian_search()?.surrogate(data).map(Some)
    }

    /// The search by BayRn, whose surrogate also estimates the gain of one more candidate.
    ///
    /// # Errors
    /// The settings are invalid for BayRn.
    pub(super) fn bayesian_search(&self) -> Result<BayRn, SearchError> {
        BayRn::new(self.search_box()?, self.bayrn(), self.seed)
    }

    fn search_box(&self) -> Result<SearchBox, SearchError> {
        Ok(SearchBox::new(self.psi.lower(), self.psi.upper())?)
    }

    fn bayrn(&self) -> BayRnSettings {
        let initial_points = self.extent.initial_candidates as usize;
        BayRnSettings { initial_points, ..self.bayrn.clone() }
    }

    /// Selects the training of a preset; the settings of the simulation stay.
    #[must_use]
    pub fn trained_with(mut self, preset: Preset) -> Self {
        let simulation = self.training.simulation;
        self.training = TrainSettings { simulation, ..preset.settings_or(self.training) };
        self.preset = Some(preset);
        self
    }

    /// The distribution of simulations for one psi.
    ///
    /// # Errors
    /// The model needs a profile and there is none, or a value cannot be simulated.
    pub fn distribution(&self, psi: &Psi) -> Result<DomainDistribution, PsiError> {
        self.model.distribution(self.plant(), self.family, self.profile.as_ref(), Some(psi))
    }

    /// The settings of simulations for one psi: the training's settings, with the corner of the
    /// velocity filter from psi if psi has one.
    #[must_use]
    pub fn simulation(&self, psi: &Psi) -> SimulationSettings {
        self.training.simulation.shaped_by(psi)
    }

    /// The base distribution that the search varies.
    ///
    /// # Errors
    /// The model needs a profile and there is none, or a value cannot be simulated.
    pub fn base_distribution(&self) -> Result<DomainDistribution, PsiError> {
        self.model.base_distribution(self.plant(), self.family, self.profile.as_ref())
    }

    /// The origin that the file of a policy trained for this psi records.
    #[must_use]
    pub fn origin(&self, psi: &Psi) -> Origin {
        let (model, preset) = (self.model.name().into(), self.preset().name().into());
        Origin { model, psi: Some(psi.clone()), preset }
    }

    /// The preset that the training's settings come from; if none was recorded, it is found by
    /// comparing the settings.
    #[must_use]
    pub fn preset(&self) -> Preset {
        self.preset.unwrap_or_else(|| Preset::of(&self.training))
    }
}

/// Reads the name of a searched model.
fn searched_model<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Model, D::Error> {
    let model = Model::deserialize(deserializer)?;
    if model.is_searched() {
        return Ok(model);
    }
    let (name, searched) = (model.name(), Model::searched_names());
    Err(D::Error::custom(format!("{name} has no psi to search: give one of {searched}")))
}

impl Default for SessionSettings {
    fn default() -> Self {
        Self::quick()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;
    use crate::learning::{curve_csv, train};
    use crate::qube::{DomainParameter, QubeModel};
    use crate::storage::checksum_of;

    #[test]
    fn the_surrogate_takes_over_when_the_initial_candidates_are_known() {
        let settings = SessionSettings::quick();
        let random = SessionSettings { strategy: StrategyKind::Random, ..settings.clone() };
        let next = |settings: &SessionSettings, data: &[Observation]| {
            settings.search().unwrap().propose(data, &[], 1).unwrap().remove(0)
        };
        let mut data = Vec::new();
        for number in 0..settings.extent.initial_candidates {
            let point = next(&settings, &data);
            assert_eq!(point, next(&random, &data));
            let returns = vec![f64::from(number), f64::from(2 * number)];
            data.push(Observation { point, returns });
        }
        assert_ne!(next(&settings, &data), next(&random, &data));
    }

    #[test]
    fn a_shift_moves_the_means_of_the_latest_fit_by_the_errors_of_the_first() {
        let resistance = DomainParameter::MotorResistance;
        let fitted = |ohm: f64, error_ohm: f64| {
            let mut model = QubeModel::NOMINAL;
            model.parameters.set(resistance, ohm);
            let standard_errors = [("R_m".to_owned(), error_ohm)].into();
            Profile { standard_errors, ..Profile::exact("fitted", &model) }
        };
        let (first, latest) = (fitted(8.4, 0.5), fitted(8.7, 0.1));
        let mean_ohm = |latest: &Profile, shift: f64| {
            let plan = IdentificationSettings::DEFAULT;
            let around = SessionSettings::quick().around(&plan, &first, latest);
            let entry = |name: String| if name == "shift_1" { shift } else { 0.0 };
            let point: Vec<f64> = around.psi.names().map(entry).collect();
            let psi = around.psi.psi(&point).unwrap();
            around.distribution(&psi).unwrap().get(resistance).mean()
        };
        for (latest, ohm) in [(&first, 8.4), (&latest, 8.7)] {
            assert!((mean_ohm(latest, 0.0) - ohm).abs() < 1e-9);
            assert!((mean_ohm(latest, 1.0) - ohm - 0.5).abs() < 1e-9);
        }
    }

    /// The first checksum covers the text of the settings; the second covers the policy and the
    /// curve of the first two updates. If a checksum changes, the reproduction of the thesis has
    /// changed.
    #[test]
    fn the_reproduction_of_the_thesis_keeps_its_bytes() {
        let settings = SessionSettings::thesis();
        let text = toml::to_string(&settings).unwrap();
        let middle = settings.psi.lower().into_iter().zip(settings.psi.upper());
        let middle: Vec<f64> = middle.map(|(lower, upper)| 0.5 * (lower + upper)).collect();
        let psi = settings.psi.psi(&middle).unwrap();
        let distribution = settings.distribution(&psi).unwrap();
        let simulation = settings.simulation(&psi);
        let training = TrainSettings { updates: 2, simulation, ..settings.training };
        let going = AtomicBool::new(false);
        let trained = train(&distribution, &training, 1, None, &going, |_| {}).unwrap();
        let result = format!("{:?}{}", trained.final_network, curve_csv(&trained.curve));
        let checksums = [text, result].map(|it| checksum_of(it.as_bytes()));
        assert_eq!(checksums, ["4e4ea45622bbbab1", "a3a95b5a3e850a9d"]);
    }
}
