//! Elementary functions for `f32`.
//!
//! Each function is a polynomial or a quotient of two after a range reduction; the inverse square
//! root is two Newton steps after a first guess. All are built only from basic arithmetic,
//! [`f32::mul_add`], clamping and bit operations in a fixed order, so every processor computes the
//! same bits. No function has a branch, so a loop over a slice becomes vector code when it is
//! compiled for vectors (see [`super::VectorKernel`]).
//!
//! The coefficients of the polynomials are minimax fits of this project: iteratively reweighted
//! least squares (Lawson's algorithm) in double precision on 4000 Chebyshev-spaced points, the
//! quotient linearised with the denominator of the previous round. The fitted coefficients are then
//! rounded to `f32`. The coefficients of cos are rounded one after the other, with the remaining
//! ones fitted again each time. The error bounds below include `f32` rounding and are tested on
//! dense grids.

use super::Scalar;

/// Largest |x| for which tanh is computed; beyond it tanh is constant: 1 - tanh(8) = 2.3e-7.
const TANH_SATURATION: f32 = 8.0;

/// Coefficients of s, s^2, s^3 and s^4 in the numerator of tanh, where s = x^2; the constant term
/// is 1.
const TANH_NUMERATOR: [f32; 4] = [1.271_166_4e-1, 2.695_739_8e-3, 7.157_679e-6, -6.134_338e-9];

/// Coefficients of s, s^2 and s^3 in the denominator of tanh; the constant term is 1.
const TANH_DENOMINATOR: [f32; 3] = [4.604_484_6e-1, 2.284_745_3e-2, 1.966_603_7e-4];

/// Hyperbolic tangent; absolute error at most 5e-7, never beyond +-1. NaN stays NaN.
///
/// Computes x P4(x^2) / Q3(x^2) on [-8, 8]. Both constant terms are 1, so that small x keep their
/// relative accuracy. (A quotient one degree smaller is off by 2.6e-6.)
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    let x = x.clamp(-TANH_SATURATION, TANH_SATURATION);
    let s = x * x;
    let [p1, p2, p3, p4] = TANH_NUMERATOR;
    let numerator = p4.mul_add(s, p3).mul_add(s, p2).mul_add(s, p1).mul_add(s, 1.0);
    let [q1, q2, q3] = TANH_DENOMINATOR;
    let denominator = q3.mul_add(s, q2).mul_add(s, q1).mul_add(s, 1.0);
    (x * numerator / denominator).clamp(-1.0, 1.0)
}

/// Sine and cosine of an angle in radians; absolute error of each at most 2e-7 on +-17 and 1e-6 on
/// +-1e4. NaN and infinities give NaN.
///
/// Subtracts the nearest multiple of pi in two parts, then evaluates polynomials of degree 9 and 8
/// on [-pi/2, pi/2].
#[inline(always)]
pub fn sin_cos(x: f32) -> (f32, f32) {
    /// 1.5 * 2^23: adding this number rounds a value to an integer, which the low bits of the sum
    /// then hold.
    const ROUND: f32 = 12_582_912.0;
    const PI_HIGH: f32 = std::f32::consts::PI;
    /// pi - PI_HIGH.
    const PI_LOW: f32 = -8.742_278e-8;

    let shifted = x.mul_add(std::f32::consts::FRAC_1_PI, ROUND);
    let half_turns = shifted - ROUND;
    let r = (-half_turns).mul_add(PI_LOW, (-half_turns).mul_add(PI_HIGH, x));
    // An odd number of half turns changes both signs.
    let sign = shifted.to_bits() << 31;
    let s = r * r;
    // The halves of each polynomial are independent, so the processor computes them in parallel.
    let s2 = s * s;
    let sin_high = 2.599_903_1e-6_f32.mul_add(s, -1.980_654_7e-4);
    let sin_low = 8.333_016e-3_f32.mul_add(s, -1.666_665_7e-1);
    let sin = sin_high.mul_add(s2, sin_low).mul_add(s * r, r);
    let cos_high = 2.315_998_4e-5_f32.mul_add(s, -1.385_441_6e-3);
    let cos_low = 4.166_379_6e-2_f32.mul_add(s, -4.999_992_5e-1);
    let cos = cos_high.mul_add(s2, cos_low).mul_add(s, 1.0);
    (f32::from_bits(sin.to_bits() ^ sign), f32::from_bits(cos.to_bits() ^ sign))
}

