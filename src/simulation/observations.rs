use std::slice::ChunksExact;

/// A view of feature-major observations, `[observation_size][lanes]`, as
/// [`super::Pendulums::observe`] writes them, that reads them lane by lane.
#[derive(Clone, Debug)]
pub struct Observations<'a> {
    /// Each feature of all lanes.
    features: ChunksExact<'a, f32>,
}

impl<'a> Observations<'a> {
    /// A view of the observations of this many lanes.
    #[must_use]
    pub fn new(observations: &'a [f32], lanes: usize) -> Self {
        // Without lanes there are no values, in chunks of any length.
        Self { features: observations.chunks_exact(lanes.max(1)) }
    }

    /// The features of a lane, in order.
    ///
    /// # Panics
    /// Panics if the lane does not exist.
    #[inline]
    pub fn of_lane(&self, lane: usize) -> impl ExactSizeIterator<Item = f32> + use<'a> {
        self.features.clone().map(move |of_lanes| of_lanes[lane])
    }

    /// Copies the features of a lane to `row`, as many as both have.
    ///
    /// # Panics
    /// Panics if the lane does not exist.
    #[inline]
    pub fn copy_lane(&self, lane: usize, row: &mut [f32]) {
        for (entry, feature) in row.iter_mut().zip(self.of_lane(lane)) {
            *entry = feature;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lane_has_its_entry_of_each_feature() {
        let values = [1.0, 2.0, 3.0, 10.0, 20.0, 30.0];
        let observations = Observations::new(&values, 3);
        assert!(observations.of_lane(1).eq([2.0, 20.0]));
        let mut row = [0.0; 3];
        observations.copy_lane(2, &mut row);
        assert_eq!(row, [3.0, 30.0, 0.0]);
        observations.copy_lane(0, &mut row[..1]);
        assert_eq!(row, [1.0, 30.0, 0.0]);
        assert_eq!(Observations::new(&[], 0).of_lane(0).len(), 0);
    }
}
