use std::path::Path;

use super::Arguments;
use crate::commands::exit::Failure;
use crate::commands::failures;
use crate::estimation::EstimatorSettings;
use crate::policy::{
    ClassicalController, ClassicalGains, EXCITATION_STEPS, Excitation, ExcitationShape, Policy,
    Randomisation, SimulatedSensors,
};
use crate::qube::{MAX_STEPS, PlantModel};
use crate::rig::RigError;

/// The controller of the rollouts, with the contents of the policy files from which they load it.
pub struct RunController {
    /// Name for the headers of the recordings.
    pub name: String,
    /// Contents of the policy files. The rollouts take them in turn: an excitation has two, which
    /// start in opposite directions.
    pub files: Vec<Vec<u8>>,
    /// Most ticks of a rollout under the controller.
    pub steps: u32,
    /// Notes for the operator before the first rollout.
    pub notes: Vec<String>,
    /// Policy of a file, or the classical controller; `None` for an excitation.
    pub policy: Option<Policy>,
}

impl RunController {
    /// Loads the controller that the arguments choose: an excitation or a policy.
    pub fn chosen(arguments: &Arguments) -> Result<Self, Failure> {
        if let Some(argument) = arguments.excite {
            let shape = ExcitationShape::from(argument);
            let excitation = |rollout| Excitation::of_rollout(shape, arguments.volts, rollout);
            let file = |rollout| Policy::Excitation(excitation(rollout)).to_bytes();
            return Ok(Self {
                name: format!("excitation by {}", shape.name()),
                files: [0, 1].map(file).into(),
                steps: EXCITATION_STEPS,
                notes: Vec::new(),
                policy: None,
            });
        }
        let path = arguments.policy.as_deref().unwrap_or(Path::new(""));
        let policy = policy(path)?;
        let name = path.to_string_lossy().into_owned();
        let truth = trained_on_true_states(&policy).then(|| {
            let guard = if trained_in_the_box_alone(&policy) { " within the box alone" } else { "" };
            format!(
                "note: {name} was trained on true states{guard}, and no Qube measures true states: with encoders \
                 and estimator the pendulum may fall at once. `train --preset robust` makes policies for a Qube"
            )
        });
        let known = randomisation(&policy)
            .map(|drawn| format!("{name} was trained in simulations of {}", drawn.summary()));
        let notes = known.into_iter().chain(truth).collect();
        let files = vec![policy.to_bytes()];
        Ok(Self { files, name, steps: MAX_STEPS as u32, notes, policy: Some(policy) })
    }

    /// Checks that the policy was made for this plant; an excitation fits every plant.
    pub fn check_plant(&self, plant: &PlantModel) -> Result<(), Failure> {
        let checked = self.policy.as_ref().map_or(Ok(()), |policy| policy.check_plant(plant));
        checked.map_err(|other| Failure::usage(format!("{}: {other}", self.name)))
    }

    /// Returns the note that the policy gets another estimator, or another velocity filter, than in
    /// its training; `None` where its file names this one or none. The models of two observers are
    /// not compared, because each describes its own Qube.
    pub fn estimator_note(&self, used: &EstimatorSettings) -> Option<String> {
        let Some(Policy::Network(network)) = &self.policy else { return None };
        let SimulatedSensors::Encoders { corner_rad_s, observer, .. } = network.training.sensors
        else {
            return None;
        };
        let filter = |corner_rad_s: f64| format!("a velocity filter of {corner_rad_s} rad/s");
        let (trained, option) = match (observer, used.observer) {
            (Some(_), Some(_)) => return None,
            (None, None) if corner_rad_s == used.corner_rad_s => return None,
            (None, _) => (filter(corner_rad_s), format!("--filter {corner_rad_s}")),
            (Some(_), None) => ("an observer".to_owned(), "--estimator observer".to_owned()),
        };
        let here =
            used.observer.map_or_else(|| filter(used.corner_rad_s), |_| "an observer".into());
        Some(format!(
            "note: {} was trained with {trained}, and here it runs with {here}; {option} selects the estimator of its \
             training",
            self.name
        ))
    }

    /// Contents of the policy file for this rollout; rollouts count from 0.
    pub fn file(&self, rollout: u32) -> &[u8] {
        &self.files[rollout as usize % self.files.len()]
    }
}

/// Loads the policy of this name: a file, or `classical`. Refuses an excitation, which balances
/// nothing, and a file that only names the controller of another program.
pub fn policy(name: &Path) -> Result<Policy, Failure> {
    if name.as_os_str() == "classical" {
        return Ok(Policy::Classical(ClassicalController::new(ClassicalGains::default())));
    }
    let policy = Policy::load(name).map_err(|error| failures::policy(&error))?;
    if let Policy::Excitation(excitation) = &policy {
        let (shape, volts) = (excitation.shape().name(), excitation.limit_v());
        return Err(Failure::usage(format!(
            "{}: it is an excitation for `identify` and no policy: to record it again, give run --excite {shape} \
             --volts {volts} instead of --policy",
            name.display()
        )));
    }
    if let Policy::External(external) = &policy {
        let controller = external.name().to_owned();
        let name = name.display();
        return Err(Failure::usage(format!("{name}: {}", RigError::External { name: controller })));
    }
    Ok(policy)
}

/// Returns the distribution of the simulated Qubes in which a policy was trained, if its file
/// contains it.
pub fn randomisation(policy: &Policy) -> Option<&Randomisation> {
    match policy {
        Policy::Network(policy) => policy.training.randomisation.as_ref(),
        Policy::Classical(_) | Policy::Excitation(_) | Policy::External(_) => None,
    }
}

/// Returns whether the box alone guarded the simulations in which a policy was trained.
fn trained_in_the_box_alone(policy: &Policy) -> bool {
    matches!(policy, Policy::Network(it) if it.training.guard.is_box())
}

/// Returns whether a policy was trained on true states, which no Qube measures.
pub fn trained_on_true_states(policy: &Policy) -> bool {
    matches!(policy, Policy::Network(it) if it.training.sensors == SimulatedSensors::TrueState)
}
