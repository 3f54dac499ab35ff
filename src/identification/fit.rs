use std::num::NonZero;
use std::thread;

use nalgebra::{DMatrix, DVector, Matrix4, SVector};

use super::Unknown;
use super::stretch::Stretch;
use crate::qube::{QubeModel, State};

/// Relative change of the cost below which a fit has converged.
const ARRIVED: f64 = 1e-6;

/// Largest number of steps with one scale of the residuals.
const MAX_STEPS: usize = 30;

/// Number of times a step is shortened before the fit counts as converged.
const MAX_SHORTENINGS: usize = 10;

/// Number of times the scale of the residuals is estimated.
const SCALES: usize = 4;

/// Step of a finite difference: for an unknown as a fraction of its prior standard deviation, and for each
/// entry of a start state.
const UNKNOWN_STEP: f64 = 1e-4;
const START_STEPS: [f64; 4] = [1e-6, 1e-6, 1e-5, 1e-5];

/// Standard deviations of the residuals of both angles, rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResidualScale {
    /// Standard deviation of the arm's residuals, rad.
    pub theta_rad: f64,
    /// Standard deviation of the pendulum's residuals, rad.
    pub alpha_rad: f64,
}

/// The model and start states that explain recordings best: the maximum of the posterior for independent
/// normal residuals of unknown scale and the priors of [`Unknown::prior`]. Each stretch has its own start
/// state.
#[derive(Clone, Debug)]
pub(super) struct Fit<'a> {
    pub unknowns: &'a [Unknown],
    pub model: QubeModel,
    pub stretches: Vec<Stretch<'a>>,
    pub starts: Vec<State>,
    pub scale: ResidualScale,
}

/// Blocks of J'J and J'r of one stretch: for the unknowns that all stretches share (g) and its own start
/// state (s).
struct Block {
    gg: DMatrix<f64>,
    gs: DMatrix<f64>,
    ss: Matrix4<f64>,
    g: DVector<f64>,
    s: SVector<f64, 4>,
}

impl<'a> Fit<'a> {
    /// A fit that starts at `model`, each stretch in its measured state.
    pub fn new(unknowns: &'a [Unknown], model: QubeModel, stretches: Vec<Stretch<'a>>) -> Self {
        let starts = stretches.iter().map(|stretch| stretch.samples()[0].state).collect();
        let scale = ResidualScale { theta_rad: 0.01, alpha_rad: 0.01 };
        Self { unknowns, model, stretches, starts, scale }
    }

    /// Fits model, start states and scale in turn until the scale settles.
    pub fn run(&mut self) {
        for _ in 0..SCALES {
            self.minimise();
            self.scale = self.scale_of_residuals();
        }
    }

    /// Minimises the cost by Levenberg-Marquardt over all unknowns and all start states; the start states
    /// are eliminated stretch by stretch (Schur complement).
    pub fn minimise(&mut self) {
        let mut damping = 1e-3;
        let mut cost = self.cost(&self.model, &self.starts);
        for _ in 0..MAX_STEPS {
            let blocks = self.blocks();
            let mut progress = 0.0;
            for _ in 0..MAX_SHORTENINGS {
                let next = self.step(&blocks, damping).map(|(model, starts)| {
                    let cost = self.cost(&model, &starts);
                    (model, starts, cost)
                });
                match next {
                    Some((model, starts, next)) if next < cost => {
                        progress = (cost - next) / cost;
                        (self.model, self.starts, cost) = (model, starts, next);
                        damping = (damping * 0.2).max(1e-9);
                        break;
                    }
                    _ => damping *= 5.0,
                }
            }
            if progress < ARRIVED {
                break;
            }
        }
    }

    /// The residuals of all stretches, in order: theta and alpha of each sample, rad.
    pub fn residuals_rad(&self) -> Vec<Vec<[f64; 2]>> {
        let of = |(stretch, start): (&Stretch<'_>, &State)| {
            let simulated = stretch.simulate(&self.model, *start);
            let samples = stretch.samples().iter().map(|sample| sample.state);
            let errors = simulated.iter().zip(samples);
            errors.map(|(a, b)| [a.theta - b.theta, a.alpha - b.alpha]).collect()
        };
        self.stretches.iter().zip(&self.starts).map(of).collect()
    }

    fn scale_of_residuals(&self) -> ResidualScale {
        let residuals: Vec<[f64; 2]> = self.residuals_rad().concat();
        let rms = |angle: usize| {
            let squares: f64 = residuals.iter().map(|residual| residual[angle].powi(2)).sum();
            // An encoder's resolution bounds the residuals from below.
            (squares / residuals.len() as f64).sqrt().max(1e-4)
        };
        ResidualScale { theta_rad: rms(0), alpha_rad: rms(1) }
    }

    /// The information matrix of the unknowns without the priors: J'J with the start states eliminated, in
    /// the fit's units and for independent residuals.
    pub fn information(&self) -> DMatrix<f64> {
        let count = self.unknowns.len();
        let mut information = DMatrix::zeros(count, count);
        for block in self.blocks() {
            information += &block.gg;
            if let Some(inverse) = block.ss.try_inverse() {
                information -= &block.gs * inverse * block.gs.transpose();
            }
        }
        information
    }

