use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::qube::{ModelError, Nonidealities, QubeModel};

/// Smallest corner of the guard's velocity filter, rad/s.
pub const GUARD_CORNER_RAD_S: f64 = 200.0;

/// Largest corner of a velocity filter that is accepted, rad/s. At 100 Hz a corner of 1000 rad/s
/// already filters almost nothing.
pub const LARGEST_CORNER_RAD_S: f64 = 1e6;

/// Settings of the estimator whose state the policy sees.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EstimatorSettings {
    /// Corner of the velocity filter, rad/s; above 0 and up to 1e6. The default is 200. The thesis
    /// uses 50, whose longer lag makes many policies fail (docs/estimation.md). The guard's filter
    /// has this corner, too, but at least [`GUARD_CORNER_RAD_S`]; with an observer, only that
    /// filter has it.
    pub corner_rad_s: f64,
    /// Model observer that replaces the filter for the policy; `None`, which files without this
    /// entry mean, selects the filter.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub observer: Option<ObserverSettings>,
}

/// Settings of an observer with a model of the Qube. The observer predicts with the equations of
/// motion and the voltages that were sent, corrects with the encoders, and returns the state at the
/// instant at which the command being computed will reach the motor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ObserverSettings {
    /// Model of the Qube. Its delay counts from the instant of a sample until the voltage computed
    /// from it acts at the motor.
    pub model: QubeModel,
    /// Standard deviation of the model's error in the arm's acceleration, rad/s^2; above 0 and up
    /// to 1e6.
    pub theta_noise_rad_s2: f64,
    /// Standard deviation of the model's error in the pendulum's acceleration, rad/s^2; above 0 and
    /// up to 1e6.
    pub alpha_noise_rad_s2: f64,
    /// Largest difference between measured and predicted angle, rad; above 0 and up to 10. Beyond
    /// it the observer restarts from the encoders and the guard's filter.
    #[serde(alias = "astray_rad")]
    pub reset_error_rad: f64,
}

/// The reason why estimator settings are invalid.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum SettingsError {
    /// A number is outside its range.
    #[error("{name} = {value}: give a number above 0 and up to {largest}")]
    OutOfRange {
        /// Name of the entry.
        name: &'static str,
        /// Value of the entry.
        value: f64,
        /// Largest accepted value.
        largest: f64,
    },
    /// A number of the observer's model is out of range.
    #[error("observer.model.{0}")]
    Model(#[from] ModelError),
}

impl EstimatorSettings {
    /// Selects the velocity filter with this corner, rad/s.
    #[must_use]
    pub fn filter(corner_rad_s: f64) -> Self {
        Self { corner_rad_s, observer: None }
    }

    /// Selects a model observer.
    #[must_use]
    pub fn observer(observer: ObserverSettings) -> Self {
        Self { observer: Some(observer), ..Self::default() }
    }

    /// Corner of the guard's filter, rad/s: `corner_rad_s`, but at least [`GUARD_CORNER_RAD_S`].
    #[must_use]
    pub fn guard_corner_rad_s(&self) -> f64 {
        self.corner_rad_s.max(GUARD_CORNER_RAD_S)
    }

    /// Returns whether policy and guard see the same state.
    #[must_use]
    pub fn policy_sees_as_guard(&self) -> bool {
        self.observer.is_none() && self.corner_rad_s >= GUARD_CORNER_RAD_S
    }

    /// Checks the settings.
    ///
    /// # Errors
    /// Names the first entry that is out of range.
    pub fn check(&self) -> Result<(), SettingsError> {
        within("corner_rad_s", self.corner_rad_s, LARGEST_CORNER_RAD_S)?;
        let Some(observer) = &self.observer else {
            return Ok(());
        };
        within("observer.theta_noise_rad_s2", observer.theta_noise_rad_s2, 1e6)?;
        within("observer.alpha_noise_rad_s2", observer.alpha_noise_rad_s2, 1e6)?;
        within("observer.reset_error_rad", observer.reset_error_rad, 10.0)?;
        Ok(observer.model.check()?)
    }
}

fn within(name: &'static str, value: f64, largest: f64) -> Result<(), SettingsError> {
    if value > 0.0 && value <= largest {
        Ok(())
    } else {
        Err(SettingsError::OutOfRange { name, value, largest })
    }
}

impl Default for EstimatorSettings {
    fn default() -> Self {
        Self::filter(200.0)
    }
}

impl ObserverSettings {
    /// Default settings with this model.
    #[must_use]
    pub fn of(model: QubeModel) -> Self {
        Self { model, ..Self::default() }
    }

    /// Replaces the delay, s.
    #[must_use]
    pub fn with_delay(self, command_delay_s: f64) -> Self {
        let nonidealities = Nonidealities { command_delay_s, ..self.model.nonidealities };
        Self { model: QubeModel { nonidealities, ..self.model }, ..self }
    }
}

impl Default for ObserverSettings {
    /// The default observes the nominal Qube. The noises are a few tenths of the acceleration that
    /// the motor can produce, the error of a model with name-plate parameters (docs/estimation.md).
    fn default() -> Self {
        Self {
            model: QubeModel::NOMINAL,
            theta_noise_rad_s2: 30.0,
            alpha_noise_rad_s2: 30.0,
            reset_error_rad: 0.1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::DomainParameters;

    #[test]
    fn files_that_name_a_corner_alone_select_the_filter_and_are_written_the_same() {
        let text = "corner_rad_s = 50.0\n";
        let settings: EstimatorSettings = toml::from_str(text).unwrap();
        assert_eq!(settings, EstimatorSettings::filter(50.0));
        assert_eq!(toml::to_string(&settings).unwrap(), text);
        let observer = EstimatorSettings::observer(ObserverSettings::default());
        let text = toml::to_string(&observer).unwrap();
        assert_eq!(toml::from_str::<EstimatorSettings>(&text).unwrap(), observer);
        let short: EstimatorSettings = toml::from_str("[observer]\n").unwrap();
        assert_eq!(short, observer);
    }

    #[test]
    fn the_guard_never_sees_through_a_filter_slower_than_its_own() {
        let observer = EstimatorSettings::observer(ObserverSettings::default());
        for (settings, corner_rad_s, same) in [
            (EstimatorSettings::filter(50.0), 200.0, false),
            (EstimatorSettings::filter(200.0), 200.0, true),
            (EstimatorSettings::filter(300.0), 300.0, true),
            (observer, 200.0, false),
        ] {
            assert_eq!(settings.guard_corner_rad_s(), corner_rad_s);
            assert_eq!(settings.policy_sees_as_guard(), same);
        }
    }

    #[test]
    fn invalid_estimator_settings_are_named() {
        let fine = ObserverSettings::default();
        assert_eq!(EstimatorSettings::observer(fine).check(), Ok(()));
        let parameters = DomainParameters { pendulum_mass_kg: 0.0, ..DomainParameters::NOMINAL };
        for (settings, words) in [
            (EstimatorSettings::filter(f64::NAN), "corner_rad_s"),
            (
                EstimatorSettings::observer(ObserverSettings { theta_noise_rad_s2: 0.0, ..fine }),
                "theta_noise_rad_s2",
            ),
            (EstimatorSettings::observer(fine.with_delay(0.2)), "command_delay_s = 0.2"),
            (
                EstimatorSettings::observer(ObserverSettings {
                    model: QubeModel { parameters, ..fine.model },
                    ..fine
                }),
                "M_p",
            ),
        ] {
            let message = settings.check().unwrap_err().to_string();
            assert!(message.contains(words), "{message}");
        }
    }
}
