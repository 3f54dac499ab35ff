use thiserror::Error;

/// Why a surrogate cannot be built or asked.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum SurrogateError {
    /// A search box without dimensions.
    #[error("the search box has no dimension: give at least one lower and one upper bound")]
    NoDimensions,
    /// Two lists of bounds that do not match.
    #[error(
        "the search box has {lower} lower but {upper} upper bounds: give one of each per dimension"
    )]
    BoundsDiffer {
        /// Number of lower bounds.
        lower: usize,
        /// Number of upper bounds.
        upper: usize,
    },
    /// A bound that is NaN or infinite.
    #[error("the bounds of dimension {dimension} are [{lower}, {upper}]: both must be finite")]
    BoundNotFinite {
        /// Which dimension, from 0.
        dimension: usize,
        /// Its lower bound.
        lower: f64,
        /// Its upper bound.
        upper: f64,
    },
    /// An empty or inverted interval.
    #[error(
        "dimension {dimension} has lower bound {lower} >= upper bound {upper}: the lower must be smaller"
    )]
    LowerNotBelowUpper {
        /// Which dimension, from 0.
        dimension: usize,
        /// Its lower bound.
        lower: f64,
        /// Its upper bound.
        upper: f64,
    },
    /// No observation at all.
    #[error("there is no observation to fit the surrogate to: evaluate at least one point first")]
    NoData,
    /// Lists that should be equally long are not.
    #[error("{points} points but {values} {what}: give one per point")]
    LengthsDiffer {
        /// Number of points.
        points: usize,
        /// Number of the others.
        values: usize,
        /// What the others are.
        what: &'static str,
    },
    /// A point with too few or too many coordinates.
    #[error("point {index} has {got} coordinates but the search box has {expected} dimensions")]
    WrongDimension {
        /// Which point, from 0.
        index: usize,
        /// Dimensions of the box.
        expected: usize,
        /// Coordinates of the point.
        got: usize,
    },
    /// A point that is NaN or not inside its box.
    #[error(
        "point {index} lies outside the search box: coordinate {dimension} is {value}, allowed is [{lower}, {upper}]"
    )]
    OutsideBox {
        /// Which point, from 0.
        index: usize,
        /// Which coordinate, from 0.
        dimension: usize,
        /// Its value.
        value: f64,
        /// The lower bound there.
        lower: f64,
        /// The upper bound there.
        upper: f64,
    },
    /// An observed value that is NaN or infinite.
    #[error(
        "the value observed at point {index} is {value}: leave that observation out or repeat it"
    )]
    ValueNotFinite {
        /// Which point, from 0.
        index: usize,
        /// The value.
        value: f64,
    },
    /// A noise variance that is none.
    #[error("the noise variance of point {index} is {value}: it must be finite and not negative")]
    BadNoise {
        /// Which point, from 0.
        index: usize,
        /// The value.
        value: f64,
    },
    /// Hyperparameters of another dimension, or not positive.
    #[error("bad hyperparameters: {reason}")]
    BadHyperparameters {
        /// What is wrong with them.
        reason: String,
    },
    /// The covariance matrix cannot be factored even with jitter.
    #[error(
        "the covariance of {points} points is not positive definite even with a jitter of {jitter:e}: \
         the noise variance is too small for points so close together, raise its lower bound"
    )]
    NotPositiveDefinite {
        /// Number of points.
        points: usize,
        /// The largest jitter that was tried, as a fraction of the signal variance.
        jitter: f64,
    },
}
