use std::sync::atomic::Ordering;

use qube_hil::control::{Tick, drive};
use qube_hil::estimation::Calibration;
use qube_hil::qube::{PlantModel, State};
use qube_hil::safety::{Guard, MotorHeat, SafetyBox};
use qube_hil::telemetry::{Ending, Fault, TickRules, TickSettings};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::{Deserialize, Serialize};

use super::attacker::Attacker;
use super::beliefs::DrawnQube;
use super::device::{Part, Qube, Watched};
use super::genes::Genes;
use super::mishap::{Mishap, MishapKind};
use super::plant::Plant;
use super::scenario::{Scenario, Start};

/// Largest error of the arm's middle after homing, rad.
const ZERO_RAD: f64 = 0.02;

/// Longest time for which an episode is observed after its last rollout, ns.
const AFTER_NS: u64 = 3_000_000_000;

/// The result of an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Largest true |theta|, rad.
    pub farthest_rad: f64,
    /// Largest speed at which the arm reached its stop, rad/s; `None` if it did not.
    pub hit_rad_s: Option<f64>,
    /// Part of the episode in which the arm first reached its stop.
    pub hit_in: Option<Part>,
    /// True if a sample was lost, an act was late or a stop was requested. These count only until
    /// the arm has reached its stop.
    #[serde(default)]
    pub went_wrong: bool,
    /// Ending of each rollout.
    pub endings: Vec<Ending>,
    /// Quality as an attack.
    pub score: f64,
}

/// An episode with a line of text for each tick.
#[derive(Clone, Debug)]
pub struct Trace {
    pub outcome: Outcome,
    /// The Qube, the error of the arm's middle, the initial state and the mishaps, as text.
    pub told: String,
    pub lines: Vec<String>,
}

/// The conditions of an episode, read from its genes, or fixed by its scenario.
struct Cast {
    qube: DrawnQube,
    zero_rad: f64,
    state: State,
    pause_ns: u64,
    mishap: Mishap,
    policies: Vec<Attacker>,
}

impl Cast {
    fn new(scenario: &Scenario, genes: &mut Genes) -> Self {
        let qube = match &scenario.qube {
            Some(fixed) => scenario.known.qube(&mut Genes::new(fixed)),
            None => scenario.known.qube(genes),
        };
        let zero_rad = ZERO_RAD * genes.signed();
        let state = match scenario.start {
            Start::Rest | Start::AfterAnother => {
                State { theta: 0.08 * genes.signed(), ..State::default() }
            }
            Start::Disturbed => State {
                theta: 0.6 * genes.signed(),
                alpha: 1.2 * genes.signed(),
                theta_dot: genes.signed(),
                alpha_dot: 4.0 * genes.signed(),
            },
        };
        let pause_ns = (3e8 * genes.unit()) as u64;
        let mishap = Mishap::new(scenario.mishap, genes, scenario.steps);
        let rollouts = if scenario.start == Start::AfterAnother { 2 } else { 1 };
        let policies = (0..rollouts)
            .map(|_| Attacker::new(scenario.moves, scenario.strikes, genes, scenario.steps));
        Self { qube, zero_rad, state, pause_ns, mishap, policies: policies.collect() }
    }
}

/// Number of genes of a scenario.
pub fn gene_count(scenario: &Scenario) -> usize {
    let mut genes = Genes::new(&[]);
    let _ = Cast::new(scenario, &mut genes);
    genes.read()
}

/// The settings of a rollout under attack.
pub fn settings(scenario: &Scenario, guard: Guard) -> TickSettings {
    TickSettings {
        calibration: Calibration::IDENTITY,
        estimator: scenario.estimator(),
        safety_box: SafetyBox { guard, ..SafetyBox::THESIS },
        max_steps: scenario.steps,
        start_theta_rad: 0.0,
        stops: None,
        foresight: (guard == Guard::Foresight).then(|| scenario.known.settings()),
        rules: TickRules::NEWEST,
        plant: PlantModel::QUBE,
    }
}

/// Runs the episode of these genes.
pub fn play(scenario: &Scenario, settings: &TickSettings, genes: &[f64]) -> Outcome {
    run(scenario, settings, genes, false).outcome
}

/// Runs the episode of these genes and describes each tick in a line.
pub fn show(scenario: &Scenario, settings: &TickSettings, genes: &[f64]) -> Trace {
    run(scenario, settings, genes, true)
}

fn run(scenario: &Scenario, settings: &TickSettings, genes: &[f64], shows: bool) -> Trace {
    let cast = Cast::new(scenario, &mut Genes::new(genes));
    let plant = Plant::new(cast.qube, cast.state, scenario.ahead_s);
    let mut qube = Qube::new(plant, cast.mishap, cast.zero_rad);
    if scenario.jitters {
        qube.jitter = Some((ChaCha8Rng::seed_from_u64(scenario.seed), 2_000_000));
    }
    qube.lines = shows.then(Vec::new);
    let (clock, progress, stop) = (qube.clock.clone(), qube.progress.clone(), qube.stop.clone());
    let mut endings = Vec::new();
    for (rollout, policy) in cast.policies.into_iter().enumerate() {
        if rollout > 0 {
            qube.coast(cast.pause_ns);
            stop.store(false, Ordering::Relaxed);
            // The same mishap may occur in each rollout.
            qube.mishap = cast.mishap;
        }
        progress.start();
        qube.rollout_began_ns = qube.plant.now_ns;
        let mut motion =
            Watched { motion: Tick::new(settings, policy), progress: progress.clone() };
        let Ok(report) =
            drive(&mut qube, &clock, &mut motion, &mut MotorHeat::default(), None, &stop)
        else {
            break;
        };
        endings.push(report.outcome.ending);
        if qube.hit_in.is_some() || report.disarmed.is_err() {
            break;
        }
    }
    qube.coast(AFTER_NS);
    let plant = &qube.plant;
    let headed_rad = plant.headed_rad.min(4.0);
    let score = plant.farthest_rad + 0.2 * headed_rad + 0.01 * plant.hit_rad_s.unwrap_or(0.0);
    let outcome = Outcome {
        farthest_rad: plant.farthest_rad,
        hit_rad_s: plant.hit_rad_s,
        hit_in: qube.hit_in,
        went_wrong: qube.went_wrong,
        endings,
        score,
    };
    let told = format!(
        "{:?}, zero off by {:+.4} rad, start {:?}, {:?}",
        cast.qube, cast.zero_rad, cast.state, cast.mishap
    );
    Trace { outcome, told, lines: qube.lines.unwrap_or_default() }
}

impl Outcome {
    /// Returns whether the arm reached its stop, and not by its cable alone after the amplifier
    /// went off.
    pub fn is_hit(&self) -> bool {
        self.hit_rad_s.is_some() && self.hit_in != Some(Part::Pulled)
    }

    /// A fault of a healthy Qube on a working link, which should not occur; the fault of an
    /// overheated motor does not count.
    pub fn false_fault(&self, mishap: MishapKind) -> Option<Fault> {
        if mishap == MishapKind::LinkDead {
            return None;
        }
        self.endings.iter().find_map(|ending| match ending {
            Ending::Fault(Fault::MotorOverheated) => None,
            Ending::Fault(fault) => Some(*fault),
            _ => None,
        })
    }
}
