use rand::RngExt;
use serde::Serialize;

use super::objective::{HUMP_WEIGHTS, bowl};
use super::statistics::{MeanInterval, confidence_interval};
use crate::search::random::stream;
use crate::search::{
    AcquisitionKind, BayRn, BayRnSettings, Observation, SearchBox, SearchError, Strategy,
};

/// A search on returns with the two-humped distribution of the thesis: each rollout either balances
/// (return 500) or falls (50), and the candidate's point determines the probability. Each
/// repetition has another optimum.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct TwoHumped {
    /// Dimensions of the box, 1 to 8. The hump of the success probability is equally wide in any
    /// number of them.
    pub dimensions: usize,
    /// Number of initial points.
    pub initial_points: usize,
    /// Number of candidates in a search, initial points included.
    pub candidates: usize,
    /// Number of rollouts of each candidate.
    pub rollouts: usize,
    /// Correlation of two rollouts of one policy, 0 to 1: the fraction of trainings that alone
    /// decide whether all rollouts of their policy balance or all fall. With 0 the trainings do not
    /// differ.
    pub rollout_correlation: f64,
}

impl TwoHumped {
    /// The thesis's extent: eight dimensions, 15 + 10 candidates, 5 rollouts each.
    pub const THESIS: Self =
        Self { dimensions: 8, initial_points: 15, candidates: 25, rollouts: 5, ..Self::NOISY };
    /// An extent in which noise dominates: fewer dimensions and rollouts, a longer search.
    pub const NOISY: Self = Self {
        dimensions: 2,
        initial_points: 8,
        candidates: 40,
        rollouts: 2,
        rollout_correlation: 0.0,
    };

    /// Correlation of two rollouts of a policy, chosen for trainings that differ as they do for the
    /// emulated Qube `lab`. Of 20 policies that were trained at one psi, 7 succeeded there, in four
    /// or five of five rollouts each, and 37 of all 100 rollouts balanced (docs/results.md of
    /// revision 7f251fcf, table 5.3, `opt-nominal`; today's table is of another search).
    /// Correlations from 0.33 to 0.94 are compatible with these counts.
    pub const OF_TRAININGS: f64 = 0.8;

    /// The same problem with trainings that differ.
    #[must_use]
    pub fn with_differing_trainings(self) -> Self {
        Self { rollout_correlation: Self::OF_TRAININGS, ..self }
    }
}

/// Return of a rollout that balances.
const BALANCES: f64 = 500.0;
/// Return of a rollout that falls.
const FALLS: f64 = 50.0;
/// Success probability at the optimum.
const MOST_LIKELY: f64 = 0.95;
/// Success probability far from the optimum.
const LEAST_LIKELY: f64 = 0.02;

/// The combinations of noise model, acquisition function and recommendation that are compared, all
/// with the same number of rollouts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum SearchVariant {
    /// The thesis's settings (one noise variance, EI over the largest mean return), recommending
    /// the candidate with the largest mean return.
    PlainLuckiest,
    /// The thesis's settings, recommending the maximum of the posterior mean as the thesis does.
    Plain,
    /// Each candidate's own noise, and EI over the best posterior mean.
    OverPosteriorMean,
    /// Each candidate's own noise, and the knowledge gradient.
    KnowledgeGradient,
    /// Each candidate's own noise, and noisy EI: the default of the program.
    NoisyExpectedImprovement,
}

impl SearchVariant {
    /// Every variant.
    pub const ALL: [Self; 5] = [
        Self::PlainLuckiest,
        Self::Plain,
        Self::OverPosteriorMean,
        Self::KnowledgeGradient,
        Self::NoisyExpectedImprovement,
    ];

    /// A description for tables.
    #[must_use]
    pub fn description(self) -> &'static str {
        match self {
            Self::PlainLuckiest => "plain EI, recommendation = luckiest candidate",
            Self::Plain => "plain EI, recommendation = best posterior mean",
            Self::OverPosteriorMean => "own noise, EI over best posterior mean",
            Self::KnowledgeGradient => "own noise, knowledge gradient",
            Self::NoisyExpectedImprovement => "own noise, noisy EI (the default)",
        }
    }

    fn settings(self, initial_points: usize) -> BayRnSettings {
        let own_noise =
            |acquisition| BayRnSettings { acquisition, initial_points, ..BayRnSettings::default() };
        match self {
            Self::PlainLuckiest | Self::Plain => {
                BayRnSettings { initial_points, ..BayRnSettings::thesis() }
            }
            Self::OverPosteriorMean => own_noise(AcquisitionKind::ExpectedImprovement),
            Self::KnowledgeGradient => own_noise(AcquisitionKind::KnowledgeGradient),
            Self::NoisyExpectedImprovement => own_noise(AcquisitionKind::NoisyExpectedImprovement),
        }
    }
}

impl TwoHumped {
    /// Runs one search and returns the expected return of the recommended point.
    ///
    /// # Errors
    /// The search cannot propose or recommend.
    pub fn search(self, variant: SearchVariant, seed: u64) -> Result<f64, SearchError> {
        let landscape = Landscape::new(self.dimensions, seed);
        let strategy = BayRn::new(
            SearchBox::unit(self.dimensions)?,
            variant.settings(self.initial_points),
            seed,
        )?;
        let mut data: Vec<Observation> = Vec::with_capacity(self.candidates);
        while data.len() < self.candidates {
            for point in strategy.propose(&data, &[], 1)? {
                let returns = landscape.rollouts(&point, self, data.len());
                data.push(Observation { point, returns });
            }
        }
        let recommendation = match variant {
            SearchVariant::PlainLuckiest => {
                data[crate::search::observation::highest_mean_return(&data)?].point.clone()
            }
            _ => strategy.recommend(&data)?.point,
        };
        Ok(landscape.expected_return(&recommendation))
    }
}