/// e^x; relative error at most 2e-7 on [-87, 88]. Outside that range the result is the value at the
/// nearer end (1.6e-38 or 1.7e38), so that it remains a normal number. NaN stays NaN.
///
/// Multiplies 2^n by a polynomial of degree 5 in the remainder, which is within +-ln 2 / 2.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0;
    const LN_2_HIGH: f32 = std::f32::consts::LN_2;
    /// ln 2 - LN_2_HIGH.
    const LN_2_LOW: f32 = -1.904_654_3e-9;

    let x = x.clamp(-87.0, 88.0);
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = (-n).mul_add(LN_2_LOW, (-n).mul_add(LN_2_HIGH, x));
    let polynomial = 8.312_481e-3_f32
        .mul_add(r, 4.189_055e-2)
        .mul_add(r, 1.666_711_6e-1)
        .mul_add(r, 4.999_922_9e-1)
        .mul_add(r, 1.0)
        .mul_add(r, 1.0);
    // Shifts the integer from the low bits into the exponent's place.
    let power_of_two = f32::from_bits((shifted.to_bits() << 23).wrapping_add(127 << 23));
    polynomial * power_of_two
}

/// 1 / sqrt(x) of a positive normal number; relative error at most 8e-7. Zero gives a large number.
///
/// Halving the exponent in the bits gives a first guess within 3.5 %; each of two Newton steps
/// squares that error. The integer constant, and the constants near 3/2, balance the largest errors
/// of both signs. Division and square root are avoided because they are slow, the processor's own
/// approximations because they differ between processors.
#[inline(always)]
pub fn inverse_square_root(x: f32) -> f32 {
    let half = 0.5 * x;
    let y = f32::from_bits(0x5f37_6900_u32.wrapping_sub(x.to_bits() >> 1));
    let y = y * (-half * y).mul_add(y, 1.500_878_9);
    y * (-half * y).mul_add(y, 1.500_000_6)
}

impl Scalar for f32 {
    #[inline(always)]
    fn from_f64(value: f64) -> Self {
        value as f32
    }

    #[inline(always)]
    fn abs(self) -> Self {
        f32::abs(self)
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, summand: Self) -> Self {
        f32::mul_add(self, factor, summand)
    }

