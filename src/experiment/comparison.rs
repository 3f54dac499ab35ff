//! Comparisons of the recipes or methods of an experiment, two at a time, on the same plant.

use rand::{RngExt as _, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::results::{PolicyResult, RecipeResult, Results};
use super::statistics::mean;

/// Number of random assignments of signs in a permutation test of many pairs, where the smallest
/// p-value is 0.0001. Fewer than 14 pairs have fewer assignments, and each of these is counted.
const PERMUTATIONS: usize = 9_999;

/// Seed of the random signs: the same results give the same p-value.
const SEED: u64 = 0x7065_726d_7574_6531;

/// The comparison of two recipes on one plant, or of two methods at one budget, over pairs of
/// policies with the same number, and so with the same seed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Name of the plant, or [`ALL_PLANTS`](super::ALL_PLANTS).
    pub plant: String,
    /// Name of the first recipe, or of the first method with its budget.
    pub first: String,
    /// Name of the second recipe, or of the second method with its budget.
    pub second: String,
    /// Number of pairs of policies.
    pub pairs: usize,
    /// Success rate of the second recipe less the first's, over the pairs.
    pub success_difference: f64,
    /// Number of comparisons on the same plant at the same budget, for which both p-values are
    /// corrected. It leaves out two methods that have the same policies, such as two rivals that
    /// both begin with the policy of `robust`.
    pub corrected_for: usize,
    /// p-value of `success_difference`: McNemar's exact test (1947), two-sided, corrected by Holm
    /// (1979).
    pub success_p: f64,
    /// Mean of the second recipe's return less the first's, over the pairs in which both policies
    /// have a return; NaN without such a pair.
    pub return_difference: f64,
    /// p-value of `return_difference`: a permutation test of the signs of the pairs' differences
    /// (Fisher 1935), two-sided, corrected by Holm in the same way; 1 where there is no difference.
    pub return_p: f64,
    /// Share of the pairs in which the second's return is higher; pairs without a return are left
    /// out, and ties count half. Equal recipes have 0.5. NaN where no pair has returns.
    pub superiority: f64,
}

impl Results {
    /// Comparisons of every two recipes with equal budgets, on every plant on which both have
    /// policies with the same number.
    #[must_use]
    pub fn comparisons(&self) -> Vec<Comparison> {
        let mut families: Vec<Vec<&RecipeResult>> = Vec::new();
        for recipe in &self.recipes {
            let belongs = |family: &&mut Vec<&RecipeResult>| {
                family[0].plant == recipe.plant && family[0].budget == recipe.budget
            };
            match families.iter_mut().find(belongs) {
                Some(family) => family.push(recipe),
                None => families.push(vec![recipe]),
            }
        }
        families.iter().flat_map(|family| compare_all(family)).collect()
    }
}

impl Comparison {
    /// The smallest value that `success_p` can have with so many pairs and comparisons, if no other
    /// comparison has a smaller p-value: its value where all policies of one recipe succeed and all
    /// policies of the other fail.
    #[must_use]
    pub fn smallest_success_p(&self) -> f64 {
        (self.corrected_for as f64 * mcnemar(self.pairs, 0)).min(1.0)
    }
}

/// Comparisons of every two of these recipes, corrected for their number.
fn compare_all(recipes: &[&RecipeResult]) -> Vec<Comparison> {
    let mut comparisons: Vec<Comparison> = Vec::new();
    for (index, first) in recipes.iter().enumerate() {
        let others = &recipes[index + 1..];
        comparisons.extend(others.iter().filter_map(|second| compare(first, second)));
    }
    let corrected_for = comparisons.iter().map(|it| it.corrected_for).sum();
    let corrected = |p_of: fn(&Comparison) -> f64| {
        holm(&comparisons.iter().map(p_of).collect::<Vec<_>>(), corrected_for)
    };
    let (by_success, by_return) = (corrected(|it| it.success_p), corrected(|it| it.return_p));
    for (index, comparison) in comparisons.iter_mut().enumerate() {
        (comparison.success_p, comparison.return_p) = (by_success[index], by_return[index]);
        comparison.corrected_for = corrected_for;
    }
    comparisons
}

