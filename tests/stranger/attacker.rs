use qube_hil::policy::Controller;
use qube_hil::qube::State;

use super::genes::Genes;
use super::moves::{Moves, MovesKind, Segment, features, weigh};

/// A policy that tries to throw the arm against its stop: it moves the arm and may strike once, in
/// a certain state.
pub struct Attacker {
    moves: Moves,
    strike: Option<Strike>,
    step: u32,
}

/// A strike: a sequence of pushes that begins once, in a certain state.
struct Strike {
    /// First step at which the strike may begin.
    from: u32,
    /// Weights of the state's features. From the step `from` on, the strike begins when the
    /// features' weighted sum is positive.
    weights: [f64; 6],
    segments: Vec<Segment>,
    /// Step at which the strike began.
    since: Option<u32>,
}

impl Strike {
    fn new(genes: &mut Genes, steps: u32) -> Self {
        let from = genes.whole(0, steps);
        let waits = genes.normal() > -0.3;
        let mut weights = std::array::from_fn(|_| genes.normal());
        if !waits {
            weights = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        }
        let segments = (0..5).map(|_| {
            let (steps, voltage_v) = (genes.whole(0, 30), 10.0 * genes.normal());
            Segment { steps, voltage_v, period: None }
        });
        Self { from, weights, segments: segments.collect(), since: None }
    }

    fn voltage_v(&mut self, step: u32, state: &State) -> Option<f64> {
        if self.since.is_none() && step >= self.from && weigh(&self.weights, &features(state)) > 0.0
        {
            self.since = Some(step);
        }
        Segment::of(&self.segments, step - self.since?)
    }
}

impl Attacker {
    /// Reads the policy from the genes.
    pub fn new(kind: MovesKind, strikes: bool, genes: &mut Genes, steps: u32) -> Self {
        let moves = Moves::new(kind, genes, steps);
        let strike = strikes.then(|| Strike::new(genes, steps));
        Self { moves, strike, step: 0 }
    }
}

impl Controller for Attacker {
    fn start(&mut self) {
        self.step = 0;
        self.moves.start();
        if let Some(strike) = &mut self.strike {
            strike.since = None;
        }
    }

    fn applied(&mut self, voltage_v: f64) {
        self.moves.applied(voltage_v);
    }

    fn voltage_v(&mut self, state: &State) -> f64 {
        let step = self.step;
        self.step += 1;
        let moves_v = self.moves.voltage_v(step, state);
        let strikes_v = self.strike.as_mut().and_then(|strike| strike.voltage_v(step, state));
        strikes_v.unwrap_or(moves_v).clamp(-5.0, 5.0)
    }
}
