//! The check of a session's settings against their ranges.

use toml::{Table, Value};

use super::SessionSettings;
use crate::learning::TrainError;
use crate::qube::MAX_STEPS;
use crate::safety::SafetyBox;
use crate::search::SearchError;
use crate::simulation::{ProfileSettings, PsiError, PsiTarget, SensorModel, box_file};

/// Advice when a session cannot be resumed, because its settings are of an earlier version.
pub(super) const NEW_SESSION_ADVICE: &str =
    "a session cannot change its settings, so begin a new one";

impl SessionSettings {
    /// Checks the settings.
    ///
    /// # Errors
    /// Describes the first invalid setting.
    pub fn check(&self) -> Result<(), String> {
        self.check_limits()?;
        self.estimator.check().map_err(|error| format!("estimator.{error}"))?;
        if let Some(ProfileSettings { model, spread, .. }) = &self.profile {
            model.check().map_err(|error| format!("profile.model.{error}"))?;
            if !(0.0..=1.0).contains(spread) {
                return Err(format!("profile.spread = {spread}: give a number from 0 to 1"));
            }
        }
        self.base_distribution().map_err(|error| match error {
            PsiError::NoProfile => format!("model = \"{}\": {error}", self.model.name()),
            other => other.to_string(),
        })?;
        let sees_truth = self.training.simulation.sensors == SensorModel::TrueState;
        if self.psi.has(PsiTarget::Filter) && sees_truth {
            return Err("psi has filter, but training.simulation.sensors shows true states: \
                        make it type = \"encoders\""
                .into());
        }
        let counts = [
            ("extent.initial_candidates", self.extent.initial_candidates, 1..=1000),
            ("extent.iterations", self.extent.iterations, 0..=1000),
            ("extent.rollouts", self.extent.rollouts, 1..=1000),
            ("extent.verification_rollouts", self.extent.verification_rollouts, 1..=1000),
            ("extent.steps", self.extent.steps, 1..=MAX_STEPS as u32),
            ("extent.repetitions", self.extent.repetitions, 0..=1000),
            ("extent.pending", self.extent.pending, 0..=1000),
        ];
        for (name, value, range) in counts {
            if !range.contains(&value) {
                let (least, most) = range.into_inner();
                return Err(format!("{name} = {value}: give a number from {least} to {most}"));
            }
        }
        if let Some(identification) = &self.identification {
            identification.check()?;
        }
        self.emulated.check().map_err(|error| format!("emulated.{error}"))?;
        for (number, rig) in (1..).zip(&self.rigs) {
            rig.emulated
                .check()
                .map_err(|error| format!("the emulated of [[rigs]] number {number}: {error}"))?;
        }
        self.training.check().map_err(|error| match error {
            TrainError::Setting { name, value, bound } => {
                format!("training.{name} = {value}: it must be {bound}")
            }
            TrainError::Estimator(error) => {
                format!("training.simulation.sensors.estimator.{error}")
            }
            other => other.to_string(),
        })?;
        self.search().map_err(|error| match error {
            SearchError::BadSettings { reason } => format!("bayrn.{reason}"),
            other => other.to_string(),
        })?;
        // The checks above know the ranges of single settings. This one bounds every number that is
        // not an integer, also of settings without a range of their own.
        Table::try_from(self).map_or(Ok(()), |all| check_numbers("", &Value::Table(all)))
    }

    /// Checks the limits of both boxes and the settings of homing: each must be valid, and no limit
    /// of a box wider than the task's. No file may widen a limit, not even for an emulated Qube.
    ///
    /// # Errors
    /// Describes the first invalid setting.
    pub fn check_limits(&self) -> Result<(), String> {
        let of_the_task = SafetyBox::GUARDED;
        self.safety_box.check_within(&of_the_task).map_err(of_file)?;
        let simulated = &self.training.simulation.safety_box;
        simulated
            .check_within(&of_the_task)
            .map_err(|error| format!("training.simulation.{}", of_file(error)))?;
        let homing = self.homing.of_plant(&self.training.simulation.plant);
        homing.check().map_err(|error| format!("homing.{error}"))
    }

    /// Checks that a session with these settings can be resumed.
    ///
    /// # Errors
    /// The session or its simulations ran under a guard that exists only to replay old recordings.
    pub fn check_resumable(&self) -> Result<(), String> {
        let simulated = self.training.simulation.safety_box.guard;
        for (key, guard) in
            [("safety_box", self.safety_box.guard), ("training.simulation.safety_box", simulated)]
        {
            if let Err(gone) = guard.check_driven() {
                return Err(format!("{key}.{gone}: {NEW_SESSION_ADVICE}"));
            }
        }
        Ok(())
    }

    /// Checks that a new session may begin with these settings. The error describes why not.
    pub(super) fn check_begun(&self) -> Result<(), String> {
        if !self.training.simulation.safety_box.guard.is_box() {
            return Err("training.simulation.safety_box.guard: simulations know no guard but the \
                        box: leave it out"
                .into());
        }
        if !self.rigs.is_empty() {
            return Err(
                "rigs: the command line names the Qubes of a new session: leave [[rigs]] out"
                    .into(),
            );
        }
        let guard = self.safety_box.guard.check_driven();
        guard.map_err(|gone| format!("safety_box.{gone}, or leave it out"))
    }
}

/// Largest absolute value of a floating-point number in the settings.
const LARGEST_NUMBER: f64 = 1e6;

/// The one number of the settings that may be infinite; infinity means that there is no limit.
const MAY_BE_INFINITE: &str = "training.largest_gradient_norm";

/// Checks that no floating-point number of these settings is NaN or exceeds [`LARGEST_NUMBER`] in
/// magnitude. It leaves out [`MAY_BE_INFINITE`], which the training's own check covers.
fn check_numbers(key: &str, value: &Value) -> Result<(), String> {
    match value {
        Value::Float(number) if number.abs() <= LARGEST_NUMBER || key == MAY_BE_INFINITE => Ok(()),
        Value::Float(number) => Err(format!(
            "{key} = {number}: give a number from -{LARGEST_NUMBER} to {LARGEST_NUMBER}"
        )),
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

/// An error of a safety box in words, with the limit under its name in files.
fn of_file(wrong: impl ToString) -> String {
    let wrong = wrong.to_string();
    let renamed = box_file::NAMES.iter().find_map(|(bare, name)| {
        let value = wrong.strip_prefix(&format!("safety_box.{bare} "))?;
        Some(format!("safety_box.{name} {value}"))
    });
    renamed.unwrap_or(wrong)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn values_that_cannot_be_are_named() {
        for (text, name) in [
            ("[estimator]\ncorner_rad_s = 0.0\n", "estimator.corner_rad_s"),
            ("[safety_box]\ntheta = nan\n", "safety_box.theta"),
            ("[extent]\nrollouts = 0\n", "extent.rollouts"),
            ("model = \"opt-profile\"\n", "[profile]"),
            ("model = \"nominal\"\n", "nominal has no psi to search"),
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
