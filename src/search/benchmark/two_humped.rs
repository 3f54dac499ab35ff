use rand::RngExt;
use serde::Serialize;

use super::objective::bowl;
use super::statistics::{Interval, confidence_interval};
use crate::search::random::stream;
use crate::search::{
    AcquisitionKind, BayRn, BayRnSettings, Observation, SearchBox, SearchError, Strategy,
};

/// Searches on returns as the thesis found them: a rollout stands (500) or falls (50), and the
/// candidate only decides how often. In eight dimensions; where success is most likely differs
/// from repetition to repetition.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct TwoHumped {
    /// Candidates evaluated in a search.
    pub candidates: usize,
    /// Rollouts of each.
    pub rollouts: usize,
}

impl TwoHumped {
    /// The thesis's extent: 15 + 10 candidates, 5 rollouts each.
    pub const THESIS: Self = Self { candidates: 25, rollouts: 5 };
}

/// Return of a rollout that stands, and of one that falls.
const STANDS: f64 = 500.0;
const FALLS: f64 = 50.0;
/// Success probability at the optimum, and far from it.
const MOST_LIKELY: f64 = 0.95;
const LEAST_LIKELY: f64 = 0.02;

/// The surrogates and acquisitions that are compared, all with the same number of rollouts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Contender {
    /// As the thesis: one noise variance, EI over the luckiest mean return; the answer is the
    /// luckiest candidate.
    PlainLuckiest,
    /// As the thesis, and like there the answer is the maximum of the posterior mean.
    Plain,
    /// Each candidate's own noise, EI over the best posterior mean.
    NoiseAware,
    /// Each candidate's own noise, knowledge gradient.
    KnowledgeGradient,
}

impl Contender {
    /// All of them.
    pub const ALL: [Self; 4] =
        [Self::PlainLuckiest, Self::Plain, Self::NoiseAware, Self::KnowledgeGradient];

    /// What it is, in words.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Self::PlainLuckiest => "plain EI, answer = luckiest candidate",
            Self::Plain => "plain EI, answer = best posterior mean",
            Self::NoiseAware => "own noise, EI over best posterior mean",
            Self::KnowledgeGradient => "own noise, knowledge gradient",
        }
    }

    fn settings(self) -> BayRnSettings {
        match self {
            Self::PlainLuckiest | Self::Plain => BayRnSettings::thesis(),
            Self::NoiseAware => BayRnSettings::default(),
            Self::KnowledgeGradient => BayRnSettings {
                acquisition: AcquisitionKind::KnowledgeGradient,
                ..BayRnSettings::default()
            },
        }
    }
}

impl TwoHumped {
    /// One search: the expected return of the point it ends with.
    ///
    /// # Errors
    /// The search cannot propose.
    pub fn search(self, contender: Contender, seed: u64) -> Result<f64, SearchError> {
        let landscape = Landscape::new(seed);
        let mut strategy = BayRn::new(SearchBox::unit(8)?, contender.settings(), seed)?;
        let mut data: Vec<Observation> = Vec::with_capacity(self.candidates);
        while data.len() < self.candidates {
            for point in strategy.propose(&data, 1)? {
                let returns = landscape.rollouts(&point, self.rollouts, data.len());
                data.push(Observation { point, returns });
            }
        }
        let answer = match contender {
            Contender::PlainLuckiest => {
                data[crate::search::observation::highest_mean_return(&data)?].point.clone()
            }
            _ => strategy.best(&data)?.point,
        };
        Ok(landscape.expected_return(&answer))
    }
}

/// Where success is likely in one repetition.
struct Landscape {
    centre: [f64; 8],
    seed: u64,
}

impl Landscape {
    fn new(seed: u64) -> Self {
        let mut random = stream(seed ^ 0x7477_6f68_756d_7073, 0);
        Self { centre: std::array::from_fn(|_| 0.2 + 0.6 * random.random::<f64>()), seed }
    }

    fn success_probability(&self, point: &[f64]) -> f64 {
        LEAST_LIKELY + (MOST_LIKELY - LEAST_LIKELY) * (-bowl(point, &self.centre)).exp()
    }

    fn expected_return(&self, point: &[f64]) -> f64 {
        FALLS + (STANDS - FALLS) * self.success_probability(point)
    }

    /// The luck of a candidate depends on its index alone, so that all contenders share it.
    fn rollouts(&self, point: &[f64], count: usize, index: usize) -> Vec<f64> {
        let mut random = stream(self.seed ^ 0x726f_6c6c_6f75_7473, index);
        let probability = self.success_probability(point);
        (0..count)
            .map(|_| if random.random::<f64>() < probability { STANDS } else { FALLS })
            .collect()
    }
}

/// How the contenders did, each also against plain EI, repetition by repetition.
#[derive(Clone, Debug, Serialize)]
pub struct Comparison {
    /// Who searched.
    pub contender: Contender,
    /// Expected return of the point that was found, with its 95 % interval.
    pub expected_return: Interval,
    /// Difference to [`Contender::Plain`] in the same repetitions, with its 95 % interval.
    pub gain_over_plain: Interval,
}

impl Comparison {
    /// Of the expected returns of the points found, one list for each of [`Contender::ALL`], the
    /// repetitions in the same order.
    #[must_use]
    pub fn table(found: &[Vec<f64>]) -> Vec<Self> {
        let plain = Contender::ALL.iter().position(|c| *c == Contender::Plain).unwrap_or(0);
        Contender::ALL
            .into_iter()
            .zip(found)
            .map(|(contender, returns)| {
                let gains: Vec<f64> =
                    returns.iter().zip(&found[plain]).map(|(ours, plain)| ours - plain).collect();
                Self {
                    contender,
                    expected_return: confidence_interval(returns),
                    gain_over_plain: confidence_interval(&gains),
                }
            })
            .collect()
    }
}
