use thiserror::Error;

/// The reason why a surrogate cannot be built or evaluated.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum SurrogateError {
    /// The search box has no dimension.
    #[error("the search box has no dimension: give at least one lower and one upper bound")]
    NoDimensions,
    /// The lists of bounds differ in length.
    #[error(
        "the search box has {lower} lower but {upper} upper bounds: give one of each per dimension"
    )]
    BoundsDiffer {
        /// Number of lower bounds.
        lower: usize,
        /// Number of upper bounds.
        upper: usize,
    },
    /// A bound is NaN or infinite, or the width between the bounds is infinite.
    #[error(
        "the bounds of dimension {dimension} are [{lower}, {upper}]: both and their difference must be finite"
    )]
    BoundNotFinite {
        /// Index of the dimension, from 0.
        dimension: usize,
        /// Lower bound of the dimension.
        lower: f64,
        /// Upper bound of the dimension.
        upper: f64,
    },
    /// A lower bound is equal to the upper one, or above it.
    #[error(
        "dimension {dimension} has lower bound {lower} >= upper bound {upper}: the lower must be smaller"
    )]
    LowerNotBelowUpper {
        /// Index of the dimension, from 0.
        dimension: usize,
        /// Lower bound of the dimension.
        lower: f64,
        /// Upper bound of the dimension.
        upper: f64,
    },
    /// There is no observation.
    #[error("there is no observation to fit the surrogate to: evaluate at least one point first")]
    NoData,
    /// The list of values or of noise variances is not as long as the list of points.
    #[error("{points} points but {values} {list}: give one per point")]
    LengthsDiffer {
        /// Number of points.
        points: usize,
        /// Length of the other list.
        values: usize,
        /// Name of the other list.
        list: &'static str,
    },
    /// A point has too few or too many coordinates.
    #[error(
        "point {index} has {got} coordinates but the search box has {expected} dimensions: give one coordinate per dimension"
    )]
    WrongDimension {
        /// Index of the point, from 0.
        index: usize,
        /// Dimensions of the box.
        expected: usize,
        /// Coordinates of the point.
        got: usize,
    },
    /// A coordinate of a point is NaN or outside the search box.
    #[error(
        "point {index} lies outside the search box: coordinate {dimension} is {value}, allowed is [{lower}, {upper}]"
    )]
    OutsideBox {
        /// Index of the point, from 0.
        index: usize,
        /// Index of the coordinate, from 0.
        dimension: usize,
        /// Value of the coordinate.
        value: f64,
        /// Lower bound of the coordinate.
        lower: f64,
        /// Upper bound of the coordinate.
        upper: f64,
    },
    /// An observed value is NaN or infinite.
    #[error(
        "the value observed at point {index} is {value}: leave that observation out or repeat it"
    )]
    ValueNotFinite {
        /// Index of the point, from 0.
        index: usize,
        /// Observed value.
        value: f64,
    },
    /// A noise variance is negative or not finite.
    #[error("the noise variance of point {index} is {value}: it must be finite and not negative")]
    BadNoise {
        /// Index of the point, from 0.
        index: usize,
        /// Noise variance, in squared units of the values.
        value: f64,
    },
    /// The hyperparameters have another dimension than the data, or one of them is out of its
    /// range.
    #[error("bad hyperparameters: {reason}")]
    BadHyperparameters {
        /// Reason for the refusal.
        reason: String,
    },
    /// The covariance matrix cannot be factored even with jitter.
    #[error(
        "the covariance of {points} points is not positive definite even with a jitter of {jitter:e}: \
         the noise variance is too small for points so close together, use a larger one"
    )]
    NotPositiveDefinite {
        /// Number of points.
        points: usize,
        /// Jitter of the last attempt. For the covariance of the data it is a fraction of the
        /// signal variance; for the draws of the noisy expected improvement it is the number added
        /// to the diagonal.
        jitter: f64,
    },
}
