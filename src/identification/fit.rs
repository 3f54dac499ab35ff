use std::num::NonZero;
use std::thread;

use nalgebra::{DMatrix, DVector, Matrix4, SVector};

use super::Unknown;
use super::residuals::{Noise, Residual, noise_of, robust_cost, robust_weight};
use super::sensitivity::{STARTS, linearised};
use super::stretch::{Regime, Stretch};
use crate::qube::{QubeModel, State};

/// Relative change of the cost below which a fit has converged.
const ARRIVED: f64 = 1e-5;

/// Largest number of steps with one scale of the residuals.
const MAX_STEPS: usize = 30;

/// Number of times a step is shortened before the fit counts as converged.
const MAX_SHORTENINGS: usize = 10;

/// Number of times the scales of the residuals are estimated.
const SCALES: usize = 4;

/// The model and start states that explain recordings best: the maximum of the posterior for normal
/// residuals of unknown scale and the priors of [`Unknown::prior`] (multiple shooting). Each stretch has its own
/// start state. Each regime has residuals of its own scale and correlation in time, and a stretch that the model
/// explains much worse than others of its regime loses weight.
#[derive(Clone, Debug)]
pub(super) struct Fit<'a> {
    pub unknowns: &'a [Unknown],
    pub model: QubeModel,
    pub stretches: Vec<Stretch<'a>>,
    pub starts: Vec<State>,
    /// Scale and correlation of the residuals of each regime, in the order of [`Regime::ALL`].
    pub noise: [Noise; 3],
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
        let starts = stretches.iter().map(Stretch::measured_start).collect();
        Self { unknowns, model, stretches, starts, noise: [Noise::default(); 3] }
    }

    /// A fit of the same unknowns over other stretches, from this one's result; stretches that both have keep
    /// their start states.
    pub fn over(&self, stretches: Vec<Stretch<'a>>) -> Self {
        let mut next = Self::new(self.unknowns, self.model, stretches);
        next.noise = self.noise;
        for (stretch, start) in next.stretches.iter().zip(&mut next.starts) {
            let pairs = || self.stretches.iter().zip(&self.starts);
            if let Some((_, own)) = pairs().find(|(own, _)| own.is(stretch)) {
                *start = *own;
            }
        }
        next
    }

    /// Fits model, start states and scales in turn until the scales settle.
    pub fn run(&mut self) {
        for _ in 0..SCALES {
            self.minimise();
            self.noise = noise_of(&self.stretches, &self.residuals_rad(), &self.noise);
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
    pub fn residuals_rad(&self) -> Vec<Vec<Residual>> {
        let pairs: Vec<_> = self.stretches.iter().zip(&self.starts).collect();
        side_by_side(&pairs, |(stretch, start)| residuals(stretch, &self.model, **start))
    }

    /// For each stretch its information about the unknowns (J'J) and its gradient (J'r), in the fit's units and
    /// without the priors; its start state is eliminated, and correlated residuals count as fewer.
    pub fn reduced(&self) -> Vec<(DMatrix<f64>, DVector<f64>)> {
        let reduce = |block: Block| {
            let Some(inverse) = block.ss.try_inverse() else { return (block.gg, block.g) };
            let weighted = &block.gs * inverse;
            let information = block.gg - &weighted * block.gs.transpose();
            (information, block.g - weighted * block.s)
        };
        self.blocks().into_iter().map(reduce).collect()
    }

    fn noise(&self, regime: Regime) -> &Noise {
        &self.noise[regime as usize]
    }

    /// The cost; NaN when the motion diverges.
    fn cost(&self, model: &QubeModel, starts: &[State]) -> f64 {
        let pairs: Vec<_> = self.stretches.iter().zip(starts).collect();
        let costs = side_by_side(&pairs, |(stretch, start)| {
            robust_cost(self.noise(stretch.regime), &residuals(stretch, model, **start))
        });
        let prior_cost = |unknown: &Unknown| {
            let prior = unknown.prior();
            ((unknown.of(model) - prior.mean) / prior.std).powi(2)
        };
        costs.iter().sum::<f64>() + self.unknowns.iter().map(prior_cost).sum::<f64>()
    }

    fn blocks(&self) -> Vec<Block> {
        let pairs: Vec<_> = self.stretches.iter().zip(&self.starts).collect();
        side_by_side(&pairs, |(stretch, start)| self.block(stretch, **start))
    }

    fn block(&self, stretch: &Stretch<'_>, start: State) -> Block {
        let noise = self.noise(stretch.regime);
        let scale = [noise.scale.theta_rad, noise.scale.alpha_rad];
        let (here, slopes) = linearised(stretch, self.unknowns, &self.model, start, scale);
        let weight = robust_weight(here.norm_squared() / here.len() as f64) / noise.correlated;
        let count = self.unknowns.len();
        let (square, gradient) = (weight * slopes.tr_mul(&slopes), weight * slopes.tr_mul(&here));
        let ss = square.view((count, count), (STARTS, STARTS));
        Block {
            gg: square.view((0, 0), (count, count)).into_owned(),
            gs: square.view((0, count), (count, STARTS)).into_owned(),
            ss: Matrix4::from_iterator(ss.iter().copied()),
            g: gradient.rows(0, count).into_owned(),
            s: SVector::from_iterator(gradient.rows(count, STARTS).iter().copied()),
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
        let change = self.change(matrix, gradient)?;
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

    /// Solves for the change of the unknowns. A strength that is 0 and would become negative stays, and the
    /// others are solved for without it.
    fn change(&self, mut matrix: DMatrix<f64>, mut gradient: DVector<f64>) -> Option<DVector<f64>> {
        let count = self.unknowns.len();
        if count == 0 {
            return Some(gradient);
        }
        for _ in 0..=count {
            let change = matrix.clone().cholesky()?.solve(&-&gradient);
            let leaves = |index: &usize| {
                let unknown = self.unknowns[*index];
                change[*index] < 0.0
                    && unknown.is_strength()
                    && unknown.of(&self.model) <= 0.0
                    && gradient[*index] != 0.0
            };
            let leaving: Vec<usize> = (0..count).filter(leaves).collect();
            if leaving.is_empty() {
                return Some(change);
            }
            for index in leaving {
                matrix.row_mut(index).fill(0.0);
                matrix.column_mut(index).fill(0.0);
                matrix[(index, index)] = 1.0;
                gradient[index] = 0.0;
            }
        }
        None
    }
}

/// The residuals of a stretch, rad.
fn residuals(stretch: &Stretch<'_>, model: &QubeModel, start: State) -> Vec<Residual> {
    let simulated = stretch.simulate(model, start);
    let pairs = simulated.iter().zip(stretch.samples());
    let of = |(a, b): (&State, &crate::replay::MotionSample)| {
        [a.theta - b.state.theta, a.alpha - b.state.alpha]
    };
    pairs.map(of).collect()
}

/// Maps items on all processors, in order, whatever their number.
fn side_by_side<T: Sync, R: Send>(items: &[T], map: impl Fn(&T) -> R + Sync) -> Vec<R> {
    let threads = thread::available_parallelism().map_or(1, NonZero::get).min(items.len());
    if threads < 2 {
        return items.iter().map(map).collect();
    }
    thread::scope(|scope| {
        let map = &map;
        // Neighbouring items differ in length, so each thread takes every n-th.
        let parts: Vec<_> = (0..threads)
            .map(|thread| {
                scope.spawn(move || {
                    items.iter().skip(thread).step_by(threads).map(map).collect::<Vec<R>>()
                })
            })
            .collect();
        let mut parts: Vec<_> = parts
            .into_iter()
            .map(|part| match part.join() {
                Ok(results) => results.into_iter(),
                Err(panic) => std::panic::resume_unwind(panic),
            })
            .collect();
        (0..items.len()).filter_map(|index| parts[index % threads].next()).collect()
    })
}

fn moved(start: State, change: &SVector<f64, 4>) -> State {
    State {
        theta: start.theta + change[0],
        alpha: start.alpha + change[1],
        theta_dot: start.theta_dot + change[2],
        alpha_dot: start.alpha_dot + change[3],
    }
}
