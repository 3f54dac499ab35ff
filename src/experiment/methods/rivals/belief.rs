use nalgebra::{DMatrix, DVector};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::gaussian::Gaussian;
use super::space::Space;
use crate::storage::checksum_of;

/// A rival's belief about a Qube after some recordings, in the coordinates of a [`Space`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub enum RivalBelief {
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

/// The field with the checksum of the belief, the last one of its file, up to the checksum.
const CHECKSUM_FIELD: &str = ",\"checksum\":\"";

impl RivalBelief {
    /// The belief as JSON for its file. An object has a checksum of the belief as its last field.
    ///
    /// # Errors
    /// The belief has no JSON form.
    pub fn to_file(&self) -> Result<String, serde_json::Error> {
        let text = serde_json::to_string(self)?;
        Ok(match text.strip_suffix('}') {
            Some(fields) => format!("{fields}{CHECKSUM_FIELD}{}\"}}", checksum_of(text.as_bytes())),
            None => text,
        })
    }

    /// Reads the belief of a file. A file without a checksum, which an earlier version wrote, is
    /// read as it is.
    ///
    /// # Errors
    /// The file is damaged.
    pub fn of_file(text: &str) -> Result<Self, String> {
        let Some((fields, checksum)) = text.rsplit_once(CHECKSUM_FIELD) else {
            return serde_json::from_str(text).map_err(|error| error.to_string());
        };
        let belief = format!("{fields}}}");
        if checksum.trim_end() != format!("{}\"}}", checksum_of(belief.as_bytes())) {
            return Err("its checksum does not match".to_owned());
        }
        serde_json::from_str(&belief).map_err(|error| error.to_string())
    }

    /// Returns `count` points whose Qubes can be simulated. The points of a distribution are drawn;
    /// a belief of points returns its own at even distances in their order: some of them if there
    /// are more than `count`, repetitions if there are fewer, none if it has none.
    pub fn draws(&self, space: &Space, count: usize, random: &mut ChaCha8Rng) -> Vec<DVector<f64>> {
        match self {
            Self::Unknown => space.draws(count, random),
            Self::Gaussian(gaussian) => space.draws_within(count, gaussian.drawing(random)),
            Self::Points(points) => {
                let evenly = |number: usize| &points[number * points.len() / count];
                let count = if points.is_empty() { 0 } else { count };
                (0..count).map(|number| space.clamped(evenly(number))).collect()
            }
        }
    }

    /// Returns the belief if it has as many coordinates as the space.
    ///
    /// # Errors
    /// Names the two numbers if they differ.
    pub fn within(self, space: &Space) -> Result<Self, String> {
        let own = match &self {
            Self::Unknown => None,
            Self::Gaussian(gaussian) => Some(gaussian.mean.len()),
            Self::Points(points) => points.first().map(DVector::len),
        };
        match own {
            Some(own) if own != space.dimensions() => Err(format!(
                "the belief has {own} coordinates, and the plant has {}: the file is damaged",
                space.dimensions()
            )),
            _ => Ok(self),
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

impl From<RivalBelief> for Written {
    fn from(belief: RivalBelief) -> Self {
        match belief {
            RivalBelief::Unknown => Self::Unknown,
            RivalBelief::Gaussian(Gaussian { mean, covariance }) => Self::Gaussian {
                mean: mean.as_slice().to_vec(),
                covariance: covariance.as_slice().to_vec(),
            },
            RivalBelief::Points(points) => {
                Self::Points(points.iter().map(|point| point.as_slice().to_vec()).collect())
            }
        }
    }
}

impl TryFrom<Written> for RivalBelief {
    type Error = String;

    fn try_from(written: Written) -> Result<Self, Self::Error> {
        Ok(match written {
            Written::Unknown => Self::Unknown,
            Written::Gaussian { mean, covariance } => {
                let (size, entries) = (mean.len(), covariance.len());
                if size.checked_mul(size) != Some(entries) {
                    return Err(format!(
                        "the covariance has {entries} entries, and the mean has {size}: the file is damaged"
                    ));
                }
                let covariance = DMatrix::from_vec(size, size, covariance);
                Self::Gaussian(Gaussian { mean: DVector::from_vec(mean), covariance })
            }
            Written::Points(points) => {
                if points.is_empty() {
                    return Err("there is no point: the file is damaged".to_owned());
                }
                if let Some(other) = points.iter().find(|point| point.len() != points[0].len()) {
                    return Err(format!(
                        "one point has {} entries, and another has {}: the file is damaged",
                        points[0].len(),
                        other.len()
                    ));
                }
                Self::Points(points.into_iter().map(DVector::from_vec).collect())
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::PlantModel;

    #[test]
    fn a_written_belief_reads_back_the_same() {
        let gaussian = Gaussian {
            mean: DVector::from_vec(vec![1.0, 0.1]),
            covariance: DMatrix::from_row_slice(2, 2, &[2.0, 0.3, 0.3, 1.0 / 3.0]),
        };
        let points = vec![DVector::from_vec(vec![0.1, 2.0]), DVector::from_vec(vec![1e-300, 7.0])];
        for belief in
            [RivalBelief::Unknown, RivalBelief::Gaussian(gaussian), RivalBelief::Points(points)]
        {
            let text = belief.to_file().unwrap();
            assert_eq!(RivalBelief::of_file(&text).unwrap(), belief);
            // An earlier version wrote beliefs without a checksum.
            let text = serde_json::to_string(&belief).unwrap();
            assert_eq!(RivalBelief::of_file(&text).unwrap(), belief);
        }
    }

    #[test]
    fn a_flipped_digit_of_a_written_belief_is_noticed() {
        let belief = RivalBelief::Points(vec![DVector::from_vec(vec![0.25, 2.0])]);
        let text = belief.to_file().unwrap();
        assert!(text.starts_with(r#"{"points":[[0.25,2.0]],"checksum":""#), "{text}");
        let refused = RivalBelief::of_file(&text.replace("0.25", "0.26")).unwrap_err();
        assert!(refused.contains("checksum"), "{refused}");
    }

    #[test]
    fn a_belief_without_points_or_with_unequal_numbers_of_coordinates_is_refused() {
        for text in [
            r#"{"gaussian":{"mean":[1.0,0.1],"covariance":[2.0,0.3,0.3]}}"#,
            r#"{"gaussian":{"mean":[1.0,0.1],"covariance":[2.0,0.3,0.3,1.0,0.0]}}"#,
            r#"{"gaussian":{"mean":[],"covariance":[1.0]}}"#,
            r#"{"points":[[0.1,2.0],[0.1]]}"#,
            r#"{"points":[]}"#,
        ] {
            let refused = serde_json::from_str::<RivalBelief>(text).unwrap_err().to_string();
            assert!(refused.contains("the file is damaged"), "{refused}");
        }
        let space = Space::of_unknown(&PlantModel::QUBE);
        let own = RivalBelief::Points(vec![DVector::zeros(space.dimensions())]);
        assert_eq!(own.clone().within(&space), Ok(own));
        let longer = RivalBelief::Points(vec![DVector::zeros(space.dimensions() + 1)]);
        assert!(longer.within(&space).unwrap_err().contains("the file is damaged"));
    }
}