/// Compares two recipes, without Holm's correction: `corrected_for` is 1, or 0 if the policies of
/// each pair earn exactly the same, because then they are the same policies, and no test is made.
/// Returns `None` if no number has a policy of both.
fn compare(first: &RecipeResult, second: &RecipeResult) -> Option<Comparison> {
    let pairs: Vec<(&PolicyResult, &PolicyResult)> = first
        .policies
        .iter()
        .filter_map(|one| {
            let other = second.policies.iter().find(|other| other.number == one.number)?;
            Some((one, other))
        })
        .collect();
    if pairs.is_empty() {
        return None;
    }
    let gained = pairs.iter().filter(|(one, other)| other.succeeds() && !one.succeeds()).count();
    let lost = pairs.iter().filter(|(one, other)| one.succeeds() && !other.succeeds()).count();
    let differences: Vec<f64> = pairs
        .iter()
        .filter_map(|(one, other)| Some(other.mean_return()? - one.mean_return()?))
        .collect();
    Some(Comparison {
        plant: first.plant.clone(),
        first: first.recipe.clone(),
        second: second.recipe.clone(),
        pairs: pairs.len(),
        corrected_for: usize::from(differences != vec![0.0; pairs.len()]),
        success_difference: (gained as f64 - lost as f64) / pairs.len() as f64,
        success_p: mcnemar(gained, lost),
        return_difference: mean(&differences),
        return_p: sign_permutation(&differences),
        superiority: superiority(&differences),
    })
}

/// McNemar's exact p-value, two-sided, of `gained` against `lost` among the pairs that differ; 1 if
/// none differs.
fn mcnemar(gained: usize, lost: usize) -> f64 {
    let differing = gained + lost;
    // The loop computes the logarithm of each count's probability under a fair coin from the
    // logarithm for the count before. The probability itself would be too small for an f64 where
    // more than 1074 pairs differ.
    let mut log_probability = -std::f64::consts::LN_2 * differing as f64;
    let mut tail = 0.0;
    for count in 0..=gained.min(lost) {
        tail += log_probability.exp();
        log_probability += ((differing - count) as f64 / (count + 1) as f64).ln();
    }
    (2.0 * tail).min(1.0)
}

/// The two-sided p-value of the mean of paired differences under random signs; 1 if there are no
/// differences or all are 0. It is exact, or estimated from [`PERMUTATIONS`] random assignments of
/// signs where there are more assignments than that.
fn sign_permutation(differences: &[f64]) -> f64 {
    let observed = differences.iter().sum::<f64>().abs();
    let largest: f64 = differences.iter().map(|it| it.abs()).sum();
    // Rounding must not hide an assignment that equals the observed one.
    let least = observed - 1e-12 * largest;
    let is_as_extreme = |keeps: &mut dyn FnMut(usize) -> bool| {
        let signed = (0..).zip(differences).map(|(pair, it)| if keeps(pair) { *it } else { -it });
        signed.sum::<f64>().abs() >= least
    };
    let assignments = 1_usize.checked_shl(differences.len() as u32).unwrap_or(usize::MAX);
    if assignments <= PERMUTATIONS {
        let as_extreme = (0..assignments)
            .filter(|signs| is_as_extreme(&mut |pair| (signs >> pair) & 1 == 1))
            .count();
        return as_extreme as f64 / assignments as f64;
    }
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let as_extreme = (0..PERMUTATIONS).filter(|_| is_as_extreme(&mut |_| random.random())).count();
    (as_extreme + 1) as f64 / (PERMUTATIONS + 1) as f64
}

/// Share of paired differences above 0; ties count half. NaN if there are no differences.
fn superiority(differences: &[f64]) -> f64 {
    let score = |difference: &f64| match difference.total_cmp(&0.0) {
        std::cmp::Ordering::Greater => 1.0,
        std::cmp::Ordering::Equal => 0.5,
        std::cmp::Ordering::Less => 0.0,
    };
    differences.iter().map(score).sum::<f64>() / differences.len() as f64
}

