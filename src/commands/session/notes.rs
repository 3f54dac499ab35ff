//! Notes for the operator, printed before anything moves.

use super::{Arguments, SessionPreset};
use crate::commands::chosen_device::ChosenDevice;
use crate::commands::command_hints::before_motion;
use crate::commands::config::WITHOUT_IDENTIFICATION;
use crate::commands::printable::print_message;
use crate::estimation::EstimatorSettings;
use crate::rig::RigSettings;
use crate::session::SessionSettings;
use crate::simulation::SensorModel;

/// Prints notes on settings that the operator may not expect: the method that a file chose, and
/// trainings on other states than the policies will see.
pub fn print_notes(arguments: &Arguments, settings: &SessionSettings) {
    let notes = [method_note(arguments, settings), estimators_differ(settings)];
    notes.iter().flatten().for_each(|note| print_message(note));
}

/// The warnings for an operator before a session drives a Qube.
pub fn warnings(
    device: &ChosenDevice,
    rig: &RigSettings,
    settings: &SessionSettings,
) -> Vec<String> {
    let power = device.power_warning();
    // A session with an identification needs no advice to identify the Qube.
    match settings.identification {
        Some(_) => power.map(str::to_owned).into_iter().collect(),
        None => before_motion(power, rig, settings.safety_box.guard).collect(),
    }
}

/// A note for the operator if a new session searches psi because the file of `--config` has no
/// table `[identification]`, and no option chooses a method.
fn method_note(arguments: &Arguments, settings: &SessionSettings) -> Option<String> {
    let path = arguments.config.as_ref()?;
    let by_rule = arguments.method.is_none() && arguments.preset == SessionPreset::Quick;
    (by_rule && settings.identification.is_none()).then(|| {
        format!("note: {}: {WITHOUT_IDENTIFICATION} (--method chooses one)", path.display())
    })
}

/// A note for the operator if the policies are trained on other states than they will see on the
/// Qube: true states, or the states of another estimator.
fn estimators_differ(settings: &SessionSettings) -> Option<String> {
    let trained_on = match settings.training.simulation.sensors {
        SensorModel::Encoders { estimator } if estimator == settings.estimator => return None,
        SensorModel::Encoders { estimator } => described(&estimator),
        SensorModel::TrueState => "true states".into(),
    };
    Some(format!(
        "note: policies are trained on {trained_on} ([training.simulation.sensors]) and will see {} \
         ([estimator])",
        described(&settings.estimator)
    ))
}

fn described(estimator: &EstimatorSettings) -> String {
    match &estimator.observer {
        None => format!("a filter of {} rad/s", estimator.corner_rad_s),
        Some(observer) => {
            let delay_ms = 1e3 * observer.model.nonidealities.command_delay_s;
            format!("an observer with a delay of {delay_ms:.1} ms")
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::{Args as _, FromArgMatches as _};

    use super::*;
    use crate::estimation::ObserverSettings;
    use crate::qube::QubeModel;

    #[test]
    fn a_file_without_an_identification_that_changes_the_method_is_noted() {
        let note = |options: &str, settings: SessionSettings| {
            let words = ["session"].into_iter().chain(options.split_whitespace());
            let command = Arguments::augment_args(clap::Command::new("session"));
            let matches = command.try_get_matches_from(words).unwrap();
            method_note(&Arguments::from_arg_matches(&matches).unwrap(), &settings)
        };
        let quick = SessionSettings::quick();
        let message = note("--config mine.toml", quick.clone()).unwrap();
        assert!(message.contains("mine.toml") && message.contains("is bayrn"), "{message}");
        let identification = Some(crate::session::IdentificationSettings::DEFAULT);
        let identified = SessionSettings { identification, ..quick.clone() };
        assert_eq!(note("--config mine.toml", identified), None);
        for options in ["--method bayrn --config mine.toml", "--preset thesis --config mine.toml"] {
            assert_eq!(note(options, quick.clone()), None, "{options}");
        }
        assert_eq!(note("--method bayrn", quick), None);
    }

    #[test]
    fn a_policy_that_will_see_other_states_than_in_training_is_noted() {
        let observer = EstimatorSettings::observer(ObserverSettings::of(QubeModel::NOMINAL));
        let quick = SessionSettings::quick();
        assert_eq!(estimators_differ(&quick), None);
        assert_eq!(estimators_differ(&quick.clone().seen_through(observer)), None);
        let differing = SessionSettings { estimator: observer, ..quick.clone() };
        let message = estimators_differ(&differing).unwrap();
        assert!(
            message.contains("filter of 200 rad/s") && message.contains("observer"),
            "{message}"
        );
        let mut on_true_states = quick;
        on_true_states.training.simulation.sensors = SensorModel::TrueState;
        let message = estimators_differ(&on_true_states).unwrap();
        assert!(message.contains("true states"), "{message}");
    }
}
