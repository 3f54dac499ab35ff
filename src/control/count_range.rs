//! The range of an encoder's count, also where the count wraps at its largest value.

/// Range of some counts, relative to the first count.
#[derive(Clone, Copy, Debug, Default)]
pub struct CountRange {
    /// The first count of the range.
    pub(super) origin: i32,
    lowest: i32,
    highest: i32,
}

impl CountRange {
    /// The range of this count alone.
    #[must_use]
    pub fn at(counts: i32) -> Self {
        Self { origin: counts, lowest: 0, highest: 0 }
    }

    /// The range with this count too.
    #[must_use]
    pub fn with(self, counts: i32) -> Self {
        let offset = counts.wrapping_sub(self.origin);
        Self { lowest: self.lowest.min(offset), highest: self.highest.max(offset), ..self }
    }

    /// The largest count minus the smallest.
    #[must_use]
    pub fn width(self) -> i32 {
        self.highest.saturating_sub(self.lowest)
    }

    /// Difference between the middles of this range and an earlier one, counts.
    #[must_use]
    pub fn shift_from(self, earlier: Self) -> f64 {
        let middle = |range: Self| 0.5 * (f64::from(range.lowest) + f64::from(range.highest));
        f64::from(self.origin.wrapping_sub(earlier.origin)) + middle(self) - middle(earlier)
    }

    pub(super) fn middle(self) -> i32 {
        self.origin.wrapping_add(self.lowest + self.width() / 2)
    }
}
