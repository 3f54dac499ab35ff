use qube_hil::policy::{LayerWeights, Network, Policy};
use qube_hil::qube::{MAX_VOLTAGE_V, State};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::genes::{Genes, normal};

/// A way in which an attack moves the arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MovesKind {
    /// Linear feedback of any sign in three stages.
    Feedback,
    /// A small neural network.
    Net,
    /// Full voltage that changes its direction at chosen times.
    BangBang,
    /// Feedback that pumps energy into the pendulum, or out of it.
    Pump,
    /// A row of pushes, some of which change their sign every 1 to 12 steps.
    Chatter,
    /// The shipped policy `robust` with other weights.
    Robust,
    /// The shipped policy `nominal` with other weights.
    Nominal,
}

/// Number of features of a linear law.
const FEATURES: usize = 6;

/// Hidden units of the small network.
const HIDDEN: usize = 6;

/// Number of directions in which a shipped policy's weights may move.
const DIRECTIONS: usize = 16;

/// The moves of one attack.
#[derive(Clone, Debug)]
pub enum Moves {
    Feedback { stages: [[f64; FEATURES]; 3], switches: [Switch; 2], stage: usize },
    Net { inner: Vec<[f64; FEATURES]>, outer: Vec<f64> },
    Times { segments: Vec<Segment> },
    Pump { gain: f64, centring: f64, damping: f64 },
    Shipped { network: Box<Network> },
}

/// Condition that ends a stage: a step is reached, or |theta| exceeds an angle, rad.
#[derive(Clone, Copy, Debug)]
pub enum Switch {
    Step(u32),
    Angle(f64),
}

/// A voltage for some steps.
#[derive(Clone, Copy, Debug)]
pub struct Segment {
    pub steps: u32,
    pub voltage_v: f64,
    /// Number of steps after which the sign changes each time; `None` if it does not change.
    pub period: Option<u32>,
}

impl Segment {
    fn voltage_v(&self, step: u32) -> f64 {
        match self.period {
            Some(period) if step / period % 2 == 1 => -self.voltage_v,
            _ => self.voltage_v,
        }
    }

    /// The voltage that consecutive segments give in a step, V; `None` after the last segment.
    pub fn of(segments: &[Self], mut step: u32) -> Option<f64> {
        for segment in segments {
            if step < segment.steps {
                return Some(segment.voltage_v(step));
            }
            step -= segment.steps;
        }
        None
    }
}

/// Features of a state, each of order one.
pub fn features(state: &State) -> [f64; FEATURES] {
    let (sin, cos) = (libm::sin(state.alpha), libm::cos(state.alpha));
    [1.0, state.theta, sin, cos, 0.1 * state.theta_dot, 0.1 * state.alpha_dot]
}

/// The sum of the features times their weights.
pub fn weigh(weights: &[f64; FEATURES], features: &[f64; FEATURES]) -> f64 {
    weights.iter().zip(features).map(|(weight, feature)| weight * feature).sum()
}

fn weights(genes: &mut Genes, scale: f64) -> [f64; FEATURES] {
    std::array::from_fn(|_| scale * genes.normal())
}

