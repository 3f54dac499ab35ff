use std::f64::consts::PI;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// One draw from the standard normal distribution (Box and Muller 1958), with `libm`'s functions:
/// the same bits on every platform.
pub(super) fn standard_normal(random: &mut ChaCha8Rng) -> f64 {
    // (0, 1], so that the logarithm is finite
    let radius = (-2.0 * libm::log(1.0 - random.random::<f64>())).sqrt();
    radius * libm::cos(2.0 * PI * random.random::<f64>())
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn moments() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let draws: Vec<f64> = (0..40_000).map(|_| standard_normal(&mut random)).collect();
        let moment = |power| draws.iter().map(|x| x.powi(power)).sum::<f64>() / draws.len() as f64;
        assert!(moment(1).abs() < 0.02);
        assert!((moment(2) - 1.0).abs() < 0.03);
        assert!((moment(4) - 3.0).abs() < 0.15);
    }
}
