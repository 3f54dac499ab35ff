use std::cmp::Ordering;
use std::ops::{Add, Div, Mul, Neg, Sub};

use crate::elementary::Scalar;

/// A number with its derivatives with respect to `N` inputs: forward-mode differentiation.
///
/// Simulating with these numbers gives the states and their exact sensitivities in one run. Finite
/// differences need one run for each input, and a step that is neither too long for the equations
/// nor too short for their rounding.
#[derive(Clone, Copy, Debug)]
pub(super) struct Dual<const N: usize> {
    /// The number.
    pub value: f64,
    /// Derivatives of the number with respect to the inputs.
    pub slopes: [f64; N],
}

impl<const N: usize> Dual<N> {
    /// A number that depends on no input.
    #[inline(always)]
    pub fn constant(value: f64) -> Self {
        Self { value, slopes: [0.0; N] }
    }

    /// An input: its derivative with respect to itself is 1.
    pub fn input(value: f64, index: usize) -> Self {
        let mut slopes = [0.0; N];
        slopes[index] = 1.0;
        Self { value, slopes }
    }

    /// Applies the chain rule: `value` is a function of this number, and `slope` its derivative
    /// with respect to this number.
    #[inline(always)]
    fn chain(self, value: f64, slope: f64) -> Self {
        Self { value, slopes: self.slopes.map(|own| slope * own) }
    }

    #[inline(always)]
    fn combine(self, other: Self, value: f64, by_self: f64, by_other: f64) -> Self {
        let mut slopes = [0.0; N];
        for (index, slope) in slopes.iter_mut().enumerate() {
            *slope = by_self * self.slopes[index] + by_other * other.slopes[index];
        }
        Self { value, slopes }
    }
}

impl<const N: usize> PartialEq for Dual<N> {
    #[inline(always)]
    fn eq(&self, other: &Self) -> bool {
        self.value == other.value
    }
}

/// Numbers are compared by their values, so that a simulation takes the same branches with
/// derivatives as without.
impl<const N: usize> PartialOrd for Dual<N> {
    #[inline(always)]
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        self.value.partial_cmp(&other.value)
    }
}

impl<const N: usize> Add for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.combine(other, self.value + other.value, 1.0, 1.0)
    }
}

impl<const N: usize> Sub for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.combine(other, self.value - other.value, 1.0, -1.0)
    }
}

impl<const N: usize> Mul for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.combine(other, self.value * other.value, other.value, self.value)
    }
}

impl<const N: usize> Div for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn div(self, other: Self) -> Self {
        let (value, inverse) = (self.value / other.value, 1.0 / other.value);
        self.combine(other, value, inverse, -value * inverse)
    }
}

impl<const N: usize> Neg for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        self.chain(-self.value, -1.0)
    }
}

impl<const N: usize> Scalar for Dual<N> {
    #[inline(always)]
    fn from_f64(value: f64) -> Self {
        Self::constant(value)
    }

    #[inline(always)]
    fn abs(self) -> Self {
        self.chain(self.value.abs(), if self.value < 0.0 { -1.0 } else { 1.0 })
    }

    #[inline(always)]
    fn mul_add(self, factor: Self, summand: Self) -> Self {
        let mut slopes = summand.slopes;
        for (index, slope) in slopes.iter_mut().enumerate() {
            *slope += factor.value * self.slopes[index] + self.value * factor.slopes[index];
        }
        Self { value: Scalar::mul_add(self.value, factor.value, summand.value), slopes }
    }

    #[inline(always)]
    fn floor(self) -> Self {
        Self::constant(self.value.floor())
    }

    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (sin, cos) = Scalar::sin_cos(self.value);
        (self.chain(sin, cos), self.chain(cos, -sin))
    }

    #[inline(always)]
    fn exp(self) -> Self {
        let value = Scalar::exp(self.value);
        self.chain(value, value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derivatives_agree_with_finite_differences() {
        fn function<T: Scalar>(x: T, y: T) -> T {
            let (sin, cos) = (x * y).sin_cos();
            let quotient = (sin - x) / (T::from_f64(2.0) + y.abs());
            quotient.mul_add(cos, -(x * T::from_f64(0.3)).exp())
        }
        for (x, y) in [(0.7, -1.3), (-2.1, 0.4), (1.9, 2.2)] {
            let both = function(Dual::<2>::input(x, 0), Dual::input(y, 1));
            assert_eq!(both.value, function(x, y));
            let step = 1e-6;
            let by_x = (function(x + step, y) - function(x - step, y)) / (2.0 * step);
            let by_y = (function(x, y + step) - function(x, y - step)) / (2.0 * step);
            assert!((both.slopes[0] - by_x).abs() < 1e-8, "{both:?}, {by_x}");
            assert!((both.slopes[1] - by_y).abs() < 1e-8, "{both:?}, {by_y}");
        }
    }
}