impl Moves {
    /// Reads moves of this kind from the genes.
    pub fn new(kind: MovesKind, genes: &mut Genes, steps: u32) -> Self {
        match kind {
            MovesKind::Feedback => Self::Feedback {
                stages: std::array::from_fn(|_| weights(genes, 5.0)),
                switches: std::array::from_fn(|_| {
                    let by_step = genes.normal() < 0.0;
                    let (step, angle) = (genes.whole(1, steps), 2.3 * genes.unit());
                    if by_step { Switch::Step(step) } else { Switch::Angle(angle) }
                }),
                stage: 0,
            },
            MovesKind::Net => Self::Net {
                inner: (0..HIDDEN).map(|_| weights(genes, 1.5)).collect(),
                outer: (0..HIDDEN).map(|_| 5.0 * genes.normal()).collect(),
            },
            MovesKind::BangBang => {
                let mut sign = if genes.normal() < 0.0 { -1.0 } else { 1.0 };
                let segments = (0..12).map(|_| {
                    sign = -sign;
                    Segment {
                        steps: genes.whole(1, 45),
                        voltage_v: sign * MAX_VOLTAGE_V,
                        period: None,
                    }
                });
                Self::Times { segments: segments.collect() }
            }
            MovesKind::Chatter => {
                let segments = (0..8).map(|_| {
                    let (steps, voltage_v) = (genes.whole(1, 60), 10.0 * genes.normal());
                    let (chatters, period) = (genes.normal() < 0.3, genes.whole(1, 12));
                    Segment { steps, voltage_v, period: chatters.then_some(period) }
                });
                Self::Times { segments: segments.collect() }
            }
            MovesKind::Pump => Self::Pump {
                gain: 10.0 * genes.normal(),
                centring: 5.0 * genes.normal(),
                damping: 0.5 * genes.normal(),
            },
            MovesKind::Robust => {
                Self::shipped(include_bytes!("../../policies/robust.safetensors"), genes)
            }
            MovesKind::Nominal => {
                Self::shipped(include_bytes!("../../policies/nominal.safetensors"), genes)
            }
        }
    }

    /// A shipped policy with its weights moved along fixed directions.
    fn shipped(bytes: &[u8], genes: &mut Genes) -> Self {
        let policy = Policy::from_bytes(bytes).expect("a shipped policy");
        let Policy::Network(policy) = policy else { panic!("a shipped network") };
        let network = policy.network;
        let mut layers = network.layers();
        for direction in 0..DIRECTIONS {
            let along = 0.5 * genes.normal();
            let mut random = ChaCha8Rng::seed_from_u64(direction as u64);
            for layer in &mut layers {
                move_along(layer, along, &mut random);
            }
        }
        let (sizes, scale_v) = (network.sizes().to_vec(), network.action_scale_v());
        let network = Network::new(&sizes, &layers, scale_v).expect("finite weights");
        Self::Shipped { network: Box::new(network) }
    }

    /// The voltage in a step, V.
    pub fn voltage_v(&mut self, step: u32, state: &State) -> f64 {
        let seen = features(state);
        match self {
            Self::Feedback { stages, switches, stage } => {
                let is_over = switches.get(*stage).is_some_and(|switch| match *switch {
                    Switch::Step(at) => step >= at,
                    Switch::Angle(angle) => state.theta.abs() > angle,
                });
                *stage += usize::from(is_over);
                weigh(&stages[*stage], &seen)
            }
            Self::Net { inner, outer } => {
                let hidden = inner.iter().map(|weights| weigh(weights, &seen));
                hidden.zip(outer).map(|(sum, weight)| *weight * sum / (1.0 + sum.abs())).sum()
            }
            Self::Times { segments } => Segment::of(segments, step).unwrap_or(0.0),
            Self::Pump { gain, centring, damping } => {
                let way = state.alpha_dot * libm::cos(state.alpha);
                *gain * way.clamp(-1.0, 1.0) - *centring * state.theta - *damping * state.theta_dot
            }
            Self::Shipped { network } => network.voltage_v(state),
        }
    }

    /// Prepares the moves for the first step of a rollout.
    pub fn start(&mut self) {
        match self {
            Self::Feedback { stage, .. } => *stage = 0,
            Self::Shipped { network } => network.start(),
            Self::Net { .. } | Self::Times { .. } | Self::Pump { .. } => {}
        }
    }

    /// Records the voltage that the motor had, V.
    pub fn applied(&mut self, voltage_v: f64) {
        if let Self::Shipped { network } = self {
            network.applied(voltage_v);
        }
    }
}

/// Adds normal numbers to a layer's weights and biases; their standard deviation is |`along`| times
/// the mean absolute value of the weights, or of the biases.
fn move_along(layer: &mut LayerWeights, along: f64, random: &mut ChaCha8Rng) {
    for numbers in [&mut layer.weight, &mut layer.bias] {
        let sum: f64 = numbers.iter().map(|number| f64::from(number.abs())).sum();
        let size = sum / numbers.len().max(1) as f64;
        for number in numbers {
            *number += (along * size * normal(random)) as f32;
        }
    }
}