/// The success probability over the box in one repetition of the benchmark.
struct Landscape {
    centre: Vec<f64>,
    weights: Vec<f64>,
    seed: u64,
}

impl Landscape {
    fn new(dimensions: usize, seed: u64) -> Self {
        // The constants here and in `rollouts` are the ASCII codes of `twohumps`, `rollouts` and
        // `training`; they keep the random streams apart.
        let mut random = stream(seed ^ 0x7477_6f68_756d_7073, 0);
        let centre = (0..dimensions).map(|_| 0.2 + 0.6 * random.random::<f64>()).collect();
        // Coordinates have unequal weights, but their sum is the same in every number of
        // dimensions.
        let chosen = &HUMP_WEIGHTS[..dimensions.min(HUMP_WEIGHTS.len())];
        let share = HUMP_WEIGHTS.iter().sum::<f64>() / chosen.iter().sum::<f64>();
        Self { centre, weights: chosen.iter().map(|w| w * share).collect(), seed }
    }

    fn success_probability(&self, point: &[f64]) -> f64 {
        LEAST_LIKELY
            + (MOST_LIKELY - LEAST_LIKELY) * (-bowl(point, &self.centre, &self.weights)).exp()
    }

    fn expected_return(&self, point: &[f64]) -> f64 {
        FALLS + (BALANCES - FALLS) * self.success_probability(point)
    }

    /// Draws the returns of a candidate at this point. Its random numbers depend on the seed and
    /// its index alone, so that all variants share them.
    fn rollouts(&self, point: &[f64], problem: TwoHumped, index: usize) -> Vec<f64> {
        let mut random = stream(self.seed ^ 0x726f_6c6c_6f75_7473, index);
        let mut training = stream(self.seed ^ 0x7472_6169_6e69_6e67, index);
        let probability = self.success_probability(point);
        let decides = training.random::<f64>() < problem.rollout_correlation;
        let luck_of_training: f64 = training.random();
        (0..problem.rollouts)
            .map(|_| {
                let luck: f64 = random.random();
                let balances = if decides { luck_of_training } else { luck } < probability;
                if balances { BALANCES } else { FALLS }
            })
            .collect()
    }
}

/// The result of one variant, and its difference to plain EI over the same repetitions.
#[derive(Clone, Debug, Serialize)]
pub struct VariantResult {
    /// Variant of the search.
    #[serde(rename = "contender")]
    pub variant: SearchVariant,
    /// Expected return of the recommended point, with its 95 % interval.
    pub expected_return: MeanInterval,
    /// Difference to [`SearchVariant::Plain`] in the same repetitions, with its 95 % interval.
    pub gain_over_plain: MeanInterval,
}

impl VariantResult {
    /// Builds the table from the expected returns of the recommended points: one list for each
    /// variant, repetitions in the same order.
    #[must_use]
    pub fn table(found: &[Vec<f64>]) -> Vec<Self> {
        let plain = SearchVariant::ALL.iter().position(|c| *c == SearchVariant::Plain).unwrap_or(0);
        SearchVariant::ALL
            .into_iter()
            .zip(found)
            .map(|(variant, returns)| {
                let gains: Vec<f64> =
                    returns.iter().zip(&found[plain]).map(|(ours, plain)| ours - plain).collect();
                Self {
                    variant,
                    expected_return: confidence_interval(returns),
                    gain_over_plain: confidence_interval(&gains),
                }
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_finds_better_candidates_than_the_luckiest() {
        let problem = TwoHumped { candidates: 20, ..TwoHumped::NOISY };
        let mean = |variant| {
            let found: Vec<f64> =
                (0..20).map(|seed| problem.search(variant, seed).unwrap()).collect();
            confidence_interval(&found).mean
        };
        let default = mean(SearchVariant::NoisyExpectedImprovement);
        let luckiest = mean(SearchVariant::PlainLuckiest);
        assert!(default > luckiest + 10.0, "{default} {luckiest}");
    }

    #[test]
    fn trainings_that_differ_correlate_their_rollouts_and_change_no_mean() {
        let landscape = Landscape::new(2, 5);
        let point = [0.4, 0.55];
        let probability = landscape.success_probability(&point);
        let problem = TwoHumped { rollouts: 2, ..TwoHumped::NOISY };
        for problem in [problem, problem.with_differing_trainings()] {
            let (mut balanced, mut both) = (0.0, 0.0);
            let trainings = 20_000;
            for index in 0..trainings {
                let returns = landscape.rollouts(&point, problem, index);
                let [one, other] = [0, 1].map(|rollout| f64::from(returns[rollout] == BALANCES));
                balanced += one + other;
                both += one * other;
            }
            let (mean, product) = (balanced / 2.0 / trainings as f64, both / trainings as f64);
            assert!((mean - probability).abs() < 0.01, "{mean} {probability}");
            let correlation = (product - mean * mean) / (mean * (1.0 - mean));
            assert!((correlation - problem.rollout_correlation).abs() < 0.03, "{correlation}");
        }
    }

    #[test]
    fn the_table_compares_repetition_by_repetition() {
        let table = VariantResult::table(&[
            vec![1.0, 2.0],
            vec![10.0, 20.0],
            vec![11.0, 21.0],
            vec![9.0, 21.0],
            vec![10.0, 20.0],
        ]);
        assert_eq!(table[2].gain_over_plain, MeanInterval { mean: 1.0, half_width: 0.0 });
        assert_eq!(table[1].expected_return.mean, 15.0);
    }
}