    fn residuals(&self, stretch: &Stretch<'_>, model: &QubeModel, start: State) -> DVector<f64> {
        let simulated = stretch.simulate(model, start);
        let scaled = simulated.iter().zip(stretch.samples()).flat_map(|(state, sample)| {
            [
                (state.theta - sample.state.theta) / self.scale.theta_rad,
                (state.alpha - sample.state.alpha) / self.scale.alpha_rad,
            ]
        });
        DVector::from_iterator(2 * simulated.len(), scaled)
    }

    /// The cost; NaN when the motion diverges.
    fn cost(&self, model: &QubeModel, starts: &[State]) -> f64 {
        let data: f64 = self
            .stretches
            .iter()
            .zip(starts)
            .map(|(stretch, start)| self.residuals(stretch, model, *start).norm_squared())
            .sum();
        let prior_cost = |unknown: &Unknown| {
            let prior = unknown.prior();
            ((unknown.of(model) - prior.mean) / prior.std).powi(2)
        };
        data + self.unknowns.iter().map(prior_cost).sum::<f64>()
    }

    /// One block a stretch, in order, whatever the number of processors.
    fn blocks(&self) -> Vec<Block> {
        let work: Vec<_> = self.stretches.iter().zip(&self.starts).collect();
        let threads = thread::available_parallelism().map_or(1, NonZero::get);
        thread::scope(|scope| {
            let parts: Vec<_> = work
                .chunks(work.len().div_ceil(threads).max(1))
                .map(|part| {
                    scope.spawn(|| {
                        part.iter().map(|(stretch, start)| self.block(stretch, **start)).collect()
                    })
                })
                .collect();
            let join = |part: thread::ScopedJoinHandle<'_, Vec<Block>>| match part.join() {
                Ok(blocks) => blocks,
                Err(panic) => std::panic::resume_unwind(panic),
            };
            parts.into_iter().flat_map(join).collect()
        })
    }

    fn block(&self, stretch: &Stretch<'_>, start: State) -> Block {
        let here = self.residuals(stretch, &self.model, start);
        let mut shared = DMatrix::zeros(here.len(), self.unknowns.len());
        for (column, unknown) in self.unknowns.iter().enumerate() {
            let step = UNKNOWN_STEP * unknown.prior().std;
            let mut moved = self.model;
            unknown.set(&mut moved, unknown.of(&self.model) + step);
            let there = self.residuals(stretch, &moved, start);
            shared.set_column(column, &((there - &here) / step));
        }
        let mut own = DMatrix::zeros(here.len(), 4);
        for (column, step) in START_STEPS.into_iter().enumerate() {
            let mut change = SVector::zeros();
            change[column] = step;
            let there = self.residuals(stretch, &self.model, moved(start, &change));
            own.set_column(column, &((there - &here) / step));
        }
        let (ss, s) = (own.tr_mul(&own), own.tr_mul(&here));
        Block {
            gg: shared.tr_mul(&shared),
            gs: shared.tr_mul(&own),
            ss: Matrix4::from_iterator(ss.iter().copied()),
            g: shared.tr_mul(&here),
            s: SVector::from_iterator(s.iter().copied()),
        }
    }

    /// The next step; `None` when the normal equations have no solution at this damping.
    fn step(&self, blocks: &[Block], damping: f64) -> Option<(QubeModel, Vec<State>)> {
        let count = self.unknowns.len();
        let mut matrix = DMatrix::<f64>::zeros(count, count);
        let mut gradient = DVector::<f64>::zeros(count);
        for (index, unknown) in self.unknowns.iter().enumerate() {
            let prior = unknown.prior();
            matrix[(index, index)] = prior.std.powi(-2);
            gradient[index] = (unknown.of(&self.model) - prior.mean) / prior.std.powi(2);
        }
        for block in blocks {
            matrix += &block.gg;
            gradient += &block.g;
        }
        for index in 0..count {
            matrix[(index, index)] *= 1.0 + damping;
        }
        let mut inverses = Vec::with_capacity(blocks.len());
        for block in blocks {
            let inverse = (block.ss + damping * Matrix4::from_diagonal(&block.ss.diagonal()))
                .try_inverse()?;
            let weighted = &block.gs * inverse;
            matrix -= &weighted * block.gs.transpose();
            gradient -= &weighted * block.s;
            inverses.push(inverse);
        }
        let change = if count == 0 { gradient } else { matrix.cholesky()?.solve(&-gradient) };
        let mut model = self.model;
        for (unknown, change) in self.unknowns.iter().zip(&change) {
            unknown.set(&mut model, unknown.of(&self.model) + change);
        }
        let starts =
            blocks.iter().zip(&inverses).zip(&self.starts).map(|((block, inverse), start)| {
                let shared: SVector<f64, 4> =
                    SVector::from_iterator(block.gs.tr_mul(&change).iter().copied());
                moved(*start, &-(inverse * (block.s + shared)))
            });
        Some((model, starts.collect()))
    }
}

fn moved(start: State, change: &SVector<f64, 4>) -> State {
    State {
        theta: start.theta + change[0],
        alpha: start.alpha + change[1],
        theta_dot: start.theta_dot + change[2],
        alpha_dot: start.alpha_dot + change[3],
    }
}
