//! The range of an encoder's count, also where the count passes its largest value.

/// Range of some counts, relative to the first count.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct CountRange {
    /// The first count, or the one that begins the range anew.
    pub(super) origin: i32,
    lowest: i32,
    highest: i32,
}

impl CountRange {
    pub(super) fn at(counts: i32) -> Self {
        Self { origin: counts, lowest: 0, highest: 0 }
    }

    pub(super) fn with(self, counts: i32) -> Self {
        let off = counts.wrapping_sub(self.origin);
        Self { lowest: self.lowest.min(off), highest: self.highest.max(off), ..self }
    }

    pub(super) fn width(self) -> i32 {
        self.highest.saturating_sub(self.lowest)
    }

    pub(super) fn middle(self) -> i32 {
        self.origin.wrapping_add(self.lowest + self.width() / 2)
    }
}
