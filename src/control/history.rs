//! The last values of a watch that looks back over some control periods.

/// Interval between samples that counts as a hole, us; a watch drops the samples before a hole.
pub(super) const HOLE_US: u64 = 15_000;

/// The last `N` values, in a ring that allocates nothing.
#[derive(Clone, Copy, Debug)]
pub(super) struct History<T, const N: usize> {
    ring: [T; N],
    newest: usize,
    len: usize,
}

impl<T: Copy + Default, const N: usize> Default for History<T, N> {
    /// A history without values.
    fn default() -> Self {
        Self { ring: [T::default(); N], newest: 0, len: 0 }
    }
}

impl<T, const N: usize> History<T, N> {
    /// Adds the newest value; the oldest one is dropped if there are `N` values.
    pub fn push(&mut self, value: T) {
        self.newest = (self.newest + 1) % N;
        self.len = (self.len + 1).min(N);
        self.ring[self.newest] = value;
    }

    /// The value that was the newest one `ticks` ticks ago, where `ticks` is at most `N`; the
    /// default value if there were fewer values.
    pub fn back(&self, ticks: usize) -> &T {
        &self.ring[(self.newest + N - ticks) % N]
    }

    /// Number of values, at most `N`.
    pub fn len(&self) -> usize {
        self.len
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_values_are_kept_newest_first() {
        let mut history = History::<u32, 3>::default();
        assert_eq!((history.len(), *history.back(0)), (0, 0));
        for value in 1..=5 {
            history.push(value);
        }
        assert_eq!(history.len(), 3);
        assert_eq!([0, 1, 2].map(|ticks| *history.back(ticks)), [5, 4, 3]);
    }
}
