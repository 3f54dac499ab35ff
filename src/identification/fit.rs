use std::num::NonZero;
use std::thread;

use nalgebra::{DMatrix, DVector, Matrix4, SVector};

use super::Unknown;
use super::change::changed;
use super::offsets::{HomingOffset, Offset, Scatter, recordings};
use super::residuals::{Noise, Residual, robust_cost, robust_weight, updated_noise};
use super::sensitivity::{STARTS, linearised};
use super::stretch::{Regime, Stretch};
use crate::qube::{Nonideality, PlantModel, QubeModel, State};

/// Relative change of the cost below which a fit has converged.
const ARRIVED: f64 = 1e-5;

/// Largest number of steps with one scale of the residuals.
const MAX_STEPS: usize = 30;

/// Number of failed attempts at a step, each shorter than the one before, after which the fit
/// counts as converged.
const MAX_SHORTENINGS: usize = 10;

/// Number of rounds in which model and residual scales are estimated in turn.
const SCALES: usize = 4;

/// Number of updates of the scatter between recordings in each round.
const SCATTERS: usize = 30;

/// Lower bound on the number of offsets that the recordings determine (MacKay's effective number of
/// parameters), against a division by 0.
const LEAST_DETERMINED: f64 = 0.01;

/// A fit of a model and start states to recordings by multiple shooting: the maximum of the
/// posterior for normal residuals of unknown scale and the priors of [`Unknown::prior`]. Each
/// stretch has its own start state, and each regime its own scale and correlation in time of the
/// residuals. A stretch that the model explains much worse than others of its regime loses weight.
/// With [`Fit::with_offsets`], each recording has its own zero of the pendulum's angle, and may
/// have its own rest angle of the cable ([`Fit::homing_offsets`]).
#[derive(Clone, Debug)]
pub(super) struct Fit<'a> {
    pub unknowns: &'a [Unknown],
    /// Plant whose priors and encoders the fit uses.
    pub plant: &'a PlantModel,
    pub model: QubeModel,
    pub stretches: Vec<Stretch<'a>>,
    pub starts: Vec<State>,
    /// Scale and correlation of the residuals of each regime, in the order of [`Regime::ALL`].
    pub noise: [Noise; 3],
    /// Index of the recording of each stretch.
    pub recording: Vec<usize>,
    /// Offsets of each recording.
    pub offsets: Vec<Offset>,
    /// Scatter of the offsets between recordings; `None` keeps the offsets as they are.
    pub scatter: Option<Scatter>,
}

/// Blocks of J'J and J'r of one stretch, where J holds the derivatives of its weighted residuals r.
/// The letter g stands for the unknowns, which all stretches share, together with the offsets of
/// the stretch's recording; s stands for the stretch's start state.
struct Block {
    gg: DMatrix<f64>,
    gs: DMatrix<f64>,
    ss: Matrix4<f64>,
    g: DVector<f64>,
    s: SVector<f64, 4>,
}

/// The residuals of one stretch, in standard deviations; their derivatives by the unknowns, the
/// offsets of its recording and its start state; and the weight of their squares.
struct Linearised {
    residuals: DVector<f64>,
    slopes: DMatrix<f64>,
    weight: f64,
}

impl<'a> Fit<'a> {
    /// A fit that starts at `model`, with each stretch at its measured state.
    pub fn new(
        unknowns: &'a [Unknown],
        plant: &'a PlantModel,
        model: QubeModel,
        stretches: Vec<Stretch<'a>>,
    ) -> Self {
        let starts = stretches.iter().map(Stretch::measured_start).collect();
        let recording = recordings(&stretches);
        let offsets = vec![Offset::default(); recording.iter().max().map_or(0, |last| last + 1)];
        let noise = [Noise::default(); 3];
        let scatter = None;
        Self { unknowns, plant, model, stretches, starts, noise, recording, offsets, scatter }
    }

    /// Lets each recording have its own offsets, whose scatter begins at [`Scatter::prior`].
    pub fn with_offsets(self) -> Self {
        Self { scatter: Some(Scatter::prior(self.plant.encoders)), ..self }
    }

