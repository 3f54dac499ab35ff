//! The check of a session's settings against their ranges.

use toml::{Table, Value};

use super::extent::MOST_ROLLOUTS;
use super::{Extent, SessionSettings, SettingError};
use crate::qube::MAX_STEPS;
use crate::safety::SafetyBox;
use crate::search::StrategyKind;
use crate::simulation::{ProfileSettings, PsiError, PsiTarget, SensorModel};

impl SessionSettings {
    /// Checks the settings.
    ///
    /// # Errors
    /// The first invalid setting.
    pub fn check(&self) -> Result<(), SettingError> {
        self.check_limits()?;
        self.estimator.check().map_err(SettingError::Estimator)?;
        if let Some(ProfileSettings { model, spread, .. }) = &self.profile {
            model.check().map_err(SettingError::Profile)?;
            SettingError::in_range("profile.spread", *spread, [0.0, 1.0])?;
        }
        self.base_distribution().map_err(|source| match source {
            PsiError::NoProfile => SettingError::NoProfile { model: self.model, source },
            other => SettingError::Distribution(other),
        })?;
        let sees_truth = self.training.simulation.sensors == SensorModel::TrueState;
        if self.psi.has(PsiTarget::Filter) && sees_truth {
            return Err(SettingError::FilterOfTrueStates);
        }
        let counts = [
            ("initial_candidates", self.extent.initial_candidates, [1, 1000]),
            ("iterations", self.extent.iterations, [0, 1000]),
            ("rollouts", self.extent.rollouts, [1, 1000]),
            ("verification_rollouts", self.extent.verification_rollouts, [1, 1000]),
            ("steps", self.extent.steps, [1, MAX_STEPS as u32]),
            ("repetitions", self.extent.repetitions, [0, 1000]),
            ("pending", self.extent.pending, [0, 1000]),
        ];
        for (name, value, range) in counts {
            let key = format!("extent.{name}");
            SettingError::in_range(key, value.into(), range.map(f64::from))?;
        }
        if let Some(identification) = &self.identification {
            identification.check()?;
            self.check_around_identified()?;
        }
        let rollouts = self.most_rollouts();
        if rollouts > MOST_ROLLOUTS {
            return Err(SettingError::TooManyRollouts { rollouts });
        }
        self.emulated.check().map_err(SettingError::Emulated)?;
        for (rig, settings) in (1..).zip(&self.rigs) {
            let checked = settings.emulated.check();
            checked.map_err(|source| SettingError::EmulatedRig { rig, source })?;
        }
        self.training.check().map_err(SettingError::Training)?;
        self.search().map_err(SettingError::Search)?;
        // The checks above cover the ranges of single settings. This one bounds the numbers that
        // are not integers, also of settings without a range of their own.
        Table::try_from(self).map_or(Ok(()), |all| check_numbers("", &Value::Table(all)))
    }

    /// Largest number of rollouts of the search and of the verifications. A search around an
    /// identified Qube may verify each of its candidates; a Qube that cannot be identified is
    /// searched as an unknown one.
    fn most_rollouts(&self) -> u32 {
        let Extent { initial_candidates, iterations, rollouts, verification_rollouts, .. } =
            self.extent;
        let of_unknown = (initial_candidates + iterations) * rollouts + 2 * verification_rollouts;
        let of_identified = self
            .identification
            .map_or(0, |plan| plan.candidates * (plan.rollouts + verification_rollouts));
        of_unknown.max(of_identified)
    }

    /// Checks the settings on which the end of a search around an identified Qube depends.
    fn check_around_identified(&self) -> Result<(), SettingError> {
        if self.strategy != StrategyKind::BayRn {
            return Err(SettingError::NoSurrogate { strategy: self.strategy });
        }
        match self.extent.steps {
            steps if steps < MAX_STEPS as u32 => Err(SettingError::ShortRollouts { steps }),
            _ => Ok(()),
        }
    }

    /// Checks the limits of both boxes and the settings of homing: each must be valid, and no limit
    /// of a box wider than the task's. No file may widen a limit, not even for an emulated Qube.
    ///
    /// # Errors
    /// The first invalid setting.
    pub fn check_limits(&self) -> Result<(), SettingError> {
        let of_the_task = SafetyBox::GUARDED;
        self.safety_box.check_within(&of_the_task).map_err(SettingError::SafetyBox)?;
        let simulated = &self.training.simulation.safety_box;
        simulated.check_within(&of_the_task).map_err(SettingError::SimulatedBox)?;
        let homing = self.homing.of_plant(&self.training.simulation.plant);
        homing.check().map_err(SettingError::Homing)
    }

    /// Checks that a session with these settings can be resumed.
    ///
    /// # Errors
    /// The session or its simulations ran under a guard that exists only to replay old recordings.
    pub fn check_resumable(&self) -> Result<(), SettingError> {
        let simulated = self.training.simulation.safety_box.guard;
        for (key, guard) in
            [("safety_box", self.safety_box.guard), ("training.simulation.safety_box", simulated)]
        {
            let checked = guard.check_driven();
            checked.map_err(|source| SettingError::BegunUnderOldGuard { key, source })?;
        }
        Ok(())
    }

    /// Checks that a new session may begin with these settings.
    ///
    /// # Errors
    /// The first setting with which no new session may begin.
    pub(super) fn check_begun(&self) -> Result<(), SettingError> {
        // A part of an experiment may have a larger seed, which follows from the experiment's.
        if i64::try_from(self.seed).is_err() {
            return Err(SettingError::SeedBeyondToml { seed: self.seed });
        }
        if !self.training.simulation.safety_box.guard.is_box() {
            return Err(SettingError::GuardOfSimulations);
        }
        if !self.rigs.is_empty() {
            return Err(SettingError::RigsInFile);
        }
        self.safety_box.guard.check_driven().map_err(SettingError::OldGuard)
    }
}

