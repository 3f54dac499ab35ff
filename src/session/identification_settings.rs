use serde::{Deserialize, Serialize};

use super::SettingError;

/// The settings of a session that identifies its Qube first and then searches around the identified
/// model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IdentificationSettings {
    /// Number of recordings under an excitation, of 10 s each.
    pub excitations: u32,
    /// Largest voltage of an excitation of a Qube, V. Another plant gets the voltage that moves its
    /// arm in the same way.
    pub excitation_v: f64,
    /// Largest number of candidates. With 1, a policy is trained for the identified Qube and no
    /// search follows.
    pub candidates: u32,
    /// Number of rollouts of each candidate.
    pub rollouts: u32,
    /// Standard deviation of each quantity in the simulations, as a fraction of its value, in
    /// addition to the identification's errors. It stands for the errors of the model itself.
    pub spread: f64,
    /// Number of trainings of each candidate, which differ in their seed; the best policy in
    /// simulations is kept.
    pub trainings: u32,
}

impl IdentificationSettings {
    /// One excitation, and up to ten candidates with two trainings and one rollout each.
    pub const DEFAULT: Self = Self {
        excitations: 1,
        excitation_v: 1.5,
        candidates: 10,
        rollouts: 1,
        spread: 0.1,
        trainings: 2,
    };

    /// Checks that every setting is in its range.
    ///
    /// # Errors
    /// The first setting that is out of its range.
    pub fn check(&self) -> Result<(), SettingError> {
        for (name, value, range) in [
            ("excitations", self.excitations.into(), [1.0, 10.0]),
            ("candidates", self.candidates.into(), [1.0, 1000.0]),
            ("rollouts", self.rollouts.into(), [1.0, 100.0]),
            ("trainings", self.trainings.into(), [1.0, 64.0]),
            ("excitation_v", self.excitation_v, [0.1, 3.0]),
            ("spread", self.spread, [0.0, 1.0]),
        ] {
            SettingError::in_range(format!("identification.{name}"), value, range)?;
        }
        Ok(())
    }
}

impl Default for IdentificationSettings {
    fn default() -> Self {
        Self::DEFAULT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_out_of_range_is_named() {
        assert!(IdentificationSettings::DEFAULT.check().is_ok());
        let default = IdentificationSettings::DEFAULT;
        for (wrong, name) in [
            (
                IdentificationSettings { excitations: 0, ..default },
                "identification.excitations = 0",
            ),
            (IdentificationSettings { spread: f64::NAN, ..default }, "identification.spread = NaN"),
            (IdentificationSettings { excitation_v: 9.0, ..default }, "excitation_v = 9"),
        ] {
            let reason = wrong.check().unwrap_err().to_string();
            assert!(reason.contains(name) && reason.contains("from"), "{reason}");
        }
    }
}
