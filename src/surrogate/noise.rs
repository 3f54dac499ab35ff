/// Weight of the pooled variance relative to a point's own sample variance, in degrees of freedom.
const PRIOR_DEGREES: f64 = 12.0;

/// Estimates the noise variance of each point's mean from the spread of the point's repeated
/// values. `groups` has one non-empty list of values for each point; the result is in squared units
/// of the values.
///
/// The sample variance of two or five values is itself very uncertain: among returns that are
/// either 50 or 500, five equal ones are common and would suggest certainty. Each sample variance
/// `s_i^2` of `k_i` values is therefore shrunk towards the pooled variance `s_0^2 = sum (k_i - 1)
/// s_i^2 / sum (k_i - 1)`, as under a scaled inverse chi-squared prior (moderated variances, Smyth
/// 2004): `s~_i^2 = (12 s_0^2 + (k_i - 1) s_i^2) / (12 + k_i - 1)`. The mean of the `k_i` values
/// then has the variance `s~_i^2 / k_i`.
///
/// Returns `None` if no point has two values. An error that all values of a point share (such as
/// the luck of one policy's training) does not show in their spread; the fitted noise variance of
/// the surrogate covers it.
#[must_use]
pub fn noise_of_means(groups: &[&[f64]]) -> Option<Vec<f64>> {
    let degrees = |group: &[f64]| group.len().saturating_sub(1) as f64;
    let total: f64 = groups.iter().map(|g| degrees(g)).sum();
    if total == 0.0 {
        return None;
    }
    let pooled = groups.iter().map(|g| squared_deviations(g)).sum::<f64>() / total;
    let noise = |group: &&[f64]| {
        let moderated =
            (PRIOR_DEGREES * pooled + squared_deviations(group)) / (PRIOR_DEGREES + degrees(group));
        moderated / group.len() as f64
    };
    Some(groups.iter().map(noise).collect())
}

fn squared_deviations(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    values.iter().map(|v| (v - mean) * (v - mean)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_samples_are_drawn_towards_the_pool() {
        let groups: [&[f64]; 3] = [&[500.0; 5], &[50.0, 500.0, 50.0, 500.0, 50.0], &[480.0]];
        let noise = noise_of_means(&groups).unwrap();
        assert!(noise[0] > 0.0, "five equal returns give no certainty");
        assert!(noise[1] > 1.3 * noise[0]);
        assert!(noise[2] > noise[1], "one value is less certain than five");
    }

    #[test]
    fn large_samples_keep_their_own_variance() {
        let wide: Vec<f64> = (0..1000).map(|i| if i % 2 == 0 { 1.0 } else { -1.0 }).collect();
        let noise = noise_of_means(&[&wide, &[0.0; 1000]]).unwrap();
        assert!((noise[0] * 1000.0 - 1.0).abs() < 0.01);
        assert!(noise[1] * 1000.0 < 0.01);
    }

    #[test]
    fn without_repetition_there_is_no_estimate() {
        assert_eq!(noise_of_means(&[&[1.0], &[2.0]]), None);
        assert_eq!(noise_of_means(&[]), None);
    }
}
