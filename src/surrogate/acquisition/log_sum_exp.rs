/// Computes `ln sum exp(t)` over the terms without overflow; minus infinity if there are none.
pub(super) fn log_sum_exp(terms: &[f64]) -> f64 {
    let largest = terms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if largest.is_finite() {
        largest + terms.iter().map(|t| (t - largest).exp()).sum::<f64>().ln()
    } else {
        largest
    }
}

#[cfg(test)]
mod tests {
    use super::log_sum_exp;

    #[test]
    fn the_sum_is_exact_for_large_small_and_no_terms() {
        assert!((log_sum_exp(&[1000.0, 1000.0]) - 1000.0 - 2f64.ln()).abs() < 1e-12);
        assert!((log_sum_exp(&[-2000.0, -3000.0]) + 2000.0).abs() < 1e-12);
        assert_eq!(log_sum_exp(&[]), f64::NEG_INFINITY);
    }
}
