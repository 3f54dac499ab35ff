use crate::storage::checksum_of;

/// The last line of a TOML file: a comment with a checksum of the lines above it. The checksum
/// reveals a changed file before it changes a result. A file without the line, which an earlier
/// version wrote, counts as unchanged.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seal(
    /// The line up to the checksum.
    &'static str,
);

impl Seal {
    /// The seal of an `experiment.toml`.
    pub const EXPERIMENT: Self = Self("# checksum of the lines above, as this experiment began: ");

    /// The seal of a stored fit.
    pub const FIT: Self = Self("# checksum of the lines above, as the fit gave them: ");

    /// The text with the checksum below it.
    pub fn sealed(self, text: &str) -> String {
        format!("{text}{}{}\n", self.0, checksum_of(text.as_bytes()))
    }

    /// Returns whether the lines above the checksum are unchanged and no line follows it.
    pub fn is_unchanged(self, text: &str) -> bool {
        text.rsplit_once(self.0)
            .is_none_or(|(above, checksum)| checksum_of(above.as_bytes()) == checksum.trim_end())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_above_or_below_the_checksum_is_noticed() {
        for seal in [Seal::EXPERIMENT, Seal::FIT] {
            let whole = seal.sealed("seed = 1\n");
            assert!(seal.is_unchanged(&whole) && seal.is_unchanged("seed = 1\n"));
            assert!(!seal.is_unchanged(&whole.replace("seed = 1", "seed = 2")));
            assert!(!seal.is_unchanged(&format!("{whole}policies = 3\n")));
        }
    }
}