    /// A fit of other unknowns over other stretches, with the model, noise and offsets of this fit.
    /// The offsets stay as they are.
    pub fn with_unknowns<'b>(&self, unknowns: &'b [Unknown], stretches: Vec<Stretch<'b>>) -> Fit<'b>
    where
        'a: 'b,
    {
        let mut next = Fit::new(unknowns, self.plant, self.model, stretches);
        next.noise = self.noise;
        for (stretch, &recording) in next.stretches.iter().zip(&next.recording) {
            let own = self.stretches.iter().position(|own| own.is_of_same_recording(stretch));
            if let Some(own) = own {
                next.offsets[recording] = self.offsets[self.recording[own]];
            }
        }
        next
    }

    /// A fit of the same unknowns over other stretches that starts from the result of this fit.
    /// Stretches that belong to both fits keep their start states.
    pub fn over(&self, stretches: Vec<Stretch<'a>>) -> Self {
        let mut next = self.with_unknowns(self.unknowns, stretches);
        next.scatter = self.scatter;
        for (stretch, start) in next.stretches.iter().zip(&mut next.starts) {
            let pairs = || self.stretches.iter().zip(&self.starts);
            if let Some((_, own)) = pairs().find(|(own, _)| own.is_same_as(stretch)) {
                *start = *own;
            }
        }
        next
    }

    /// Fits in [`SCALES`] rounds: each fits model, start states and offsets, then the scales of the
    /// residuals and the scatter of the offsets.
    pub fn run(&mut self) {
        for _ in 0..SCALES {
            self.minimise();
            let residuals = self.residuals_rad();
            self.noise =
                updated_noise(&self.stretches, &residuals, &self.noise, self.plant.encoders);
            self.scatter = self.scatter.map(|scatter| self.scatter_of(scatter));
        }
    }

