use std::borrow::Cow;

use super::bayrn_settings::{AcquisitionKind, BayRnSettings, IncumbentRule, NoiseModel};
use super::observation::{check, next_indices};
use super::{Observation, Recommendation, SearchBox, SearchError, Strategy};
use crate::surrogate::{
    Acquisition, Criterion, Dataset, FitSettings, GaussianProcess, LogExpectedImprovement,
    LogKnowledgeGradient, LogNoisyExpectedImprovement, LogProbabilityOfImprovement,
    MaximiserSettings, OnProcess, PosteriorMean, UpperConfidenceBound, maximise, noise_of_means,
};

/// Bayesian optimisation of the return over a box (BayRn: Eilers 2019, Muratore et al. 2021).
///
/// The first points are uniformly random or a Sobol sequence, as the settings specify. After them a
/// Gaussian process is fitted to the mean returns, and each new point maximises an acquisition
/// function. The recommendation is the maximum of the posterior mean over the whole box, a point
/// that need not have been evaluated.
#[derive(Clone, Debug)]
pub struct BayRn {
    search_box: SearchBox,
    settings: BayRnSettings,
    seed: u64,
}

impl BayRn {
    /// A search in a box with settings and a seed.
    ///
    /// # Errors
    /// [`BayRnSettings::check`] refuses the settings.
    pub fn new(
        search_box: SearchBox,
        settings: BayRnSettings,
        seed: u64,
    ) -> Result<Self, SearchError> {
        settings.check()?;
        Ok(Self { search_box, settings, seed })
    }

    /// A search between bounds of each coordinate.
    ///
    /// # Errors
    /// The bounds form no box, or [`Self::new`] would fail.
    pub fn between(
        lower: &[f64],
        upper: &[f64],
        settings: BayRnSettings,
        seed: u64,
    ) -> Result<Self, SearchError> {
        Self::new(SearchBox::new(lower.to_vec(), upper.to_vec())?, settings, seed)
    }

    /// Fits the surrogate to data.
    ///
    /// # Errors
    /// There is no data, or the data is invalid or cannot be fitted.
    pub fn surrogate(&self, data: &[Observation]) -> Result<GaussianProcess, SearchError> {
        check(&self.search_box, data)?;
        let points: Vec<Vec<f64>> = data.iter().map(|o| o.point.clone()).collect();
        let means: Vec<f64> = data.iter().map(Observation::mean_return).collect();
        let noise = match self.settings.noise {
            NoiseModel::Shared => None,
            NoiseModel::PerCandidate => {
                let returns: Vec<&[f64]> = data.iter().map(|o| o.returns.as_slice()).collect();
                noise_of_means(&returns)
            }
        };
        let dataset = Dataset::new(&self.search_box, &points, &means, noise.as_deref())?;
        let seed = self.settings.surrogate.seed ^ self.seed;
        Ok(GaussianProcess::fit(dataset, &FitSettings { seed, ..self.settings.surrogate })?)
    }