/// Largest absolute value of a floating-point number in the settings.
const LARGEST_NUMBER: f64 = 1e6;

/// The one number of the settings that may be infinite; infinity means that there is no limit.
const MAY_BE_INFINITE: &str = "training.largest_gradient_norm";

/// Checks that no floating-point number of these settings is NaN or exceeds [`LARGEST_NUMBER`] in
/// magnitude. It leaves out [`MAY_BE_INFINITE`], which the training's own check covers.
fn check_numbers(key: &str, value: &Value) -> Result<(), SettingError> {
    match value {
        Value::Float(_) if key == MAY_BE_INFINITE => Ok(()),
        Value::Float(number) => {
            SettingError::in_range(key, *number, [-LARGEST_NUMBER, LARGEST_NUMBER])
        }
        Value::Array(entries) => (1..)
            .zip(entries)
            .try_for_each(|(number, entry)| check_numbers(&format!("{key}[{number}]"), entry)),
        Value::Table(table) => table.iter().try_for_each(|(name, value)| {
            let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
            check_numbers(&key, value)
        }),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::session::IdentificationSettings;

    #[test]
    fn more_rollouts_than_a_ledger_has_room_for_are_refused() {
        let plan = IdentificationSettings::DEFAULT;
        let checked = |[initial_candidates, iterations, rollouts]: [u32; 3], plan| {
            let extent = Extent { initial_candidates, iterations, rollouts, ..Extent::QUICK };
            let settings =
                SessionSettings { extent, identification: plan, ..SessionSettings::quick() };
            settings.check().map_err(|refused| refused.to_string())
        };
        assert_eq!(checked([1000, 1000, 49], None), Ok(()));
        assert_eq!(checked([1000, 1000, 49], Some(plan)), Ok(()));
        let refused = checked([1000, 1000, 1000], None).unwrap_err();
        assert!(refused.contains("extent: the session may make 2000010 rollouts"), "{refused}");
        let verified = IdentificationSettings { candidates: 1000, rollouts: 96, ..plan };
        let refused = checked([6, 4, 2], Some(verified)).unwrap_err();
        assert!(refused.contains("101000 rollouts") && refused.contains("100000"), "{refused}");
    }

    #[test]
    fn a_new_session_has_a_seed_that_every_toml_file_can_hold() {
        let checked = |seed| SessionSettings { seed, ..SessionSettings::quick() }.check_begun();
        assert!(checked(i64::MAX as u64).is_ok());
        let refused = checked(i64::MAX as u64 + 1).unwrap_err().to_string();
        assert!(refused.starts_with("seed = 9223372036854775808"), "{refused}");
    }

    #[test]
    fn rollouts_around_an_identified_qube_are_as_long_as_simulations() {
        for (steps, is_long_enough) in [(300, false), (599, false), (600, true)] {
            let extent = Extent { steps, ..Extent::QUICK };
            let unidentified = SessionSettings { extent, ..SessionSettings::quick() };
            assert!(unidentified.check().is_ok(), "{steps}");
            let identification = Some(IdentificationSettings::DEFAULT);
            let identified = SessionSettings { identification, ..unidentified };
            assert_eq!(identified.check().is_ok(), is_long_enough, "{steps}");
        }
    }

    #[test]
    fn only_a_strategy_with_a_surrogate_may_search_around_an_identified_qube() {
        for strategy in StrategyKind::ALL {
            let unidentified = SessionSettings { strategy, ..SessionSettings::quick() };
            assert!(unidentified.check().is_ok(), "{strategy}");
            let identification = Some(IdentificationSettings::DEFAULT);
            let identified = SessionSettings { identification, ..unidentified };
            assert_eq!(identified.check().is_ok(), strategy == StrategyKind::BayRn, "{strategy}");
        }
    }

    #[test]
    fn an_invalid_value_is_named() {
        for (text, name) in [
            ("[estimator]\ncorner_rad_s = 0.0\n", "estimator.corner_rad_s"),
            ("[safety_box]\ntheta = nan\n", "safety_box.theta"),
            ("[extent]\nrollouts = 0\n", "extent.rollouts"),
            ("[extent]\niterations = 1000\nrollouts = 1000\n", "my.toml, line 1: extent: "),
            ("model = \"opt-profile\"\n", "[profile]"),
            ("model = \"nominal\"\n", "nominal has no psi to search"),
            (
                "[extent]\nsteps = 599\n[identification]\ncandidates = 2\n",
                "my.toml, line 2: extent.steps = 599",
            ),
            (
                "strategy = \"cem\"\n[identification]\ncandidates = 2\n",
                "my.toml, line 1: strategy = \"cem\"",
            ),
            ("preset = \"fast\"\n", "fast"),
            ("[[psi]]\nname = \"mean_M_x\"\n", "mean_M_x"),
            ("psi = []\n", "no entry"),
            (
                "[safety_box]\nguard = \"envelope\"\n",
                "my.toml, line 2: safety_box.guard = \"envelope\" is only for replays of old recordings: give \
                 guard = \"foresight\", or leave it out",
            ),
            (
                "[[psi]]\nname = \"filter\"\n[training.simulation.sensors]\ntype = \"true_state\"\n",
                "filter",
            ),
        ] {
            let overridden =
                SessionSettings::thesis().overridden_by_text(text, Path::new("my.toml"));
            let message = overridden.unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
        }
    }
}
