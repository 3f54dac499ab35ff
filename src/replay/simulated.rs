use super::{AngleError, MotionLog, OpenLoop};
use crate::qube::{PlantModel, Profile, QubeModel};
use crate::scoring::criterion::{is_about_upright, is_upright};

/// The specimen of a plant that is simulated beside a recorded motion.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedSpecimen {
    /// Parameters and nonidealities of the simulation.
    pub model: QubeModel,
    /// Name for people, with its article, such as `the nominal Qube`.
    pub name: String,
}

impl SimulatedSpecimen {
    /// The nominal specimen of a plant.
    #[must_use]
    pub fn nominal(plant: &PlantModel) -> Self {
        let plant_name =
            if plant.is_qube() { "Qube".to_owned() } else { format!("plant {}", plant.name) };
        Self { model: plant.nominal(), name: format!("the nominal {plant_name}") }
    }

    /// The specimen that a profile describes; `name` is the profile's file or its name.
    #[must_use]
    pub fn of_profile(profile: &Profile, name: &str) -> Self {
        let plant_name = if profile.plant.is_qube() {
            "Qube".to_owned()
        } else {
            format!("plant {}", profile.plant)
        };
        Self { model: profile.model(), name: format!("the {plant_name} of the profile {name}") }
    }
}

/// The distance of a simulation in open loop from the recorded motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimulationError {
    /// Root mean square error over the whole motion.
    pub whole: AngleError,
    /// Root mean square error until the recorded pendulum is first upright; `None` if it is never
    /// upright, or is upright at the start.
    pub until_upright: Option<AngleError>,
    /// True if the simulated pendulum is at some time far from upright while the recorded one is
    /// upright: near upright a small error grows.
    pub falls: bool,
}

impl SimulationError {
    /// Compares a simulation with the motion whose voltages drove it.
    #[must_use]
    pub fn of(log: &MotionLog, open_loop: &OpenLoop) -> Self {
        let samples = &log.samples;
        let first = samples.iter().position(|sample| is_upright(&sample.state));
        let until_upright =
            first.filter(|first| *first > 0).map(|first| open_loop.error_of(&samples[..first]));
        let falls = samples
            .iter()
            .zip(&open_loop.simulated)
            .any(|(sample, simulated)| is_upright(&sample.state) && !is_about_upright(simulated));
        Self { whole: open_loop.rmse, until_upright, falls }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::qube::State;
    use crate::replay::{MotionSample, simulate_from_first_state};

    /// Compares a motion with these angles of the pendulum, rad, with its simulation by the nominal
    /// Qube.
    fn error_of(alphas: [f64; 4]) -> SimulationError {
        let sample = |(index, alpha): (usize, f64)| MotionSample {
            time_s: 0.01 * index as f64,
            state: State { alpha, ..State::default() },
            voltage_v: 0.0,
        };
        let samples = alphas.into_iter().enumerate().map(sample).collect();
        let log = MotionLog { samples, plant: PlantModel::QUBE };
        let open_loop = simulate_from_first_state(&log, &log.plant.nominal()).unwrap();
        SimulationError::of(&log, &open_loop)
    }

    #[test]
    fn the_error_until_upright_leaves_out_later_samples() {
        let error = error_of([0.0, 0.0, PI, PI]);
        assert_eq!(error.until_upright.map(|it| it.alpha_rad), Some(0.0));
        assert!((error.whole.alpha_rad - PI / 2.0_f64.sqrt()).abs() < 1e-9, "{error:?}");
        assert!(error.falls);
        let hangs = error_of([0.0, 0.3, 0.0, 0.0]);
        assert_eq!((hangs.until_upright, hangs.falls), (None, false));
        let balances = error_of([PI; 4]);
        assert_eq!((balances.until_upright, balances.falls), (None, false));
    }

    #[test]
    fn a_simulated_specimen_has_a_name() {
        assert_eq!(SimulatedSpecimen::nominal(&PlantModel::QUBE).name, "the nominal Qube");
        let lab = SimulatedSpecimen::of_profile(&Profile::lab(), "lab");
        assert_eq!(lab.name, "the Qube of the profile lab");
        assert_eq!(lab.model, Profile::lab().model());
    }
}
