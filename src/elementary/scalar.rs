use std::ops::{Add, Div, Mul, Neg, Sub};

/// The arithmetic that the equations of motion need, so that they are written once for `f64`, for
/// the `f32` lanes of simulations, and for the identification's numbers with derivatives.
pub trait Scalar:
    Copy
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// The nearest representable value.
    fn from_f64(value: f64) -> Self;

    /// The magnitude.
    fn abs(self) -> Self;

    /// `self * factor + summand`. `f32` rounds once, because its kernels run where a fused
    /// multiply-add is one fast instruction; the others run outside of kernels and round twice.
    fn mul_add(self, factor: Self, summand: Self) -> Self;

    /// The largest integer that is not above the value.
    fn floor(self) -> Self;

    /// Sine and cosine of an angle in radians.
    fn sin_cos(self) -> (Self, Self);

    /// The exponential e^x.
    fn exp(self) -> Self;
}