    /// The largest expected improvement of one more point, maximised over the box: the expectation
    /// of the amount, at least 0, by which the point's true return exceeds the best return so far.
    /// The best return so far is `known`; without it, the largest true return at a point of the
    /// data.
    ///
    /// # Errors
    /// There is no data, or the data is invalid or cannot be fitted.
    pub fn expected_improvement(
        &self,
        data: &[Observation],
        known: Option<f64>,
    ) -> Result<f64, SearchError> {
        if data.is_empty() {
            return Err(SearchError::NothingEvaluated);
        }
        let process = self.surrogate(data)?;
        let index = data.len();
        let acquisition: Box<dyn Acquisition + '_> = match known {
            Some(incumbent) => Box::new(on(&process, LogExpectedImprovement { incumbent })),
            None => {
                let seed = self.seed.wrapping_add(index as u64);
                Box::new(LogNoisyExpectedImprovement::new(&process, &[], seed)?)
            }
        };
        let point = self.maximise(&*acquisition, &means_at_data(&process), index);
        Ok(acquisition.value(&point).exp())
    }

    fn initial_point(&self, index: usize) -> Vec<f64> {
        self.settings.initial_design.point(&self.search_box, self.seed, index)
    }

    /// The next point by the acquisition function while other points are pending; `index` is its
    /// number among all points of the search.
    ///
    /// The noisy expected improvement averages over the returns that pending points may have. For
    /// the other functions the surrogate is conditioned at each pending point on its posterior mean
    /// there ("kriging believer", Ginsbourger et al. 2010). Both methods reduce the uncertainty at
    /// the pending points and drive the next point away from them.
    fn acquire(
        &self,
        process: &GaussianProcess,
        pending: &[Vec<f64>],
        largest_observed: f64,
        index: usize,
    ) -> Result<Vec<f64>, SearchError> {
        let observed = process;
        let mut believed = Cow::Borrowed(observed);
        for point in pending {
            believed = Cow::Owned(believed.conditioned_on_fantasy(point, believed.mean(point))?);
        }
        let process = believed.as_ref();
        let means = means_at_data(process);
        let incumbent = match self.settings.incumbent {
            IncumbentRule::LargestObserved => largest_observed,
            IncumbentRule::BestPosteriorMean => means[0].0,
        };
        Ok(match self.settings.acquisition {
            AcquisitionKind::ExpectedImprovement => {
                self.maximise(&on(process, LogExpectedImprovement { incumbent }), &means, index)
            }
            AcquisitionKind::ProbabilityOfImprovement => self.maximise(
                &on(process, LogProbabilityOfImprovement { incumbent }),
                &means,
                index,
            ),
            AcquisitionKind::UpperConfidenceBound => {
                let criterion = UpperConfidenceBound { beta: self.settings.beta };
                self.maximise(&on(process, criterion), &means, index)
            }
            AcquisitionKind::NoisyExpectedImprovement => {
                let seed = self.seed.wrapping_add(index as u64);
                let acquisition = LogNoisyExpectedImprovement::new(observed, pending, seed)?;
                self.maximise(&acquisition, &means, index)
            }
            AcquisitionKind::KnowledgeGradient => {
                let recommended = self.maximise(&on(process, PosteriorMean), &means, index);
                self.maximise(&LogKnowledgeGradient::new(process, &[recommended]), &means, index)
            }
        })
    }

    fn maximise(&self, acquisition: &dyn Acquisition, means: &Means, index: usize) -> Vec<f64> {
        let hints: Vec<Vec<f64>> = means.iter().take(HINTS).map(|(_, p)| p.clone()).collect();
        let seed = self.seed.wrapping_add(index as u64);
        let settings = MaximiserSettings { seed, ..MaximiserSettings::default() };
        maximise(acquisition, &self.search_box, &hints, &settings).point
    }
}

/// Number of candidates around which the maximiser samples more densely: the candidates with the
/// highest posterior means.
const HINTS: usize = 5;

/// Posterior means at the points of a process's data, evaluated and pending ones, each with its
/// point, highest first.
type Means = Vec<(f64, Vec<f64>)>;

fn means_at_data(process: &GaussianProcess) -> Means {
    let data = process.data();
    let mut means: Means = (0..data.len())
        .map(|i| {
            let point = data.search_box().from_unit(&data.unit_point(i));
            (process.mean(&point), point)
        })
        .collect();
    means.sort_by(|a, b| b.0.total_cmp(&a.0));
    means
}

fn on<C: Criterion>(process: &GaussianProcess, criterion: C) -> OnProcess<'_, C> {
    OnProcess { process, criterion }
}