    #[inline(always)]
    fn floor(self) -> Self {
        f32::floor(self)
    }

    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        sin_cos(self)
    }

    #[inline(always)]
    fn exp(self) -> Self {
        exp(self)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use nalgebra::{DMatrix, DVector};

    use super::*;

    /// `count` values evenly over [low, high].
    fn grid(low: f64, high: f64, count: u32) -> impl Iterator<Item = f32> {
        (0..=count).map(move |i| (low + (high - low) * f64::from(i) / f64::from(count)) as f32)
    }

    #[test]
    fn tanh_is_within_5e_7_and_never_beyond_one() {
        for x in grid(-12.0, 12.0, 1_000_000).chain([f32::MAX, f32::MIN, f32::INFINITY]) {
            let error = (f64::from(tanh(x)) - f64::from(x).tanh()).abs();
            assert!(error <= 5e-7, "tanh({x}) is off by {error:e}");
            assert!(tanh(x).abs() <= 1.0);
            assert_eq!(tanh(-x), -tanh(x));
        }
        assert!(tanh(f32::NAN).is_nan());
    }

    /// Fits the quotient of tanh as the module's page describes, on fewer points and in fewer
    /// rounds. Returns the coefficients of the numerator, then of the denominator.
    fn fitted_tanh() -> [f64; 7] {
        const POINTS: u32 = 400;
        const ROUNDS: usize = 100;
        let reach = f64::from(TANH_SATURATION);
        // The fit is well conditioned in powers of (x / reach)^2.
        let points: Vec<(f64, f64)> = (0..POINTS)
            .map(|i| (FRAC_PI_2 * (f64::from(i) + 0.5) / f64::from(POINTS)).cos())
            .map(|u| (u * u, (reach * u).tanh()))
            .collect();
        let x = |s: f64| reach * s.sqrt();
        let terms = |(s, tanh): (f64, f64)| {
            let [first, second, third] = [s, s * s, s * s * s].map(|power| -tanh * power);
            [x(s) * s, x(s) * s * s, x(s) * s.powi(3), x(s) * s.powi(4), first, second, third]
        };
        let mut weights = vec![1.0; points.len()];
        let mut denominators = vec![1.0; points.len()];
        let mut fit = [0.0; 7];
        for _ in 0..ROUNDS {
            let scale: Vec<f64> = weights
                .iter()
                .zip(&denominators)
                .map(|(w, q): (&f64, &f64)| w.sqrt() / q)
                .collect();
            let rows = points.iter().zip(&scale).flat_map(|(at, k)| terms(*at).map(|t| k * t));
            let matrix = DMatrix::from_row_iterator(points.len(), 7, rows);
            let right = points.iter().zip(&scale).map(|((s, tanh), k)| k * (tanh - x(*s)));
            let right = DVector::from_iterator(points.len(), right);
            let qr = matrix.qr();
            let solution = qr.r().solve_upper_triangular(&(qr.q().transpose() * right)).unwrap();
            fit.copy_from_slice(solution.as_slice());
            for (index, &(s, tanh)) in points.iter().enumerate() {
                let [p1, p2, p3, p4, q1, q2, q3] = fit;
                let numerator = 1.0 + s * (p1 + s * (p2 + s * (p3 + s * p4)));
                denominators[index] = 1.0 + s * (q1 + s * (q2 + s * q3));
                weights[index] *= (x(s) * numerator / denominators[index] - tanh).abs();
            }
            let sum: f64 = weights.iter().sum();
            weights.iter_mut().for_each(|weight| *weight /= sum);
        }
        let powers = [1, 2, 3, 4, 1, 2, 3];
        std::array::from_fn(|i| fit[i] / reach.powi(2 * powers[i]))
    }

    #[test]
    fn the_coefficients_of_tanh_agree_with_the_fit() {
        let coefficients = TANH_NUMERATOR.into_iter().chain(TANH_DENOMINATOR).map(f64::from);
        for (coefficient, fitted) in coefficients.zip(fitted_tanh()) {
            assert!((coefficient / fitted - 1.0).abs() < 5e-5, "{coefficient:e} {fitted:e}");
        }
    }

    #[test]
    fn tanh_of_small_values_keeps_relative_accuracy() {
        for x in grid(1e-6, 0.1, 100_000) {
            let exact = f64::from(x).tanh();
            let relative = (f64::from(tanh(x)) - exact).abs() / exact;
            assert!(relative <= 1e-6, "tanh({x}) is off by {relative:e} of its value");
        }
    }

    #[test]
    fn sine_and_cosine_are_within_2e_7_where_pendulums_go_and_1e_6_far_beyond() {
        for (reach, bound) in [(17.0, 2e-7), (1e4, 1e-6)] {
            for x in grid(-reach, reach, 1_000_000) {
                let (sin, cos) = sin_cos(x);
                let (exact_sin, exact_cos) = f64::from(x).sin_cos();
                let error =
                    (f64::from(sin) - exact_sin).abs().max((f64::from(cos) - exact_cos).abs());
                assert!(error <= bound, "sin_cos({x}) is off by {error:e}");
            }
        }
        for x in grid(-1e7, 1e7, 100_000) {
            let (sin, cos) = sin_cos(x);
            assert!(sin.is_finite() && cos.is_finite(), "sin_cos({x}) = {sin}, {cos}");
        }
        assert_eq!(sin_cos(0.0), (0.0, 1.0));
    }

    #[test]
    fn exp_is_within_2e_7_of_its_value_and_normal_everywhere() {
        for x in grid(-87.0, 88.0, 1_000_000) {
            let exact = f64::from(x).exp();
            let relative = (f64::from(exp(x)) - exact).abs() / exact;
            assert!(relative <= 2e-7, "exp({x}) is off by {relative:e} of its value");
        }
        for x in [f32::MIN, f32::MAX, f32::INFINITY, f32::NEG_INFINITY] {
            assert!(exp(x).is_normal(), "exp({x}) = {}", exp(x));
        }
        assert!(exp(f32::NAN).is_nan());
        assert_eq!(exp(0.0), 1.0);
    }

    #[test]
    fn inverse_square_root_is_within_8e_7_of_its_value_from_tiny_to_huge() {
        let check = |x: f32| {
            let relative = f64::from(inverse_square_root(x)) * f64::from(x).sqrt() - 1.0;
            assert!(relative.abs() <= 8e-7, "1 / sqrt({x}) is off by {relative:e} of its value");
        };
        // The error repeats every second power of two.
        grid(1.0, 4.0, 1_000_000).for_each(check);
        (-126..128).for_each(|power| check(2.0_f32.powi(power) * 1.7));
        let largest = inverse_square_root(0.0);
        assert!(largest.is_normal() && largest > 1e19, "{largest:e}");
    }
}
