use crate::policy::Network;
use crate::qube::{CONTROL_PERIOD_S, MAX_STEPS, PlantModel, QubeModel, State};
use crate::replay::{MotionLog, MotionSample};
use crate::simulation::{
    LaneStatus, Observations, Pendulums, SensorModel, SimulationSettings, Trajectory,
};

/// Number of Qubes that are simulated side by side.
const LANES: usize = 256;

/// A recorded motion and the policy that made it.
pub struct Demonstration {
    /// Motion and voltages.
    pub log: MotionLog,
    /// Policy of the rollout; `None` where an excitation chose the voltages.
    pub policy: Option<Network>,
}

impl Demonstration {
    /// A template for simulating a rollout that was never recorded: 6 s of a policy that starts at
    /// rest with a hanging pendulum and the arm at `theta` (rad). The log repeats this start and
    /// has no motion.
    pub fn of_policy(policy: &Network, plant: &PlantModel, theta: f64) -> Self {
        let sample = |step| MotionSample {
            time_s: step as f64 * CONTROL_PERIOD_S,
            state: State { theta, ..State::default() },
            voltage_v: 0.0,
        };
        let samples = (0..MAX_STEPS).map(sample).collect();
        let log = MotionLog { samples, plant: *plant };
        Self { log, policy: Some(policy.clone()) }
    }
}

/// A motion in steps of 10 ms: states and voltages.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SampledMotion {
    /// State at each step.
    pub states: Vec<State>,
    /// Voltage from each step to the next, V.
    pub voltages_v: Vec<f64>,
}

impl SampledMotion {
    /// The motion of a recording.
    pub fn recorded(log: &MotionLog) -> Self {
        Self {
            states: log.samples.iter().map(|sample| sample.state).collect(),
            voltages_v: log.samples.iter().map(|sample| sample.voltage_v).collect(),
        }
    }
}

/// Simulates a recorded rollout on each of several Qubes. A policy acts on the observations of the
/// simulated Qube, and the motion has the states that it sees; an excitation has the recorded
/// voltages, and the motion has the true states.
pub fn simulate(
    demonstration: &Demonstration,
    simulation: &SimulationSettings,
    models: &[QubeModel],
) -> Vec<SampledMotion> {
    models
        .chunks(LANES)
        .flat_map(|models| side_by_side(demonstration, simulation, models))
        .collect()
}

fn side_by_side(
    Demonstration { log, policy }: &Demonstration,
    simulation: &SimulationSettings,
    models: &[QubeModel],
) -> Vec<SampledMotion> {
    let recorded = SampledMotion::recorded(log);
    let Some(&first) = recorded.states.first() else { return Vec::new() };
    // A rollout begins at rest: the filter shows a velocity there only after the last edge of an
    // encoder.
    let start = State { theta_dot: 0.0, alpha_dot: 0.0, ..first };
    let (mut policy, simulation) = match policy {
        Some(policy) => {
            (Some(policy.clone()), SimulationSettings { history: policy.history(), ..*simulation })
        }
        // An excitation does not depend on the states, so no sensor is simulated.
        None => (None, SimulationSettings { sensors: SensorModel::TrueState, ..*simulation }),
    };
    let largest_v = simulation.plant.limits.largest_voltage_v;
    let mut pendulums = Pendulums::new(models.len(), &simulation);
    for (lane, &model) in models.iter().enumerate() {
        pendulums.restart(lane, &Trajectory { model, start });
    }
    let lanes = pendulums.lanes();
    let mut observations = vec![0.0; pendulums.observation_size() * lanes];
    let (mut voltages_v, mut rewards) = (vec![0.0; lanes], vec![0.0; lanes]);
    let mut statuses = vec![LaneStatus::Running; lanes];
    let mut motions = vec![SampledMotion::default(); models.len()];
    let mut observed = vec![0.0; pendulums.observation_size()];
    pendulums.observe(&mut observations);
    for &recorded_v in &recorded.voltages_v {
        for lane in 0..models.len() {
            voltages_v[lane] = match &mut policy {
                Some(policy) => {
                    Observations::new(&observations, lanes).copy_lane(lane, &mut observed);
                    policy.voltage_of_observation_v(&observed)
                }
                None => recorded_v as f32,
            };
            let seen = match policy {
                Some(_) => pendulums.seen(lane),
                None => pendulums.state(lane),
            };
            motions[lane].states.push(seen.into());
            // A recording has the voltage that the motor gets, within its limit.
            let applied_v = f64::from(voltages_v[lane]).clamp(-largest_v, largest_v);
            motions[lane].voltages_v.push(applied_v);
        }
        pendulums.step(&voltages_v, &mut rewards, &mut statuses, &mut observations);
    }
    motions
}
