use serde::{Deserialize, Serialize};

use super::TrainSettings;

/// The named settings that a training's settings come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// [`TrainSettings::robust`].
    Robust,
    /// [`TrainSettings::quick`].
    Quick,
    /// [`TrainSettings::thesis`].
    Thesis,
    /// Settings that equal no preset.
    Custom,
}

impl Preset {
    /// The presets that have settings: all but [`Self::Custom`].
    pub const NAMED: [Self; 3] = [Self::Robust, Self::Quick, Self::Thesis];

    /// The name in files and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Robust => "robust",
            Self::Quick => "quick",
            Self::Thesis => "thesis",
            Self::Custom => "custom",
        }
    }

    /// A description for people.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Self::Robust => "Half a minute, with a real Qube's encoders and velocity filter",
            Self::Quick => "A few seconds, on true states in the thesis's box",
            Self::Thesis => {
                "Published budget, on true states in the thesis's box: 100 updates of 48 000 \
                 transitions"
            }
            Self::Custom => "Settings of your own",
        }
    }

    /// The preset's settings; for [`Self::Custom`], the settings `custom`.
    #[must_use]
    pub fn settings_or(self, custom: TrainSettings) -> TrainSettings {
        match self {
            Self::Robust => TrainSettings::robust(),
            Self::Quick => TrainSettings::quick(),
            Self::Thesis => TrainSettings::thesis(),
            Self::Custom => custom,
        }
    }

    /// The preset that equals these settings in everything but the simulation and the number of
    /// threads; [`Self::Custom`] if there is none. The simulation may differ, because a policy's
    /// file records the sensors beside the preset.
    #[must_use]
    pub fn of(settings: &TrainSettings) -> Self {
        let has_its_budget = |preset: &Self| {
            let named = preset.settings_or(settings.clone());
            // The number of threads changes no result.
            let TrainSettings { simulation, threads, .. } = *settings;
            *settings == TrainSettings { simulation, threads, ..named }
        };
        Self::NAMED.into_iter().find(has_its_budget).unwrap_or(Self::Custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::SimulationSettings;

    #[test]
    fn settings_keep_their_preset_in_any_simulation() {
        for preset in Preset::NAMED {
            let settings = preset.settings_or(TrainSettings::default());
            assert_eq!(Preset::of(&settings), preset);
            let simulation = SimulationSettings { history: 4, ..settings.simulation };
            assert_eq!(Preset::of(&TrainSettings { simulation, ..settings.clone() }), preset);
            let own = TrainSettings { updates: settings.updates + 1, ..settings };
            assert_eq!(Preset::of(&own), Preset::Custom);
            assert_eq!(toml::Value::try_from(preset).unwrap().as_str(), Some(preset.name()));
        }
    }
}