impl Strategy for BayRn {
    /// Chooses the points after the initial ones one after the other, each as if the points before
    /// it were pending.
    fn propose(
        &self,
        data: &[Observation],
        pending: &[Vec<f64>],
        count: usize,
    ) -> Result<Vec<Vec<f64>>, SearchError> {
        let next = next_indices(&self.search_box, data, pending, count)?;
        let largest_observed =
            data.iter().map(Observation::mean_return).fold(f64::NEG_INFINITY, f64::max);
        let mut process: Option<GaussianProcess> = None;
        let mut chosen = pending.to_vec();
        for index in next {
            let point = if index < self.settings.initial_points || data.is_empty() {
                self.initial_point(index)
            } else {
                let process = match &mut process {
                    Some(process) => process,
                    none => none.insert(self.surrogate(data)?),
                };
                self.acquire(process, &chosen, largest_observed, index)?
            };
            chosen.push(point);
        }
        Ok(chosen.split_off(pending.len()))
    }

    fn recommend(&self, data: &[Observation]) -> Result<Recommendation, SearchError> {
        if data.is_empty() {
            return Err(SearchError::NothingEvaluated);
        }
        let process = self.surrogate(data)?;
        let evaluated: Vec<f64> = data.iter().map(|o| process.mean(&o.point)).collect();
        let best_evaluated = (0..data.len())
            .max_by(|&a, &b| evaluated[a].total_cmp(&evaluated[b]).then(b.cmp(&a)))
            .ok_or(SearchError::NothingEvaluated)?;
        let acquisition = on(&process, PosteriorMean);
        let point = self.maximise(&acquisition, &means_at_data(&process), data.len());
        let posterior = process.posterior(&point);
        Ok(Recommendation {
            point,
            expected_return: posterior.mean,
            standard_deviation: Some(posterior.deviation()),
            best_evaluated,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn search_box() -> SearchBox {
        SearchBox::new(vec![0.0, -5.0], vec![2.0, 5.0]).unwrap()
    }

    /// A single hump of height 500 at (1.4, 1.0).
    fn hump(point: &[f64]) -> f64 {
        500.0 * (-((point[0] - 1.4) / 0.8).powi(2) - ((point[1] - 1.0) / 4.0).powi(2)).exp()
    }

    fn evaluated(search: &mut BayRn, mut data: Vec<Observation>, until: usize) -> Vec<Observation> {
        while data.len() < until {
            let point = search.propose(&data, &[], 1).unwrap().remove(0);
            let value = hump(&point);
            data.push(Observation { point, returns: vec![value - 5.0, value + 5.0] });
        }
        data
    }

    fn settings(acquisition: AcquisitionKind) -> BayRnSettings {
        BayRnSettings { initial_points: 5, acquisition, ..BayRnSettings::default() }
    }

    #[test]
    fn every_acquisition_finds_a_smooth_hump() {
        for acquisition in [
            AcquisitionKind::ExpectedImprovement,
            AcquisitionKind::ProbabilityOfImprovement,
            AcquisitionKind::UpperConfidenceBound,
            AcquisitionKind::NoisyExpectedImprovement,
            AcquisitionKind::KnowledgeGradient,
        ] {
            for base in [
                settings(acquisition),
                BayRnSettings { initial_points: 5, acquisition, ..BayRnSettings::thesis() },
            ] {
                let mut search = BayRn::new(search_box(), base, 3).unwrap();
                let data = evaluated(&mut search, Vec::new(), 20);
                let best = search.recommend(&data).unwrap();
                assert!(hump(&best.point) > 495.0, "{acquisition:?} {best:?}");
                assert!(hump(&data[best.best_evaluated].point) > 480.0);
                assert!((best.expected_return - 500.0).abs() < 30.0);
            }
        }
    }

    #[test]
    fn a_resumed_search_continues_like_one_that_was_never_stopped() {
        let kind = AcquisitionKind::KnowledgeGradient;
        let whole = evaluated(&mut BayRn::new(search_box(), settings(kind), 9).unwrap(), vec![], 9);
        for stopped in [0, 3, 5, 7] {
            let mut resumed = BayRn::new(search_box(), settings(kind), 9).unwrap();
            assert_eq!(evaluated(&mut resumed, whole[..stopped].to_vec(), 9), whole);
        }
        let other =
            BayRn::new(search_box(), settings(kind), 10).unwrap().propose(&[], &[], 1).unwrap();
        assert_ne!(other[0], whole[0].point);
    }

    #[test]
    fn a_batch_spreads_out() {
        for kind in [
            AcquisitionKind::ExpectedImprovement,
            AcquisitionKind::NoisyExpectedImprovement,
            AcquisitionKind::KnowledgeGradient,
        ] {
            let mut search = BayRn::new(search_box(), settings(kind), 1).unwrap();
            let data = evaluated(&mut search, vec![], 8);
            let batch = search.propose(&data, &[], 6).unwrap();
            assert_eq!(batch[0], search.propose(&data, &[], 1).unwrap()[0]);
            // The result does not depend on whether the pending points were proposed in this call
            // or earlier.
            assert_eq!(batch[4..], search.propose(&data, &batch[..4], 2).unwrap());
            let units: Vec<Vec<f64>> = batch.iter().map(|p| search_box().to_unit(p)).collect();
            for i in 0..units.len() {
                for j in 0..i {
                    let apart = units[i].iter().zip(&units[j]).map(|(a, b)| (a - b).abs());
                    assert!(apart.fold(0.0, f64::max) > 0.01, "{kind:?} {batch:?}");
                }
            }
        }
    }

    #[test]
    fn a_batch_may_begin_among_the_initial_points() {
        let mut search =
            BayRn::new(search_box(), settings(AcquisitionKind::ExpectedImprovement), 1).unwrap();
        let data = evaluated(&mut search, vec![], 4);
        let batch = search.propose(&data, &[], 3).unwrap();
        assert_eq!(batch[0], search.initial_point(4));
        assert_eq!(batch.len(), 3);
        // Without data the surrogate cannot be fitted.
        assert_eq!(search.propose(&[], &[], 8).unwrap()[7], search.initial_point(7));
    }

    #[test]
    fn the_expected_improvement_is_large_at_first_and_small_where_the_hump_is_known() {
        let mut search = BayRn::new(search_box(), settings(AcquisitionKind::default()), 3).unwrap();
        let few = evaluated(&mut search, Vec::new(), 5);
        let many = evaluated(&mut search, few.clone(), 25);
        let gain = |data: &[Observation], known| search.expected_improvement(data, known).unwrap();
        assert!(gain(&few, None) > 5.0, "{}", gain(&few, None));
        assert!((0.0..2.0).contains(&gain(&many, None)), "{}", gain(&many, None));
        // The hump is 500 high.
        let over = gain(&many, Some(400.0));
        assert!((over - 100.0).abs() < 20.0, "{over}");
        assert!(gain(&many, Some(600.0)) < 1.0);
        assert_eq!(search.expected_improvement(&[], None), Err(SearchError::NothingEvaluated));
    }

    #[test]
    fn poor_data_have_a_defined_recommendation() {
        let search = BayRn::new(
            search_box(),
            BayRnSettings { initial_points: 1, ..settings(AcquisitionKind::default()) },
            1,
        )
        .unwrap();
        let at = |x: f64, returns: Vec<f64>| Observation { point: vec![x, 0.0], returns };
        for data in [
            vec![at(1.0, vec![7.0])],
            vec![at(1.0, vec![7.0, 7.0]), at(0.5, vec![7.0, 7.0]), at(1.5, vec![7.0, 7.0])],
            vec![at(1.0, vec![7.0]), at(1.0, vec![9.0]), at(1.0, vec![8.0])],
        ] {
            let point = search.propose(&data, &[], 1).unwrap().remove(0);
            search_box().check(0, &point).unwrap();
            let best = search.recommend(&data).unwrap();
            assert!(
                best.expected_return.is_finite() && (6.0..10.0).contains(&best.expected_return)
            );
        }
        assert_eq!(search.recommend(&[]), Err(SearchError::NothingEvaluated));
        assert!(search.propose(&[at(3.0, vec![1.0])], &[], 1).is_err());
        assert!(search.propose(&[at(1.0, vec![f64::NAN])], &[], 1).is_err());
        assert!(search.propose(&[at(1.0, vec![1.0])], &[vec![3.0, 0.0]], 1).is_err());
    }
}
