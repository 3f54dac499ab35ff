//! The standard normal distribution, accurate far into its tail.

use std::f64::consts::{FRAC_1_SQRT_2, PI};

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// The density of the standard normal distribution at `z`.
#[must_use]
pub fn density(z: f64) -> f64 {
    log_density(z).exp()
}

/// Draws one standard normal number (Box and Muller 1958). The functions of `libm` give the same
/// bits on every platform. The room `elementary` has this transform too, but this room imports no
/// other.
pub fn draw(random: &mut ChaCha8Rng) -> f64 {
    // The argument lies in (0, 1], so that the logarithm is finite.
    let radius = (-2.0 * libm::log(1.0 - random.random::<f64>())).sqrt();
    radius * libm::cos(2.0 * PI * random.random::<f64>())
}

/// The natural logarithm of [`density`].
#[must_use]
pub fn log_density(z: f64) -> f64 {
    -0.5 * (z * z + (2.0 * PI).ln())
}

/// The distribution function: the probability that a standard normal number is at most `z`.
#[must_use]
pub fn distribution(z: f64) -> f64 {
    0.5 * libm::erfc(-z * FRAC_1_SQRT_2)
}

/// The natural logarithm of [`distribution`], accurate also where the probability underflows to 0.
#[must_use]
pub fn log_distribution(z: f64) -> f64 {
    if z > -1.0 { distribution(z).ln() } else { log_density(z) + tail(z).mills.ln() }
}

/// The natural logarithm of `h(z) = density(z) + z distribution(z)`: the expected improvement over
/// 0 of a normal number with mean `z` and standard deviation 1.
#[must_use]
pub fn log_improvement(z: f64) -> f64 {
    if z > -1.0 {
        (density(z) + z * distribution(z)).ln()
    } else {
        log_density(z) + tail(z).improvement.ln()
    }
}

/// The distribution function and `h` (see [`log_improvement`]) in the lower tail, divided by the
/// density, which underflows there.
pub(super) struct Tail {
    /// `distribution(z) / density(z)`, Mills' ratio.
    pub mills: f64,
    /// `h(z) / density(z)`.
    pub improvement: f64,
}

/// Computes the tail for z <= -1. The difference `1 - |z| mills` loses about `z^2` units in the
/// last place. From |z| = 14 on, `improvement` therefore comes from the asymptotic series
/// (Abramowitz and Stegun 1964, 26.2.12), whose smallest term is far below rounding there.
pub(super) fn tail(z: f64) -> Tail {
    let distance = -z;
    let mills = (0.5 * PI).sqrt() * scaled_complementary_error(distance * FRAC_1_SQRT_2);
    let improvement = if distance < 14.0 {
        1.0 - distance * mills
    } else {
        // 1/z^2 - 3/z^4 + 15/z^6 - ...
        let square = distance * distance;
        alternating_series(1.0 / square, |k| (2.0 * k + 1.0) / square)
    };
    Tail { mills, improvement }
}

/// `exp(x^2) erfc(x)` for x >= 0.
fn scaled_complementary_error(x: f64) -> f64 {
    if x < 7.0 {
        (x * x).exp() * libm::erfc(x)
    } else {
        // 1/(x sqrt(pi)) (1 - 1/(2x^2) + 3/(2x^2)^2 - ...)
        alternating_series(1.0 / (x * PI.sqrt()), |k| (2.0 * k - 1.0) / (2.0 * x * x))
    }
}

/// Sums `first - first r(1) + first r(1) r(2) - ...` until a term is negligible.
fn alternating_series(first: f64, ratio: impl Fn(f64) -> f64) -> f64 {
    let (mut sum, mut term) = (first, first);
    for k in 1..40 {
        term *= -ratio(f64::from(k));
        sum += term;
        if term.abs() < 1e-17 * sum {
            break;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn draws_have_the_right_moments() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let draws: Vec<f64> = (0..40_000).map(|_| draw(&mut random)).collect();
        let moment = |power| draws.iter().map(|x| x.powi(power)).sum::<f64>() / draws.len() as f64;
        assert!(moment(1).abs() < 0.02);
        assert!((moment(2) - 1.0).abs() < 0.03);
        assert!((moment(4) - 3.0).abs() < 0.15);
    }

    /// z, `ln h(z)`, `ln distribution(z)`, from arithmetic with 700 digits (mpmath).
    #[allow(clippy::excessive_precision, clippy::approx_constant)]
    const REFERENCE: [(f64, f64, f64); 10] = [
        (3.0, 1.098739665327707773, -0.001350809964748193799),
        (0.0, -0.9189385332046727418, -0.6931471805599453094),
        (-0.9, -2.298282989459651731, -1.692492806561338169),
        (-1.0, -2.485121025712641337, -1.841021645009263506),
        (-3.0, -7.869686059603028517, -6.607726221510349543),
        (-8.0, -37.122364261692633, -35.0134371599145499),
        (-13.9, -102.8029712239015175, -100.1609377683258053),
        (-14.1, -105.631120658297971, -102.9750815237353497),
        (-25.0, -319.8614635814959543, -316.6394080080202589),
        (-40.0, -808.2985683566199602, -804.6084420137537882),
    ];

    #[test]
    fn logarithms_are_right_far_into_the_tail() {
        for (z, improvement, probability) in REFERENCE {
            let close = |ours: f64, theirs: f64| {
                assert!(
                    (ours - theirs).abs() < 2e-12 * (1.0 + theirs.abs()),
                    "{z}: {ours} {theirs}"
                )
            };
            close(log_improvement(z), improvement);
            close(log_distribution(z), probability);
        }
        // Below z = -38.6 the density itself is zero in double precision.
        assert!((log_improvement(-1e6) - (log_density(-1e6) - 2.0 * 1e6_f64.ln())).abs() < 1e-3);
    }
}
