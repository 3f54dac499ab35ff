//! The last line of an `experiment.toml`: a checksum of the lines above it. The checksum reveals a
//! changed setting before it mixes the results of two experiments.

use crate::storage::checksum_of;

const MARK: &str = "# checksum of the lines above, as this experiment began: ";

/// The settings with the checksum below them.
pub(super) fn sealed(settings: &str) -> String {
    format!("{settings}{MARK}{}\n", checksum_of(settings.as_bytes()))
}

/// Returns whether the lines above the checksum are unchanged and no line follows it. A file
/// without a checksum, which an early version wrote, passes.
pub(super) fn is_unchanged(text: &str) -> bool {
    text.rsplit_once(MARK)
        .is_none_or(|(settings, checksum)| checksum_of(settings.as_bytes()) == checksum.trim_end())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_above_or_below_the_checksum_is_noticed() {
        let whole = sealed("seed = 1\n");
        assert!(is_unchanged(&whole) && is_unchanged("seed = 1\n"));
        assert!(!is_unchanged(&whole.replace("seed = 1", "seed = 2")));
        assert!(!is_unchanged(&format!("{whole}policies = 3\n")));
    }
}