/// Corrects p-values by Holm's step-down method for a number of tests. If there are more p-values
/// than tests, those without a test are 1.
fn holm(p_values: &[f64], tests: usize) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p_values.len()).collect();
    order.sort_by(|a, b| p_values[*a].total_cmp(&p_values[*b]));
    let mut corrected = vec![0.0; p_values.len()];
    let mut largest: f64 = 0.0;
    for (rank, index) in order.into_iter().enumerate() {
        let remaining = tests.saturating_sub(rank).max(1);
        largest = largest.max(remaining as f64 * p_values[index]).min(1.0);
        corrected[index] = largest;
    }
    corrected
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::RolloutResult;
    use crate::scoring::{Behaviour, Quietness};

    #[test]
    fn mcnemar_is_a_binomial_test_of_the_pairs_that_differ() {
        // R: binom.test(1, 10)$p.value, binom.test(0, 5)$p.value, binom.test(3, 15)$p.value.
        assert!((mcnemar(1, 9) - 0.021_484_375).abs() < 1e-12);
        assert!((mcnemar(5, 0) - 0.0625).abs() < 1e-12);
        assert!((mcnemar(12, 3) - 0.035_156_25).abs() < 1e-12);
        assert_eq!((mcnemar(0, 0), mcnemar(4, 4)), (1.0, 1.0));
        // From logarithms of the gamma function.
        assert!((mcnemar(950, 1050) - 0.026_824_146).abs() < 1e-8);
    }

    #[test]
    fn all_signs_of_few_differences_are_counted() {
        // Five differences of one sign: 2 of 32 assignments are as extreme.
        assert_eq!(sign_permutation(&[1.0, 2.0, 3.0, 4.0, 5.0]), 2.0 / 32.0);
        assert_eq!(sign_permutation(&[3.0, -1.0, 4.0, -2.0]), 10.0 / 16.0);
        assert_eq!(sign_permutation(&[1.0, -1.0]), 1.0);
        // The sums of these differ by rounding alone.
        assert_eq!(sign_permutation(&[0.1, 0.2, -0.3]), 1.0);
        assert_eq!(sign_permutation(&[]), 1.0);
        assert_eq!(sign_permutation(&[1.0; 13]), 2.0 / 8192.0);
    }

    #[test]
    fn signs_of_many_differences_are_drawn() {
        // All of 14, or 14 less one: 30 of 16 384 assignments are as extreme.
        let mut differences = [1.0; 14];
        differences[0] = -1.0;
        let p = sign_permutation(&differences);
        assert!((p - 30.0 / 16_384.0).abs() < 0.001, "{p}");
        assert!(sign_permutation(&[1.0; 100]) >= 1e-4);
    }

    #[test]
    fn holm_corrects_by_the_number_of_remaining_p_values() {
        // R: p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm").
        let corrected = holm(&[0.01, 0.04, 0.03, 0.005], 4);
        for (found, expected) in corrected.iter().zip([0.03, 0.06, 0.06, 0.02]) {
            assert!((found - expected).abs() < 1e-12, "{corrected:?}");
        }
        assert_eq!(holm(&[0.9, 0.8], 2), [1.0, 1.0]);
        assert_eq!(holm(&[1.0, 0.02, 1.0], 2), [1.0, 0.04, 1.0]);
    }

    #[test]
    fn a_method_that_shares_the_policies_of_another_adds_no_test() {
        let policy = |(number, return_)| PolicyResult {
            number,
            simulated_return: 540.0,
            rollouts: vec![RolloutResult {
                return_: Some(return_),
                behaviour: Behaviour::Balanced,
                quietness: Quietness::NONE,
            }],
            recordings: Default::default(),
            fallback: None,
        };
        let result = |name: &str, returns: [f64; 6]| RecipeResult {
            recipe: name.into(),
            plant: "lab".into(),
            budget: Some(0),
            psi: Default::default(),
            policies: (0..).zip(returns).map(policy).collect(),
        };
        let robust = result("robust", [500.0, 510.0, 505.0, 507.0, 503.0, 501.0]);
        let simopt = RecipeResult { recipe: "simopt".into(), ..robust.clone() };
        let history = result("history", [520.0, 521.0, 522.0, 523.0, 524.0, 525.0]);
        let compared = compare_all(&[&robust, &simopt, &history]);
        let found = compared.iter().map(|it| (it.corrected_for, it.return_p)).collect::<Vec<_>>();
        assert_eq!(found, [(2, 1.0), (2, 2.0 * 2.0 / 64.0), (2, 2.0 * 2.0 / 64.0)]);
    }

    #[test]
    fn superiority_counts_pairs_and_ties_half() {
        assert_eq!(superiority(&[0.0, 0.0]), 0.5);
        assert_eq!(superiority(&[2.0, 0.1, -9.0, 0.0]), 0.625);
        assert!(superiority(&[]).is_nan());
    }

    /// A test at 5 % may find a difference between equal recipes in one of twenty experiments.
    #[test]
    fn equal_recipes_differ_as_often_as_the_level_of_the_test_allows() {
        let mut random = ChaCha8Rng::seed_from_u64(1000);
        let found = (0..400)
            .filter(|_| {
                let mut earned = || if random.random::<f64>() < 0.8 { 540.0 } else { 100.0 };
                let differences: Vec<f64> = (0..20).map(|_| earned() - earned()).collect();
                sign_permutation(&differences) < 0.05
            })
            .count();
        assert!(found <= 33, "{found} of 400");
    }
}
