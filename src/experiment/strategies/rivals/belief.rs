use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::gaussian::Gaussian;
use super::space::Space;

/// A rival's belief about a Qube after some recordings, in the coordinates of a [`Space`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "Written", into = "Written")]
pub enum Belief {
    /// Nothing has been learnt.
    Unknown,
    /// A normal distribution.
    Gaussian(Gaussian),
    /// Any other distribution, given by draws from it.
    Points(Vec<DVector<f64>>),
}

/// A belief in the form in which files store it: a covariance column by column.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Written {
    Unknown,
    Gaussian { mean: Vec<f64>, covariance: Vec<f64> },
    Points(Vec<Vec<f64>>),
}

impl Belief {
    /// Draws points whose Qubes can be simulated. A belief that is given by points draws nothing:
    /// it gives `count` of its points, at even distances in their order, or none if it has none.
    pub fn draws(&self, space: &Space, count: usize, random: &mut ChaCha8Rng) -> Vec<DVector<f64>> {
        match self {
            Self::Unknown => space.draws(count, random),
            Self::Gaussian(gaussian) => {
                gaussian.draws(count, random).iter().map(|point| space.clamped(point)).collect()
            }
            Self::Points(points) => {
                let evenly = |number: usize| &points[number * points.len() / count];
                let count = if points.is_empty() { 0 } else { count };
                (0..count).map(|number| space.clamped(evenly(number))).collect()
            }
        }
    }

    /// The normal distribution with the mean and covariance of the belief.
    pub fn gaussian(&self, space: &Space) -> Gaussian {
        match self {
            Self::Unknown => Gaussian::standard(space.dimensions()),
            Self::Gaussian(gaussian) => gaussian.clone(),
            Self::Points(points) => Gaussian::of_points(points, &vec![1.0; points.len()]),
        }
    }
}

impl From<Belief> for Written {
    fn from(belief: Belief) -> Self {
        match belief {
            Belief::Unknown => Self::Unknown,
            Belief::Gaussian(Gaussian { mean, covariance }) => Self::Gaussian {
                mean: mean.as_slice().to_vec(),
                covariance: covariance.as_slice().to_vec(),
            },
            Belief::Points(points) => {
                Self::Points(points.iter().map(|point| point.as_slice().to_vec()).collect())
            }
        }
    }
}

impl From<Written> for Belief {
    fn from(written: Written) -> Self {
        match written {
            Written::Unknown => Self::Unknown,
            Written::Gaussian { mean, covariance } => {
                let size = mean.len();
                let entry = |row: usize, column: usize| {
                    covariance.get(column * size + row).copied().unwrap_or_default()
                };
                let covariance = DMatrix::from_fn(size, size, entry);
                Self::Gaussian(Gaussian { mean: DVector::from_vec(mean), covariance })
            }
            Written::Points(points) => {
                Self::Points(points.into_iter().map(DVector::from_vec).collect())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_belief_reads_back_the_same() {
        let gaussian = Gaussian {
            mean: DVector::from_vec(vec![1.0, 0.1]),
            covariance: DMatrix::from_row_slice(2, 2, &[2.0, 0.3, 0.3, 1.0 / 3.0]),
        };
        let points = vec![DVector::from_vec(vec![0.1, 2.0]), DVector::from_vec(vec![1e-300, 7.0])];
        for belief in [Belief::Unknown, Belief::Gaussian(gaussian), Belief::Points(points)] {
            let text = serde_json::to_string(&belief).unwrap();
            assert_eq!(serde_json::from_str::<Belief>(&text).unwrap(), belief);
        }
    }
}