    /// The quantities that are estimated for each recording. The rest angle of the cable is one of
    /// them only if it is an unknown and there are several recordings: the rest angle of a single
    /// recording is the unknown itself.
    pub fn homing_offsets(&self) -> &'static [HomingOffset] {
        let rest = Unknown::from(Nonideality::CableRest);
        match self.scatter {
            None => &[],
            Some(_) if self.offsets.len() > 1 && self.unknowns.contains(&rest) => {
                &HomingOffset::ALL
            }
            Some(_) => &[HomingOffset::AlphaZero],
        }
    }

    /// The scatter of the estimated offsets; 0 for other offsets and for a single recording.
    pub fn own_scatter(&self) -> Scatter {
        let mut own = Scatter::default();
        for &quantity in self.homing_offsets() {
            if let (Some(scatter), true) = (self.scatter, self.offsets.len() > 1) {
                own.set(quantity, scatter.get(quantity));
            }
        }
        own
    }

    /// The scatter of the offsets that makes the recordings most likely, with motions taken as
    /// linear in the unknowns (MacKay's update of a prior's width).
    fn scatter_of(&self, before: Scatter) -> Scatter {
        let (quantities, count) = (self.homing_offsets(), self.unknowns.len());
        let total = count + self.offsets.len() * quantities.len();
        let mut information = DMatrix::zeros(total, total);
        let mut gradient = DVector::zeros(total);
        for ((own, pull), &recording) in self.reduced().iter().zip(&self.recording) {
            self.add_matrix(&mut information, recording, own);
            self.add_gradient(&mut gradient, recording, pull);
        }
        let mut scatter = before;
        for _ in 0..SCATTERS {
            let (prior, pull) = self.priors(scatter);
            let Some(covariance) = (&information + prior).try_inverse() else { break };
            let change = -(&covariance * (&gradient + pull));
            for (place, &quantity) in quantities.iter().enumerate() {
                let (mut squares, mut determined) = (0.0, 0.0);
                for (recording, offset) in self.offsets.iter().enumerate() {
                    let index = self.offset_place(recording, place);
                    squares += (offset.get(quantity) + change[index]).powi(2);
                    determined += 1.0 - covariance[(index, index)] / scatter.get(quantity).powi(2);
                }
                scatter.set(quantity, (squares / determined.max(LEAST_DETERMINED)).sqrt());
            }
        }
        scatter
    }

    /// Adds the matrix of a stretch, over the unknowns and the offsets of its recording, to a
    /// matrix over the unknowns and the offsets of all recordings.
    fn add_matrix(&self, sum: &mut DMatrix<f64>, recording: usize, own: &DMatrix<f64>) {
        for row in 0..own.nrows() {
            for column in 0..own.ncols() {
                sum[(self.place(recording, row), self.place(recording, column))] +=
                    own[(row, column)];
            }
        }
    }

    /// Place, among the unknowns and the offsets of all recordings, of an entry of a stretch's
    /// block.
    fn place(&self, recording: usize, index: usize) -> usize {
        match index.checked_sub(self.unknowns.len()) {
            None => index,
            Some(offset) => self.offset_place(recording, offset),
        }
    }

    /// Place, among the unknowns and the offsets of all recordings, of an offset of a recording;
    /// `offset` is its index among [`Self::homing_offsets`].
    fn offset_place(&self, recording: usize, offset: usize) -> usize {
        self.unknowns.len() + recording * self.homing_offsets().len() + offset
    }

    /// Information and gradient of the priors of the unknowns, and of the priors of all offsets for
    /// this scatter.
    fn priors(&self, scatter: Scatter) -> (DMatrix<f64>, DVector<f64>) {
        let quantities = self.homing_offsets();
        let count = self.unknowns.len();
        let total = count + self.offsets.len() * quantities.len();
        let mut matrix = DMatrix::<f64>::zeros(total, total);
        let mut gradient = DVector::<f64>::zeros(total);
        for (index, unknown) in self.unknowns.iter().enumerate() {
            let prior = unknown.prior(self.plant);
            matrix[(index, index)] = prior.std.powi(-2);
            gradient[index] = (unknown.of(&self.model) - prior.mean) / prior.std.powi(2);
        }
        for (recording, offset) in self.offsets.iter().enumerate() {
            for (place, &quantity) in quantities.iter().enumerate() {
                let index = self.offset_place(recording, place);
                let information = scatter.get(quantity).powi(-2);
                matrix[(index, index)] = information;
                gradient[index] = offset.get(quantity) * information;
            }
        }
        (matrix, gradient)
    }

    /// The Qube with the rest angle of a recording, and the zero of the recording's pendulum angle,
    /// rad.
    fn own(&self, model: &QubeModel, recording: usize, offsets: &[Offset]) -> (QubeModel, f64) {
        let offset = offsets[recording];
        (offset.applied(model), offset.alpha_zero_rad)
    }

    /// Minimises the cost by Levenberg-Marquardt over all unknowns and all start states; the start
    /// states are eliminated stretch by stretch (Schur complement).
    pub fn minimise(&mut self) {
        let mut damping = 1e-3;
        let mut cost = self.cost(&self.model, &self.starts, &self.offsets);
        for _ in 0..MAX_STEPS {
            let blocks = self.blocks();
            let mut progress = 0.0;
            for _ in 0..MAX_SHORTENINGS {
                let next = self.step(&blocks, damping).map(|(model, starts, offsets)| {
                    let cost = self.cost(&model, &starts, &offsets);
                    (model, starts, offsets, cost)
                });
                match next {
                    Some((model, starts, offsets, next)) if next < cost => {
                        progress = (cost - next) / cost;
                        (self.model, self.starts, self.offsets) = (model, starts, offsets);
                        cost = next;
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
        side_by_side(&self.pieces(&self.starts), |&(stretch, start, recording)| {
            residuals(stretch, self.own(&self.model, recording, &self.offsets), start)
        })
    }

    /// The information (J'J) and the gradient (J'r) that each stretch gives of the unknowns, then
    /// of the offsets of its recording, in the fit's units and without the priors. The start state
    /// of the stretch is eliminated, and correlated residuals count as fewer.
    ///
    /// A wide swing depends so strongly on its start that the squares of the derivatives would lose
    /// all that other unknowns say. The start's part is therefore taken from the derivatives
    /// themselves, by an orthonormal basis of it.
    pub fn reduced(&self) -> Vec<(DMatrix<f64>, DVector<f64>)> {
        side_by_side(&self.pieces(&self.starts), |&(stretch, start, recording)| {
            let Linearised { residuals, mut slopes, weight } =
                self.linearised(stretch, start, recording);
            let count = slopes.ncols() - STARTS;
            let basis = slopes.columns(count, STARTS).into_owned().qr().q();
            slopes = slopes.remove_columns(count, STARTS);
            // Once more, for the rounding of the first time.
            for _ in 0..2 {
                slopes -= &basis * basis.tr_mul(&slopes);
            }
            (weight * slopes.tr_mul(&slopes), weight * slopes.tr_mul(&residuals))
        })
    }

    /// Stretches with their start states and the indices of their recordings.
    fn pieces(&self, starts: &[State]) -> Vec<(&Stretch<'a>, State, usize)> {
        let of = |((stretch, &start), &recording)| (stretch, start, recording);
        self.stretches.iter().zip(starts).zip(&self.recording).map(of).collect()
    }

    pub(super) fn noise(&self, regime: Regime) -> &Noise {
        &self.noise[regime as usize]
    }

    /// The cost that a fit minimises: the robust costs of the stretches, and the squared distances
    /// of unknowns and offsets from their priors, in standard deviations. NaN when the motion
    /// diverges.
    fn cost(&self, model: &QubeModel, starts: &[State], offsets: &[Offset]) -> f64 {
        let costs = side_by_side(&self.pieces(starts), |&(stretch, start, recording)| {
            let own = self.own(model, recording, offsets);
            robust_cost(self.noise(stretch.regime), &residuals(stretch, own, start))
        });
        let prior_cost = |unknown: &Unknown| {
            let prior = unknown.prior(self.plant);
            ((unknown.of(model) - prior.mean) / prior.std).powi(2)
        };
        let offset_cost = |scatter: Scatter| {
            let one = |quantity: &HomingOffset| {
                let square =
                    |offset: &Offset| (offset.get(*quantity) / scatter.get(*quantity)).powi(2);
                offsets.iter().map(square).sum::<f64>()
            };
            self.homing_offsets().iter().map(one).sum::<f64>()
        };
        costs.iter().sum::<f64>()
            + self.unknowns.iter().map(prior_cost).sum::<f64>()
            + self.scatter.map_or(0.0, offset_cost)
    }

    fn blocks(&self) -> Vec<Block> {
        side_by_side(&self.pieces(&self.starts), |&(stretch, start, recording)| {
            self.block(stretch, start, recording)
        })
    }

    fn block(&self, stretch: &Stretch<'_>, start: State, recording: usize) -> Block {
        let Linearised { residuals, slopes, weight } = self.linearised(stretch, start, recording);
        let count = slopes.ncols() - STARTS;
        let square = weight * slopes.tr_mul(&slopes);
        let gradient = weight * slopes.tr_mul(&residuals);
        let ss = square.view((count, count), (STARTS, STARTS));
        Block {
            gg: square.view((0, 0), (count, count)).into_owned(),
            gs: square.view((0, count), (count, STARTS)).into_owned(),
            ss: Matrix4::from_iterator(ss.iter().copied()),
            g: gradient.rows(0, count).into_owned(),
            s: SVector::from_iterator(gradient.rows(count, STARTS).iter().copied()),
        }
    }

    /// The residuals of a stretch, their derivatives and their weight.
    fn linearised(&self, stretch: &Stretch<'_>, start: State, recording: usize) -> Linearised {
        let noise = self.noise(stretch.regime);
        let scale = [noise.scale.theta_rad, noise.scale.alpha_rad];
        let (model, zero_rad) = self.own(&self.model, recording, &self.offsets);
        let (mut residuals, slopes) =
            linearised(stretch, self.unknowns, self.plant, &model, start, scale);
        residuals.iter_mut().skip(1).step_by(2).for_each(|alpha| *alpha += zero_rad / scale[1]);
        let slopes = self.with_homing_offsets(slopes, scale[1]);
        let weight = robust_weight(residuals.norm_squared() / residuals.len() as f64)
            / noise.autocorrelation_samples;
        Linearised { residuals, slopes, weight }
    }

    /// Inserts the derivatives by the recording's offsets between the derivatives by the unknowns
    /// and the derivatives by the start state.
    fn with_homing_offsets(&self, slopes: DMatrix<f64>, alpha_scale: f64) -> DMatrix<f64> {
        let (quantities, count) = (self.homing_offsets(), self.unknowns.len());
        let rest = Unknown::from(Nonideality::CableRest);
        let rest = self.unknowns.iter().position(|&unknown| unknown == rest);
        let mut slopes = slopes.insert_columns(count, quantities.len(), 0.0);
        for (place, quantity) in quantities.iter().enumerate() {
            match (quantity, rest) {
                (HomingOffset::CableRest, Some(rest)) => {
                    let column = slopes.column(rest).into_owned();
                    slopes.set_column(count + place, &column);
                }
                (HomingOffset::CableRest, None) => {}
                (HomingOffset::AlphaZero, _) => {
                    let mut column = slopes.column_mut(count + place);
                    let alphas = column.iter_mut().skip(1).step_by(2);
                    alphas.for_each(|slope| *slope = 1.0 / alpha_scale);
                }
            }
        }
        slopes
    }

    /// Model, start states and offsets after the next step; `None` when the normal equations have
    /// no solution at this damping.
    fn step(&self, blocks: &[Block], damping: f64) -> Option<(QubeModel, Vec<State>, Vec<Offset>)> {
        let (mut matrix, mut gradient) = self.priors(self.scatter.unwrap_or_default());
        for (block, &recording) in blocks.iter().zip(&self.recording) {
            self.add_matrix(&mut matrix, recording, &block.gg);
            self.add_gradient(&mut gradient, recording, &block.g);
        }
        for index in 0..matrix.nrows() {
            matrix[(index, index)] *= 1.0 + damping;
        }
        let mut inverses = Vec::with_capacity(blocks.len());
        for (block, &recording) in blocks.iter().zip(&self.recording) {
            let inverse = (block.ss + damping * Matrix4::from_diagonal(&block.ss.diagonal()))
                .try_inverse()?;
            let weighted = &block.gs * inverse;
            self.add_matrix(&mut matrix, recording, &-(&weighted * block.gs.transpose()));
            self.add_gradient(&mut gradient, recording, &-(&weighted * block.s));
            inverses.push(inverse);
        }
        let change = self.change(matrix, gradient)?;
        let count = self.unknowns.len();
        let model = changed(self.unknowns, &self.model, &change.as_slice()[..count]);
        let quantities = self.homing_offsets();
        let mut offsets = self.offsets.clone();
        for (recording, offset) in offsets.iter_mut().enumerate() {
            for (place, &quantity) in quantities.iter().enumerate() {
                let change = change[self.offset_place(recording, place)];
                offset.set(quantity, offset.get(quantity) + change);
            }
        }
        let pieces = blocks.iter().zip(&inverses).zip(&self.starts).zip(&self.recording);
        let starts = pieces.map(|(((block, inverse), start), &recording)| {
            let own =
                DVector::from_fn(block.g.len(), |index, _| change[self.place(recording, index)]);
            let shared: SVector<f64, 4> =
                SVector::from_iterator(block.gs.tr_mul(&own).iter().copied());
            moved(*start, &-(inverse * (block.s + shared)))
        });
        Some((model, starts.collect(), offsets))
    }

    /// Adds the gradient of a stretch, over the unknowns and the offsets of its recording, to a
    /// gradient over the unknowns and the offsets of all recordings.
    fn add_gradient(&self, sum: &mut DVector<f64>, recording: usize, own: &DVector<f64>) {
        for (index, value) in own.iter().enumerate() {
            sum[self.place(recording, index)] += value;
        }
    }

    /// Solves for the change of unknowns and offsets. A strength that is 0 and would become
    /// negative stays 0, and the others are solved for without it.
    fn change(&self, mut matrix: DMatrix<f64>, mut gradient: DVector<f64>) -> Option<DVector<f64>> {
        let count = self.unknowns.len();
        if gradient.is_empty() {
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

/// The residuals of a stretch for a model and a zero of the pendulum's angle, rad.
fn residuals(
    stretch: &Stretch<'_>,
    (model, zero_rad): (QubeModel, f64),
    start: State,
) -> Vec<Residual> {
    let simulated = stretch.simulate(&model, start);
    let pairs = simulated.iter().zip(stretch.samples());
    let of = |(simulated, measured): (&State, &crate::replay::MotionSample)| {
        [simulated.theta - measured.state.theta, simulated.alpha + zero_rad - measured.state.alpha]
    };
    pairs.map(of).collect()
}

/// Maps items on all processors; the results have the order of the items for any number of
/// processors.
fn side_by_side<T: Sync, R: Send>(items: &[T], map: impl Fn(&T) -> R + Sync) -> Vec<R> {
    let threads = thread::available_parallelism().map_or(1, NonZero::get).min(items.len());
    if threads < 2 {
        return items.iter().map(map).collect();
    }
    thread::scope(|scope| {
        let map = &map;
        // Items differ in length. Each of n threads takes every n-th item, so that all have about
        // the same work.
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
